"""The imperative layer: devices that produce readings, poses and images. It imports no JAX."""
