"""Predicted outcome of a touch on a possible object: the contact, the indentation and the reading.

An object that may lie anywhere near its believed pose is met by the flat skin at some distance along the approach
(`i2t.simulation.sites.press_along`); there its heights over the skin are pressed with a few loads into a layer of
the pad's kind (`i2t.skin.contact`), and the pad's reading model (`i2t.recognition.reading_model`) turns pressures into
readings. For one load F it is linear in the pressure p,

    mean = p . M_F,    variance = p' V_F p   (in units of each channel's signal),

so that a reading costs a product. Between loads, readings per newton are interpolated in the logarithm of the load.

`predict_contact` is geometry and mechanics of a layer, `predict_reading` one pad. Neither depends on what is measured,
so touches can be predicted for sites, objects and pose particles once and used for any number of episodes. The approach
distance comes with its Jacobian along the six coordinates of the object's pose, so that poses between the particles are
distinguished too (`i2t.recognition.belief`).

Pure functions on one example; metres, newtons, microtesla; frames as in `i2t.types`. A reading has c = 3 * chips
channels.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from i2t.contact.pressure import SOLVER_TOLERANCE, PressureModelConfig
from i2t.geometry import from_twist, full_precision, inverse
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF, TWIST_LEVER_M
from i2t.rendering.render import render_heights
from i2t.simulation import sites
from i2t.skin.contact import CELL_GRID, solve_force
from i2t.skin.pad import POISSON_RATIO, YOUNG_PA, nominal_pad
from i2t.types import Pad, Surface, in_one_line

LOADS_N = (0.3, 0.9, 2.7)  # most presses to 25 uT end between the outer ones
MIN_LOAD_N = PressureModelConfig.floor  # a noisy wrench sensor says less


class Layer(NamedTuple):
    """Elastic layer that stands for a pad in contacts; the rest is that of `nominal_pad`."""

    poisson: Float[Array, ""] | float = POISSON_RATIO
    young: Float[Array, ""] | float = YOUNG_PA


NOMINAL_LAYER = Layer()


@in_one_line
class LinearReadingModel(NamedTuple):
    """A pad's reading model at a few loads, where it is linear in the pressure on a layer."""

    loads: Float[Array, " l"]  # N
    mean: Float[Array, "l cells c"]  # uT per N on each cell of 1 mm
    root: Float[Array, "l cells rank"]  # of the variance, relative to the square of a channel's signal
    scale: Float[Array, " c"]  # uT, root mean square of each channel's signal
    softness: Float[Array, ""]  # indentation of the pad over that of the layer
    layer: Layer = NOMINAL_LAYER


class PredictedContact(NamedTuple):
    """Predicted contact of a layer with an object; the same for every pad of that layer."""

    hit: Bool[Array, ""]  # whether the skin meets anything before it gives up
    approach_distance: Float[Array, ""]  # m, from the site to first contact; where nothing is met, the overtravel
    jacobian: Float[Array, "6"]  # of that distance along the twist of the object's pose
    indentation: Float[Array, " l"]  # m past first contact at each load, on the layer
    newtons: Float[Array, "l cells"]  # on each cell of 1 mm


class PredictedTouch(NamedTuple):
    """A predicted touch; loads (l) are those of the `LinearReadingModel`."""

    hit: Bool[Array, ""]  # as in `PredictedContact`
    approach_distance: Float[Array, ""]  # m
    jacobian: Float[Array, "6"]
    indentation: Float[Array, " l"]  # m past first contact
    reading: Float[Array, "l c"]  # uT
    variance: Float[Array, " l"]  # of the reading, relative to the square of a channel's signal


def layer_pad(layer: Layer) -> Pad:
    """The nominal pad with another layer.

    Args:
        layer: Its Poisson's ratio and Young's modulus (Pa).

    Returns:
        The pad.
    """
    return nominal_pad()._replace(poisson=jnp.float32(layer.poisson), young=jnp.float32(layer.young))


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
    """Predict the contact of the skin with an object and the distribution of a few loads over it.

    Args:
        surface: Of the object, in its own frame.
        T_w_o: The object's believed pose.
        twist: Displacement (m) of the object from there (`i2t.geometry.from_twist`).
        T_w_site: The skin's pose where it would just lie on the surface; it moves along its z axis.
        loads: With which it is pressed (N).
        overtravel: Distance (m) beyond the site after which the press gives up.
        layer: That is pressed.

    Returns:
        Contact, distance to it and its Jacobian, indentations and newtons; zeros where nothing is met.
    """
    (distance, (T_o_t, hit)), jacobian = approach(surface, T_w_o, twist, T_w_site, overtravel)
    indentation, newtons = contact_pressures(surface, T_o_t, loads, layer)
    hit = hit & jnp.isfinite(indentation[0])
    return PredictedContact(
        hit=hit,
        approach_distance=distance,
        jacobian=jnp.where(hit, jacobian, 0.0),
        indentation=jnp.where(hit, indentation, 0.0),
        newtons=jnp.where(hit, newtons, 0.0),
    )


def predict_reading(contact: PredictedContact, model: LinearReadingModel) -> PredictedTouch:
    """Predict the reading of a pad at a contact.

    Args:
        contact: Pressed with the loads of the model.
        model: Of the pad.

    Returns:
        The touch with reading and variance at each load.
    """
    reading = jnp.einsum("lx,lxc->lc", contact.newtons, model.mean, precision="highest")
    variance = jnp.sum(jnp.einsum("lx,lxr->lr", contact.newtons, model.root, precision="highest") ** 2, axis=-1)
    return PredictedTouch(
        hit=contact.hit,
        approach_distance=contact.approach_distance,
        jacobian=contact.jacobian,
        indentation=model.softness * contact.indentation,
        reading=reading,
        variance=variance,
    )


def approach(
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    twist: Float[Array, "6"],
    T_w_site: Float[Array, "4 4"],
    overtravel: float | Float[Array, ""],
) -> tuple[tuple[Float[Array, ""], tuple[Float[Array, "4 4"], Bool[Array, ""]]], Float[Array, "6"]]:
    """First contact of the skin with an object along z of a site.

    Args:
        surface: Of the object, in its frame.
        T_w_o: Pose of the object.
        twist: Its error, in the world (m and rad), by which the distance is differentiated.
        T_w_site: Contact pose of the tool.
        overtravel: m beyond the site after which nothing was met.

    Returns:
        Distance (m) from the site, the contact (T_o_t, and whether there is one), and the distance's Jacobian along the
        twist, zero where it is not finite.
    """
    (distance, contact), jacobian = jax.value_and_grad(_approach_distance, argnums=2, has_aux=True)(
        surface, T_w_o, twist, T_w_site, overtravel
    )
    smooth = jnp.all(jnp.isfinite(jacobian))
    return (distance, jax.lax.stop_gradient(contact)), jnp.where(smooth, jacobian, 0.0)


@full_precision
def _approach_distance(
    surface: Surface, T_w_o: Array, twist: Array, T_w_site: Array, overtravel: float | Array
) -> tuple[Array, tuple[Array, Array]]:
    """Distance (m) from the site to first contact, and the contact (T_o_t, hit)."""
    T_o_w = inverse(T_w_o @ from_twist(twist))
    start = T_o_w @ T_w_site @ jnp.eye(4).at[2, 3].set(-STANDOFF)
    T_o_t, hit = sites.press_along(surface, start, start[:3, 2], max_distance=STANDOFF + overtravel)
    return jnp.dot(T_o_t[:3, 3] - start[:3, 3], start[:3, 2]) - STANDOFF, (T_o_t, hit)


def contact_pressures(
    surface: Surface, T_o_t: Float[Array, "4 4"], loads: Float[Array, " l"], layer: Layer = NOMINAL_LAYER
) -> tuple[Float[Array, " l"], Float[Array, "l cells"]]:
    """Press a layer into a surface with each of some loads.

    Args:
        surface: Of the object.
        T_o_t: The skin's pose at first contact.
        loads: Newtons, at least `MIN_LOAD_N`.
        layer: That is pressed.

    Returns:
        Indentation (m) and newtons on each cell; infinite and zero where nothing lies before the skin.
    """
    pad = layer_pad(layer)
    heights = render_heights(surface, inverse(T_o_t), PAD_WINDOW, CELL_GRID.cells)
    nearest = jnp.min(heights)
    met = jnp.isfinite(nearest)
    behind = jnp.where(met, heights - jnp.where(met, nearest, 0.0), 0.0)

    def press(load: Float[Array, ""]) -> tuple[Array, Array]:
        load = jnp.maximum(load, MIN_LOAD_N)
        contact = solve_force(
            pad, behind, load, CELL_GRID, tolerance=SOLVER_TOLERANCE, max_steps=PressureModelConfig.iterations
        )
        newtons = contact.pressure.reshape(-1) * CELL_GRID.spacing**2
        return contact.indentation, newtons * load / jnp.maximum(jnp.sum(newtons), 1e-9)

    indentation, newtons = jax.vmap(press)(loads)
    return jnp.where(met, nearest + indentation, jnp.inf), jnp.where(met, newtons, 0.0)


def interpolate_load(
    predicted: PredictedTouch, loads: Float[Array, " l"], force: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, " c"], Float[Array, ""]]:
    """A predicted touch at any load: between those predicted, or beyond them.

    Indentation is a power of the load between two loads and down to none. Readings per newton are linear in the
    logarithm of the load, up to one step between loads beyond the outer ones, and constant from there.

    Args:
        predicted: The touch at `loads`.
        loads: Ascending (N).
        force: The load asked for (N); none and less is no touch.

    Returns:
        Indentation (m), reading (uT) and its relative variance; all zero without load.
    """
    pressed = force > 0
    at = jnp.log(jnp.where(pressed, force, loads[0]))
    knots = jnp.log(loads)
    i = jnp.clip(jnp.searchsorted(knots, at) - 1, 0, len(loads) - 2)
    step = (at - knots[i]) / (knots[i + 1] - knots[i])
    between = partial(_interpolate, i, jnp.clip(step, -1.0, 2.0))
    newtons = jnp.exp(at)
    # A contact sinks as a power of its load; a reading grows about in proportion to it.
    log_indentation = jnp.log(jnp.maximum(predicted.indentation, 1e-7))
    indentation = jnp.exp(_interpolate(i, jnp.minimum(step, 2.0), log_indentation))
    variance = jnp.exp(between(jnp.log(jnp.maximum(predicted.variance / loads**2, 1e-12)))) * newtons**2
    reading = between(predicted.reading / loads[:, None]) * newtons
    touched = predicted.hit & pressed
    return (
        jnp.where(touched, indentation, 0.0),
        jnp.where(pressed, reading, 0.0),
        jnp.where(touched, variance, 0.0),
    )


def _interpolate(i: Array, step: Array, values: Array) -> Array:
    """Linear interpolation between values i and i + 1, a number of steps from the first."""
    low, high = (
        jax.lax.dynamic_index_in_dim(values, i, keepdims=False),
        jax.lax.dynamic_index_in_dim(values, i + 1, keepdims=False),
    )
    return low + step * (high - low)


def placement_std(distance: float, angle: float) -> Float[np.ndarray, "6"]:
    """The prior of an object's pose that is uncertain alike about each axis.

    Args:
        distance: Standard deviation along each axis (m).
        angle: Standard deviation about each axis (rad).

    Returns:
        Standard deviations (m) of the six parts of a twist.
    """
    return np.repeat([distance, TWIST_LEVER_M * angle], 3).astype(np.float32)
