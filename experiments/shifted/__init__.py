"""Whether calibration loses to a baseline on shifted and damaged recordings."""
