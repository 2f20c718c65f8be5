"""How many presses of a skin predict all others."""
