"""Collecting touches: one procedure for real, emulated and simulated devices; each touch is on disk before it is
acknowledged."""
