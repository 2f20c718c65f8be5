"""Faults on purpose: `table` says what a fault is, and each other module tries one kind of them."""
