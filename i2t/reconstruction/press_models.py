"""Readings of one pad at every patch of a library, by its physics or by a model fitted to its touches.

By physics (`imagine_presses`): the pad's own layer is pressed onto each patch with the library's loads in turn,
friction follows the path of the press (`i2t.skin.friction`), and the field of the moved magnets is what chips read.
Friction without any slide belongs to that: it is a third of a reading. What a slant of the press adds is taken as
linear in it, and differs little between patches of one pressure: it is computed for a few hundred patches, and a ridge
regression on the pressures gives it for all (`SLIDING_PATCHES`; nine tenths of its variance).

By a model (`model_presses`): anything that maps pressures on cells of 1 mm to readings at a few loads, as a pad's
Gaussian process does (`i2t.recognition.outcomes.linear_reading_model`), real pads included. Such a model has friction
in its mean, and no sliding of its own.

Metres, newtons, microtesla.
"""

from functools import partial
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.batching import map_batches
from i2t.reconstruction.library import BATCH, CELL_GRID, pressure_chain
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PressModel
from i2t.skin.dipoles import response
from i2t.skin.friction import Shear, rest, shear
from i2t.skin.noise import Noise
from i2t.types import Board, Pad

STIFFNESS_N_PER_M = 10e3  # of arm and mount in series, as `i2t.simulation.press.PressLimits` has it
LOOSE_FRICTION = 3e-2  # of the largest displacement: 1 % of a reading
FRICTION_STEPS = 15
SLIDING_PATCHES = 256
SLIDING_SLANT = 0.0175  # m/m, at which the effect of a slant is computed: a degree
SLIDING_RIDGE = 0.1  # of the mean square of the pressures


@runtime_checkable
class ReadingModel(Protocol):
    """Pad model that `model_presses` needs."""

    @property
    def loads(self) -> Float[Array, " l"]:
        """Loads (N), ascending."""

    @property
    def mean(self) -> Float[Array, "l cells c"]:
        """Mean reading (uT) per N on each cell of 1 mm."""

    @property
    def softness(self) -> Float[Array, ""]:
        """Indentation of the pad over that of the nominal layer."""


def imagine_presses(
    pad: Pad,
    library: PatchLibrary,
    *,
    likelihood: PatchLikelihood | None = None,
    noise: Noise | None = None,
    stiffness: float = STIFFNESS_N_PER_M,
) -> PressModel:
    """Readings of a pad of known physics at a library's patches: simulated, nominal, or fitted to its presses.

    Args:
        pad: The skin.
        library: The patches.
        likelihood: How far presses differ from what is imagined.
        noise: Of the sensor.
        stiffness: N/m, of arm and mount in series.

    Returns:
        The model, on the default device.

    Example:
        model = imagine_presses(i2t.nominal_pad(), library)
    """
    heights, loads = jnp.asarray(library.height), jnp.asarray(library.loads)
    newtons, indentation, reading = _press_all(pad, heights, loads)
    rows = np.random.default_rng(0).permutation(len(heights))[:SLIDING_PATCHES]
    some = _slide_all(pad, heights[rows], loads)
    sliding = _ridge(newtons[rows] / loads[None, :, None], some / loads[None, :, None, None], newtons)
    travel = indentation + loads[None] / stiffness
    return _press_model(loads, reading, sliding, travel, pad.board, likelihood=likelihood, noise=noise)


def model_presses(
    reading_model: ReadingModel,
    library: PatchLibrary,
    *,
    board: Board,
    likelihood: PatchLikelihood | None = None,
    noise: Noise | None = None,
    stiffness: float = STIFFNESS_N_PER_M,
) -> PressModel:
    """Readings of a pad at a library's patches by a model that was fitted to its touches.

    Args:
        reading_model: From pressures to readings at a few loads.
        library: The patches.
        board: The pad's.
        likelihood: How far presses differ from what is imagined.
        noise: Of the sensor.
        stiffness: N/m, of arm and mount in series.

    Returns:
        The model, on the default device.
    """
    loads = jnp.asarray(library.loads)
    knots = jnp.log(jnp.asarray(reading_model.loads))

    def at(load: Array, newtons: Array) -> Array:
        low = jnp.clip(jnp.searchsorted(knots, jnp.log(load)) - 1, 0, len(knots) - 2)
        step = jnp.clip((jnp.log(load) - knots[low]) / (knots[low + 1] - knots[low]), 0.0, 1.0)
        first, second = jnp.asarray(reading_model.mean)[low], jnp.asarray(reading_model.mean)[low + 1]
        return newtons @ (first + step * (second - first))

    newtons = jnp.moveaxis(jnp.asarray(library.newtons, jnp.float32), 1, 0)
    reading = jnp.moveaxis(jax.vmap(at)(loads, newtons), 0, 1)
    sliding = jnp.zeros((*reading.shape[:2], 2, reading.shape[-1]))
    travel = reading_model.softness * jnp.asarray(library.indentation) + loads[None] / stiffness
    return _press_model(loads, reading, sliding, travel, board, likelihood=likelihood, noise=noise)


def noise_covariance(board: Board, noise: Noise) -> Float[np.ndarray, "c c"]:
    """Covariance of a recorded reading about that of an ideal sensor (`i2t.skin.noise.add_sensor_noise`).

    Args:
        board: Whose chips read it.
        noise: Sizes of the errors.

    Returns:
        uT^2.
    """
    bursts = 1 / noise.contact_samples + 1 / noise.ambient_samples
    own = noise.sigma(board.num_chips) ** 2 * (1 - noise.common) * bursts + noise.steps(board.num_chips) ** 2 / 12
    each_axis = np.diag([noise.xy, noise.xy, noise.z]) * np.sqrt(2 * noise.common)  # in contact, and before it
    seen = np.stack([np.asarray(board.to_board(jnp.tile(axis, (board.num_chips, 1)))) for axis in each_axis], -1)
    return np.diag(own) + seen @ seen.T


def _press_model(
    loads: Array,
    reading: Array,
    sliding: Array,
    travel: Array,
    board: Board,
    *,
    likelihood: PatchLikelihood | None,
    noise: Noise | None,
) -> PressModel:
    """Readings (n, l, c) and sliding terms (n, l, 2, c), turned to the axes of the noise, patches last."""
    variance, vectors = np.linalg.eigh(noise_covariance(board, Noise() if noise is None else noise))
    axes = jnp.asarray(vectors.T, jnp.float32)
    return PressModel(
        loads=loads,
        reading=jnp.einsum("dc,nlc->ldn", axes, reading),
        sliding=jnp.einsum("dc,nlic->lidn", axes, sliding),
        travel=travel.T,
        axes=axes,
        noise=jnp.asarray(np.maximum(variance, 0), jnp.float32),
        likelihood=likelihood or PatchLikelihood(),
    )


@jax.jit
def _press_all(pad: Pad, heights: Array, loads: Array) -> tuple[Array, Array, Array]:
    """Newtons on each cell (n, l, cells), indentations (n, l) and readings without slide (n, l, c)."""

    def one(height: Array) -> tuple[Array, Array, Array]:
        pressure, indentation = pressure_chain(pad, height, loads)
        traction = _friction(pad, pressure, jnp.zeros((len(loads), 2)))
        newtons = pressure.reshape(len(loads), -1) * CELL_GRID.spacing**2
        return newtons, indentation, jax.lax.map(lambda each: _reading(pad, *each), (pressure, traction))

    return map_batches(one, heights, batch_size=BATCH)


@jax.jit
def _slide_all(pad: Pad, heights: Array, loads: Array) -> Array:
    """Change of the readings by a slant of 1 m/m along x and along y, (n, l, 2, c)."""

    def one(height: Array) -> Array:
        pressure, indentation = pressure_chain(pad, height, loads)
        way = jnp.diff(indentation - indentation[0], prepend=-indentation[:1])

        def reading(slant: Array) -> Array:
            traction = _friction(pad, pressure, way[:, None] * slant[None])
            return jax.lax.map(lambda each: _reading(pad, *each), (pressure, traction))

        found = jax.lax.map(reading, SLIDING_SLANT * jnp.array([[0.0, 0], [1, 0], [0, 1]]))
        return jnp.moveaxis(found[1:] - found[:1], 0, 1) / SLIDING_SLANT

    return map_batches(one, heights, batch_size=BATCH)


def _friction(pad: Pad, pressure: Array, slide: Array) -> Array:
    """Tractions (l, 2, g, g) along the path of a press, by how far the surface slides between loads (m)."""

    def follow(state: Shear, step: tuple[Array, Array]) -> tuple[Shear, Array]:
        pressure, slide = step
        state = shear(pad, pressure, slide, CELL_GRID, before=state, tolerance=LOOSE_FRICTION, max_steps=FRICTION_STEPS)
        return state, state.traction

    return jax.lax.scan(follow, rest(pad, jnp.zeros_like(pressure[0]), CELL_GRID), (pressure, slide))[1]


def _reading(pad: Pad, pressure: Array, traction: Array) -> Array:
    return response(pad, pressure, CELL_GRID, traction=traction)


@partial(jax.jit, static_argnames=("ridge",))
def _ridge(seen: Array, target: Array, all_of: Array, *, ridge: float = SLIDING_RIDGE) -> Array:
    """A linear map from pressures (n, l, cells) to targets (n, l, 2, c), one for each load, applied to all."""

    def one(x: Array, y: Array, new: Array) -> Array:
        gram = x @ x.T
        system = gram + ridge * jnp.trace(gram) * jnp.eye(len(x)) / len(x)
        return (new @ x.T) @ jnp.linalg.solve(system, y.reshape(len(x), -1))

    found = jax.vmap(one, in_axes=1, out_axes=1)(seen, target, all_of)
    return found.reshape(*all_of.shape[:2], *target.shape[2:])
