"""Levenberg-Marquardt for robust least squares whose scale shrinks from step to step (graduated non-convexity).

Every step evaluates the trial of the step before, accepts it if its cost is not larger, and solves the damped normal
equations

    (J' W J + damping D) change = -J' W r

for the next trial. W are the weights of iteratively reweighted least squares (Levenberg, "A method for the solution of
certain non-linear problems in least squares", 1944). D is the diagonal of the matrix, so that the units of the
parameters do not matter (Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963). An
accepted step reduces the damping, a rejected one raises it. The first step only evaluates the start, so that the
linearisation is compiled once.

The functions are pure; lift them with `vmap` over starts or observations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@dataclass(frozen=True)
class Damping:
    """Bounds of the Levenberg-Marquardt damping, relative to the matrix's diagonal, and its factors after a step."""

    smallest: float = 1e-3
    largest: float = 1e6
    accepted_factor: float = 1 / 3
    rejected_factor: float = 4.0


class LeastSquares(NamedTuple):
    """A least-squares problem as functions of the parameters x: linearisation, cost to minimise and normal equations.

    The problem chooses the type of its linearisation, which is passed on to the other two functions.
    """

    residual_and_jacobian: Callable[[Array], Any]  # x -> linearisation, any tree of arrays
    cost: Callable[[Array, Any, Array], Array]  # x, linearisation, scale -> cost to minimise
    # the same arguments -> J' W J (p, p), J' W r (p,)
    normal_equations: Callable[[Array, Any, Array], tuple[Array, Array]]
    placeholder: Any  # linearisation whose cost exceeds all others, in place of the start's before it is evaluated


def levenberg_marquardt(
    problem: LeastSquares, x0: Float[Array, " p"], scales: Float[Array, " steps"], *, damping: Damping = Damping()
) -> tuple[Float[Array, " p"], Any]:
    """Minimise a robust sum of squares by Levenberg-Marquardt, with one scale of the loss for each step.

    Args:
        problem: The problem.
        x0: `(p,)` parameters at which the search starts.
        scales: Scale of the robust loss at each step.
        damping: Bounds and factors of the damping.

    Returns:
        `(p,)` best parameters, and the problem's linearisation there.
    """

    def step(state: tuple[Any, ...], scale: Float[Array, ""]) -> tuple[tuple[Any, ...], None]:
        """Evaluate the trial, accept it if its cost is not larger, and propose the next one."""
        x, linearised, trial, factor = state
        there = problem.residual_and_jacobian(trial)
        accepted = problem.cost(trial, there, scale) <= problem.cost(x, linearised, scale)
        x, linearised = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), (trial, there), (x, linearised))
        change = jnp.where(accepted, damping.accepted_factor, damping.rejected_factor)
        factor = jnp.clip(factor * change, damping.smallest, damping.largest)
        matrix, gradient = problem.normal_equations(x, linearised, scale)
        damped = matrix + factor * jnp.diag(jnp.diagonal(matrix))
        trial = x - jax.scipy.linalg.solve(damped, gradient, assume_a="pos")
        return (x, linearised, trial, factor), None

    start = x0, problem.placeholder, x0, jnp.full((), damping.smallest, jnp.float32)
    (x, linearised, _, _), _ = jax.lax.scan(step, start, scales)
    return x, linearised
