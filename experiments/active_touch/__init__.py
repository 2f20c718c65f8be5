"""Speed of touching policies in telling objects apart, on pads that no policy was trained on."""
