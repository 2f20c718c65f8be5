"""A small library without a renderer: patches of closed form, and readings that are linear in them."""

import jax.numpy as jnp
import numpy as np
import pytest

from i2t.patches.dimensions import REACH
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PressModel

LOADS = (0.3, 1.0, 3.0)
CHANNELS = 6


@pytest.fixture(scope="session")
def patches() -> np.ndarray:
    """(24, 48, 48) m: planes that tilt in 24 directions."""
    at = np.linspace(-1, 1, 48)
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    planes = np.stack([np.cos(a) * at[None, :] + np.sin(a) * at[:, None] for a in angles])
    return np.clip(1e-3 * (planes - planes.min((1, 2), keepdims=True)), 0, REACH)


@pytest.fixture(scope="session")
def library(patches) -> PatchLibrary:
    """Library of those planes, each pressed at its nearest point."""
    count, loads = len(patches), np.asarray(LOADS, np.float32)
    rng = np.random.default_rng(0)
    corner = np.stack([np.unravel_index(patch.argmin(), patch.shape) for patch in patches])
    newtons = np.zeros((count, len(loads), 20, 20), np.float32)
    for i, (row, column) in enumerate(corner * 20 // 48):
        newtons[i, :, row, column] = loads
    centre = np.repeat((corner[:, None, ::-1] / 47 - 0.5) * 17e-3, len(loads), axis=1)
    return PatchLibrary(
        patch=jnp.asarray(patches, jnp.float16),
        height=jnp.asarray(patches[:, ::2, ::2][:, :20, :20], jnp.float32),
        object=jnp.arange(count),
        loads=jnp.asarray(loads),
        newtons=jnp.asarray(newtons.reshape(count, len(loads), 400), jnp.float16),
        indentation=jnp.asarray(1e-4 * rng.uniform(1, 2, (count, 1)) * loads**0.6, jnp.float32),
        centre=jnp.asarray(centre, jnp.float32),
    )


@pytest.fixture(scope="session")
def model(library) -> PressModel:
    """Model of a pad of two chips, whose readings are proportional to the load."""
    rng = np.random.default_rng(1)
    loads, count = np.asarray(LOADS, np.float32), len(library.patch)
    per_newton = rng.normal(0, 20, (CHANNELS, count))
    sliding = rng.normal(0, 100, (2, CHANNELS, count))
    return PressModel(
        loads=jnp.asarray(loads),
        reading=jnp.asarray(loads[:, None, None] * per_newton, jnp.float32),
        sliding=jnp.asarray(loads[:, None, None, None] * sliding, jnp.float32),
        travel=jnp.asarray(np.asarray(library.indentation).T + loads[:, None] / 10e3, jnp.float32),
        axes=jnp.eye(CHANNELS),
        noise=jnp.full(CHANNELS, 4.0),
        likelihood=PatchLikelihood(relative_error=0.02, prior_share=0.0),
    )
