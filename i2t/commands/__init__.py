"""Commands of the program `i2t` that fit models to a data set and recognise objects with them."""
