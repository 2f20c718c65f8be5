"""From what is seen, and a force, to what the skin will report: predictors, their training and their scores."""
