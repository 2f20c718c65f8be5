"""Where an object is, and what a real camera sees of it."""
