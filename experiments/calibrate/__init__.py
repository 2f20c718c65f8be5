"""The number of presses that suffice to calibrate a skin."""
