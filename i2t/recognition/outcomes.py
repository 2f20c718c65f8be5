"""Predicted outcome of a touch on a possible object: the contact, the indentation and the reading.

An object somewhere near its believed pose is met by the flat skin at some distance along the approach
(`i2t.contact.approach`). There a layer like the pad's is pressed onto it with a few loads (`i2t.contact.pressure`), and
the pad's reading model (`i2t.skin_models.reading_model`) turns pressures into readings. For one load F it is linear in
the pressure p,

    mean = p . M_F,    variance = p' V_F p   (in units of each channel's signal),

so that a reading costs one product. Between loads, readings per newton are interpolated in the logarithm of the load.

`predict_contact` covers geometry and mechanics of a layer, `predict_reading` one pad. Neither depends on measurements,
so touches are predicted once for sites, objects and pose particles and used in any number of episodes. The approach
distance comes with its Jacobian along the six coordinates of the object's pose, so that poses between the particles are
distinguished as well (`i2t.recognition.belief`).

All functions are pure and work on one example. Units are metres, newtons and microtesla; frames as in `i2t.types`. A
reading has c = 3 * chips channels.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from i2t.contact.pressure import surface_pressure
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.skin_models.layer import NOMINAL_LAYER, Layer, approach, layer_pad
from i2t.skin_models.reading_model import (
    LinearReadingModel,
    interpolate,
    interpolate_reading,
    load_step,
    readings_at_loads,
)
from i2t.types import Surface


class PredictedContact(NamedTuple):
    """Predicted contact of a skin's elastic layer with an object, the same for every pad with that layer: whether they
    meet, distance (m) from the site to first contact and its derivative by the object's twist, and indentation (m) and
    force on each cell of 1 mm (N) at l loads.
    """

    hit: Bool[Array, ""]  # whether the skin meets the object before the press gives up
    approach_distance: Float[Array, ""]  # m, from the site to first contact; the overtravel without contact
    jacobian: Float[Array, "6"]  # derivative of `approach_distance` by the twist of the object's pose
    indentation: Float[Array, " l"]  # m past first contact at each load, on the layer
    newtons: Float[Array, "l cells"]  # N, force on each cell of 1 mm at each load


class PredictedTouch(NamedTuple):
    """Predicted outcome of a touch: whether the skin meets the object, distance (m) from the site to first contact and
    its derivative by the object's twist, and indentation (m), reading (uT) and the reading's variance (relative to the
    square of a channel's signal) at the l loads of the `LinearReadingModel`.
    """

    hit: Bool[Array, ""]  # whether the skin meets the object before the press gives up
    approach_distance: Float[Array, ""]  # m, travel from the site to first contact; the overtravel without contact
    jacobian: Float[Array, "6"]
    indentation: Float[Array, " l"]  # m past first contact
    reading: Float[Array, "l c"]  # uT, predicted reading
    variance: Float[Array, " l"]  # variance of the reading, relative to the square of a channel's signal


def predict_contact(
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    twist: Float[Array, "6"],
    T_w_site: Float[Array, "4 4"],
    loads: Float[Array, " l"],
    *,
    overtravel: float | Float[Array, ""],
    layer: Layer = NOMINAL_LAYER,
) -> PredictedContact:
    """Predict the contact of the skin with an object, and the distribution of a few loads over it.

    Args:
        surface: Surface of the object, in its own frame.
        T_w_o: The object's believed pose.
        twist: Displacement (m) of the object from there (`i2t.geometry.from_twist`).
        T_w_site: Pose of the skin at which it just touches the believed surface; it moves along its z axis.
        loads: Loads (N) of the press.
        overtravel: Distance (m) beyond the site after which the press gives up.
        layer: The pressed layer.

    Returns:
        Contact, distance (m) to it and its Jacobian, indentations (m) and forces on cells (N). Without contact, the
        distance is the overtravel, and the Jacobian, indentations and forces are 0.
    """
    (T_o_t, distance, hit), jacobian = approach(surface, T_w_o, twist, T_w_site, overtravel)
    pressed, indentation = surface_pressure(layer_pad(layer), surface, T_o_t, loads)
    hit = hit & jnp.isfinite(indentation[0])
    return PredictedContact(
        hit=hit,
        approach_distance=distance,
        jacobian=jnp.where(hit, jacobian, 0.0),
        indentation=jnp.where(hit, indentation, 0.0),
        newtons=jnp.where(hit, pressed.pressure.reshape(len(loads), -1), 0.0),
    )


def predict_reading(contact: PredictedContact, model: LinearReadingModel) -> PredictedTouch:
    """Predict the reading of a pad at a contact.

    Args:
        contact: Contact pressed with the loads of the model.
        model: Reading model of the pad.

    Returns:
        Touch with reading (uT) and relative variance at each load, and with the indentation scaled by the softness.
    """
    reading, variance = readings_at_loads(model, contact.newtons)
    return PredictedTouch(
        hit=contact.hit,
        approach_distance=contact.approach_distance,
        jacobian=contact.jacobian,
        indentation=model.softness * contact.indentation,
        reading=reading,
        variance=variance,
    )


def interpolate_load(
    predicted: PredictedTouch, loads: Float[Array, " l"], force: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, " c"], Float[Array, ""]]:
    """Interpolate a predicted touch at any load, also beyond the predicted ones.

    The indentation is a power of the load between two loads and down to zero; for readings see
    `i2t.skin_models.reading_model.interpolate_reading`.

    Args:
        predicted: The touch at `loads`.
        loads: Ascending loads (N).
        force: Load (N) at which to interpolate; zero or less means no touch.

    Returns:
        Indentation (m), reading (uT) and its relative variance; all zero without load or contact.
    """
    i, step, _ = load_step(loads, force)
    # The indentation of a contact is a power of its load; a reading grows about in proportion to the load.
    log_indentation = jnp.log(jnp.maximum(predicted.indentation, 1e-7))
    indentation = jnp.exp(interpolate(i, jnp.minimum(step, 2.0), log_indentation))
    reading, variance = interpolate_reading(predicted.reading, predicted.variance, loads, force)
    return jnp.where(predicted.hit & (force > 0), indentation, 0.0), reading, jnp.where(predicted.hit, variance, 0.0)


def placement_std(distance: float, angle: float) -> Float[np.ndarray, "6"]:
    """Build the prior of an object's pose with equal uncertainty about each axis.

    Args:
        distance: Standard deviation along each axis (m).
        angle: Standard deviation about each axis (rad).

    Returns:
        `(6,)` standard deviations (m) of the parts of a twist.
    """
    return np.repeat([distance, TWIST_LEVER_M * angle], 3).astype(np.float32)
