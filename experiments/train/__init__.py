"""The main experiment: prediction of readings on objects that were not used for training."""
