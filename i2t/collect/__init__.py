"""Collection of touches: one procedure for real, emulated and simulated devices. Each touch is on disk before it is
acknowledged.
"""
