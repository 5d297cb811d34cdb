"""Socially cohesive driving in SUMO."""
