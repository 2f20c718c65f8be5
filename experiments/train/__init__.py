"""The main experiment: which predictor foretells readings on objects it has not seen."""
