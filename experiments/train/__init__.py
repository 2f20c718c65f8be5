"""The main experiment: predictors of readings on objects not seen in training."""
