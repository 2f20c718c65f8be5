"""Section `skin` of the benchmark: contacts and readings of i2t against the contacts of the package ContactMechanics.

Both solve the same contacts of the same bonded layer on the same cells, to a similar residual: i2t to a maximum
violation of 1e-5 of the deepest deflection, ContactMechanics to a root mean square penetration of the same size. Its
systems are built before timing starts. A reading adds the field of the layer's dipoles at the chips, for which
ContactMechanics has no counterpart; the ratio of a reading to the contact shows the cost of the field.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.benchmark.contests import Contest, finish
from i2t.skin.contact import CONTACT_SOLVER, solve
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import nominal_pad, press
from i2t.types import Pad

PEER = "ContactMechanics"
NO_SURFACE_M = 1.0  # height of empty cells above the nearest point
CELLS = (20, 40, 80)  # along each edge of the pad
UNIT = "s a touch"


def skin(small: bool) -> Iterator[Contest]:
    """Compare each shape on the default grid, then all shapes on every grid, then readings by number of dipoles."""
    pad, shapes, batch = nominal_pad(), ["tilted punch"] if small else list(SHAPES), 2 if small else 64
    steady = 0.0 if small else 0.5
    for name in shapes:
        yield from contests(pad, GRID, [name], batch, steady=steady, kinds=("contacts",))
    for cells in (20,) if small else CELLS:
        yield from contests(pad, _grid(cells), shapes, batch, steady=steady)
    yield from dipoles(pad, shapes, batch, steady, (10,) if small else CELLS)


def contests(
    pad: Pad,
    grid: Grid,
    shapes: list[str],
    batch: int,
    *,
    steady: float,
    kinds: Sequence[str] = ("contacts", "readings"),
) -> Iterator[Contest]:
    """Compare contacts, and complete readings, with the peer's contacts."""
    heights, indentations = touches(grid, shapes, batch)
    run = {
        "contacts": jax.jit(jax.vmap(partial(solve, grid=grid), (None, 0, 0))),
        "readings": jax.jit(jax.vmap(partial(_reading, grid=grid, dipoles=None), (None, 0, 0))),
    }
    work = f"{shapes[0] if len(shapes) == 1 else 'all shapes'}, {grid.cells} x {grid.cells} cells"
    systems = [
        peer_contact(pad, grid, np.asarray(height, float), float(indentation))
        for height, indentation in zip(heights[: len(shapes)], indentations, strict=False)
    ]  # one of each shape
    check(work, run["contacts"](pad, heights, indentations), [system() for system in systems], grid)
    for kind in kinds:
        yield Contest(
            f"{kind}: {work}", partial(finish, run[kind], pad, heights, indentations), PEER,
            lambda: [system() for system in systems],
            our_calls=1 / batch, peer_calls=1 / len(systems), unit=UNIT, steady=steady,
        )  # fmt: skip


def dipoles(pad: Pad, shapes: list[str], batch: int, steady: float, counts: Sequence[int]) -> Iterator[Contest]:
    """Compare readings on the finest grid, with more and more dipoles, with the contact alone."""
    grid = _grid(max(CELLS))
    heights, indentations = touches(grid, shapes, batch)
    contact = jax.jit(jax.vmap(lambda pad, height, indentation: solve(pad, height, indentation, grid), (None, 0, 0)))
    for count in counts:
        reading = jax.jit(jax.vmap(partial(_reading, grid=grid, dipoles=_grid(count)), (None, 0, 0)))
        yield Contest(
            f"readings: {grid.cells} x {grid.cells} cells, {count} x {count} x 5 dipoles",
            partial(finish, reading, pad, heights, indentations), "the contact alone",
            partial(finish, contact, pad, heights, indentations),
            our_calls=1 / batch, peer_calls=1 / batch, unit=UNIT, steady=steady,
        )  # fmt: skip


def _reading(pad: Pad, height: jax.Array, indentation: jax.Array, *, grid: Grid, dipoles: Grid | None) -> jax.Array:
    return press(pad, height, indentation, grid=grid, dipoles=dipoles).reading


def peer_contact(pad: Pad, grid: Grid, height: np.ndarray, indentation: float) -> Callable[[], np.ndarray]:
    """Make a function that solves a contact with ContactMechanics and returns the pressure (Pa) on the pad's cells."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a warning at import about missing MPI
        from ContactMechanics import PeriodicFFTElasticHalfSpace
        from ContactMechanics.Systems import NonSmoothContactSystem
        from SurfaceTopography import Topography
    period, modes = grid.modes * grid.spacing, (grid.modes, grid.modes)
    elastic = PeriodicFFTElasticHalfSpace(
        modes, float(pad.young), (period, period), thickness=float(pad.thickness), poisson=float(pad.poisson)
    )
    surface = np.full(modes, -NO_SURFACE_M)
    surface[: grid.cells, : grid.cells] = -np.minimum(height, NO_SURFACE_M)
    system = NonSmoothContactSystem(elastic, Topography(surface, (period, period)))

    def run() -> np.ndarray:
        if not system.minimize_proxy(offset=indentation, pentol=CONTACT_SOLVER.tolerance * indentation).success:
            raise ValueError(f"{PEER} did not converge")
        return np.asarray(system.force)[: grid.cells, : grid.cells] / grid.spacing**2

    return run


def check(work: str, ours: object, theirs: list[np.ndarray], grid: Grid) -> None:
    """Raise `ValueError` if a contact has not converged, or differs from the peer's by an RMS of 0.1 % of the peak."""
    pressures, converged = np.asarray(ours.pressure), np.asarray(ours.converged)  # type: ignore[attr-defined]
    if not converged.all():
        raise ValueError(f"{work}: {np.sum(~converged)} contacts have not converged.")
    for mine, pressure in zip(pressures, theirs, strict=False):
        difference = np.sqrt(np.mean((mine - pressure) ** 2)) / pressure.max()
        if difference > 1e-3:
            raise ValueError(f"{work}: pressures differ by {difference:.1e} of the peak from those of {PEER}.")


def _grid(cells: int) -> Grid:
    """Grid with `cells` cells along each edge and the period of the default."""
    return Grid(cells, cells * GRID.modes // GRID.cells)


def touches(grid: Grid, shapes: list[str], batch: int) -> tuple[jax.Array, jax.Array]:
    """Heights (batch, n, n) and indentations (batch,) in metres, of the shapes in turn at random positions."""
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    rng = np.random.default_rng(0)
    heights, indentations = [], []
    for i in range(batch):
        shape, indentation = SHAPES[shapes[i % len(shapes)]]
        dx, dy = rng.uniform(-3e-3, 3e-3, 2)
        height = shape(x - dx, y - dy)
        heights.append(height - height.min())
        indentations.append(indentation)
    return jnp.asarray(np.stack(heights), jnp.float32), jnp.asarray(indentations, jnp.float32)


def _ball(radius: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    square = radius**2 - x**2 - y**2
    return np.where(square > 0, radius - np.sqrt(np.maximum(square, 0)), NO_SURFACE_M)


def _stamp(tilt: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    bars = ((abs(x) < 1e-3) & (abs(y) < 5e-3)) | ((abs(x) < 5e-3) & (abs(y - 4e-3) < 1e-3))
    return np.where(bars, 0, 3.5e-3) + tilt * (x + 15e-3)


def _punch(tilt: float, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(x**2 + y**2 < 4e-3**2, tilt * (x + 15e-3), NO_SURFACE_M)


def _edge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.maximum(0.5 * (x + 0.3 * y), -(x + 0.3 * y))


SHAPES: dict[str, tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], float]] = {
    "ball of 16 mm": (partial(_ball, 8e-3), 0.6e-3),
    "ball of 4.6 mm": (partial(_ball, 2.3e-3), 0.5e-3),
    "punch": (partial(_punch, 0.0), 0.2e-3),
    "tilted punch": (partial(_punch, 0.02), 0.2e-3),
    "stamp T": (partial(_stamp, 0.0), 0.2e-3),
    "tilted stamp": (partial(_stamp, 0.03), 0.3e-3),
    "edge": (_edge, 0.2e-3),
}
