"""Depth patches: their size, and what surrounds them."""
