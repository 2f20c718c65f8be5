"""An object's pose from touches, with its covariance.

The object is believed at `T_w_o` and stands at `T_w_o from_twist(x)`, where x (6,) is a twist in its own frame
(`i2t.geometry.from_twist`): three translations (m), then three rotations times `TWIST_LEVER_M`, all in metres.

Each contact measures the distance of the skin's face from the surface along its normal, with noise of Student's t
(`i2t.registration.contacts`). With x normal before, the most probable x is sought by Levenberg-Marquardt steps on the
reweighted squares, while the noise shrinks from the size of the prior's own errors to what it is (deterministic
annealing; Rose, "Deterministic annealing for clustering, compression, classification, regression, and related
optimization problems", 1998). The contact of edges and corners is not smooth, so the search starts from several draws
of the prior and keeps the most probable end. Nor are posteriors normal there: from the mode and the inverse of the
Gauss-Newton matrix (Laplace's method) on, mean and covariance are corrected by rounds of importance sampling
(`importance_covariance`). What no touch tells keeps the prior's.

Inside, the unknown is z = x over the prior's standard deviations, so that its prior is standard normal.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from i2t import validation
from i2t.geometry import from_twist, full_precision
from i2t.patches.dimensions import PAD_WINDOW
from i2t.registration.contacts import (
    Contacts,
    LinearisedContacts,
    check_contacts,
    contacts_of,
    linearise,
    t_weights,
)
from i2t.registration.contacts import cost as contact_cost
from i2t.registration.contacts import normal_equations as contact_normal_equations
from i2t.registration.estimate import PoseEstimate
from i2t.registration.levenberg_marquardt import LeastSquares, levenberg_marquardt
from i2t.runtime.batching import map_batches
from i2t.runtime.compiling import jit_quickly, traced_floats
from i2t.types import Surface

UNSEEN_CONTACT_RESIDUAL_M = 1e3  # of a motion that was not looked at yet: worse than any
PROPOSAL_DOF = 5  # of what is drawn: heavier tails than any posterior's
MIN_PROPOSAL_STD = 1e-3  # of draws, in standard deviations of the prior, for float32's sake
MIN_VARIANCE_FACTOR = 0.1  # by which one round of draws may shrink the variance along any direction
DRAWS_AT_A_TIME = 16  # whose densities are found together


@traced_floats
@dataclass(frozen=True)
class TouchRegistrationConfig:
    """Options of pose search by touches."""

    num_starts: int = 12  # draws of the prior; the first is its mean
    annealing_steps: int = 10  # while the noise shrinks
    steps: int = 10  # at its true size
    draws: int = 256  # for the moments of the posterior
    rounds: int = 4  # of drawing; 0 leaves mode and curvature
    half_edge: float = PAD_WINDOW / 2  # m, of the skin's face
    candidate_faces: int = 128  # of the surface at each touch: those that could come nearest


@full_precision
def register_by_touch(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array | np.ndarray, "4 4"],
    T_w_contact: Float[Array | np.ndarray, "n 4 4"],
    weight: Float[Array | np.ndarray, " n"] | Bool[Array | np.ndarray, " n"],
    *,
    translation_std: float | Float[Array, ""],
    rotation_std: float | Float[Array, ""],
    contact_std: float | Float[Array, ""] = 0.1e-3,
    config: TouchRegistrationConfig = TouchRegistrationConfig(),
    often: bool = False,
) -> PoseEstimate:
    """The mean pose of an object that was met at known tool poses.

    Args:
        key: A JAX key, for the starts and the draws.
        surface: The object, in its own frame.
        T_w_o: Where it is believed to be.
        T_w_contact: The tool at first contact, as of `contact_poses`.
        weight: Of each touch; 0 (or false) leaves it out, whatever its pose holds: one in air.
        translation_std: Standard deviation (m) of the belief along each axis.
        rotation_std: Standard deviation (rad) of the belief about each axis.
        contact_std: Standard deviation (m) of a contact, which counts the arm, the skin's tilt times its half edge, and
            the object's shape.
        config: How to search; its whole numbers are static.
        often: Compile with all optimisations, which pays from about twenty registrations on; last digits may differ.

    Returns:
        The estimate; its residuals, weights and cost are those of the most probable pose.

    Raises:
        ValueError: There is no touch, not one weight for each, a pose or weight that counts and is not finite, a pose
            that is not rigid, or a standard deviation that is none.
        TypeError: The key is none, or a standard deviation is no number.

    Example:
        T_w_contact, in_contact = contact_poses(dataset.touches)
        estimate = i2t.register_by_touch(
            key, surface, T_w_o, T_w_contact, in_contact, translation_std=2e-3, rotation_std=0.03
        )
    """
    validation.random_key("key", key)
    for name, std in (("translation_std", translation_std), ("rotation_std", rotation_std)):
        validation.number(name, std, "a standard deviation, 0 where it is known", least=0)
    validation.number("contact_std", contact_std, "a standard deviation (m) above 0", above=0)
    T_w_o, T_w_contact, weight = (jnp.asarray(value, jnp.float32) for value in (T_w_o, T_w_contact, weight))
    check_contacts(T_w_o, T_w_contact, weight)
    stds = (jnp.asarray(std, jnp.float32) for std in (translation_std, rotation_std, contact_std))
    register = _register_often if often else _register_once
    return register(key, surface, T_w_o, T_w_contact, weight, *stds, config=config)


@full_precision
def _register(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_contact: Float[Array, "n 4 4"],
    weight: Float[Array, " n"],
    translation_std: Float[Array, ""],
    rotation_std: Float[Array, ""],
    noise: Float[Array, ""],
    *,
    config: TouchRegistrationConfig,
) -> PoseEstimate:
    """`register_by_touch` of what was checked."""
    contacts = contacts_of(
        surface, T_w_o, T_w_contact, weight, translation_std=translation_std, rotation_std=rotation_std,
        half_edge=config.half_edge, candidate_faces=config.candidate_faces,
    )  # fmt: skip
    problem = _touch_problem(contacts, config.half_edge)
    key_starts, key_draws = jax.random.split(key)
    mode, linearised, cost = _most_probable(key_starts, problem, contacts.prior_std, noise, config)
    z, covariance = _moments(key_draws, problem, mode, linearised, noise=noise, config=config)
    return PoseEstimate(
        T_w_o=T_w_o @ from_twist(contacts.prior_std * z),
        covariance=contacts.prior_std[:, None] * covariance * contacts.prior_std[None],
        residual=linearised.residual,
        weight=weight * t_weights(linearised.residual / noise),
        cost=cost,
    )


_register_once = jit_quickly(_register)
_register_often = jax.jit(_register)


def _most_probable(
    key: Key[Array, ""],
    problem: LeastSquares,
    prior_std: Float[Array, "6"],
    noise: Float[Array, ""],
    config: TouchRegistrationConfig,
) -> tuple[Float[Array, "6"], LinearisedContacts, Float[Array, ""]]:
    """The best of several searches, the first from the prior's mean and the others from draws of it: z, its residuals,
    and its cost.
    """
    scales = _annealed(noise, jnp.hypot(prior_std[0], prior_std[3]), config)  # how far the prior may be off at the face

    def search(z: Float[Array, "6"]) -> tuple[Float[Array, "6"], LinearisedContacts, Float[Array, ""]]:
        found, linearised = levenberg_marquardt(problem, z, scales)
        return found, linearised, problem.cost(found, linearised, noise)

    starts = jax.random.normal(key, (config.num_starts, 6)).at[0].set(0.0)
    ends = jax.vmap(search)(starts)
    best = jnp.argmin(ends[-1])
    return jax.tree.map(lambda leaf: leaf[best], ends)


def _moments(
    key: Key[Array, ""],
    problem: LeastSquares,
    mode: Float[Array, "6"],
    linearised: LinearisedContacts,
    *,
    noise: Float[Array, ""],
    config: TouchRegistrationConfig,
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Mean and covariance of z: those of Laplace's method at the mode, corrected by importance sampling."""

    def negative_log_posterior(z: Float[Array, "6"]) -> Float[Array, ""]:
        return problem.cost(z, problem.residual_and_jacobian(z), noise)

    information, _ = problem.normal_equations(mode, linearised, noise)
    draws = jax.random.normal(key, (config.rounds, config.draws, 6 + PROPOSAL_DOF))
    return importance_covariance(negative_log_posterior, mode, jnp.linalg.inv(information), draws)


def _touch_problem(contacts: Contacts, half_edge: float | Array) -> LeastSquares:
    """Problem of the most probable z."""
    n = len(contacts.weight)
    return LeastSquares(
        residual_and_jacobian=lambda z: linearise(z, contacts, half_edge),
        cost=lambda z, linearised, scale: contact_cost(z, linearised, contacts.weight, scale),
        normal_equations=lambda z, linearised, scale: contact_normal_equations(z, linearised, contacts.weight, scale),
        unseen=LinearisedContacts(jnp.full(n, UNSEEN_CONTACT_RESIDUAL_M), jnp.zeros((n, 6)), jnp.ones(n)),
    )


def _annealed(
    noise: Float[Array, ""], prior_error: Float[Array, ""], config: TouchRegistrationConfig
) -> Float[Array, " steps"]:
    """Scales (m) of the residuals, from the prior's errors down to the noise in equal factors."""
    wide = jnp.maximum(noise, prior_error)
    fraction = jnp.minimum(jnp.arange(config.annealing_steps + config.steps) / config.annealing_steps, 1.0)
    return wide ** (1 - fraction) * noise**fraction


@full_precision
def importance_covariance(
    negative_log_posterior: Callable[[Float[Array, "6"]], Float[Array, ""]],
    mode: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    draws: Float[Array, "rounds draws numbers"],
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Correct the mean and covariance of a posterior by rounds of importance sampling, each from the result of the one
    before (population Monte Carlo; Cappé, Guillin, Marin and Robert, J. Comput. Graph. Stat. 13, 2004).

    Each round draws Student's t about the mean and weighs the draws as the posterior's and, to take off the noise of
    drawing, as those of the normal distribution that was believed; a few effective draws change little.

    Args:
        negative_log_posterior: Minus the logarithm of the density at z, up to a constant.
        mode: Where it is largest; z is in standard deviations of the prior.
        covariance: Of Laplace's method, the inverse of the information at the mode.
        draws: Standard normal numbers, six for a direction and the others for the tail of each draw.

    Returns:
        Mean and covariance of z.
    """
    dof = draws.shape[-1] - 6

    def adapt(
        belief: tuple[Float[Array, "6"], Float[Array, "6 6"]], drawn: Float[Array, "draws numbers"]
    ) -> tuple[tuple[Float[Array, "6"], Float[Array, "6 6"]], None]:
        mean, covariance = belief
        factor = jnp.linalg.cholesky(covariance + MIN_PROPOSAL_STD**2 * jnp.eye(6))
        u = drawn[:, :6] / jnp.sqrt(jnp.mean(drawn[:, 6:] ** 2, axis=1, keepdims=True))
        z = mean[None] + u @ factor.T
        square = jnp.sum(u**2, axis=1)
        heavy = (dof + 6) / 2 * jnp.log1p(square / dof)  # minus the logarithm of the density that was drawn from
        posterior = jax.nn.softmax(map_batches(lambda z: -negative_log_posterior(z), z, DRAWS_AT_A_TIME) + heavy)
        change = posterior - jax.nn.softmax(heavy - square / 2)
        count = 1 / jnp.sum(posterior**2)  # effective number of draws
        trust = count / (count + 6)
        shift = trust * (change @ u)
        values, axes = jnp.linalg.eigh(jnp.eye(6) + trust * (u.T @ (change[:, None] * u)) - jnp.outer(shift, shift))
        root = factor @ axes * jnp.sqrt(jnp.maximum(values, MIN_VARIANCE_FACTOR))[None]
        return (mean + factor @ shift, root @ root.T), None

    return jax.lax.scan(adapt, (mode, covariance), draws)[0]
