"""Simulate presses with several stops, by the full physics: test data for inference of the local shape.

A press continues past a first change of the reading to a second one, or to the largest force. Its slope stays the same,
and each stop is measured with the errors of `SimulationErrors`. Contacts are solved on cells of half a millimetre and
friction to its default tolerance, both more accurate than predictions from a library.

Metres, newtons, microtesla; functions take a single press and are lifted by `vmap`.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Key

from i2t.contact.press import PressLimits, pad_response, press_to_stop
from i2t.contact.pressure import centre_of_pressure, newtons_on_cells
from i2t.simulation.touches import SimulationErrors
from i2t.skin.contact import GRID, cells_in_contact
from i2t.skin.noise import add_sensor_noise
from i2t.skin.pad import friction_response
from i2t.types import Array, Pad


class PressCurve(NamedTuple):
    """Simulated press with s stops: measured reading (uT), force (N) and travel past first contact (m) at each, and the
    true force on each cell (N) and centre of pressure (m).
    """

    reading: Float[Array, "*batch s c"]  # uT, reading at each travel
    force: Float[Array, "*batch s"]  # N, force at each travel
    travel: Float[Array, "*batch s"]  # m past first contact, including the deflection of arm and mount
    newtons: Float[Array, "*batch s cells"]  # N, true force on each cell of 1 mm
    centre: Float[Array, "*batch s 2"]  # m, true centre of pressure (x, y)

    @property
    def contact(self) -> Bool[Array, "*batch s cells"]:
        """Mask of the cells of 1 mm that truly bear pressure at each stop."""
        return cells_in_contact(self.newtons)


def simulate_press_curve(
    key: Key[Array, ""],
    pad: Pad,
    heights: Float[Array, "g g"],
    *,
    errors: SimulationErrors,
    limits: PressLimits,
    skin_changes: tuple[float, ...] = (25.0, 100.0),
) -> PressCurve:
    """Press a pad onto a surface, past several changes of its reading.

    Args:
        key: Random key.
        pad: The skin.
        heights: Heights (m) of the surface beyond the plane of first contact, over the cells of
            `i2t.skin.contact.GRID`.
        errors: Sizes of the errors of slant, force, travel and sensor.
        limits: Limits of the press, whose skin change is ignored.
        skin_changes: Changes (uT) of the reading at which the press stops, by default the paper's and four times that.

    Returns:
        Press with s stops, one for each change: measurements with errors, and the true contact.
    """
    key_slant, key_force, key_travel, key_sensor = jax.random.split(key, 4)
    stops = len(skin_changes)
    nearest = jnp.min(heights)
    height = heights - nearest
    slant = errors.slant * jax.random.normal(key_slant, (2,))
    force_error = errors.force * jax.random.normal(key_force, (stops,))
    # The arm's repeatability adds an error at first contact, and another at each stop.
    missed = errors.repeatability * jax.random.normal(key_travel, (stops + 1,))

    response = pad_response(pad)

    def stop(limits: PressLimits, key: Array) -> tuple[Array, ...]:
        end = press_to_stop(pad, height, limits, response=response)
        friction = friction_response(pad, height, end.indentation, slant * end.indentation, pressed=end.press)
        read = add_sensor_noise(key, end.reading + friction, pad.board, errors.noise)
        cells, centre = newtons_on_cells(end.pressure, GRID), centre_of_pressure(end.pressure, GRID)
        travel = nearest + end.indentation + end.force / limits.stiffness
        return read, end.force, travel, cells.reshape(-1), centre

    keys = jax.random.split(key_sensor, stops)
    at_stops = [replace(limits, skin_change=change) for change in skin_changes]
    # The stops are mapped in turn, so that the press is compiled once.
    reading, force, travel, newtons, centre = jax.lax.map(
        lambda arguments: stop(*arguments), (jax.tree.map(lambda *sizes: jnp.asarray(sizes), *at_stops), keys)
    )
    measured = jnp.maximum(force + force_error, 0)
    return PressCurve(reading, measured, travel + missed[0] + missed[1:], newtons, centre)
