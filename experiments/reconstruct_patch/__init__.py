"""From one press to the local surface: how well, and how honestly."""
