"""A pad that is known from presses of a ball, in place of the true one."""

import jax

from i2t.contact.press import PressLimits
from i2t.runtime.batching import map_batches
from i2t.simulation.press_curves import PressCurve, simulate_press_curve
from i2t.simulation.touches import SimulationErrors
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.magnetic_layer import RoundTip
from i2t.skin_models.magnetization import MagnetizationModel, TipReadings
from i2t.types import Array, Pad

TIP = RoundTip("sphere", 4e-3)
HALF_EDGE_M = 8e-3  # of the square of the skin that is pressed
PRESSES_AT_ONCE = 16


def fit_pad(key: Array, pad: Pad, errors: SimulationErrors, presses: int) -> Pad:
    """Fit a pad to presses of a ball at random places of the true one.

    The presses are simulated by the full physics and end at 100 uT or 8 N. The fit is given their believed positions,
    measured forces and readings, and the layout of the board, and solves contacts on cells of 1 mm, as a library does.

    Args:
        key: Random key of the presses.
        pad: The true pad.
        errors: Of the arm's position, the slant, the force and the sensor.
        presses: Number of presses; below `MagnetizationModel.max_layer_presses` the layer stays at its prior's median.

    Returns:
        The fitted pad.
    """
    key_position, key_missed, key_press = jax.random.split(key, 3)
    position = jax.random.uniform(key_position, (presses, 2), minval=-HALF_EDGE_M, maxval=HALF_EDGE_M)
    missed = errors.repeatability * jax.random.normal(key_missed, position.shape)
    curves = press_all(jax.random.split(key_press, presses), pad, jax.vmap(TIP.height)(position + missed), errors)
    ends = TipReadings(position, curves.force[:, -1], curves.reading[:, -1], pad.board)
    enough = MagnetizationModel.max_layer_presses
    layer_presses = enough if presses >= enough else 0
    model = MagnetizationModel(TIP, by_force=True, grid=CELL_GRID, max_layer_presses=layer_presses)
    return model.fit(None, ends).pad


@jax.jit
def press_all(keys: Array, pad: Pad, heights: Array, errors: SimulationErrors) -> PressCurve:
    """Press a pad onto every surface, with two stops.

    Args:
        keys: (n,) random keys.
        pad: The skin.
        heights: (n, g, g) m, over the cells of the simulated contact.
        errors: Of slant, force, travel and sensor.

    Returns:
        The stops of all presses.
    """

    def one(each: tuple[Array, Array]) -> PressCurve:
        return simulate_press_curve(each[0], pad, each[1], errors=errors, limits=PressLimits())

    return map_batches(one, (keys, heights), batch_size=PRESSES_AT_ONCE)
