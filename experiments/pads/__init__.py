"""Presses located on simulated pads that were never seen."""
