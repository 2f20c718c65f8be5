"""Contacts: where a press ends, and the pressure on the skin from a view, a mesh or a tip."""
