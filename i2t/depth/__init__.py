"""Depth patches from real depth images."""
