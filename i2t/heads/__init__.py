"""Heads: position, travel, force and shear of a tip from the readings of one skin."""
