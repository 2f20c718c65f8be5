"""Objects that are touched, and the simulated arm and skin that touch them."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.reconstruct.arguments import ReconstructSizes
from i2t.objects.catalogue import random_object
from i2t.objects.solids import Object
from i2t.reconstruction.library import ContactSampling, build_library
from i2t.reconstruction.local_shape import PatchLibrary, PressModel, infer_patch
from i2t.reconstruction.press_models import imagine_presses
from i2t.reconstruction.surface import TouchEvidence, contact_evidence, posterior_evidence
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors, sample_session_errors, simulate_touch
from i2t.skin.noise import add_sensor_noise
from i2t.skin.pad import numbered_pad
from i2t.types import Pad, ReturnCode, Surface

APPROACH_M, EXPLORING_OVERTRAVEL_M = 0.1, 10e-3  # straight way before a site, and beyond it
PATCH_SHAPES = 40  # of which the library of local surfaces is made
PATCH_TILT_RAD = (0.0, 0.35)  # an estimated surface lies up to so far from the true one
ERRORS = SimulationErrors()


class ObjectSplit(NamedTuple):
    """Objects, none of which is in two of these."""

    test: list[Object]
    validation: list[Object]
    train: list[Object]


class Reality(NamedTuple):
    """Facts that only the simulation knows, and what each skin is imagined to read."""

    objects: list[Object]
    surfaces: Surface  # stacked
    pads: list[Pad]
    models: list[PressModel]  # of the pads
    library: PatchLibrary


def split_objects(sizes: ReconstructSizes, seed: int) -> ObjectSplit:
    """Random objects of the catalogue."""
    first = 100_000 * seed
    ends = np.cumsum([0, sizes.test, sizes.validation, sizes.train])
    return ObjectSplit(*([random_object(first + i) for i in range(low, high)] for low, high in pairwise(ends)))


def make_reality(key: jax.Array, split: ObjectSplit, sizes: ReconstructSizes) -> Reality:
    """The objects of validation and test, and skins of which it is known what they read at patches of known shapes."""
    shapes = [prepare_surface(item.mesh) for item in split.train[:PATCH_SHAPES]]
    library = build_library(key, shapes, sizes.patches, sampling=ContactSampling(tilt=PATCH_TILT_RAD, limits=None))
    pads = [numbered_pad(number) for number in range(sizes.pads)]
    objects = split.validation + split.test
    surfaces = stack_surfaces([prepare_surface(item.mesh) for item in objects])
    return Reality(objects, surfaces, pads, [imagine_presses(pad, library) for pad in pads], library)


@jax.jit
def _touch(key: Any, surface: Surface, site: Any, session: Any, pad: Pad) -> Any:
    key_touch, key_noise = jax.random.split(key)
    limits = PressLimits(approach_distance=APPROACH_M, overtravel=EXPLORING_OVERTRAVEL_M)
    touch = simulate_touch(key_touch, surface, jnp.eye(4), site, session=session, pad=pad, errors=ERRORS, limits=limits)
    return touch._replace(reading=add_sensor_noise(key_noise, touch.reading, pad.board, ERRORS.noise))


_infer = jax.jit(infer_patch, static_argnames=("samples",))


@dataclass
class Session:
    """One object, put down once within the errors of its placement, before one pad."""

    reality: Reality
    number: int  # of the object
    seed: int
    touches: int = 0  # so far

    def __post_init__(self) -> None:
        key = jax.random.fold_in(jax.random.key(self.seed), self.number)
        key_session, self.key_touches, _ = jax.random.split(key, 3)  # one more than is used: the draws of a seed stay
        self.surface = element(self.reality.surfaces, self.number)
        self.errors = sample_session_errors(key_session, ERRORS)

    def touch(self, site: np.ndarray, reading: bool) -> TouchEvidence:
        """Touch a site: where it was met, and what the reading says besides if it is asked."""
        pad = (self.number + self.seed) % len(self.reality.pads)
        key, at = jax.random.fold_in(self.key_touches, self.touches), jnp.asarray(site, jnp.float32)
        self.touches += 1
        touch = jax.device_get(_touch(key, self.surface, at, self.errors, self.reality.pads[pad]))
        T_o_t = np.asarray(touch.T_w_t, np.float64)  # the object is believed at the world's origin
        if int(touch.code) == ReturnCode.AIR:
            return contact_evidence(T_o_t, hit=False, swept=APPROACH_M)
        T_o_t[:3, 3] -= float(touch.depth) * T_o_t[:3, 2]  # back to first contact
        if not reading:
            return contact_evidence(T_o_t, swept=APPROACH_M)
        model, library = self.reality.models[pad], self.reality.library
        found = _infer(touch.reading, touch.force, touch.depth, model=model, library=library)
        return posterior_evidence(T_o_t, np.asarray(found.patch), swept=APPROACH_M)
