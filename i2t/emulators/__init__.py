"""Emulated and simulated devices, with which everything can be tried without hardware."""
