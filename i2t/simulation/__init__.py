"""Simulated touches: sites, presses and batches of touches with the errors of camera, arm and skin."""
