"""How near to a mesh's patches are those of a point cloud that was sampled from it?"""
