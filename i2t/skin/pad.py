"""Pads and boards: a nominal one, ones as different as real skins are, and the press of a pad on a surface.

The board is ReSkin's: five MLX90393 chips, one below the centre and four 7 mm from it, the skin 2-3 mm thick and 20 x 20 mm (Bhirangi et al., ReSkin,
CoRL 2021). Order and rotation of the chips were read off a real board's recordings: with chip 0 as reference a uniform field (x0, y0) shows as
(y0, -x0) at chip 1, (x0, y0) at 2, (-y0, x0) at 3 and (-x0, -y0) at 4. Frames and units as in `i2t.types`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t.skin.contact import GRID, Contact, Grid, solve, solve_force
from i2t.skin.field import response
from i2t.types import PAD_WINDOW, READINGS, Board, Pad

THICKNESS = 2e-3  # m
GAP = 1.5e-3  # m from the layer's base to the sensing elements: half of the chip's 1 mm package and the glue and film above it
YOUNG = 200e3  # Pa: soft silicone (Shore 10A, about 150 kPa) stiffened by the magnetic powder
POISSON = 0.48
ARM = 7e-3  # m, from the centre of the board to its outer chips
STRENGTH = 2.4e4  # A/m, root mean square of a component of the magnetisation


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
) -> Press:
    """Press the pad `indentation` (m) past first touch onto a surface `height` (m) behind its nearest point; see `contact.solve`."""
    return _press(pad, solve(pad, height, indentation, grid, start), grid)


def press_force(
    pad: Pad,
    height: Float[Array, "n n"],
    force: Float[Array, ""] | float,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
) -> Press:
    """As `press`, to a normal force (N, > 0); see `contact.solve_force`."""
    return _press(pad, solve_force(pad, height, force, grid, start), grid)


def reskin(thickness: float | Array = THICKNESS, gap: float | Array = GAP) -> Board:
    """ReSkin's board under a skin of `thickness` with its chips `gap` (m) below the skin's base."""
    return _board([(0, 0), (1, 0), (0, 1), (0, -1), (-1, 0)], [0, 1, 0, 3, 2], thickness, gap)


def anyskin(thickness: float | Array = THICKNESS, gap: float | Array = GAP) -> Board:
    """A board in the order in which public viewers draw AnySkin (centre, left, right, up, down), its chips taken as aligned: check it on yours."""
    return _board([(0, 0), (-1, 0), (1, 0), (0, 1), (0, -1)], [0] * 5, thickness, gap)


def nominal_pad(pattern: str = "poles", strength: float | Array = STRENGTH) -> Pad:
    """A middling pad with a known magnetisation `pattern` (`poles` or `uniform`, see `magnetise`)."""
    return Pad(
        jnp.asarray(THICKNESS),
        jnp.asarray(YOUNG),
        jnp.asarray(POISSON),
        magnetise(pattern) * strength,
        jnp.ones(READINGS),
        reskin(),
    )


def magnetise(pattern: str, size: int = 20) -> Float[Array, "size size 3"]:
    """A magnetisation map of size x size cells, in units of its strength: `poles` (4 x 4, up and down in turn, as in ReSkin) or `uniform` (up)."""
    quarter = np.arange(size) * 4 // size
    signs = {"poles": 1 - 2 * ((quarter[:, None] + quarter[None, :]) % 2), "uniform": np.ones((size, size))}
    if pattern not in signs:
        raise ValueError(f"magnetisation pattern {pattern!r} is unknown; use one of {', '.join(signs)}")
    return jnp.asarray(np.stack([np.zeros((size, size)), np.zeros((size, size)), signs[pattern]], -1), float)


def smooth_random(key: Key[Array, ""], length: float | Array, size: int = 20) -> Float[Array, "size size 3"]:
    """A smooth random vector map: normal, variance 1 on each component, correlated as exp(-d^2 / (2 length^2)) over d metres."""
    place = (np.arange(size) + 0.5) / size * PAD_WINDOW
    distance = place[:, None] - place[None, :]
    covariance = jnp.exp(-0.5 * (distance / length) ** 2) + 1e-4 * jnp.eye(size)  # jitter keeps the factor real
    factor = jnp.linalg.cholesky(covariance / (1 + 1e-4))
    return jnp.einsum("ia,jb,abc->ijc", factor, factor, jax.random.normal(key, (size, size, 3)))


def sample_pad(key: Key[Array, ""], spread: float | Array = 1.0) -> Pad:
    """A pad as different from the next as real skins are; `spread` 0 gives the middle of every size, and still a random magnetisation.

    Thickness 2-3 mm (ReSkin's range), stiffness within 15 %, gap within 0.25 mm and gains within 5 % (one sigma), and a smooth random magnetisation
    about 4 mm across with its strength varying within 25 % from skin to skin. The strength was set so that presses of a small tip to 0.6-1.0 N change
    the 15 values by the norm real boards show, 46-85 uT (median), see `tests/skin/test_pad.py`.
    """
    key_thickness, key_young, key_gap, key_map, key_length, key_strength, key_gains = jax.random.split(key, 7)
    thickness = THICKNESS + spread * jax.random.uniform(key_thickness, maxval=1e-3)
    young = YOUNG * jnp.exp(spread * 0.15 * jax.random.normal(key_young))
    gap = GAP + spread * 0.25e-3 * jax.random.truncated_normal(key_gap, -2, 2)
    length = 4e-3 * jnp.exp(spread * 0.2 * jax.random.normal(key_length))
    strength = STRENGTH * jnp.exp(spread * 0.25 * jax.random.normal(key_strength))
    gains = 1 + spread * 0.05 * jax.random.truncated_normal(key_gains, -3, 3, (READINGS,))
    return Pad(
        thickness,
        young,
        jnp.asarray(POISSON),
        strength * smooth_random(key_map, length),
        gains,
        reskin(thickness, gap),
    )


def _press(pad: Pad, contact: Contact, grid: Grid) -> Press:
    return Press(
        response(pad, contact.pressure, grid), contact.force, contact.indentation, contact.pressure, contact.converged
    )


def _board(places: list[tuple[int, int]], quarters: list[int], thickness: float | Array, gap: float | Array) -> Board:
    """Chips at `places` (in arms from the centre), each turned anticlockwise about z by a number of `quarters` of a turn."""
    cosine, sine = np.array([1, 0, -1, 0])[quarters], np.array([0, 1, 0, -1])[quarters]
    rotations = np.zeros((len(places), 3, 3))
    rotations[:, 0, 0] = rotations[:, 1, 1] = cosine
    rotations[:, 1, 0], rotations[:, 0, 1] = sine, -sine
    rotations[:, 2, 2] = 1
    down = jnp.broadcast_to(-(jnp.asarray(thickness) + gap), (len(places), 1))
    return Board(jnp.concatenate([ARM * jnp.asarray(places, float), down], axis=1), jnp.asarray(rotations, float))


RESKIN = reskin()
ANYSKIN = anyskin()
