"""Number of touches that policies need to recognise objects."""
