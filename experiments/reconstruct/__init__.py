"""Shape from touch: what one press met, and the surface of an object from many."""
