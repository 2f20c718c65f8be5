"""Speed of i2t relative to named peers: `contests` times pairs, and the other modules define them."""
