"""Batches: many runs of a grid, isolated, resumable, here or on a cluster; and their statistics."""
