"""Report on the quality of a recording of a skin."""
