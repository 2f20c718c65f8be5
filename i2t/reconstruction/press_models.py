"""Readings of one pad at every patch of a library, by its physics.

The pad's own layer is pressed onto each patch with each of the library's loads, friction follows the path of the press
(`i2t.skin.friction`), and the field of the moved magnets is what chips read.
Friction without any slide belongs to that: it is a third of a reading. What a slant of the press adds is taken as
linear in it, and differs little between patches of one pressure: it is computed for a few hundred patches, and a ridge
regression on the pressures gives it for all (`SLIDING_PATCHES`; nine tenths of its variance).

Metres, newtons, microtesla.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.contact.press import PressLimits
from i2t.contact.pressure import newtons_on_cells
from i2t.reconstruction.library import in_batches, press_batches
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PressModel
from i2t.runtime.compiling import jit_quickly
from i2t.skin.contact import CELL_GRID
from i2t.skin.dipoles import response
from i2t.skin.friction import Shear, shear, without_traction
from i2t.skin.noise import Noise
from i2t.types import Board, Pad

LOOSE_FRICTION = 3e-2  # of the largest displacement: 1 % of a reading
FRICTION_STEPS = 15
SLIDING_PATCHES = 256
SLIDING_SLANT = 0.0175  # m/m, at which the effect of a slant is computed: a degree
SLANTS = SLIDING_SLANT * np.eye(2, dtype=np.float32)  # along x, along y
NO_SLANT = np.zeros(2, np.float32)
SLIDING_RIDGE = 0.1  # of the mean square of the pressures


def imagine_presses(pad: Pad, library: PatchLibrary) -> PressModel:
    """Readings of a pad of known physics at a library's patches: simulated, nominal, or fitted to its presses.

    Args:
        pad: The skin.
        library: The patches.

    Returns:
        The model, on the default device.

    Example:
        model = imagine_presses(i2t.nominal_pad(), library)
    """
    loads = np.asarray(library.loads, np.float32)
    pressure, indentation = press_batches(pad, np.asarray(library.height), loads)
    newtons = newtons_on_cells(pressure, CELL_GRID).reshape(*indentation.shape, -1)
    rows = np.random.default_rng(0).permutation(len(newtons))[:SLIDING_PATCHES]
    reading = in_batches(_read, pressure, indentation, shared=(pad, NO_SLANT))
    slanted = [in_batches(_read, pressure[rows], indentation[rows], shared=(pad, slant)) for slant in SLANTS]
    by_slant = (np.stack(slanted, 2) - reading[rows][:, :, None]) / SLIDING_SLANT / loads[None, :, None, None]
    sliding = _ridge(newtons[rows] / loads[None, :, None], by_slant, newtons)
    variance, vectors = np.linalg.eigh(noise_covariance(pad.board, Noise()))
    axes = np.asarray(vectors.T, np.float32)
    return PressModel(
        loads=jnp.asarray(loads),
        reading=jnp.asarray(np.einsum("dc,nlc->ldn", axes, reading)),
        sliding=jnp.asarray(np.einsum("dc,nlic->lidn", axes, sliding)),
        travel=jnp.asarray((indentation + loads[None] / np.float32(PressLimits.stiffness)).T),
        axes=jnp.asarray(axes),
        noise=jnp.asarray(np.maximum(variance, 0), jnp.float32),
        likelihood=PatchLikelihood(),
    )


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


@jit_quickly
def _read(pressure: Array, indentation: Array, pad: Pad, slant: Array) -> Array:
    """Readings (n, l, c) of pressures (n, l, g, g), pressed in turn with a slant of the press."""

    def one(pressure: Array, indentation: Array) -> Array:
        way = jnp.diff(indentation - indentation[0], prepend=-indentation[:1])
        traction = _friction(pad, pressure, way[:, None] * slant[None])
        return jax.lax.map(lambda each: response(pad, each[0], CELL_GRID, traction=each[1]), (pressure, traction))

    return jax.vmap(one)(pressure, indentation)


def _friction(pad: Pad, pressure: Array, slide: Array) -> Array:
    """Tractions (l, 2, g, g) along the path of a press, by how far the surface slides between loads (m)."""

    def follow(state: Shear, step: tuple[Array, Array]) -> tuple[Shear, Array]:
        pressure, slide = step
        state = shear(pad, pressure, slide, CELL_GRID, before=state, tolerance=LOOSE_FRICTION, max_steps=FRICTION_STEPS)
        return state, state.traction

    return jax.lax.scan(follow, without_traction(pad, jnp.zeros_like(pressure[0]), CELL_GRID), (pressure, slide))[1]


def _ridge(seen: np.ndarray, target: np.ndarray, all_of: np.ndarray) -> np.ndarray:
    """A linear map from pressures (n, l, cells) to targets (n, l, 2, c), one for each load, applied to all."""

    def one(x: np.ndarray, y: np.ndarray, new: np.ndarray) -> np.ndarray:
        gram = x @ x.T
        system = gram + SLIDING_RIDGE * np.trace(gram) * np.eye(len(x), dtype=x.dtype) / len(x)
        return (new @ x.T) @ np.linalg.solve(system, y.reshape(len(x), -1))

    by_load = [one(seen[:, i], target[:, i], all_of[:, i]) for i in range(seen.shape[1])]
    return np.stack(by_load, 1).reshape(*all_of.shape[:2], *target.shape[2:])
