"""Contacts of an object with a known mesh as measurements of its pose, for `register_by_touch` and `register_session`.

The object is believed to be at `T_w_o` and is at `T_w_o from_twist(x)`. At first contact the skin's flat square face
just meets the surface: the gap to the lowest surface point inside the square (`i2t.contact.approach.nearest_in_square`)
is zero up to noise. On a steep facet, a sideways error changes the gap by more than itself. A residual is therefore the
gap divided by the length of its derivative by translations, which is the distance along the normal (Sampson, "Fitting
conic sections to very scattered data", 1982). Residuals are distributed as Student's t (Lange, Little and Taylor,
"Robust statistical modeling using the t distribution", 1989).

The unknown is z, which is x divided by the prior's standard deviations, so that its prior is standard normal.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from i2t import validation
from i2t.contact.approach import double_areas, fast_argmin, lowest_in_square, nearest_in_square
from i2t.geometry import from_twist, inverse
from i2t.patches.dimensions import STANDOFF, TWIST_LEVER_M
from i2t.types import ReturnCode, Surface, Touches

STUDENT_T_DOF = 4.0  # degrees of freedom of the t distribution of residuals, a compromise that Lange et al. recommend


class Contacts(NamedTuple):
    """n contacts with an object at its believed pose: weights, the object's pose in the tool frame, and corners (m) of
    the k faces that the skin may meet at each; and the prior standard deviations (m) of the object's twist.
    """

    prior_std: Float[Array, "6"]  # m, prior standard deviations of the twist
    weight: Float[Array, " n"]
    T_t_o: Float[Array, "n 4 4"]  # believed pose of the object in the tool frame
    corners: Float[Array, "n 3 3 k"]  # m, corners of each contact's candidate faces; the last axis is that of the faces


class LinearisedContacts(NamedTuple):
    """Residuals (m) along the surface's normal of n contacts with the object moved by the twist z, their derivatives by
    z (m for one standard deviation of the prior), and the ratio of each gap along tool z to its residual.
    """

    residual: Float[Array, " n"]  # m, gap between skin and object along the surface's normal
    jacobian: Float[Array, "n 6"]  # m, derivative of the residual by the twist, for one standard deviation of the prior
    stretch: Float[Array, " n"]  # ratio of the gap along tool z to the residual


def contact_poses(touches: Touches) -> tuple[Float[np.ndarray, "n 4 4"], Bool[np.ndarray, " n"]]:
    """Compute the poses of first contact, from which each press moved along tool z by its measured travel.

    Args:
        touches: Recorded touches.

    Returns:
        `(n, 4, 4)` poses T_w_t of the tool at first contact, and `(n,)` flags of the touches that met the object and
        whose travel was measured. The poses of the others are as recorded.
    """
    T_w_t, travel = np.array(touches.T_w_t), np.asarray(touches.travel)
    met = np.isfinite(travel) & np.isin(touches.code, (ReturnCode.SKIN, ReturnCode.WRENCH))
    T_w_t[:, :3, 3] -= np.where(met, travel, 0)[:, None] * T_w_t[:, :3, 2]
    return T_w_t, met


def check_contacts(T_w_o: Array, T_w_contact: Array, weight: Array) -> None:
    """Check poses of contacts and their weights. Values of traced arrays are not checked.

    Args:
        T_w_o: Believed pose of the object.
        T_w_contact: `(n, 4, 4)` poses of the tool at first contact.
        weight: `(n,)` weights of the touches.

    Raises:
        ValueError: There is no touch, the number of weights differs, a weight is not finite, or a pose with a weight is
            not finite or not rigid.
    """
    n = len(T_w_contact) if T_w_contact.ndim else 0
    if n == 0 or T_w_contact.shape != (n, 4, 4) or weight.shape != (n,):
        raise ValueError(
            f"T_w_contact has the shape {T_w_contact.shape} and weight {weight.shape}; give n poses (n, 4, 4) "
            "and n weights (n,) of at least one touch"
        )
    if validation.is_traced(T_w_o, T_w_contact, weight):
        return
    if not np.isfinite(T_w_o).all():
        raise ValueError("T_w_o has non-finite numbers; give the pose where the object is believed to be")
    wrong = ~np.isfinite(weight) | ((weight > 0) & ~np.isfinite(T_w_contact).all((1, 2)))
    if wrong.any():
        raise ValueError(
            f"{wrong.sum()} touches have a non-finite pose or weight, the first in row {np.argmax(wrong)}; give them "
            "the weight 0"
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
    candidate_stds: float = 3.0,
) -> Contacts:
    """Collect contacts with an object at its believed pose, for estimating its true pose.

    Args:
        surface: The object, in its own frame.
        T_w_o: Believed pose of the object.
        T_w_contact: `(n, 4, 4)` poses of the tool at first contact.
        weight: `(n,)` weights of the touches; 0 leaves a touch out.
        translation_std: Standard deviation (m) of the believed position along each axis.
        rotation_std: Standard deviation (rad) of the believed orientation about each axis.
        half_edge: Half the edge (m) of the skin's face.
        candidate_faces: Number of faces that are considered for each touch; static.
        candidate_stds: Motion of the object, in standard deviations, that determines which faces may come nearest.

    Returns:
        The object's pose at each contact, and the faces that the skin may meet there.
    """
    std = [translation_std] * 3 + [rotation_std * TWIST_LEVER_M] * 3
    T_w_t = jnp.where((weight > 0)[:, None, None], T_w_contact, jnp.eye(4)[None])
    T_t_o = jax.vmap(lambda T: inverse(T) @ T_w_o)(T_w_t)
    reach = candidate_stds * translation_std, candidate_stds * rotation_std
    corners = jax.vmap(lambda T: candidates(surface, T, *reach, half_edge=half_edge, count=candidate_faces))(T_t_o)
    return Contacts(jnp.stack(std), weight, T_t_o, corners)


def linearise(z: Float[Array, "6"], contacts: Contacts, half_edge: float | Array) -> LinearisedContacts:
    """Compute the gap between skin and object at each contact, with the object moved by a twist, and its derivatives.

    Args:
        z: Twist of the object, in standard deviations of the prior.
        contacts: The contacts.
        half_edge: Half the edge (m) of the skin's face.

    Returns:
        The `(n,)` residuals (m), gaps along the surface's normal, and their `(n, 6)` derivatives by z (m for each
        standard deviation). Both are 0 for contacts without weight.
    """
    linearise_each = jax.vmap(_linearise_contact, (None, 0, 0, None))
    seen = linearise_each(contacts.prior_std * z, contacts.T_t_o, contacts.corners, half_edge)
    observed = (contacts.weight > 0) & jnp.isfinite(seen.jacobian).all(axis=1)
    return LinearisedContacts(
        jnp.where(contacts.weight > 0, seen.residual, 0.0),
        jnp.where(observed[:, None], seen.jacobian * contacts.prior_std[None], 0.0),
        jnp.where(observed, seen.stretch, 1.0),
    )


def _linearise_contact(
    twist: Float[Array, "6"], T_t_o: Float[Array, "4 4"], corners: Float[Array, "3 3 k"], half_edge: float | Array
) -> LinearisedContacts:
    """Compute the residual of a contact and its derivative by the twist (m)."""
    gaps = _gaps(corners, T_t_o @ from_twist(twist), half_edge)
    face = corners[:, :, fast_argmin(gaps)].T
    gap, slope = jax.value_and_grad(lambda twist: _gap(face, T_t_o @ from_twist(twist), half_edge))(twist)
    stretch = jnp.maximum(jnp.linalg.norm(slope[:3]), 1.0)
    return LinearisedContacts(gap / stretch, slope / stretch, stretch)


def cost(
    z: Float[Array, "6"], linearised: LinearisedContacts, weight: Float[Array, " n"], scale: Float[Array, ""]
) -> Float[Array, ""]:
    """Compute minus the logarithm of the posterior density of an object's pose, given contacts.

    Args:
        z: Twist of the object, in standard deviations of the prior.
        linearised: The contacts at z.
        weight: `(n,)` weights of the contacts.
        scale: Standard deviation (m) of a contact.

    Returns:
        Minus the logarithm of the density, up to a constant.
    """
    return 0.5 * z @ z + weight @ (t_cost(linearised.residual / scale) + jnp.log(linearised.stretch))


def t_cost(residual: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Compute minus the logarithm of Student's t density.

    Args:
        residual: Residuals, in standard deviations.

    Returns:
        Minus the logarithm of the density of each residual, up to a constant.
    """
    return (STUDENT_T_DOF + 1) / 2 * jnp.log1p(residual**2 / STUDENT_T_DOF)


def t_weights(residual: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Compute the weights of iteratively reweighted least squares, which give squared residuals the slope of `t_cost`.

    Args:
        residual: Residuals, in standard deviations.

    Returns:
        The weight of each residual, largest for small ones.
    """
    return (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + residual**2)


def normal_equations(
    z: Float[Array, "6"], linearised: LinearisedContacts, weight: Float[Array, " n"], scale: Float[Array, ""]
) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """Compute the Gauss-Newton matrix and the gradient of `cost`.

    Args:
        z: Twist of the object, in standard deviations of the prior.
        linearised: The contacts at z.
        weight: `(n,)` weights of the contacts.
        scale: Standard deviation (m) of a contact.

    Returns:
        `(6, 6)` matrix and `(6,)` gradient by z.
    """
    share = weight * t_weights(linearised.residual / scale)
    jacobian = linearised.jacobian
    matrix = jacobian.T @ (share[:, None] * jacobian) / scale**2 + jnp.eye(6)
    return matrix, jacobian.T @ (share * linearised.residual) / scale**2 + z


def _gap(triangle: Float[Array, "3 3"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, ""]:
    """Compute the gap (m) between the square face and a triangle, negative where they overlap and `STANDOFF` where the
    triangle is outside the square.
    """
    gap = nearest_in_square(Surface(triangle[None]), T_t_o, half)
    return jnp.where(gap < jnp.inf, gap, STANDOFF)


def _gaps(corners: Float[Array, "3 3 k"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, " k"]:
    """Compute the gaps (m) of several triangles, as `_gap` does."""
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
    """Choose the faces that may come nearest to the skin when the object moves sideways and turns.

    Args:
        surface: The object.
        T_t_o: Pose of the object in the tool frame.
        distance: Largest translation (m).
        angle: Largest rotation (rad).
        half_edge: Half the edge (m) of the skin's face.
        count: Number of faces to choose; static.

    Returns:
        `(3, 3, count)` coordinates (m) of their corners; faces are the last axis.
    """
    triangles = jnp.asarray(surface.triangles)
    arm = jnp.linalg.norm(T_t_o[:3, 3])
    corners = jnp.moveaxis(triangles, (1, 2), (1, 0))
    gaps = _gaps(corners, T_t_o, half_edge + distance + angle * arm)
    gaps = jnp.where(double_areas(triangles) > 0, gaps, jnp.inf)
    minus_gap, nearest = jax.lax.top_k(-gaps, min(count, len(triangles)))
    return corners[..., jnp.where(minus_gap > -jnp.inf, nearest, nearest[0])]  # repeated in place of faces without area
