"""Comparison of patches from real depth images with rendered patches."""
