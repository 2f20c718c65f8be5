"""Emulated and simulated devices, so that everything can be tried without hardware."""
