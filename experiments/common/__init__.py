"""Code that experiments share: run folders."""
