"""Where an object or a tool is, from one depth patch, from touches or from a depth image."""
