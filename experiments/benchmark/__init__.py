"""Speeds, each as a ratio to a named peer in the same run: `contests` times a pair, and each other module has pairs."""
