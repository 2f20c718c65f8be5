"""Shapes split by object, and presses of simulated skins onto them."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.reconstruct.arguments import PatchSizes
from experiments.reconstruct.fitted_pad import fit_pad, press_all
from i2t.objects import Mesh, catalogue, primitives
from i2t.objects.drawing import disk, outline, rectangle
from i2t.reconstruction.library import library_from_contacts, pad_to_size_classes, sample_contacts
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PressModel
from i2t.reconstruction.press_models import predict_presses
from i2t.rendering.render import prepare_surface
from i2t.runtime.progress import progress
from i2t.simulation.press_curves import PressCurve
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import pad_from_seed
from i2t.types import Array

FIRST_SHAPE_SEED = {"train": 0, "validation": 1_000_000, "test": 2_000_000}  # disjoint ranges


class Part(NamedTuple):
    """One part of the split: "train", "validation" or "test"."""

    library: PatchLibrary
    heights: Array  # (n, g, g) m, over the cells of the simulated contact; empty where nothing is pressed


class MetSurface(NamedTuple):
    """The surface below a press; one touch, or many on axis 0."""

    patch: Array  # (p, p) m
    contact: Array  # (cells,) bool, at the last stop
    centre: Array  # (2,) m, of pressure at the last stop


class Trial(NamedTuple):
    """Presses of one part with one pad, and the readings predicted for the pad at the library."""

    model: PressModel
    fitted: PressModel  # of the pad fitted to presses of a ball
    presses: PressCurve
    truth: MetSurface

    def with_likelihood(self, likelihood: PatchLikelihood) -> "Trial":
        """Copy with other constants of the likelihood."""
        model, fitted = (press_model._replace(likelihood=likelihood) for press_model in (self.model, self.fitted))
        return self._replace(model=model, fitted=fitted)

    def with_fitted_pad(self) -> "Trial":
        """Copy that infers with the fitted pad instead of the true one."""
        return self._replace(model=self.fitted)


def make_parts(key: Array, sizes: PatchSizes) -> dict[str, Part]:
    """Sample contacts at random safe sites of the shapes of each part."""
    counts = {"train": sizes.patches, "validation": sizes.validation, "test": sizes.test}
    meshes = {part: list_shapes(part, sizes.shapes) for part in counts}
    sized = iter(pad_to_size_classes([prepare_surface(mesh) for some in meshes.values() for mesh in some]))
    parts = {}
    for number, (part, count) in enumerate(counts.items()):
        surfaces = [next(sized) for _ in meshes[part]]
        contacts, objects = sample_contacts(jax.random.fold_in(key, number), surfaces, count)
        parts[part] = Part(library_from_contacts(contacts, objects), contacts.height[: 0 if part == "train" else None])
    return parts


def list_shapes(part: str, drawn: int) -> list[Mesh]:
    """List the catalogue's shapes of a part, then random ones: `drawn` for training, a fifth for each other part."""
    count = drawn if part == "train" else max(drawn // 5, 1)
    return [catalogue.make_object(name).mesh for name in list_names(part)] + [
        draw_shape(FIRST_SHAPE_SEED[part] + i) for i in range(count)
    ]


def list_names(part: str) -> list[str]:
    """Names of the catalogue's shapes of a part; a quarter is for test, an eighth for validation, from every family."""
    parts = ["test" if i % 4 == 2 else "validation" if i % 8 == 5 else "train" for i in range(len(catalogue.NAMES))]
    return [name for name, own in zip(catalogue.NAMES, parts, strict=True) if own == part]


def draw_shape(seed: int) -> Mesh:
    """Draw a random primitive of stamp to hand size, or a stamp of up to three overlapping outlines."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:
        mesh = catalogue.random_object(int(rng.integers(2**31))).mesh
        return Mesh(mesh.vertices * 0.25 ** rng.random(), mesh.faces)
    region = None
    for _ in range(rng.integers(1, 4)):
        size, turn = rng.uniform(2.0, 12.0, 2), rng.uniform(0, 180)
        kind = rng.integers(3)
        if kind == 0:
            part = rectangle(size[0], min(size[1], 5.0))
        elif kind == 1:
            part = disk(size[0] / 2)
        else:
            part = outline([(-size[0] / 2, -size[1] / 3), (size[0] / 2, -size[1] / 3), (0, 2 * size[1] / 3)])
        part = part.rotate(turn).translate(rng.uniform(-3, 3, 2))
        region = part if region is None else region + part
    return primitives.stamp(region)


def press_parts(
    key: Array, parts: dict[str, Part], library: PatchLibrary, sizes: PatchSizes, errors: SimulationErrors
) -> dict[str, list[Trial]]:
    """Press every validation and test contact with every pad, and predict the readings of true and fitted pads at the
    library.
    """
    trials: dict[str, list[Trial]] = {"validation": [], "test": []}
    for number in progress(range(sizes.pads), desc="pressing", unit="pads"):
        pad = pad_from_seed(number)
        key_fit = jax.random.fold_in(jax.random.fold_in(key, 1_000_000), number)
        fitted_pad = fit_pad(key_fit, pad, errors, sizes.fit_presses)
        model, fitted = (predict_presses(used_pad, library) for used_pad in (pad, fitted_pad))
        for which, (name, some) in enumerate(trials.items()):
            heights, patch = jnp.asarray(parts[name].heights), np.asarray(parts[name].library.patch, np.float32)
            keys = jax.random.split(jax.random.fold_in(key, 2 * number + which), len(heights))
            presses = jax.device_get(press_all(keys, pad, heights, errors))
            truth = MetSurface(patch, np.asarray(presses.contact[:, -1]), np.asarray(presses.centre[:, -1]))
            some.append(Trial(model, fitted, presses, truth))
    return trials
