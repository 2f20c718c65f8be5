"""Tests of estimates of what a recording does not say."""
