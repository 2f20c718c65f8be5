"""Shapes that presses meet, split by object, and the presses of simulated skins into them."""

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

SMALLEST_SCALE = 0.25  # of the size of a drawn object: from a stamp's to a hand's
FIRST_SEED = {"train": 0, "validation": 1_000_000, "test": 2_000_000}  # of drawn shapes
FIT_KEY = 1_000_000  # what the presses' key is folded with, beyond those of parts
HELD_OUT_PART = 5  # as many drawn shapes to train on as there are to test, and to validate


class Part(NamedTuple):
    """One part of the split: "train", "validation" or "test"."""

    library: PatchLibrary
    heights: Array  # (n, g, g) m, over the cells of the simulated contact; empty where nothing is pressed


class MetSurface(NamedTuple):
    """The surface that a press met; one touch, or many on axis 0."""

    patch: Array  # (p, p) m
    contact: Array  # (cells,) at the last stop
    centre: Array  # (2,) m, of pressure there


class Trial(NamedTuple):
    """Presses of one part with one pad, and what that pad reads at the library."""

    model: PressModel
    fitted: PressModel  # of the pad as far as it is known from presses of a ball
    presses: PressCurve
    truth: MetSurface

    def with_likelihood(self, likelihood: PatchLikelihood) -> "Trial":
        """The same with other constants of the pad's models."""
        model, fitted = (each._replace(likelihood=likelihood) for each in (self.model, self.fitted))
        return self._replace(model=model, fitted=fitted)

    def with_fitted_pad(self) -> "Trial":
        """The same for who knows the fitted pad in place of the true one."""
        return self._replace(model=self.fitted)


def make_parts(key: Array, sizes: PatchSizes) -> dict[str, Part]:
    """Shapes of each part, met at random safe sites."""
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
    """The catalogue's shapes of a part, a quarter to test and an eighth to validate with every family in each, and
    drawn ones, of which `drawn` are to train on.
    """
    count = drawn if part == "train" else max(drawn // HELD_OUT_PART, 1)
    return [catalogue.make_object(name).mesh for name in list_names(part)] + [
        draw_shape(FIRST_SEED[part] + i) for i in range(count)
    ]


def list_names(part: str) -> list[str]:
    """Names of the catalogue's shapes of a part, which are the first of `list_shapes`."""
    parts = ["test" if i % 4 == 2 else "validation" if i % 8 == 5 else "train" for i in range(len(catalogue.NAMES))]
    return [name for name, own in zip(catalogue.NAMES, parts, strict=True) if own == part]


def draw_shape(seed: int) -> Mesh:
    """A random primitive of any size from a stamp's to a hand's, or a stamp with up to three strokes."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:
        mesh = catalogue.random_object(int(rng.integers(2**31))).mesh
        return Mesh(mesh.vertices * SMALLEST_SCALE ** rng.random(), mesh.faces)
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
    """Every contact of validation and test, pressed with every pad; and every pad, true and fitted, imagined at the
    library.
    """
    trials: dict[str, list[Trial]] = {"validation": [], "test": []}
    for number in progress(range(sizes.pads), desc="pads"):
        pad = pad_from_seed(number)
        key_fit = jax.random.fold_in(jax.random.fold_in(key, FIT_KEY), number)
        fitted_pad = fit_pad(key_fit, pad, errors, sizes.fit_presses)
        model, fitted = (predict_presses(known, library) for known in (pad, fitted_pad))
        for which, (name, some) in enumerate(trials.items()):
            heights, patch = jnp.asarray(parts[name].heights), np.asarray(parts[name].library.patch, np.float32)
            keys = jax.random.split(jax.random.fold_in(key, 2 * number + which), len(heights))
            presses = jax.device_get(press_all(keys, pad, heights, errors))
            truth = MetSurface(patch, np.asarray(presses.contact[:, -1]), np.asarray(presses.centre[:, -1]))
            some.append(Trial(model, fitted, presses, truth))
    return trials
