"""Agreement between views and readings of touches."""
