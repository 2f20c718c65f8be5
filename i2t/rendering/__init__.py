"""Meshes to depth patches: exact orthographic depth along the tool axis, with derivatives."""
