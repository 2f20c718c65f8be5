"""Pressure on the skin at a contact: the geometry half of predicting a touch.

Heights over the cells of the skin come from a view or from a mesh at a pose, and are pressed with a given load into an
elastic layer (`press_heights`, by `i2t.skin.contact`): `predict_pressure` is that of a view, `surface_pressure` that of
a mesh.

A view is smoothed to robust local planes (`i2t.contact.smoothing`), resampled to cells over the skin, and pressed with
the measured force into a layer of nominal stiffness. What the camera cannot tell, the tilt between looking and
pressing, is integrated out: the pressure is the mean over a 3 x 3 Gauss-Hermite rule in the two tilts, because one
degree over 20 mm is as large as a press is deep and a single guess would put all of the load on the wrong edge. The
result, a pressure map and its load, says where and how hard the skin is met; which reading that gives is a property of
one pad's magnetisation and is learned from its touches (`i2t.skin_models.pressure_gp`).

Wide views are used where there are any; of a cropped one the outermost pixels are continued. Forces are positive where
they press, and depths count from first contact; what a recording counts otherwise is corrected when it is read
(`i2t.recordings.sets`).
"""

from dataclasses import dataclass, field
from functools import cache, partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.contact import smoothing
from i2t.contact.approach import facing_surface
from i2t.patches.dimensions import PAD_WINDOW
from i2t.runtime.batching import size_classes
from i2t.runtime.compiling import traced_floats
from i2t.skin.contact import CELL_GRID, Grid, solve, solve_force
from i2t.skin.pad import nominal_pad
from i2t.types import Array as AnyArray
from i2t.types import Pad, Surface, in_one_line

CELL_MM = 1.0  # mm
SOLVER_TOLERANCE = 1e-3  # of the contact: far below the uncertainty of what is pressed
MAX_STEPS = 25  # of the contact solver, which meets that tolerance in them from any start

# Gauss-Hermite, three points: exact to the fifth moment of the tilt.
_NODES = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]) * np.sqrt(3)
_WEIGHTS = np.array(
    [{0: 2 / 3, 1: 1 / 6}[abs(x)] * {0: 2 / 3, 1: 1 / 6}[abs(y)] for x in (-1, 0, 1) for y in (-1, 0, 1)]
)


@in_one_line
class ContactPressure(NamedTuple):
    """The pressure of a contact on the skin's surface; one touch, or many on axis 0."""

    pressure: Float[Array, "*n m m"]  # N on each 1 mm cell
    load: Float[Array, "*n"]  # N, total


@traced_floats
@dataclass(frozen=True)
class PressureModelConfig:
    """Options of the pressure model. Metres, radians, newtons."""

    pitch: float  # m, edge of a pixel of the view
    window: float = field(default=PAD_WINDOW, metadata={"static": True})  # m, edge of the square that can carry load
    smooth: bool = True  # off for views without noise
    tilt: float = 0.6 * np.pi / 180  # standard deviation of the tilt that the view does not show, about each axis
    control: Literal["force", "depth"] = "force"  # what the press is known by
    # m, edge of a cell of the contact grid; divides 1 mm
    cell: float = field(default=0.5e-3, metadata={"static": True})
    iterations: int = MAX_STEPS  # of the contact solver
    floor: float = 0.02  # N, least load, where a noisy wrench sensor says less
    softness: float = 1.0  # of the layer that is pressed, in units of the pad's: of one twice as soft, E is halved

    def __post_init__(self) -> None:
        """Refuse cells that do not tile the skin, and a layer of no stiffness (ValueError)."""
        if not (np.isfinite(self.softness) and self.softness > 0):
            raise ValueError(f"softness is {self.softness:g}; give a positive number, 1 for a nominal layer")
        for name, length in (("1 mm", CELL_MM * 1e-3), ("the window", self.window)):
            count = length / self.cell
            if count < 0.5 or abs(count - round(count)) > 1e-6 * count:
                raise ValueError(f"cell is {self.cell:g} m, which does not divide {name}; take 0.5e-3 or 1e-3")

    @property
    def grid(self) -> Grid:
        """The contact grid and its period of 1.6 windows."""
        cells = round(self.window / self.cell)
        return Grid(cells=cells, modes=int(np.ceil(1.6 * cells / 2) * 2), window=self.window)


def press_heights(
    pad: Pad,
    height: Float[Array, "g g"],
    load: Float[Array, ""] | float,
    grid: Grid = CELL_GRID,
    *,
    max_steps: int = MAX_STEPS,
) -> tuple[Float[Array, "g g"], Float[Array, ""]]:
    """Press a layer onto a surface with a load, to `SOLVER_TOLERANCE`.

    Args:
        pad: Whose layer is pressed.
        height: m, of the surface behind its nearest point, over the cells of the grid.
        load: N, above 0.
        grid: Cells of the skin.
        max_steps: Of the contact solver.

    Returns:
        Pressure (Pa) on each cell, which carries the load, and the indentation (m) past first contact.
    """
    contact = solve_force(pad, height, load, grid, tolerance=SOLVER_TOLERANCE, max_steps=max_steps)
    return contact.pressure * load / jnp.maximum(contact.force, 1e-6), contact.indentation


def surface_pressure(
    pad: Pad, surface: Surface, T_o_t: Float[Array, "4 4"], loads: Float[Array, " l"]
) -> tuple[ContactPressure, Float[Array, " l"]]:
    """Contact pressures of a layer that is pressed onto a mesh with each of some loads.

    Args:
        pad: Whose layer is pressed.
        surface: Of the object.
        T_o_t: The skin's pose at first contact.
        loads: N; less than `PressureModelConfig.floor` counts as that.

    Returns:
        Pressure (N on each 1 mm cell) and load (N) of each press, and its indentation (m) past that pose; without
        pressure and infinite where nothing lies before the skin.
    """
    height, nearest = facing_surface(surface, T_o_t, CELL_GRID)
    met, loads = jnp.isfinite(nearest), jnp.maximum(loads, PressureModelConfig.floor)
    behind = jnp.where(met, height, 0.0)
    pressure, indentation = jax.vmap(lambda load: press_heights(pad, behind, load))(loads)
    newtons = jnp.where(met, newtons_on_cells(pressure, CELL_GRID), 0.0)
    return ContactPressure(newtons, loads), jnp.where(met, nearest + indentation, jnp.inf)


def newtons_on_cells(pressure: Float[AnyArray, "*n g g"], grid: Grid) -> Float[AnyArray, "*n m m"]:
    """Newtons on each cell of 1 mm.

    Args:
        pressure: Pa, on the cells of a grid.
        grid: That grid; a whole number of its cells fits along 1 mm.

    Returns:
        Newtons, of NumPy where the pressure is.
    """
    fine = round(CELL_MM * 1e-3 / grid.spacing)
    cells = pressure.shape[-1] // fine
    return pressure.reshape(*pressure.shape[:-2], cells, fine, cells, fine).sum((-3, -1)) * grid.spacing**2


def centre_of_pressure(pressure: Float[AnyArray, "*n g g"], grid: Grid) -> Float[Array, "*n 2"]:
    """Centre of a pressure on the skin.

    Args:
        pressure: Pa, on the cells of a grid.
        grid: That grid.

    Returns:
        x and y (m); 0 without pressure.
    """
    total = pressure.sum((-2, -1))
    along = jnp.stack([pressure.sum(-2) @ grid.centres, pressure.sum(-1) @ grid.centres], -1)
    return along / jnp.where(total > 0, total, 1)[..., None]


def heights(cfg: PressureModelConfig, view: Float[Array, "n n"]) -> Float[Array, "g g"]:
    """Heights of the view over the cells of the skin.

    Args:
        cfg: How pressure is predicted.
        view: m, depth view about the tool axis; NaN where nothing is known.

    Returns:
        m, of the view, at the centres of the contact grid's cells.
    """
    if cfg.smooth:
        view = smoothing.local_planes(view)
    view = smoothing.fill(view)
    at = cfg.grid.centres / cfg.pitch + (view.shape[0] - 1) / 2
    row, column = jnp.meshgrid(at, at, indexing="ij")
    return jax.scipy.ndimage.map_coordinates(view, [row, column], order=1, mode="nearest")


def predict_pressure(
    cfg: PressureModelConfig,
    pad: Pad,
    view: Float[Array, "n n"],
    force: Float[Array, ""],
    depth: Float[Array, ""],
) -> ContactPressure:
    """Contact pressure of a press on the surface in the view.

    Of `force` and `depth` only the one named by `cfg.control` is used. A press known by its depth alone gets the load
    that the nominal layer gives.

    Args:
        cfg: How pressure is predicted.
        pad: Whose layer is pressed.
        view: m, depth view; NaN where nothing is known.
        force: N, along tool z, positive where it presses.
        depth: m, past first contact.

    Returns:
        Pressure (N on each 1 mm cell) and its load (N).
    """
    grid = cfg.grid
    pad = pad._replace(young=pad.young / cfg.softness)
    height = heights(cfg, view)
    x, y = jnp.meshgrid(grid.centres, grid.centres)

    def press(tilt: Float[Array, "2"]) -> Float[Array, "g g"]:
        tilted = height + cfg.tilt * (tilt[0] * x + tilt[1] * y)
        tilted = tilted - jnp.min(tilted)
        if cfg.control == "force":
            load = jnp.maximum(force, cfg.floor)
            return press_heights(pad, tilted, load, grid, max_steps=cfg.iterations)[0]
        indentation = jnp.maximum(depth, 0.0)
        return solve(pad, tilted, indentation, grid, tolerance=SOLVER_TOLERANCE, max_steps=cfg.iterations).pressure

    # Without a tilt the middle node is pressed alone.
    tilted, middle, nodes = cfg.tilt > 0, len(_NODES) // 2, jnp.float32(_NODES)
    first, last = jnp.where(tilted, 0, middle), jnp.where(tilted, len(_NODES), middle + 1)
    pressures = jax.lax.fori_loop(
        first, last, lambda i, some: some.at[i].set(press(nodes[i])), jnp.zeros((len(_NODES), grid.cells, grid.cells))
    )
    weights = jnp.where(tilted, jnp.float32(_WEIGHTS), jnp.arange(len(_NODES)) == middle)
    pressure = jnp.einsum("t,tij->ij", weights, pressures)
    newtons = newtons_on_cells(pressure, grid)
    return ContactPressure(newtons, jnp.maximum(jnp.sum(newtons), cfg.floor))


def predict_pressures(
    cfg: PressureModelConfig, views: np.ndarray, force: np.ndarray, depth: np.ndarray, pad: Pad | None = None
) -> ContactPressure:
    """The contact pressures of many touches, in batches of few sizes, so that a new number of them compiles nothing.

    Args:
        cfg: How pressure is predicted.
        views: (n, w, w) m, depth views; NaN where the recording was cropped.
        force: (n,) N along tool z.
        depth: (n,) m past first contact.
        pad: Whose layer is pressed; left out, one of nominal stiffness.

    Returns:
        Pressures and loads, n on axis 0.
    """
    columns, pressed = [np.asarray(x, np.float32) for x in (views, force, depth)], pad or _nominal_pad()
    parts = [_pressures(cfg, pressed, *(x[rows] for x in columns)) for rows in size_classes(len(views))]
    # Only the last part is filled up.
    return jax.tree.map(lambda *found: jnp.asarray(np.concatenate(found)[: len(views)]), *parts)


_nominal_pad = cache(nominal_pad)  # whose making takes a fifth of a single prediction


@jax.jit
def _pressures(cfg: PressureModelConfig, pad: Pad, views: Array, force: Array, depth: Array) -> ContactPressure:
    return jax.vmap(partial(predict_pressure, cfg, pad))(views, force, depth)
