"""Gaussian process of one skin with given hyperparameters: a mixture of one kernel.

A reading of channel c of a press at x (m, tool frame) with the load d, its travel (m) or its normal force (N), is

  y_c = e_c(x) [f(d) g_c(x) + f(d) b_c(x, d) + g0_c(x)] + const_c + noise,
  f(d) = ((d + load_offset) / (unit_load + load_offset))^load_power,

as in `i2t.skin_models.tip_gp.kernel`. If the surface is not flat, d is replaced by d + h(x), with one height h per
position for all channels, which is estimated as in `i2t.skin_models.tip_gp.population`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.skin_models.tip_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels
from i2t.skin_models.tip_gp.population import PopulationGP, PressTable, fit_one


class StructuredGPHyperparameters(NamedTuple):
    """Hyperparameters of one kernel, by which a tip's readings on a skin are predicted from position and load.

    Loads have the unit of the presses' loads (m or N); variances are relative to a channel's at the unit load.

    Example:
        from i2t.skin_models import FORCE_HYPERPARAMETERS

        stiff = FORCE_HYPERPARAMETERS._replace(unit_load=2.0)  # N
        calibration = i2t.calibrate(positions, forces, readings, load_kind="force", hyperparameters=stiff)
    """

    unit_load: float  # load at which f is 1
    load_offset: float  # load below zero at which f vanishes: f is zero at minus this load
    load_power: float
    map_length: float  # m, length scale of the maps g and g0
    map_variance: float  # variance of the map g
    bend_variance: float  # variance of the bend b
    bend_length: float  # m, length scale of the bend b
    bend_load_width: float  # width of the bend b over the load
    static_variance: float  # variance of the map g0
    constant_variance: float  # variance of the constant const
    noise_variance: float  # variance of the noise and of model errors
    height_std: float  # standard deviation of the local heights h, as a load
    height_length: float  # m, length scale of the local heights h
    chip_reach: float  # m, distance over which the amplitude e falls
    far_amplitude: float  # amplitude e far from the chip


# Hyperparameters of the structured process with travel (m) as the load, fitted to the development presses of one eFlesh
# session (docs/calibration.md). The long length is of the order of the height of the magnets over the chips and of
# their spacing; the short one is that of a lattice's struts.
TRAVEL_HYPERPARAMETERS = StructuredGPHyperparameters(
    unit_load=2e-3, load_offset=2.7e-3, load_power=1.8, map_length=16.5e-3, map_variance=1.0, bend_variance=0.0145,
    bend_length=2e-3, bend_load_width=7e-3, static_variance=0.03, constant_variance=2e-3, noise_variance=4.5e-3,
    height_std=0.17e-3, height_length=1.8e-3, chip_reach=10e-3, far_amplitude=0.2,
)  # fmt: skip
# Hyperparameters of the structured process with force (N) as the load, fitted to 24 simulated boards pressed with a
# spherical tip of 4 mm to 0.2 to 1 N, by a coordinate search on the leave-one-out R2. The result is a map of two
# lengths, the layer's thickness and twice that, hardly bent by the load. The static part is a guess, because simulated
# boards have none, but real ones may.
FORCE_HYPERPARAMETERS = StructuredGPHyperparameters(
    unit_load=1.0, load_offset=0.24, load_power=1.4, map_length=2.1e-3, map_variance=1.0, bend_variance=5.2,
    bend_length=5e-3, bend_load_width=7.8, static_variance=0.3, constant_variance=0.1, noise_variance=1.7e-2,
    height_std=0.0, height_length=2e-3, chip_reach=5.8e-3, far_amplitude=0.013,
)  # fmt: skip


def fit_structured(
    hyperparameters: StructuredGPHyperparameters,
    presses: PressTable,
    readings: Float[np.ndarray, "n c"],
    chip_positions: Float[np.ndarray, "chips 2"] | None = None,
) -> PopulationGP:
    """Condition a Gaussian process with given hyperparameters on n presses and their readings.

    Args:
        hyperparameters: Hyperparameters of the process.
        presses: n presses with one load each.
        readings: `(n, c)` readings of the presses (uT); with chips, three channels for each in the chips' order.
        chip_positions: `(chips, 2)` chip positions (m), for amplitudes that fall with the distance from the chips.

    Returns:
        The conditioned process.
    """
    h = StructuredGPHyperparameters(*(float(value) for value in hyperparameters))
    variance = h.map_variance + h.bend_variance  # of map and bend together, which is 1 in a kernel
    values = {
        "load_power": h.load_power, "load_offset": h.load_offset / h.unit_load, "map_length": h.map_length,
        "bend_share": h.bend_variance / variance, "bend_length": h.bend_length,
        "bend_load_width": h.bend_load_width / h.unit_load, "static_variance": h.static_variance / variance,
        "static_length": h.map_length, "constant_variance": h.constant_variance / variance,
        "noise_variance": h.noise_variance / variance, "gain_noise_variance": 0.0, "chip_reach": h.chip_reach,
        "far_amplitude": UNIFORM_FAR_AMPLITUDE if chip_positions is None else h.far_amplitude,
    }  # fmt: skip
    return fit_one(
        SkinKernels(**{name: np.array([value]) for name, value in values.items()}),
        presses,
        readings,
        typical_load=h.unit_load,
        chip_positions=chip_positions,
        height_std=h.height_std / h.unit_load,
        height_length=h.height_length,
    )
