"""Contacts of a known object as measurements of its pose: what `register_by_touch` and `register_session` share.

The object is believed at `T_w_o` and stands at `T_w_o from_twist(x)`. At first contact the skin's flat square face just
meets the surface: the gap to the lowest surface point inside the square (`i2t.contact.approach.nearest_in_square`) is
zero up to noise. On a steep facet a sideways error changes the gap more than itself, so a residual is the gap over the
length of its derivative by translations, the distance along the normal (Sampson, "Fitting conic sections to very
scattered data", 1982). Residuals are distributed as Student's t (Lange, Little and Taylor, "Robust statistical modeling
using the t distribution", 1989).

The unknown is z = x over the prior's standard deviations, so that its prior is standard normal.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from i2t import validation
from i2t.contact.approach import double_areas, first_smallest, lowest_in_square, nearest_in_square
from i2t.geometry import from_twist, inverse
from i2t.patches.dimensions import STANDOFF, TWIST_LEVER_M
from i2t.types import ReturnCode, Surface, Touches

STUDENT_T_DOF = 4.0  # of the residuals: the usual compromise of Lange et al.
CANDIDATE_STDS = 3.0  # of the prior: how far the object may move before other faces come nearest


class Contacts(NamedTuple):
    """Contacts with a believed object, and the faces that may be met at each."""

    prior_std: Float[Array, "6"]  # m, of the twist
    weight: Float[Array, " n"]
    T_t_o: Float[Array, "n 4 4"]  # of the believed object at each contact
    corners: Float[Array, "n 3 3 k"]  # m, coordinates of the corners of each contact's candidates, faces last


class LinearisedContacts(NamedTuple):
    """Residuals after a motion, with derivatives by z."""

    residual: Float[Array, " n"]  # m, along the surface's normal
    jacobian: Float[Array, "n 6"]  # m
    stretch: Float[Array, " n"]  # of the gap along tool z against the residual


def contact_poses(touches: Touches) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"]]:
    """Poses of first contact of recorded touches: the pose at the end of each press, taken back along tool z by the
    measured travel past contact.

    Args:
        touches: Recorded touches.

    Returns:
        The tool's poses T_w_t at first contact, and which touches met the object.
    """
    T_w_t, depth = np.array(touches.T_w_t), np.asarray(touches.depth)
    met = np.isfinite(depth) & np.isin(touches.code, (ReturnCode.SKIN, ReturnCode.WRENCH))
    T_w_t[:, :3, 3] -= np.where(met, depth, 0)[:, None] * T_w_t[:, :3, 2]
    return T_w_t, met


def check_contacts(T_w_o: Array, T_w_contact: Array, weight: Array) -> None:
    """Check for a list of rigid poses with a weight for each; traced ones pass.

    Args:
        T_w_o: The believed pose of the object.
        T_w_contact: (n, 4, 4), the tool at first contact.
        weight: (n,).

    Raises:
        ValueError: There is no touch, not one weight for each, or a pose or weight that counts and is not finite or not
            rigid.
    """
    n = len(T_w_contact) if T_w_contact.ndim else 0
    if n == 0 or T_w_contact.shape != (n, 4, 4) or weight.shape != (n,):
        raise ValueError(
            f"T_w_contact has the shape {T_w_contact.shape} and weight {weight.shape}; give n poses (n, 4, 4) and as "
            "many weights (n,), of one touch or more"
        )
    if validation.is_traced(T_w_o, T_w_contact, weight):
        return
    if not np.isfinite(T_w_o).all():
        raise ValueError("T_w_o has numbers that are not finite; give the pose where the object is believed to be")
    wrong = ~np.isfinite(weight) | ((weight > 0) & ~np.isfinite(T_w_contact).all((1, 2)))
    if wrong.any():
        raise ValueError(
            f"{wrong.sum()} touches have a pose or a weight that is not finite, the first in row {np.argmax(wrong)}; "
            "give them the weight 0"
        )
    validation.pose("T_w_o", T_w_o)
    for number in np.flatnonzero(np.asarray(weight) > 0):
        validation.pose(f"T_w_contact[{number}]", T_w_contact[number])


def contacts_of(
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_contact: Float[Array, "n 4 4"],
    weight: Float[Array, " n"],
    *,
    translation_std: Float[Array, ""],
    rotation_std: Float[Array, ""],
    half_edge: float | Array,
    candidate_faces: int,
) -> Contacts:
    """The contacts of an object that is believed at a pose.

    Args:
        surface: The object, in its own frame.
        T_w_o: Where it is believed to be.
        T_w_contact: The tool at first contact.
        weight: Of each touch; 0 leaves it out.
        translation_std: Standard deviation (m) of the belief along each axis.
        rotation_std: Standard deviation (rad) of the belief about each axis.
        half_edge: m, of the skin's face.
        candidate_faces: Number of faces that are looked at for each touch; static.

    Returns:
        The believed object at each contact, and the faces that may be met there.
    """
    std = [translation_std] * 3 + [rotation_std * TWIST_LEVER_M] * 3
    T_w_t = jnp.where((weight > 0)[:, None, None], T_w_contact, jnp.eye(4)[None])
    T_t_o = jax.vmap(lambda T: inverse(T) @ T_w_o)(T_w_t)
    reach = CANDIDATE_STDS * translation_std, CANDIDATE_STDS * rotation_std
    corners = jax.vmap(lambda T: candidates(surface, T, *reach, half_edge=half_edge, count=candidate_faces))(T_t_o)
    return Contacts(jnp.stack(std), weight, T_t_o, corners)


def linearise(z: Float[Array, "6"], contacts: Contacts, half_edge: float | Array) -> LinearisedContacts:
    """Residuals of all contacts.

    Args:
        z: The object's twist, in standard deviations of the prior.
        contacts: The contacts.
        half_edge: m, of the skin's face.

    Returns:
        The residuals with their derivatives; contacts without weight have no effect.
    """
    one = jax.vmap(_linearise_one, (None, 0, 0, None))
    seen = one(contacts.prior_std * z, contacts.T_t_o, contacts.corners, half_edge)
    observed = (contacts.weight > 0) & jnp.isfinite(seen.jacobian).all(axis=1)
    return LinearisedContacts(
        jnp.where(contacts.weight > 0, seen.residual, 0.0),
        jnp.where(observed[:, None], seen.jacobian * contacts.prior_std[None], 0.0),
        jnp.where(observed, seen.stretch, 1.0),
    )


def _linearise_one(
    twist: Float[Array, "6"], T_t_o: Float[Array, "4 4"], corners: Float[Array, "3 3 k"], half_edge: float | Array
) -> LinearisedContacts:
    """One contact's residual and its derivative by the twist."""
    gaps = _gaps(corners, T_t_o @ from_twist(twist), half_edge)
    face = corners[:, :, first_smallest(gaps)].T
    gap, slope = jax.value_and_grad(lambda twist: _gap(face, T_t_o @ from_twist(twist), half_edge))(twist)
    stretch = jnp.maximum(jnp.linalg.norm(slope[:3]), 1.0)
    return LinearisedContacts(gap / stretch, slope / stretch, stretch)


def cost(
    z: Float[Array, "6"], linearised: LinearisedContacts, weight: Float[Array, " n"], scale: Float[Array, ""]
) -> Float[Array, ""]:
    """Minus the logarithm of the posterior, up to a constant.

    Args:
        z: The object's twist, in standard deviations of the prior.
        linearised: The contacts there.
        weight: Of each contact.
        scale: m, standard deviation of a contact.

    Returns:
        The cost.
    """
    return 0.5 * z @ z + weight @ (t_cost(linearised.residual / scale) + jnp.log(linearised.stretch))


def t_cost(residual: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Minus the logarithm of Student's t density, up to a constant.

    Args:
        residual: In standard deviations.

    Returns:
        The cost of each residual.
    """
    return (STUDENT_T_DOF + 1) / 2 * jnp.log1p(residual**2 / STUDENT_T_DOF)


def t_weights(residual: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Weights of the squared residuals that have the slope of `t_cost` (iteratively reweighted least squares).

    Args:
        residual: In standard deviations.

    Returns:
        The weight of each residual.
    """
    return (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + residual**2)


def normal_equations(
    z: Float[Array, "6"], linearised: LinearisedContacts, weight: Float[Array, " n"], scale: Float[Array, ""]
) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """The Gauss-Newton matrix and the gradient of the posterior.

    Args:
        z: The object's twist, in standard deviations of the prior.
        linearised: The contacts there.
        weight: Of each contact.
        scale: m, standard deviation of a contact.

    Returns:
        Both, of z.
    """
    share = weight * t_weights(linearised.residual / scale)
    jacobian = linearised.jacobian
    matrix = jacobian.T @ (share[:, None] * jacobian) / scale**2 + jnp.eye(6)
    return matrix, jacobian.T @ (share * linearised.residual) / scale**2 + z


def _gap(triangle: Float[Array, "3 3"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, ""]:
    """Gap (m) between the square face and a triangle, negative where they overlap; one next to the face is far off."""
    gap = nearest_in_square(Surface(triangle[None]), T_t_o, half)
    return jnp.where(gap < jnp.inf, gap, STANDOFF)


def _gaps(corners: Float[Array, "3 3 k"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, " k"]:
    """Gaps (m) of several triangles."""
    gaps = lowest_in_square(corners, T_t_o, half)
    return jnp.where(gaps < jnp.inf, gaps, STANDOFF)


def candidates(
    surface: Surface,
    T_t_o: Float[Array, "4 4"],
    distance: float | Array,
    angle: float | Array,
    *,
    half_edge: float | Array,
    count: int,
) -> Float[Array, "3 3 k"]:
    """Choose the faces that come nearest when the object moves sideways and turns.

    Args:
        surface: The object.
        T_t_o: Its pose before the tool.
        distance: m, by which it may move.
        angle: rad, by which it may turn.
        half_edge: m, of the skin's face.
        count: Number of faces to choose; static.

    Returns:
        Coordinates (m) of their corners, faces last.
    """
    triangles = jnp.asarray(surface.triangles)
    arm = jnp.linalg.norm(T_t_o[:3, 3])
    corners = jnp.moveaxis(triangles, (1, 2), (1, 0))
    gaps = _gaps(corners, T_t_o, half_edge + distance + angle * arm)
    gaps = jnp.where(double_areas(triangles) > 0, gaps, jnp.inf)
    minus_gap, nearest = jax.lax.top_k(-gaps, min(count, len(triangles)))
    return corners[..., jnp.where(minus_gap > -jnp.inf, nearest, nearest[0])]  # in place of faces without area
