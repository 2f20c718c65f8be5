"""Contact of the elastic layer that stands for a pad.

The flat skin meets an object at some distance along the approach (`i2t.contact.approach`), which comes with its
Jacobian along the six coordinates of the object's pose; there the layer is pressed onto it (`i2t.contact.pressure`).

Pure functions on one example; metres, newtons; frames as in `i2t.types`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.contact.approach import FirstContact, first_contact
from i2t.contact.pressure import PressureModelConfig
from i2t.geometry import from_twist, full_precision, inverse
from i2t.skin.pad import POISSON_RATIO, YOUNG_PA, nominal_pad
from i2t.types import Pad, Surface

MIN_LOAD_N = PressureModelConfig.floor  # a noisy wrench sensor says less


class Layer(NamedTuple):
    """Elastic layer that stands for a pad in contacts; the rest is that of `nominal_pad`."""

    poisson: Float[Array, ""] | float = POISSON_RATIO
    young: Float[Array, ""] | float = YOUNG_PA


NOMINAL_LAYER = Layer()


def layer_pad(layer: Layer) -> Pad:
    """The nominal pad with another layer.

    Args:
        layer: Its Poisson's ratio and Young's modulus (Pa).

    Returns:
        The pad.
    """
    return nominal_pad()._replace(poisson=jnp.float32(layer.poisson), young=jnp.float32(layer.young))


def approach(
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    twist: Float[Array, "6"],
    T_w_site: Float[Array, "4 4"],
    overtravel: float | Float[Array, ""],
) -> tuple[FirstContact, Float[Array, "6"]]:
    """First contact of the skin with an object along z of a site.

    Args:
        surface: Of the object, in its frame.
        T_w_o: Pose of the object.
        twist: Its error, in the world (m and rad), by which the distance is differentiated.
        T_w_site: Contact pose of the tool.
        overtravel: m beyond the site after which nothing was met.

    Returns:
        The contact, its pose T_o_t in the object's frame, and the Jacobian of its distance from the site along the
        twist, zero where it is not finite.
    """

    @full_precision
    def distance(twist: Float[Array, "6"]) -> tuple[Array, FirstContact]:
        contact = first_contact(surface, inverse(T_w_o @ from_twist(twist)) @ T_w_site, beyond=overtravel)
        return contact.distance, jax.lax.stop_gradient(contact)

    jacobian, contact = jax.grad(distance, has_aux=True)(twist)
    return contact, jnp.where(jnp.all(jnp.isfinite(jacobian)), jacobian, 0.0)
