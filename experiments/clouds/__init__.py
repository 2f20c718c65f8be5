"""Comparison of a mesh's patches with those of a point cloud that was sampled from it."""
