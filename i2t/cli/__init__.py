"""Command lines: options and exit codes."""
