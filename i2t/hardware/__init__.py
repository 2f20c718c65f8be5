"""Devices that produce readings, poses and images: the imperative layer, which imports no JAX."""
