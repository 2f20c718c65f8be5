"""Pads, random pads that vary like real ones, and the press of a pad on a surface.

Sizes are those of ReSkin (Bhirangi et al., CoRL 2021): 20 x 20 mm of magnetic silicone, 2-3 mm thick, on a board of
five magnetometers (`i2t.skin.boards`). Frames and units as in `i2t.types`.
"""

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t import validation
from i2t.errors import did_you_mean
from i2t.patches.dimensions import PAD_WINDOW
from i2t.runtime.compiling import jit_quickly
from i2t.skin.boards import reskin_board
from i2t.skin.contact import GRID, Contact, Grid, solve, solve_force
from i2t.skin.dipoles import response, rest_field
from i2t.skin.faults import RANGE_XY_UT, RANGE_Z_UT
from i2t.skin.friction import Shear, shear, without_traction
from i2t.types import Board, Pad, in_one_line, shown


@dataclass(frozen=True)
class NominalSkin:
    """Properties of a typical ReSkin, and assumptions on how skins differ; see `sample_pad`."""

    thickness: float = 2e-3  # m
    chip_gap: float = 1.5e-3  # m, gap from the base to the sensing elements: half of the 1 mm package, glue and film
    # Pa, Young's modulus: soft silicone (Shore 00-50, about 80 kPa) stiffened by the magnetic powder
    young: float = 150e3
    poisson: float = 0.48
    friction: float = 0.6  # Coulomb friction coefficient: dry silicone on plastic, typically between 0.4 and 1
    mount_compliance: float = 0.25e-3  # m/N, compliance of a middling skin that is clamped at its edge
    magnetization: float = 2e4  # A/m, root mean square of one component of a random magnetization
    poisson_range: tuple[float, float] = (0.475, 0.485)
    edge_clamped_share: float = 1 / 3  # share of skins that are clamped at their edge
    max_range_share: float = 0.85  # largest field at rest along any axis, as a share of the converter's range


NOMINAL_SKIN = NominalSkin()  # sizes, stiffness, friction and magnet of a typical ReSkin, and how skins differ
# Quantities of a pad that `sample_pad` draws, each with its own random key.
DRAWN = ("thickness", "young", "gap", "map", "strength", "gains", "friction", "clamped", "compliance")
MAP_CELLS = 20  # cells of a magnetization map along each edge: 1 mm, and a whole number for each of 4 poles


@in_one_line
class Press(NamedTuple):
    """Result of pressing a pad onto a surface: noise-free reading (uT), force (N), indentation (m) and pressure (Pa).

    Example:
        pressed = i2t.press(pad, height, 0.3e-3)
        print(f"{float(pressed.force):.2f} N")
    """

    reading: Float[Array, " c"]  # uT, reading without noise, in the board's order and axes
    force: Float[Array, ""]  # N
    indentation: Float[Array, ""]  # m
    pressure: Float[Array, "n n"]  # Pa
    converged: Bool[Array, ""]

    def __str__(self) -> str:
        """Describe force, indentation and reading."""
        force, indentation, converged = map(shown, (self.force, self.indentation, self.converged))
        return (
            f"Press with {force} N at an indentation of {indentation} m (converged: {converged})\n"
            f"  reading of {self.reading.shape[-1]} values (uT), pressure on {shown(self.pressure)} cells (Pa)"
        )


def press(
    pad: Pad,
    height: Float[Array | np.ndarray, "n n"],
    indentation: Float[Array, ""] | float,
    *,
    grid: Grid = GRID,
    start: Float[Array, "n n"] | None = None,
    dipoles: Grid | None = None,
) -> Press:
    """Press the pad onto a surface to an indentation; see `contact.solve`.

    Args:
        pad: The skin.
        height: `(n, n)` distance (m) of the surface behind its nearest point at each cell centre, row along tool y; inf
            for air.
        indentation: Distance (m) past first touch.
        grid: Grid of the contact.
        start: `(n, n)` pressure (Pa) to start from.
        dipoles: A coarser grid of the same period for the field.

    Returns:
        Noise-free reading (uT), force (N), indentation (m), pressure (Pa), and whether the contact solver converged.

    Raises:
        ValueError: The heights do not fit the grid, are NaN or nowhere finite, or the indentation is not a length.
        TypeError: An argument does not contain real numbers.

    Example:
        pressed = i2t.press(i2t.nominal_pad(), height, 0.4e-3)
        pressed.reading, pressed.force
    """
    if not validation.is_traced(height, indentation):
        hint = f"({grid.cells}, {grid.cells}) metres behind the nearest point, one for each cell of the grid"
        heights = validation.numbers("height", height, hint)
        if heights.shape != (grid.cells, grid.cells) or not np.isfinite(heights.min()):
            raise ValueError(f"height: has the shape {heights.shape}, or is NaN or nowhere finite; give {hint}")
        validation.number("indentation", indentation, "metres past first touch")
    return _press(pad, solve(pad, jnp.asarray(height), indentation, grid, start=start), grid, dipoles)


def press_force(
    pad: Pad,
    height: Float[Array | np.ndarray, "n n"],
    force: Float[Array, ""] | float,
    grid: Grid = GRID,
    *,
    start: Float[Array, "n n"] | None = None,
    dipoles: Grid | None = None,
) -> Press:
    """Press the pad onto a surface to a normal force; see `contact.solve_force`.

    Args:
        pad: The skin.
        height: `(n, n)` distance (m) of the surface behind its nearest point, as for `press`.
        force: Normal force (N), > 0.
        grid: Grid of the contact.
        start: `(n, n)` pressure (Pa) to start from.
        dipoles: A coarser grid of the same period for the field.

    Returns:
        Noise-free reading (uT), force (N), indentation (m), pressure (Pa), and whether the contact solver converged.
    """
    return _press(pad, solve_force(pad, jnp.asarray(height), force, grid, start=start), grid, dipoles)


@partial(jax.jit, static_argnames=("grid", "increments", "pressure_tolerance", "traction_tolerance"))
def friction_response(
    pad: Pad,
    height: Float[Array, "n n"],
    indentation: Float[Array, ""] | float,
    slide: Float[Array, "2"],
    *,
    grid: Grid = GRID,
    increments: int = 3,
    pressed: Press | None = None,
    pressure_tolerance: float = 1e-4,
    traction_tolerance: float = 1e-3,
) -> Float[Array, " c"]:
    """Compute the change of a press's reading by friction, if the surface slides evenly along the skin on its way.

    The part is not zero without a slide, because friction also holds material that the pressure would spread; see
    `i2t.skin.friction`. The default tolerances of the intermediate steps change the result by about 5 nT.

    Args:
        pad: The skin.
        height: `(n, n)` distance (m) of the surface behind its nearest point, as for `press`.
        indentation: Distance (m) past first touch.
        slide: Motion (m) along x and y of the skin, from first touch to the indentation.
        grid: Grid of the contact.
        increments: Number of equal steps of the path.
        pressed: `press` of the same pad, height, indentation and grid, if it is available.
        pressure_tolerance: Tolerance of the contacts in intermediate steps, as of `contact.solve`.
        traction_tolerance: Tolerance of the tractions, relative to the largest displacement.

    Returns:
        `(c,)` change of the reading (uT).
    """
    pressed = press(pad, height, indentation, grid=grid) if pressed is None else pressed

    def pressure_after(part: Float[Array, ""]) -> Float[Array, "n n"]:
        start = part * pressed.pressure
        return solve(pad, height, part * indentation, grid, start=start, tolerance=pressure_tolerance).pressure

    def advance(before: Shear, reached: tuple[Array, Array]) -> tuple[Shear, None]:
        number, pressure = reached
        start = before._replace(traction=before.traction * number / jnp.maximum(number - 1, 1))
        state = shear(pad, pressure, slide / increments, grid, before=start, tolerance=traction_tolerance)
        return state, None

    numbers = jnp.arange(1, increments + 1, dtype=pressed.pressure.dtype)
    pressures = jnp.append(jax.vmap(pressure_after)(numbers[:-1] / increments), pressed.pressure[None], axis=0)
    untouched = without_traction(pad, jnp.zeros_like(pressed.pressure), grid)
    state, _ = jax.lax.scan(advance, untouched, (numbers, pressures))
    return response(pad, pressed.pressure, grid, traction=state.traction) - pressed.reading


def nominal_pad(
    pattern: str = "poles", *, strength: float | Array = NOMINAL_SKIN.magnetization, board: Board | None = None
) -> Pad:
    """Make a typical ReSkin with a known magnetization: a pattern times its strength.

    Args:
        pattern: Name of a `magnetization_pattern`.
        strength: Strength of the magnetization (A/m).
        board: Board below the skin, by default ReSkin's with five chips. The depth of its chips is replaced by that
            below a nominal layer.

    Returns:
        The pad, bonded and without friction.

    Raises:
        ValueError: The pattern is unknown, or the strength is not finite.

    Example:
        pad = i2t.nominal_pad("uniform", board=make_board("grid-4x4"))
    """
    validation.number("strength", strength, "A/m")
    board = reskin_board() if board is None else board
    return Pad(
        thickness=jnp.float32(NOMINAL_SKIN.thickness),  # typed like `sample_pad`, so that compiled programs serve both
        young=jnp.float32(NOMINAL_SKIN.young),
        poisson=jnp.float32(NOMINAL_SKIN.poisson),
        magnetization=strength * magnetization_pattern(pattern),
        gains=jnp.ones(board.num_readings),
        board=_at_depth(board, jnp.asarray(NOMINAL_SKIN.thickness + NOMINAL_SKIN.chip_gap)),
        friction=jnp.zeros(()),
        mount_compliance=jnp.zeros(()),
    )


def sample_pad(key: Key[Array, ""], *, spread: float | Array = 1.0, board: Board | None = None) -> Pad:
    """Draw a random pad that varies like real skins; with `spread` 0 only its magnetization is random.

    The thickness is 2-3 mm (ReSkin's range). Stiffness varies by 15 %, the gap by 0.25 mm, gains by 5 % and friction by
    20 % (one sigma). Poisson's ratio is 0.475-0.485, an assumption: silicone rubber is nearly incompressible (0.49 and
    more), the material between the powder is not all rubber, and there is no measurement of a skin. To a wide flat
    press the layer's stiffness is proportional to (1 - nu) / ((1 + nu) (1 - 2 nu)), 19 % less to 32 % more than at
    0.48; to a small tip it hardly changes.

    One skin in three is clamped at its edge instead of bonded, with a nominal mounting compliance within a factor of
    1.8: on one of a few real boards a press anywhere moved two chips by 60-100 uT. The magnetization is that of
    `sample_magnetization`, and its strength varies by 25 % from skin to skin. A skin that would bring an axis at rest
    near the end of its range (most would) is weakened, because makers magnetize as strongly as the chips allow. The
    nominal magnetization and compliance are such that presses of a small tip to 0.6-1.0 N change the readings as on
    real boards (`tests/skin/test_pad.py`).

    Args:
        key: Random key. Pads of the same key on different boards differ in their gains, and in strength if the range of
            a chip limits it.
        spread: Factor on all variations except that of the magnetization.
        board: Board below the skin, by default ReSkin's with five chips. The depth of its chips is replaced by the
            pad's thickness and gap.

    Returns:
        The random pad on its board.

    Raises:
        ValueError: `spread` is negative or not finite.
        TypeError: `key` is not a random key.

    Example:
        pad = i2t.sample_pad(jax.random.key(0))
    """
    validation.random_key("key", key)
    validation.number(
        "spread", spread, "0 for pads that differ in their magnetization alone, 1 for real skins'", minimum=0
    )
    board = reskin_board() if board is None else board
    # Drawn separately: gains identify a board (`i2t.skin.faults.board_key`), and compiled with the rest their last bits
    # would differ.
    key_gains = jax.random.split(key, len(DRAWN))[DRAWN.index("gains")]
    gains = 1 + spread * 0.05 * jax.random.truncated_normal(key_gains, -3.0, 3.0, (board.num_readings,))
    return _sample_pad(jax.random.clone(key), spread, board, gains)


@jit_quickly
def _sample_pad(key: Key[Array, ""], spread: float | Array, board: Board, gains: Float[Array, " c"]) -> Pad:
    """Draw a pad with checked arguments and the gains of its board; see `sample_pad`."""
    keys = dict(zip(DRAWN, jax.random.split(key, len(DRAWN)), strict=True))
    clamped = jax.random.uniform(keys["clamped"]) < NOMINAL_SKIN.edge_clamped_share
    compliance = spread * NOMINAL_SKIN.mount_compliance * jnp.exp(0.6 * jax.random.normal(keys["compliance"]))
    strength = NOMINAL_SKIN.magnetization * jnp.exp(spread * 0.25 * jax.random.normal(keys["strength"]))
    thickness = NOMINAL_SKIN.thickness + spread * jax.random.uniform(keys["thickness"], maxval=1e-3)
    gap = NOMINAL_SKIN.chip_gap + spread * 0.25e-3 * jax.random.truncated_normal(keys["gap"], -2.0, 2.0)
    low, high = NOMINAL_SKIN.poisson_range  # drawn from a separate key, so that the other draws of a key stay the same
    poisson = jax.random.uniform(jax.random.fold_in(key, len(DRAWN)), minval=low, maxval=high)
    pad = Pad(
        thickness=thickness,
        young=NOMINAL_SKIN.young * jnp.exp(spread * 0.15 * jax.random.normal(keys["young"])),
        poisson=NOMINAL_SKIN.poisson + spread * (poisson - NOMINAL_SKIN.poisson),
        magnetization=strength * sample_magnetization(keys["map"], spread),
        gains=gains,
        board=_at_depth(board, thickness + gap),
        friction=NOMINAL_SKIN.friction * jnp.exp(spread * 0.2 * jax.random.normal(keys["friction"])),
        mount_compliance=jnp.where(clamped, compliance, 0.0),
    )
    full_scale = np.tile([RANGE_XY_UT, RANGE_XY_UT, RANGE_Z_UT], board.num_chips)
    use = jnp.max(jnp.abs(pad.board.to_board(rest_field(pad))) / full_scale)
    return pad._replace(magnetization=pad.magnetization * jnp.minimum(1.0, NOMINAL_SKIN.max_range_share / use))


def pad_from_seed(seed: int, *, board: Board | None = None) -> Pad:
    """Draw a random pad from a seed. Experiments, emulators and results identify simulated pads by this number.

    Args:
        seed: Seed of the pad, from 0; equal seeds give equal pads.
        board: As for `sample_pad`.

    Returns:
        The random pad of this seed.
    """
    return sample_pad(jax.random.key(1000 + seed), board=board)


def sample_magnetization(key: Key[Array, ""], spread: float | Array = 1.0) -> Float[Array, "m m 3"]:
    """Draw a magnetization as uneven as that of real skins: patches of some 2.5 mm about a common direction.

    It is stronger along some axes and at some positions than at others (some chips 100 uT, others 10 uT for the same
    press). The sizes are assumptions that agree with real boards; see `sample_pad`.

    Args:
        key: Random key.
        spread: Factor on the assumed variation of the patches' length; 0 gives 2.5 mm.

    Returns:
        `(m, m, 3)` magnetization map with a root mean square of 1, m cells along an edge.
    """
    key_length, key_patches, key_common, key_axes, key_places = jax.random.split(key, 5)
    length = 2.5e-3 * jnp.exp(spread * 0.2 * jax.random.normal(key_length))
    patches = smooth_random(key_patches, length) * jnp.exp(0.8 * jax.random.normal(key_axes, (1, 1, 3)))
    strong = jnp.exp(0.6 * smooth_random(key_places, 7e-3)[..., :1])
    magnetization = strong * patches + jax.random.normal(key_common, (1, 1, 3))
    return magnetization / jnp.sqrt(jnp.mean(magnetization**2))


def magnetization_pattern(pattern: str, cells: int = MAP_CELLS) -> Float[Array, "m m 3"]:
    """Make a regular magnetization map of a skin.

    Args:
        pattern: `poles` (4 x 4, alternating up and down, as in ReSkin's first paper), `uniform` (up) or `magnets` (four
            upright magnets of 6 mm, alternating up and down, in an otherwise nonmagnetic skin; `i2t.skin.magnets` has
            their exact field).
        cells: Number of the map's cells along an edge.

    Returns:
        `(m, m, 3)` magnetization map, in units of its strength.

    Raises:
        ValueError: The pattern is unknown.
    """
    quarter = np.arange(cells) * 4 // cells
    half = np.arange(cells) * 2 // cells
    place = (np.arange(cells) + 0.5) / cells * PAD_WINDOW
    offset_square = np.square(place % (PAD_WINDOW / 2) - PAD_WINDOW / 4)  # from the nearest magnet's centre
    inside = offset_square[:, None] + offset_square[None, :] <= 3e-3**2
    maps = {
        "poles": 1 - 2 * ((quarter[:, None] + quarter[None, :]) % 2),
        "uniform": np.ones((cells, cells)),
        "magnets": inside * (1 - 2 * ((half[:, None] + half[None, :]) % 2)),
    }
    if pattern not in maps:
        raise ValueError(f"pattern: {pattern!r} is not known; {did_you_mean(pattern, maps)}")
    return jnp.asarray(maps[pattern][..., None] * np.array([0, 0, 1.0]))


def smooth_random(key: Key[Array, ""], length: float | Array, cells: int = MAP_CELLS) -> Float[Array, "m m 3"]:
    """Draw a normal random vector map whose components have variance 1 and the correlation exp(-d^2 / (2 length^2)).

    Args:
        key: Random key.
        length: Correlation length (m).
        cells: Number of the map's cells along an edge.

    Returns:
        `(m, m, 3)` random map, dimensionless.
    """
    places = (np.arange(cells) + 0.5) / cells * PAD_WINDOW
    distance = places[:, None] - places[None, :]
    # One part in a thousand of white noise keeps the covariance safely positive in float32.
    factor = jnp.linalg.cholesky(0.999 * jnp.exp(-0.5 * (distance / length) ** 2) + 0.001 * np.eye(cells))
    return jnp.einsum("ia,jb,abc->ijc", factor, factor, jax.random.normal(key, (cells, cells, 3)))


def _at_depth(board: Board, depth: Array) -> Board:
    return Board(jnp.asarray(board.chips).at[:, 2].set(-depth), jnp.asarray(board.rotations))


@partial(jax.jit, static_argnames=("grid", "dipoles"))
def _press(pad: Pad, contact: Contact, grid: Grid, dipoles: Grid | None) -> Press:
    return Press(
        response(pad, contact.pressure, grid, dipoles=dipoles),
        contact.force,
        contact.indentation,
        contact.pressure,
        contact.converged,
    )
