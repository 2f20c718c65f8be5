"""Stand-ins for devices, so that everything can be rehearsed without them."""
