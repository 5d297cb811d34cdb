"""Perception: what the ego sees now, and what it has seen."""
