"""Objects over which rigs are tried: some of the catalogue, and others that are thin, small, tall or hollow."""

from functools import lru_cache

import numpy as np
import trimesh
from trimesh.creation import annulus, box, cylinder, icosphere, torus

from i2t.objects.catalogue import make_object
from i2t.objects.solids import Mesh

STRETCHED = {"tall star": ("star", (0.5, 0.5, 2.2)), "tall cylinder": ("cylinder", (0.4, 0.4, 2.5))}
SHINY = "shiny square"  # whose depth has holes
RIG_OBJECTS = (
    "star", "hammer", "screwdriver", "hexagon", "dome", "cone", "wall", "plate", "ball", "cube", "rod", "mug", SHINY,
)  # fmt: skip


@lru_cache
def rig_object(name: str) -> Mesh:
    """An object on the table of its own frame.

    Args:
        name: Name in the catalogue, or of another object.

    Returns:
        The mesh, m.
    """
    made = _made(name)
    if made is not None:
        made.apply_translation([0.0, 0.0, -made.bounds[0, 2]])
        return Mesh(np.array(made.vertices), np.array(made.faces))
    of, scale = STRETCHED.get(name, (name.removeprefix("shiny "), (1.0, 1.0, 1.0)))
    mesh = make_object(of).mesh
    return Mesh(mesh.vertices * np.array(scale), mesh.faces)


def _made(name: str) -> trimesh.Trimesh | None:
    match name:
        case "wall":
            return box((50e-3, 3e-3, 60e-3))
        case "plate":
            return box((60e-3, 40e-3, 2e-3))
        case "ball":
            return icosphere(subdivisions=3, radius=5e-3)
        case "cube":
            return box((10e-3, 10e-3, 10e-3))
        case "rod":
            return cylinder(radius=7.5e-3, height=120e-3, sections=48)
        case "mug":
            handle = torus(20e-3, 4e-3, major_sections=32, minor_sections=12)
            handle.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0], [0, 0, 0]))
            handle.apply_translation([44e-3, 0.0, 0.0])
            walls, bottom = annulus(36e-3, 40e-3, 90e-3, sections=48), cylinder(37e-3, 4e-3, sections=48)
            bottom.apply_translation([0.0, 0.0, -43e-3])
            return walls + bottom + handle
    return None
