"""Real depth images to the same depth patches."""
