"""Files: reading what somebody else made, within bounds, and writing what is there whole or not at all."""
