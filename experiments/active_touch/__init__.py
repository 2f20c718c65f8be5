"""Speed of touching policies in telling objects apart."""
