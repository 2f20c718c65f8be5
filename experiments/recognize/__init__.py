"""Recognition of objects: the paper's rules against a calibrated belief."""
