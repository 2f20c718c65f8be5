"""Contact of the elastic layer that stands for a pad.

The flat skin meets an object at some distance along the approach (`i2t.simulation.sites.press_along`); there its
heights over the skin are pressed with a few loads into a layer of the pad's kind (`i2t.skin.contact`). The approach
distance comes with its Jacobian along the six coordinates of the object's pose.

Pure functions on one example; metres, newtons; frames as in `i2t.types`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from i2t.contact.pressure import SOLVER_TOLERANCE, PressureModelConfig
from i2t.geometry import from_twist, full_precision, inverse
from i2t.patches.dimensions import PAD_WINDOW, STANDOFF
from i2t.rendering.render import render_heights
from i2t.simulation import sites
from i2t.skin.contact import CELL_GRID, solve_force
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
