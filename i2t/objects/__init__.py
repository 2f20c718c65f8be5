"""What is touched: procedural solids, meshes and point clouds from files. Imports no JAX."""

from i2t.objects.catalogue import (
    NAMES,
    PRIMITIVES,
    STAMPS,
    TOOLS,
    make_object,
    random_object,
    surrogate_unknown,
)
from i2t.objects.mesh_files import CleaningReport, clean_mesh, load_mesh, read_mesh
from i2t.objects.point_clouds import load_point_cloud, suggest_radius, surface_from_points
from i2t.objects.poses import contact_pose
from i2t.objects.solids import Mesh, Object, place_on_table, transform_mesh

__all__ = [
    "NAMES",
    "PRIMITIVES",
    "STAMPS",
    "TOOLS",
    "CleaningReport",
    "Mesh",
    "Object",
    "clean_mesh",
    "contact_pose",
    "load_mesh",
    "load_point_cloud",
    "make_object",
    "place_on_table",
    "random_object",
    "read_mesh",
    "suggest_radius",
    "surface_from_points",
    "surrogate_unknown",
    "transform_mesh",
]
