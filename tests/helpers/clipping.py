"""Heights of a mesh inside a square by cutting it in float64, an oracle of first contact and of sites."""

import jax.numpy as jnp
import numpy as np
import trimesh

from i2t.geometry import transform
from i2t.objects import make_object, transform_mesh
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import PAD_WINDOW
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.types import Surface

# Coordinates stay below half a metre, where one step of float32 is 3e-8 m. A pose, its inverse and the map of a corner
# take some ten roundings, so every place is wrong by up to this length.
DELTA = 3e-7
HALF = PAD_WINDOW / 2
DOWN = np.diag([1.0, -1.0, -1.0])  # the tool looks straight down
BELOW = jnp.array([0.0, 0.0, -1.0])


def pose(rotation, position) -> jnp.ndarray:
    """A pose in float32."""
    return jnp.asarray(transform(np.asarray(rotation, float), np.asarray(position, float)), jnp.float32)


def turned(thing: Mesh, rotation, position=(0.0, 0.0, 0.0)) -> Mesh:
    """A mesh turned, then moved."""
    return transform_mesh(thing, transform(rotation.as_matrix(), np.array(position)))


def of_hammer_s_size(thing: Mesh) -> Surface:
    """A mesh in the hammer's size class, so that one compilation serves both."""
    return Surface(stack_surfaces([prepare_surface(thing), prepare_surface(make_object("hammer").mesh)]).triangles[0])


def clipped_nearest(thing: Mesh, T_w_t, half: float, behind: float) -> float:
    """Smallest z inside the square prism, found in float64 by cutting the mesh with the planes of the square prism."""
    moved = transform_mesh(thing, np.linalg.inv(np.asarray(T_w_t, np.float64)))
    cut = trimesh.Trimesh(moved.vertices, moved.faces, process=False)
    for normal in ([1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]):
        cut = cut.slice_plane(-(behind if normal[2] else half) * np.array(normal), normal, cap=False)
        if not len(cut.faces):
            return np.inf
    return cut.triangles.reshape(-1, 3)[:, 2].min()


def bracketed(value: float, reference, half: float, error: float = DELTA) -> bool:
    """Whether `value` lies between reference(half + error) and reference(half - error), within `error`."""
    return bool(reference(half + error) - error <= value <= reference(half - error) + error)
