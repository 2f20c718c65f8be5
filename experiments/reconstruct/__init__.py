"""Which shape is it? An unknown object's surface from a few touches."""
