"""The sections of `experiments.faults`: each does one kind of harm, many times, and counts what came of it."""
