"""What a real camera sees of an object, next to what is imagined."""
