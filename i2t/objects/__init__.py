"""What is touched: procedural solids, meshes and point clouds from files."""
