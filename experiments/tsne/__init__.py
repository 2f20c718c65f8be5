"""Agreement of views and readings of touches."""
