"""Shape from touch: the patch below one press, and the surface of an object from many presses."""
