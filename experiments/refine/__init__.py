"""How far one depth patch corrects a pose."""
