"""Pressure on the skin at a contact, the geometric half of predicting a touch.

`press_heights` presses heights over the cells of the skin into an elastic layer with a given load, using
`i2t.skin.contact`. The heights come from a view (`predict_pressure`) or from a mesh at a pose (`surface_pressure`).

A view is smoothed to robust local planes (`i2t.contact.smoothing`), resampled to cells over the skin, and pressed with
the measured force into a layer of nominal stiffness. The camera does not observe the tilt between looking and pressing,
so it is integrated out: the pressure is the mean over a 3 x 3 Gauss-Hermite rule in the two tilts. One degree over
20 mm is as much as a press is deep, and a single guess would put the whole load on the wrong edge. The resulting
pressure map shows where and how hard the skin is touched. The reading that follows from it depends on the magnetisation
of the pad and is learned from its touches (`i2t.skin_models.pressure_gp`).

Views include the surroundings of the patch if they were recorded; the outermost pixels of a cropped view are repeated.
Forces are positive in compression, and travel counts from first contact. Recordings with other conventions are
corrected when they are read (`i2t.recordings.sets`).
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
from i2t.runtime.compiling import compiles_slowly, traced_floats
from i2t.skin.contact import CELL_GRID, Grid, solve, solve_force
from i2t.skin.pad import nominal_pad
from i2t.types import Array as AnyArray
from i2t.types import Pad, Surface, in_one_line

CELL_MM = 1.0  # mm, edge of a cell of `ContactPressure`
SOLVER_TOLERANCE = 1e-3  # largest violation of the contact conditions, relative to the largest deflection
MAX_SOLVER_STEPS = 25  # number of steps in which the contact solver reaches `SOLVER_TOLERANCE` from any start

# Nodes of the three-point Gauss-Hermite rule in the two tilts, in standard deviations; exact to the fifth moment of the
# tilt.
_TILT_NODES = np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1)]) * np.sqrt(3)
# Weights of `_TILT_NODES` in the mean over the tilt.
_TILT_WEIGHTS = np.array(
    [{0: 2 / 3, 1: 1 / 6}[abs(x)] * {0: 2 / 3, 1: 1 / 6}[abs(y)] for x in (-1, 0, 1) for y in (-1, 0, 1)]
)


@in_one_line
class ContactPressure(NamedTuple):
    """Force (N) on each 1 mm cell of the skin's surface, and its sum, of one touch or of many along axis 0."""

    pressure: Float[Array, "*n m m"]  # N, force on each cell of 1 mm
    load: Float[Array, "*n"]  # N, total force


@traced_floats
@dataclass(frozen=True)
class PressureModelConfig:
    """Options of the contact model that predicts the pressure on a skin from a depth view (m, rad, N)."""

    pitch: float  # m, edge of a pixel of the view
    window: float = field(default=PAD_WINDOW, metadata={"static": True})  # m, edge of the square that can carry load
    smooth: bool = True  # whether views are smoothed; views without noise need not be
    tilt: float = 0.6 * np.pi / 180  # rad, standard deviation about each axis of the tilt that the view does not show
    control: Literal["force", "travel"] = "force"  # measurement that determines how hard the skin is pressed
    # m, edge of a cell of the contact grid; it must divide 1 mm
    cell: float = field(default=0.5e-3, metadata={"static": True})
    iterations: int = MAX_SOLVER_STEPS  # steps of the contact solver
    floor: float = 0.02  # N, smallest load that is used; a noisy wrench sensor may report less
    softness: float = 1.0  # factor that divides Young's modulus of the pad: a layer twice as soft has softness 2

    def __post_init__(self) -> None:
        """Refuse cells that do not tile the skin, and a layer without stiffness (ValueError)."""
        if not (np.isfinite(self.softness) and self.softness > 0):
            raise ValueError(f"softness is {self.softness:g}; give a positive number, 1 for a nominal layer")
        for name, length in (("1 mm", CELL_MM * 1e-3), ("the window", self.window)):
            count = length / self.cell
            if count < 0.5 or abs(count - round(count)) > 1e-6 * count:
                raise ValueError(f"cell is {self.cell:g} m, which does not divide {name}; take 0.5e-3 or 1e-3")

    @property
    def grid(self) -> Grid:
        """Grid of cells on which the contact is solved, with a period of 1.6 windows."""
        cells = round(self.window / self.cell)
        return Grid(cells=cells, modes=int(np.ceil(1.6 * cells / 2) * 2), window=self.window)


def press_heights(
    pad: Pad,
    height: Float[Array, "g g"],
    load: Float[Array, ""] | float,
    grid: Grid = CELL_GRID,
    *,
    max_steps: int = MAX_SOLVER_STEPS,
) -> tuple[Float[Array, "g g"], Float[Array, ""]]:
    """Compute the pressure on a pad's elastic layer that is pressed onto a height map with a given load.

    Args:
        pad: Pad whose layer is pressed.
        height: Depth (m) of the surface behind its nearest point, over the g x g cells of the grid.
        load: Load (N), above 0.
        grid: Cells of the skin.
        max_steps: Largest number of steps of the contact solver.

    Returns:
        Pressure (Pa) on each cell, solved to within `SOLVER_TOLERANCE` and scaled to carry the load, and the
        indentation (m) past first contact.
    """
    contact = solve_force(pad, height, load, grid, tolerance=SOLVER_TOLERANCE, max_steps=max_steps)
    return contact.pressure * load / jnp.maximum(contact.force, 1e-6), contact.indentation


def surface_pressure(
    pad: Pad, surface: Surface, T_o_t: Float[Array, "4 4"], loads: Float[Array, " l"]
) -> tuple[ContactPressure, Float[Array, " l"]]:
    """Compute the contact pressure of a pad that is pressed onto a mesh with each of several loads.

    Args:
        pad: Pad whose layer is pressed.
        surface: Surface of the object.
        T_o_t: Pose (m) of the skin in the object's frame at first contact.
        loads: Loads (N). A load below `PressureModelConfig.floor` is raised to it.

    Returns:
        Contact pressure of each of the l presses, and its indentation (m) past that pose. If no surface is in front
        of the skin, the pressure is zero and the indentation infinite.
    """
    height, nearest = facing_surface(surface, T_o_t, CELL_GRID)
    hit, loads = jnp.isfinite(nearest), jnp.maximum(loads, PressureModelConfig.floor)
    behind = jnp.where(hit, height, 0.0)
    pressure, indentation = jax.vmap(lambda load: press_heights(pad, behind, load))(loads)
    newtons = jnp.where(hit, newtons_on_cells(pressure, CELL_GRID), 0.0)
    return ContactPressure(newtons, loads), jnp.where(hit, nearest + indentation, jnp.inf)


def newtons_on_cells(pressure: Float[AnyArray, "*n g g"], grid: Grid) -> Float[AnyArray, "*n m m"]:
    """Convert a pressure on fine cells to the force on each 1 mm cell of the skin.

    Args:
        pressure: Pressure (Pa) on the g x g cells of a grid.
        grid: The grid, whose cells divide 1 mm.

    Returns:
        `(*n, m, m)` forces (N) on m x m cells of 1 mm, a NumPy array if the pressure is one.
    """
    fine = round(CELL_MM * 1e-3 / grid.spacing)
    cells = pressure.shape[-1] // fine
    return pressure.reshape(*pressure.shape[:-2], cells, fine, cells, fine).sum((-3, -1)) * grid.spacing**2


def centre_of_pressure(pressure: Float[AnyArray, "*n g g"], grid: Grid) -> Float[Array, "*n 2"]:
    """Compute the centre of pressure on the skin.

    Args:
        pressure: Pressure (Pa) on the cells of a grid.
        grid: The grid.

    Returns:
        `(*n, 2)` coordinates x and y (m) in the tool frame; 0 if there is no pressure.
    """
    total = pressure.sum((-2, -1))
    along = jnp.stack([pressure.sum(-2) @ grid.centres, pressure.sum(-1) @ grid.centres], -1)
    return along / jnp.where(total > 0, total, 1)[..., None]


def heights(cfg: PressureModelConfig, view: Float[Array, "n n"]) -> Float[Array, "g g"]:
    """Smooth a depth view (if `cfg.smooth`), fill its unknown border, and resample it to the cells of the contact grid.

    Args:
        cfg: Options of the pressure model.
        view: Depth view (m) centred on the tool axis, NaN where it is unknown.

    Returns:
        `(g, g)` depths (m) at the centres of the cells of the contact grid.
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
    travel: Float[Array, ""],
) -> ContactPressure:
    """Predict the mean contact pressure, over unknown tilts, on a pad that is pressed onto the surface in a depth view.

    Only the force or the travel is used, as `cfg.control` says. The travel is taken for the indentation of the pad's
    layer, whose load follows from it.

    Args:
        cfg: Options of the pressure model.
        pad: Pad whose layer is pressed.
        view: Depth view (m), NaN where it is unknown.
        force: Force (N) along tool z, positive in compression; raised to `cfg.floor` if it is smaller.
        travel: Travel (m) past first contact; raised to 0 if it is negative.

    Returns:
        Predicted force (N) on each 1 mm cell, and its sum.
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
        indentation = jnp.maximum(travel, 0.0)
        return solve(pad, tilted, indentation, grid, tolerance=SOLVER_TOLERANCE, max_steps=cfg.iterations).pressure

    # Without a tilt, only the central node is pressed.
    tilted, middle, nodes = cfg.tilt > 0, len(_TILT_NODES) // 2, jnp.float32(_TILT_NODES)
    first, last = jnp.where(tilted, 0, middle), jnp.where(tilted, len(_TILT_NODES), middle + 1)
    pressures = jax.lax.fori_loop(
        first,
        last,
        lambda i, parts: parts.at[i].set(press(nodes[i])),
        jnp.zeros((len(_TILT_NODES), grid.cells, grid.cells)),
    )
    weights = jnp.where(tilted, jnp.float32(_TILT_WEIGHTS), jnp.arange(len(_TILT_NODES)) == middle)
    pressure = jnp.einsum("t,tij->ij", weights, pressures)
    newtons = newtons_on_cells(pressure, grid)
    return ContactPressure(newtons, jnp.maximum(jnp.sum(newtons), cfg.floor))


def predict_pressures(
    cfg: PressureModelConfig, views: np.ndarray, force: np.ndarray, travel: np.ndarray, pad: Pad | None = None
) -> ContactPressure:
    """Predict the contact pressures of many touches from depth views; batches of a few sizes reuse compiled code.

    Args:
        cfg: Options of the pressure model.
        views: `(n, w, w)` depth views (m), NaN where the recording was cropped.
        force: `(n,)` forces (N) along tool z.
        travel: `(n,)` travels (m) past first contact.
        pad: Pad whose layer is pressed; the nominal pad if not given.

    Returns:
        Forces (N) on the 1 mm cells in the n touches, along axis 0.
    """
    columns, pressed = [np.asarray(x, np.float32) for x in (views, force, travel)], pad or _nominal_pad()
    parts = [_pressures(cfg, pressed, *(x[rows] for x in columns)) for rows in size_classes(len(views))]
    # Only the last batch is padded.
    return jax.tree.map(lambda *batches: jnp.asarray(np.concatenate(batches)[: len(views)]), *parts)


_nominal_pad = cache(nominal_pad)  # making it takes a fifth of the time of a prediction


@jax.jit
@compiles_slowly("the prediction of contact pressure", seconds=2)
def _pressures(cfg: PressureModelConfig, pad: Pad, views: Array, force: Array, travel: Array) -> ContactPressure:
    return jax.vmap(partial(predict_pressure, cfg, pad))(views, force, travel)
