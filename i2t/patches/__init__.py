"""Depth patches: their size and their surroundings."""
