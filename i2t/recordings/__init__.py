"""Recordings of presses: where presses are in a log, and what a recording states wrongly."""
