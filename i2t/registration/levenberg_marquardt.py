"""Levenberg-Marquardt for robust least squares whose scale shrinks from step to step (graduated non-convexity).

Every step looks where the last one led, keeps it if the cost there is not larger, and solves the damped normal
equations

    (J' W J + damping D) change = -J' W r

for the next trial, where W are the weights of iteratively reweighted least squares (Levenberg, "A method for the
solution of certain non-linear problems in least squares", 1944) and D is the diagonal of the matrix, so that the units
of the parameters do not matter (Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963).
A step that is kept cuts the damping, one that is not raises it. The first step only looks, so that what is linearised
is compiled once.

Pure: lift it with `vmap` over starts or observations.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

MIN_DAMPING, MAX_DAMPING = 1e-3, 1e6  # relative to D
DAMPING_CUT, DAMPING_RAISE = 1 / 3, 4.0  # factors after a step that was kept and one that was not


class LeastSquares(NamedTuple):
    """A problem: plain functions of the parameters x.

    What `residual_and_jacobian` returns is up to the problem; it goes to the two functions that weigh it.
    """

    residual_and_jacobian: Callable[[Array], Any]  # x -> linearisation, any tree of arrays
    cost: Callable[[Array, Any, Array], Array]  # x, linearisation, scale -> what is made small
    normal_equations: Callable[[Array, Any, Array], tuple[Array, Array]]  # the same -> J' W J (p, p) and J' W r (p,)
    unseen: Any  # linearisation of a start that was not looked at yet: its cost exceeds all others


def levenberg_marquardt(
    problem: LeastSquares, x0: Float[Array, " p"], scales: Float[Array, " steps"]
) -> tuple[Float[Array, " p"], Any]:
    """Minimise a robust sum of squares.

    Args:
        problem: What is sought.
        x0: Where the search starts.
        scales: Of the robust loss at each step.

    Returns:
        The best x, and what the problem says there.
    """

    def step(state: tuple[Any, ...], scale: Float[Array, ""]) -> tuple[tuple[Any, ...], None]:
        """Look at the trial, keep it if its cost is not larger, and propose the next one."""
        x, linearised, trial, damping = state
        there = problem.residual_and_jacobian(trial)
        accepted = problem.cost(trial, there, scale) <= problem.cost(x, linearised, scale)
        x, linearised = jax.tree.map(lambda new, old: jnp.where(accepted, new, old), (trial, there), (x, linearised))
        damping = jnp.clip(damping * jnp.where(accepted, DAMPING_CUT, DAMPING_RAISE), MIN_DAMPING, MAX_DAMPING)
        matrix, gradient = problem.normal_equations(x, linearised, scale)
        damped = matrix + damping * jnp.diag(jnp.diagonal(matrix))
        trial = x - jax.scipy.linalg.solve(damped, gradient, assume_a="pos")
        return (x, linearised, trial, damping), None

    start = x0, problem.unseen, x0, jnp.full((), MIN_DAMPING, jnp.float32)
    (x, linearised, _, _), _ = jax.lax.scan(step, start, scales)
    return x, linearised
