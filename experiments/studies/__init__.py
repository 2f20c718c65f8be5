"""Studies of recognition by touch; see `python -m experiments.studies --help`."""
