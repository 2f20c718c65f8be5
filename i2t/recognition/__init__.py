"""Recognition of objects: predicted touches, the belief over objects and poses, and the next touch."""
