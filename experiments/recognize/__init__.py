"""Which object is it: the paper's rules against a calibrated belief."""
