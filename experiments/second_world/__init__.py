"""A world of other physics, in the layout of the authors' recordings."""
