"""Correction of a pose by one depth patch."""
