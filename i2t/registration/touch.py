"""Estimate an object's pose and its covariance from touches.

The object is believed to be at `T_w_o` and is at `T_w_o from_twist(x)`, where x (6,) is a twist in its own frame
(`i2t.geometry.from_twist`): three translations (m), then three rotations times `TWIST_LEVER_M`, all in metres.

Each contact measures the distance of the skin's face from the surface along its normal, with noise of Student's t
(`i2t.registration.contacts`). The prior of x is normal. The most probable x is found by Levenberg-Marquardt steps on
the reweighted squares, while the noise shrinks from the size of the prior's errors to its true size (deterministic
annealing; Rose, "Deterministic annealing for clustering, compression, classification, regression, and related
optimization problems", 1998). The contact of edges and corners is not smooth, so the search starts from several draws
of the prior and keeps the most probable end. There the posterior is not normal either. Starting from the mode and the
inverse of the Gauss-Newton matrix (Laplace's method), mean and covariance are therefore corrected by rounds of
importance sampling (`importance_covariance`). Directions that no touch determines keep the prior.

Inside, the unknown is z, which is x divided by the prior's standard deviations, so that its prior is standard normal.
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
from i2t.runtime.compiling import compiles_slowly, jit_quickly, traced_floats
from i2t.types import Surface


@traced_floats
@dataclass(frozen=True)
class TouchRegistrationConfig:
    """Options of the search for an object's pose from touches.

    Example:
        config = i2t.TouchRegistrationConfig(num_starts=40)  # for a poorly known pose
    """

    num_starts: int = 12  # number of starts of the search: the prior's mean and draws of the prior
    annealing_steps: int = 10  # number of steps while the noise shrinks
    steps: int = 10  # number of steps at the true noise
    draws: int = 256  # number of draws in each round of importance sampling
    rounds: int = 4  # number of rounds of importance sampling; 0 keeps the result of Laplace's method
    proposal_dof: int = 5  # degrees of freedom of the draws, whose tails must be heavier than any posterior's
    half_edge: float = PAD_WINDOW / 2  # m, half the edge of the skin's face
    candidate_faces: int = 128  # number of faces that are considered for each touch


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
    """Estimate an object's pose (posterior mean) and its covariance from touches at known tool poses.

    Args:
        key: A JAX key for the starts and the draws.
        surface: The object, in its own frame.
        T_w_o: Believed pose of the object.
        T_w_contact: `(n, 4, 4)` poses of the tool at first contact, such as from `contact_poses`.
        weight: `(n,)` weights of the touches. 0 or false leaves a touch out even if its pose is not
            finite, such as a touch in air.
        translation_std: Standard deviation (m) of the believed position along each axis.
        rotation_std: Standard deviation (rad) of the believed orientation about each axis.
        contact_std: Standard deviation (m) of a contact. It includes errors of the arm, of the object's shape, and of
            the skin's tilt times half its edge.
        config: Options of the search; its whole numbers are static.
        often: Whether to compile with all optimisations, which is faster from about twenty registrations on. The last
            digits may differ.

    Returns:
        The estimate. Its residuals, weights and cost are those of the most probable pose.

    Raises:
        ValueError: There is no touch, the number of weights differs, a weight is not finite, a pose with a weight is
            not finite or not rigid, or a standard deviation is out of range.
        TypeError: `key` is not a JAX key, or a standard deviation is not a number.

    Example:
        T_w_contact, in_contact = contact_poses(dataset.touches)
        estimate = i2t.register_by_touch(
            key, surface, T_w_o, T_w_contact, in_contact, translation_std=2e-3, rotation_std=0.03
        )
    """
    validation.random_key("key", key)
    for name, std in (("translation_std", translation_std), ("rotation_std", rotation_std)):
        validation.number(name, std, "a standard deviation, 0 where it is known", minimum=0)
    validation.number("contact_std", contact_std, "a standard deviation (m) above 0", above=0)
    T_w_o, T_w_contact, weight = (jnp.asarray(value, jnp.float32) for value in (T_w_o, T_w_contact, weight))
    check_contacts(T_w_o, T_w_contact, weight)
    stds = (jnp.asarray(std, jnp.float32) for std in (translation_std, rotation_std, contact_std))
    register = _register_often if often else _register_once
    return register(key, surface, T_w_o, T_w_contact, weight, *stds, config=config)


@compiles_slowly("registration by touch", seconds=4)
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
    """Register as `register_by_touch` does, with checked arguments."""
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
    """Search from the prior's mean and from draws of the prior, and return the most probable z with its linearisation
    and cost.
    """
    scales = _annealed(noise, jnp.hypot(prior_std[0], prior_std[3]), config)  # the prior's error at the face

    def search(z: Float[Array, "6"]) -> tuple[Float[Array, "6"], LinearisedContacts, Float[Array, ""]]:
        end, linearised = levenberg_marquardt(problem, z, scales)
        return end, linearised, problem.cost(end, linearised, noise)

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
    """Compute the mean and covariance of z by Laplace's method at the mode, corrected by importance sampling."""

    def negative_log_posterior(z: Float[Array, "6"]) -> Float[Array, ""]:
        return problem.cost(z, problem.residual_and_jacobian(z), noise)

    information, _ = problem.normal_equations(mode, linearised, noise)
    draws = jax.random.normal(key, (config.rounds, config.draws, 6 + config.proposal_dof))
    return importance_covariance(negative_log_posterior, mode, jnp.linalg.inv(information), draws)


def _touch_problem(contacts: Contacts, half_edge: float | Array) -> LeastSquares:
    """State the problem of the most probable z."""
    n = len(contacts.weight)
    return LeastSquares(
        residual_and_jacobian=lambda z: linearise(z, contacts, half_edge),
        cost=lambda z, linearised, scale: contact_cost(z, linearised, contacts.weight, scale),
        normal_equations=lambda z, linearised, scale: contact_normal_equations(z, linearised, contacts.weight, scale),
        # Residuals (m) that are worse than any real ones.
        placeholder=LinearisedContacts(jnp.full(n, 1e3), jnp.zeros((n, 6)), jnp.ones(n)),
    )


def _annealed(
    noise: Float[Array, ""], prior_error: Float[Array, ""], config: TouchRegistrationConfig
) -> Float[Array, " steps"]:
    """Compute scales (m) of the residuals from the prior's errors down to the noise, in equal factors."""
    wide = jnp.maximum(noise, prior_error)
    fraction = jnp.minimum(jnp.arange(config.annealing_steps + config.steps) / config.annealing_steps, 1.0)
    return wide ** (1 - fraction) * noise**fraction


@full_precision
def importance_covariance(
    negative_log_posterior: Callable[[Float[Array, "6"]], Float[Array, ""]],
    mode: Float[Array, "6"],
    covariance: Float[Array, "6 6"],
    draws: Float[Array, "rounds draws numbers"],
    *,
    min_proposal_std: float = 1e-3,
    min_variance_factor: float = 0.1,
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Correct the mean and covariance of a posterior by rounds of importance sampling, each from the result of the one
    before (population Monte Carlo; Cappé, Guillin, Marin and Robert, J. Comput. Graph. Stat. 13, 2004).

    Each round draws from Student's t about the mean and weights the draws by the posterior. The same draws, weighted by
    the normal distribution of the round before, serve as a control variate that reduces the noise of drawing. Few
    effective draws change little.

    Args:
        negative_log_posterior: Function that computes minus the logarithm of the density at z, up to a constant.
        mode: `(6,)` z at the maximum of the density, in standard deviations of the prior.
        covariance: `(6, 6)` covariance of Laplace's method, the inverse of the information at the mode.
        draws: Standard normal numbers; the first six are the direction of a draw, the others determine its tail.
        min_proposal_std: Standard deviation, relative to the prior's, that is added to the draws, because float32
            cannot resolve much less.
        min_variance_factor: Smallest factor by which a round may shrink the variance along any direction.

    Returns:
        `(6,)` mean and `(6, 6)` covariance of z.
    """
    dof = draws.shape[-1] - 6

    def adapt(
        belief: tuple[Float[Array, "6"], Float[Array, "6 6"]], drawn: Float[Array, "draws numbers"]
    ) -> tuple[tuple[Float[Array, "6"], Float[Array, "6 6"]], None]:
        mean, covariance = belief
        factor = jnp.linalg.cholesky(covariance + min_proposal_std**2 * jnp.eye(6))
        u = drawn[:, :6] / jnp.sqrt(jnp.mean(drawn[:, 6:] ** 2, axis=1, keepdims=True))
        z = mean[None] + u @ factor.T
        square = jnp.sum(u**2, axis=1)
        heavy = (dof + 6) / 2 * jnp.log1p(square / dof)  # minus the logarithm of the density of the draws
        posterior = jax.nn.softmax(map_batches(lambda z: -negative_log_posterior(z), z, 16) + heavy)
        change = posterior - jax.nn.softmax(heavy - square / 2)
        count = 1 / jnp.sum(posterior**2)  # effective number of draws
        trust = count / (count + 6)
        shift = trust * (change @ u)
        values, axes = jnp.linalg.eigh(jnp.eye(6) + trust * (u.T @ (change[:, None] * u)) - jnp.outer(shift, shift))
        root = factor @ axes * jnp.sqrt(jnp.maximum(values, min_variance_factor))[None]
        return (mean + factor @ shift, root @ root.T), None

    return jax.lax.scan(adapt, (mode, covariance), draws)[0]
