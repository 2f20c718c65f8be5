"""Number of presses of a skin that predict all others."""
