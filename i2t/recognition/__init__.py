"""Which object is touched: predicted touches, the belief over objects and poses, and the next touch."""
