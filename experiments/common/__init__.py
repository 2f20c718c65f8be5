"""Code that experiments share: commands, options, run folders, tasks and tables."""
