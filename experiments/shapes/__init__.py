"""Classification of five stamps by touch."""
