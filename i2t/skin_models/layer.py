"""Contact of the elastic layer that represents a pad.

The approach (`i2t.contact.approach`) finds the distance at which the flat skin first meets an object, with its
Jacobian along the six coordinates of the object's pose. There the layer is pressed onto the object
(`i2t.contact.pressure`).

Pure functions on one example; metres, newtons; frames as in `i2t.types`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.contact.approach import FirstContact, first_contact
from i2t.contact.pressure import PressureModelConfig
from i2t.geometry import from_twist, full_precision, inverse
from i2t.skin.pad import NOMINAL_SKIN, nominal_pad
from i2t.types import Pad, Surface

# N, load to which smaller ones are raised, because they are within the noise of a wrench sensor
MIN_LOAD_N = PressureModelConfig.floor


class Layer(NamedTuple):
    """Poisson's ratio and Young's modulus (Pa) of the elastic layer that represents a pad in contacts.

    Its other properties are those of `nominal_pad`.
    """

    poisson: Float[Array, ""] | float = NOMINAL_SKIN.poisson
    young: Float[Array, ""] | float = NOMINAL_SKIN.young


NOMINAL_LAYER = Layer()  # elastic layer (Poisson's ratio and Young's modulus) of the nominal pad


def layer_pad(layer: Layer) -> Pad:
    """Build the nominal pad with another layer.

    Args:
        layer: Poisson's ratio and Young's modulus (Pa) of the layer.

    Returns:
        The nominal pad with this Poisson's ratio and Young's modulus.
    """
    return nominal_pad()._replace(poisson=jnp.float32(layer.poisson), young=jnp.float32(layer.young))


def approach(
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    twist: Float[Array, "6"],
    T_w_site: Float[Array, "4 4"],
    overtravel: float | Float[Array, ""],
) -> tuple[FirstContact, Float[Array, "6"]]:
    """Find the first contact of the skin with an object on an approach along the z axis of a site.

    Args:
        surface: Surface of the object, in its frame.
        T_w_o: Pose of the object.
        twist: Error of the object's pose in the world (m and rad), by which the distance is differentiated.
        T_w_site: Contact pose of the tool.
        overtravel: Distance (m) beyond the site at which the approach gives up.

    Returns:
        The contact with its pose T_o_t in the object's frame, and the `(6,)` Jacobian of its distance (m) from the site
        along the twist (m, rad), which is zero if it is not finite.
    """

    @full_precision
    def distance(twist: Float[Array, "6"]) -> tuple[Array, FirstContact]:
        contact = first_contact(surface, inverse(T_w_o @ from_twist(twist)) @ T_w_site, beyond=overtravel)
        return contact.distance, jax.lax.stop_gradient(contact)

    jacobian, contact = jax.grad(distance, has_aux=True)(twist)
    return contact, jnp.where(jnp.all(jnp.isfinite(jacobian)), jacobian, 0.0)
