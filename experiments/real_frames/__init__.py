"""Comparison of imagined patches with those of real depth cameras."""
