"""Files: reading files of others within bounds, and writing files whole or not at all."""
