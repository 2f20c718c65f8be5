"""A pad fitted to presses of a ball, in place of the true one."""

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


def fit_pad(key: Array, pad: Pad, errors: SimulationErrors, presses: int) -> Pad:
    """Fit a pad to presses of a ball at random positions on the true pad.

    The presses are simulated by the full physics and end at 100 uT or 8 N. The fit uses nominal positions, measured
    forces and readings, and the layout of the board. Its contacts are solved on cells of 1 mm, as for a library.

    Args:
        key: Random key of the presses.
        pad: The true pad.
        errors: Simulated errors of the arm's position, the slant, the force and the sensor.
        presses: Number of presses; below `MagnetizationModel.max_layer_presses` the layer stays at its prior's median.

    Returns:
        The fitted pad.
    """
    key_position, key_missed, key_press = jax.random.split(key, 3)
    position = jax.random.uniform(key_position, (presses, 2), minval=-8e-3, maxval=8e-3)
    missed = errors.repeatability * jax.random.normal(key_missed, position.shape)
    curves = press_all(jax.random.split(key_press, presses), pad, jax.vmap(TIP.height)(position + missed), errors)
    ends = TipReadings(position, curves.force[:, -1], curves.reading[:, -1], pad.board)
    enough = MagnetizationModel.max_layer_presses
    layer_presses = enough if presses >= enough else 0
    model = MagnetizationModel(TIP, by_force=True, grid=CELL_GRID, max_layer_presses=layer_presses)
    return model.fit(None, ends).pad


@jax.jit
def press_all(keys: Array, pad: Pad, heights: Array, errors: SimulationErrors) -> PressCurve:
    """Press a pad onto each surface, with two stops.

    Args:
        keys: (n,) random keys.
        pad: The skin.
        heights: (n, g, g) m, surfaces over the cells of the simulated contact.
        errors: Simulated errors of slant, force, travel and sensor.

    Returns:
        The press curves, n on axis 0.
    """

    def press(inputs: tuple[Array, Array]) -> PressCurve:
        key, height = inputs
        return simulate_press_curve(key, pad, height, errors=errors, limits=PressLimits())

    return map_batches(press, (keys, heights), batch_size=16)
