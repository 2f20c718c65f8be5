"""World of the experiment: libraries of the three parts of the split, pads, and presses with their truth."""

from typing import NamedTuple

import jax
import numpy as np

from experiments.reconstruct_patch.arguments import PatchArgs
from experiments.reconstruct_patch.scores import MetSurface
from experiments.reconstruct_patch.shapes import list_shapes
from i2t.batching import map_batches
from i2t.reconstruction.library import library_of, sample_contacts, to_few_sizes
from i2t.reconstruction.local_shape import PatchLibrary
from i2t.reconstruction.press_curves import PressCurve, simulate_press_curve
from i2t.rendering.render import prepare_surface
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors
from i2t.types import Array, Pad

PRESSES_AT_ONCE = 16


class Part(NamedTuple):
    """One part of the split."""

    library: PatchLibrary
    heights: Array  # (n, g, g) m, over the cells of the simulated contact; empty where nothing is pressed
    named: Array  # (n,) whether each contact is with an object of the catalogue


def make_parts(key: Array, args: PatchArgs) -> dict[str, Part]:
    """Shapes of each part, met at random safe sites."""
    sizes = args.sizes
    counts = {"train": sizes.patches, "validation": sizes.validation, "test": sizes.test}
    shapes = {part: list_shapes(part, sizes.shapes, args.meshes) for part in counts}
    sized = iter(to_few_sizes([prepare_surface(mesh) for some in shapes.values() for mesh in some.meshes]))
    parts = {}
    for number, (part, count) in enumerate(counts.items()):
        surfaces = [next(sized) for _ in shapes[part].meshes]
        contacts, objects = sample_contacts(jax.random.fold_in(key, number), surfaces, count)
        heights = contacts.height[: 0 if part == "train" else None]
        parts[part] = Part(library_of(contacts, objects), heights, objects < shapes[part].named)
    return parts


@jax.jit
def press_all(keys: Array, pad: Pad, heights: Array) -> PressCurve:
    """Press a pad onto every surface, with two stops."""

    def one(each: tuple[Array, Array]) -> PressCurve:
        return simulate_press_curve(each[0], pad, each[1], errors=SimulationErrors(), limits=PressLimits())

    return map_batches(one, (keys, heights), batch_size=PRESSES_AT_ONCE)


def truth_of(part: Part, presses: PressCurve) -> MetSurface:
    """Surfaces that presses of a part met, at their last stop."""
    library = part.library
    return MetSurface(
        patch=np.asarray(library.patch, np.float32),
        contact=np.asarray(presses.contact[:, -1]),
        centre=np.asarray(presses.centre[:, -1]),
        edge=library.edge,
        kind=library.kind,
    )
