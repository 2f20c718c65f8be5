"""Calibration of simulated pads by force."""
