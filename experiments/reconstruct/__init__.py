"""An unknown object's surface from a few touches."""
