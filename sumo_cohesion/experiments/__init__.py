"""Experiments: run the walk many times and keep tables."""
