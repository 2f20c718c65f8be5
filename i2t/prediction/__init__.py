"""Predictors of skin readings from a view and a force, their training and their scores."""
