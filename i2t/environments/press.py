"""One touch of an environment: approach, contact and the end of the press, at cells of 1 mm.

The physics is that of `i2t.simulation.touches`, made quick enough to be learned in. Contacts are solved on cells of
1 mm; the reading is linear in the pressure (`response_map`, one product instead of a field of displaced dipoles), which
holds while the skin moves little next to its distance from the chips. There is no camera, no friction and no memory of
the skin. Against the whole physics, tests/environments/test_press.py measures how much that changes.

Metres, newtons, microtesla; frames as in `i2t.types`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from i2t.contact.press import PadResponse, PressLimits, press_to_stop
from i2t.geometry import full_precision, inverse, random_motion
from i2t.patches.dimensions import PAD_WINDOW
from i2t.rendering.render import render_heights
from i2t.simulation.sites import press_along
from i2t.simulation.touches import SimulationErrors
from i2t.skin.dipoles import linear_response
from i2t.skin.elasticity import CELL_GRID
from i2t.types import Pad, Surface


class TouchOutcome(NamedTuple):
    """End of a touch, before the sensors are read."""

    reading: Float[Array, "*batch c"]  # uT, noise free; 0 where nothing was met
    force: Float[Array, "*batch"]  # N
    advance: Float[Array, "*batch"]  # m, of the arm from the site to the press's end, along the approach
    contact: Bool[Array, "*batch"]  # whether anything was met


class TouchGeometry(NamedTuple):
    """Geometry of the skin's contact with a surface; the same for every pad."""

    height: Float[Array, "n n"]  # m, behind the nearest point, over the pad's cells
    nearest: Float[Array, ""]  # m, of that point along the approach, from the site
    contact: Bool[Array, ""]


def response_map(pad: Pad) -> Float[Array, "c n n"]:
    """Response of a reading to a pressure on each cell of 1 mm, as long as the skin moves little.

    Args:
        pad: the skin.

    Returns:
        uT per Pa.
    """
    return linear_response(pad, CELL_GRID)


@full_precision
def meet(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_site: Float[Array, "4 4"],
    *,
    errors: SimulationErrors,
    limits: PressLimits,
) -> TouchGeometry:
    """Approach along the site's z, with the arm's errors, until the skin meets the surface.

    Args:
        key: random key of the arm's errors.
        surface: of the object, in its frame.
        T_w_o: where the object really is.
        T_w_site: contact pose of the tool, as the lab believes it.
        errors: of the arm: repeatability and angle of approach.
        limits: where the approach starts and gives up.

    Returns:
        The contact.
    """
    arm = random_motion(key, errors.repeatability, errors.approach_angle)
    start = inverse(T_w_o) @ T_w_site @ arm @ jnp.eye(4).at[2, 3].set(-limits.approach_distance)
    T_o_t, hit = press_along(surface, start, start[:3, 2], max_distance=limits.approach_distance + limits.overtravel)
    heights = render_heights(surface, inverse(T_o_t), PAD_WINDOW, CELL_GRID.cells)
    nearest = jnp.min(heights)
    contact = hit & jnp.isfinite(nearest)
    nearest = jnp.where(contact, nearest, 0.0)
    advanced = jnp.dot(T_o_t[:3, 3] - start[:3, 3], start[:3, 2]) - limits.approach_distance
    return TouchGeometry(jnp.where(contact, heights - nearest, 0.0), advanced + nearest, contact)


@full_precision
def press(
    pad: Pad,
    response_of_pad: Float[Array, "c n n"],
    geometry: TouchGeometry,
    overshoot: Float[Array, ""] | float,
    limits: PressLimits,
) -> TouchOutcome:
    """Press a pad onto what it met until the skin change or the force crosses its limit.

    Args:
        pad: the skin.
        response_of_pad: its `response_map`.
        geometry: what it met.
        overshoot: fraction by which both limits are raised.
        limits: of skin change, force and indentation.

    Returns:
        The end of the press; where neither limit is met it ends at the deepest allowed indentation.
    """
    response = PadResponse(response_of_pad, None)
    end = press_to_stop(pad, geometry.height, limits, overshoot, law=None, response=response, grid=CELL_GRID)
    advance = geometry.nearest + end.indentation + end.force / limits.stiffness
    return TouchOutcome(
        reading=jnp.where(geometry.contact, end.reading, 0.0),
        force=jnp.where(geometry.contact, end.force, 0.0),
        advance=jnp.where(geometry.contact, advance, limits.overtravel),
        contact=geometry.contact,
    )


def touch_outcome(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_site: Float[Array, "4 4"],
    *,
    pads: Pad,
    response: Float[Array, "pads c n n"],
    errors: SimulationErrors,
    limits: PressLimits,
) -> TouchOutcome:
    """One approach with the errors of the arm, pressed with each of some pads.

    Args:
        key: random key.
        surface: of the object, in its frame.
        T_w_o: where it really is.
        T_w_site: contact pose of the tool, as the lab believes it.
        pads: the skins, stacked.
        response: of each, its `response_map`.
        errors: of the arm.
        limits: of the press.

    Returns:
        How it ends, (pads,).
    """
    key_arm, key_overrun = jax.random.split(key)
    geometry = meet(key_arm, surface, T_w_o, T_w_site, errors=errors, limits=limits)
    overshoot = limits.overshoot * jnp.abs(jax.random.normal(key_overrun))
    return jax.vmap(lambda pad, own: press(pad, own, geometry, overshoot, limits))(pads, response)
