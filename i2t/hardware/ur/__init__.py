"""A UR arm over RTDE."""
