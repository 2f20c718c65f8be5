"""Contacts between skin and object: first contact, the end of a press, and the pressure on the skin."""
