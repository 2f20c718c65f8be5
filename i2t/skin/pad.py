"""What a pad is, pads as different as real ones are, and the press of a pad on a surface.

Sizes are those of ReSkin (Bhirangi et al., CoRL 2021): 20 x 20 mm of magnetic silicone, 2-3 mm thick, on a board of
five magnetometers (`i2t.boards`). Frames and units as in `i2t.types`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t.boards import reskin
from i2t.skin.contact import GRID, Contact, Grid, solve, solve_force
from i2t.skin.field import response
from i2t.types import PAD_WINDOW, READINGS, Board, Pad

THICKNESS = 2e-3  # m
GAP = 1.5e-3  # m from the layer's base to the sensing elements: half of the chip's 1 mm package, glue and film
YOUNG = 200e3  # Pa: soft silicone (Shore 10A, about 150 kPa) stiffened by the magnetic powder
POISSON = 0.48
STRENGTH = 2.7e4  # A/m, root mean square of one component of a random magnetisation; see `sample_pad`
MAP = 20  # cells of a magnetisation map along each edge: 1 mm, and whole cells to each of 4 poles


class Press(NamedTuple):
    """What a press of the pad gives."""

    reading: Float[Array, "15"]  # uT, without noise, in the board's order and axes
    force: Float[Array, ""]  # N
    indentation: Float[Array, ""]  # m
    pressure: Float[Array, "n n"]  # Pa
    converged: Bool[Array, ""]


def press(
    pad: Pad,
    height: Float[Array, "n n"],
    indentation: Float[Array, ""] | float,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
    dipoles: Grid | None = None,
) -> Press:
    """Press the pad `indentation` (m) past first touch onto a surface `height` (m) behind its nearest point at each
    cell centre, row along tool y; `start` is a pressure to begin from. See `contact.solve`.
    """
    return _press(pad, solve(pad, height, indentation, grid, start), grid, dipoles)


def press_force(
    pad: Pad,
    height: Float[Array, "n n"],
    force: Float[Array, ""] | float,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
    dipoles: Grid | None = None,
) -> Press:
    """As `press`, to a normal force (N, > 0). See `contact.solve_force`."""
    return _press(pad, solve_force(pad, height, force, grid, start), grid, dipoles)


def nominal_pad(pattern: str = "poles", strength: float | Array = STRENGTH) -> Pad:
    """A middling ReSkin with a known magnetisation: `pattern` (see `magnetise`) times `strength` (A/m)."""
    return Pad(
        jnp.asarray(THICKNESS),
        jnp.asarray(YOUNG),
        jnp.asarray(POISSON),
        strength * magnetise(pattern),
        jnp.ones(READINGS),
        _board(jnp.asarray(THICKNESS + GAP)),
        friction=jnp.zeros(()),
        give=jnp.zeros(()),
    )


def sample_pad(key: Key[Array, ""], spread: float | Array = 1.0) -> Pad:
    """A pad as different from the next as real skins are; with `spread` 0 only its magnetisation is random.

    Thickness 2-3 mm (ReSkin's range); stiffness within 15 %, gap within 0.25 mm and gains within 5 % (one sigma); a
    smooth random magnetisation with patches of about 4 mm, whose strength varies by 35 % from skin to skin. STRENGTH is
    such that presses of a small tip to 0.6-1.0 N change the 15 values by the norm that real boards show, a median of
    46-85 uT at 78-122 uT/N (`tests/skin/test_pad.py`).
    """
    key_thickness, key_young, key_gap, key_map, key_length, key_strength, key_gains = jax.random.split(key, 7)
    thickness = THICKNESS + spread * jax.random.uniform(key_thickness, maxval=1e-3)
    gap = GAP + spread * 0.25e-3 * jax.random.truncated_normal(key_gap, -2.0, 2.0)
    length = 4e-3 * jnp.exp(spread * 0.2 * jax.random.normal(key_length))
    strength = STRENGTH * jnp.exp(spread * 0.35 * jax.random.normal(key_strength))
    return Pad(
        thickness,
        YOUNG * jnp.exp(spread * 0.15 * jax.random.normal(key_young)),
        jnp.asarray(POISSON),
        strength * smooth_random(key_map, length),
        1 + spread * 0.05 * jax.random.truncated_normal(key_gains, -3.0, 3.0, (READINGS,)),
        _board(thickness + gap),
        friction=jnp.zeros(()),
        give=jnp.zeros(()),
    )


def magnetise(pattern: str, cells: int = MAP) -> Float[Array, "m m 3"]:
    """A magnetisation map in units of its strength: `poles` (4 x 4, up and down in turn, as in ReSkin's first paper) or
    `uniform` (up). Raises ValueError for any other name.
    """
    quarter = np.arange(cells) * 4 // cells
    maps = {"poles": 1 - 2 * ((quarter[:, None] + quarter[None, :]) % 2), "uniform": np.ones((cells, cells))}
    if pattern not in maps:
        raise ValueError(f"Magnetisation pattern {pattern!r} is not known; choose one of {', '.join(maps)}.")
    return jnp.asarray(maps[pattern][..., None] * np.array([0, 0, 1.0]))


def smooth_random(key: Key[Array, ""], length: float | Array, cells: int = MAP) -> Float[Array, "m m 3"]:
    """A random vector map: normal, each component of variance 1, correlated as exp(-d^2 / (2 length^2)) over d (m)."""
    places = (np.arange(cells) + 0.5) / cells * PAD_WINDOW
    distance = places[:, None] - places[None, :]
    # One part in a thousand of white noise keeps the covariance safely positive in float32.
    factor = jnp.linalg.cholesky(0.999 * jnp.exp(-0.5 * (distance / length) ** 2) + 0.001 * np.eye(cells))
    return jnp.einsum("ia,jb,abc->ijc", factor, factor, jax.random.normal(key, (cells, cells, 3)))


def _board(depth: Array) -> Board:
    board = reskin()
    return Board(jnp.asarray(board.chips).at[:, 2].set(-depth), jnp.asarray(board.rotations))


def _press(pad: Pad, contact: Contact, grid: Grid, dipoles: Grid | None) -> Press:
    return Press(
        response(pad, contact.pressure, grid, dipoles),
        contact.force,
        contact.indentation,
        contact.pressure,
        contact.converged,
    )
