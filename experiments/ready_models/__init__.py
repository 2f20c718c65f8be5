"""Ready models for the package, from a finished run."""
