"""What the methods are tried on: libraries of the three parts of the split, pads, and presses with their truth."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from experiments.reconstruct_patch.arguments import PatchArgs
from experiments.reconstruct_patch.scores import Truth
from experiments.reconstruct_patch.shapes import list_shapes
from i2t.reconstruction.library import library_of, sample_contacts
from i2t.reconstruction.local_shape import PatchLibrary
from i2t.reconstruction.press_curves import PressCurve, simulate_press_curve
from i2t.rendering.render import prepare_surface, render_heights
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import GRID
from i2t.types import PAD_WINDOW, Pad, Surface

BATCH = 16
UNDER_PADS = GRID.cells  # cells along an edge of the heights that are pressed


class Part(NamedTuple):
    """One part of the split."""

    library: PatchLibrary
    heights: np.ndarray  # (n, g, g) m, over the cells of the simulated contact; empty where nothing is pressed
    named: np.ndarray  # (n,) whether each contact is with an object of the catalogue


def make_part(key: Array, part: str, count: int, args: PatchArgs) -> Part:
    """Shapes of a part, met at random safe sites."""
    shapes = list_shapes(part, args.sizes.shapes, args.meshes)
    surfaces = [prepare_surface(mesh) for mesh in shapes.meshes]
    contacts, objects = sample_contacts(key, surfaces, count)
    heights = np.zeros((0, UNDER_PADS, UNDER_PADS))
    if part != "train":
        heights = np.stack([_heights(surfaces[i], T) for i, T in zip(objects, contacts.T_o_t, strict=True)])
    return Part(library_of(contacts, objects), heights, objects < shapes.named)


@jax.jit
def _heights(surface: Surface, T_o_t: Array) -> Array:
    return render_heights(surface, jax.numpy.linalg.inv(T_o_t), PAD_WINDOW, UNDER_PADS)


@jax.jit
def press_all(keys: Array, pad: Pad, heights: Array) -> PressCurve:
    """Press a pad onto every surface, with two stops."""

    def one(each: tuple[Array, Array]) -> PressCurve:
        return simulate_press_curve(each[0], pad, each[1], errors=SimulationErrors(), limits=PressLimits())

    return jax.lax.map(one, (keys, heights), batch_size=BATCH)


def truth_of(part: Part, presses: PressCurve) -> Truth:
    """What presses of a part met, at their last stop."""
    library = part.library
    return Truth(
        patch=np.asarray(library.patch, np.float32),
        contact=np.asarray(presses.contact[:, -1]),
        centre=np.asarray(presses.centre[:, -1]),
        edge=library.edge,
        kind=library.kind,
    )
