"""Readings of one pad at every patch of a library, computed from the pad's physics.

The pad's layer is pressed onto each patch with each of the library's loads, friction follows the path of the press
(`i2t.skin.friction`), and the chips read the field of the displaced magnets. Friction contributes a third of a reading
even when the press does not slide.
The effect of a slanted press is taken as linear in the slant. It differs little between patches with the same pressure,
so it is computed for a few hundred patches, and a ridge regression on the pressures gives it for all patches, with nine
tenths of its variance.

Units are metres, newtons and microtesla.
"""

from dataclasses import dataclass

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


@dataclass(frozen=True)
class FrictionConfig:
    """Accuracy with which friction and the effect of a slanted press are computed."""

    tolerance: float = 3e-2  # tolerance relative to the largest displacement, for 1 % of a reading
    max_steps: int = 15
    slant_patches: int = 256  # number of patches at which the effect of a slant is computed
    slant: float = 0.0175  # m/m, the slant at which its effect is computed: a degree
    slant_ridge: float = 0.1  # penalty of the regression, relative to the mean square of the pressures


_FRICTION = FrictionConfig()  # accuracy of the friction, and of the effect of a slanted press


def predict_presses(pad: Pad, library: PatchLibrary) -> PressModel:
    """Predict the readings of a pad of given physics (simulated, nominal or fitted) at a library's patches.

    Args:
        pad: The skin.
        library: The patches.

    Returns:
        Readings of the pad at each patch under each load, on the default device.

    Example:
        model = predict_presses(i2t.nominal_pad(), library)
    """
    loads = np.asarray(library.loads, np.float32)
    pressure, indentation = press_batches(pad, np.asarray(library.height), loads)
    newtons = newtons_on_cells(pressure, CELL_GRID).reshape(*indentation.shape, -1)
    rows = np.random.default_rng(0).permutation(len(newtons))[: _FRICTION.slant_patches]
    reading = in_batches(_read, pressure, indentation, shared=(pad, np.zeros(2, np.float32)))
    slants = _FRICTION.slant * np.eye(2, dtype=np.float32)  # along x, along y
    slanted = [in_batches(_read, pressure[rows], indentation[rows], shared=(pad, slant)) for slant in slants]
    by_slant = (np.stack(slanted, 2) - reading[rows][:, :, None]) / _FRICTION.slant / loads[None, :, None, None]
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
    """Compute the covariance of a recorded reading about that of an ideal sensor (`i2t.skin.noise.add_sensor_noise`).

    Args:
        board: The board whose chips give the reading.
        noise: Sizes of the errors.

    Returns:
        `(c, c)` covariance (uT^2).
    """
    bursts = 1 / noise.contact_samples + 1 / noise.ambient_samples
    own = noise.sigma(board.num_chips) ** 2 * (1 - noise.common) * bursts + noise.steps(board.num_chips) ** 2 / 12
    axis_std = np.diag([noise.xy, noise.xy, noise.z]) * np.sqrt(2 * noise.common)  # in contact, and before it
    shared = np.stack([np.asarray(board.to_board(jnp.tile(axis, (board.num_chips, 1)))) for axis in axis_std], -1)
    return np.diag(own) + shared @ shared.T


@jit_quickly
def _read(pressure: Array, indentation: Array, pad: Pad, slant: Array) -> Array:
    """Compute readings (n, l, c) of pressures (n, l, g, g), which a slanted press applies in turn."""

    def read_press(pressure: Array, indentation: Array) -> Array:
        way = jnp.diff(indentation - indentation[0], prepend=-indentation[:1])
        traction = _friction(pad, pressure, way[:, None] * slant[None])
        return jax.lax.map(lambda load: response(pad, load[0], CELL_GRID, traction=load[1]), (pressure, traction))

    return jax.vmap(read_press)(pressure, indentation)


def _friction(pad: Pad, pressure: Array, slide: Array) -> Array:
    """Compute tractions (l, 2, g, g) along the path of a press, whose surface slides by `slide` (m) between loads."""

    def follow(state: Shear, step: tuple[Array, Array]) -> tuple[Shear, Array]:
        pressure, slide = step
        tolerance, max_steps = _FRICTION.tolerance, _FRICTION.max_steps
        state = shear(pad, pressure, slide, CELL_GRID, before=state, tolerance=tolerance, max_steps=max_steps)
        return state, state.traction

    return jax.lax.scan(follow, without_traction(pad, jnp.zeros_like(pressure[0]), CELL_GRID), (pressure, slide))[1]


def _ridge(inputs: np.ndarray, targets: np.ndarray, all_inputs: np.ndarray) -> np.ndarray:
    """Fit linear maps from pressures (n, l, cells) to targets (n, l, 2, c), one for each load, and apply them to all
    pressures.
    """

    def fit_load(x: np.ndarray, y: np.ndarray, new: np.ndarray) -> np.ndarray:
        gram = x @ x.T
        system = gram + _FRICTION.slant_ridge * np.trace(gram) * np.eye(len(x), dtype=x.dtype) / len(x)
        return (new @ x.T) @ np.linalg.solve(system, y.reshape(len(x), -1))

    by_load = [fit_load(inputs[:, i], targets[:, i], all_inputs[:, i]) for i in range(inputs.shape[1])]
    return np.stack(by_load, 1).reshape(*all_inputs.shape[:2], *targets.shape[2:])
