"""Comparison of calibration with baselines on shifted and damaged recordings."""
