"""Levenberg-Marquardt for robust least squares whose scale shrinks from step to step (graduated non-convexity).

Every step looks where the last one led, keeps it if the cost there is not larger, and solves the damped normal
equations

    (J' W J + damping D) change = -J' W r

for the next trial, where W are the weights of iteratively reweighted least squares and D is the identity (Levenberg,
"A method for the solution of certain non-linear problems in least squares", 1944) or the diagonal of the matrix
(Marquardt, "An algorithm for least-squares estimation of nonlinear parameters", 1963). A step that is kept cuts the
damping, one that is not raises it. The first step only looks, so that what is linearised is compiled once.

Pure: lift it with `vmap` over starts or observations.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

MIN_DAMPING, MAX_DAMPING = 1e-3, 1e6  # relative to D
DAMPING_CUT, DAMPING_RAISE = 1 / 3, 4.0  # factors after a step that was kept and one that was not


class LeastSquares(NamedTuple):
    """A problem: plain functions of the parameters x (an array or a tree of them).

    What `residual_and_jacobian` returns is up to the problem; it goes to the two functions that weigh it.
    """

    residual_and_jacobian: Callable[[Any], Any]  # x -> linearisation, any tree of arrays
    cost: Callable[[Any, Any, Array], Array]  # x, linearisation, scale -> what is made small
    normal_equations: Callable[[Any, Any, Array], tuple[Array, Array]]  # the same -> J' W J (p, p) and J' W r (p,)
    retract: Callable[[Any, Array], Any]  # x, change (p,) -> x moved by the change
    unseen: Any  # linearisation of a start that was not looked at yet: its cost exceeds all others


class SolverState(NamedTuple):
    """State for the next step."""

    x: Any  # the best so far
    linearised: Any  # there
    trial: Any  # to be looked at next
    trial_length: Float[Array, ""]  # of the change from x to the trial
    looked_length: Float[Array, ""]  # of the change that was looked at last
    damping: Float[Array, ""]
    steps: Int[Array, ""]  # so far


def levenberg_marquardt(
    problem: LeastSquares,
    x0: Any,
    scales: Float[Array, " steps"],
    next_scales: Float[Array, " steps"] | None = None,
    *,
    damping: float = MIN_DAMPING,
    scale_free: bool = False,
    tolerance: float | None = None,
) -> SolverState:
    """Minimise a robust sum of squares.

    Args:
        problem: What is sought.
        x0: Where the search starts.
        scales: Of the robust loss at each step; as many steps are made at most.
        next_scales: By which each step proposes the next trial; those of `scales` unless given.
        damping: The first damping.
        scale_free: Whether the damping multiplies the matrix's diagonal (Marquardt) instead of the identity
            (Levenberg): the better choice where parameters differ in their units.
        tolerance: Ends at the last scale once a change is shorter; None makes all steps.

    Returns:
        The last state: `x` is the answer, `linearised` what the problem says there.
    """
    next_scales = scales if next_scales is None else next_scales

    def unfinished(state: SolverState) -> Bool[Array, ""]:
        left = state.steps < len(scales)
        if tolerance is None:
            return left
        last_scale = scales[jnp.minimum(state.steps, len(scales) - 1)] <= scales[-1]
        return left & ~((state.looked_length < tolerance) & last_scale)

    def step(state: SolverState) -> SolverState:
        """Look at the trial, keep it if its cost is not larger, and propose the next one."""
        there, scale = problem.residual_and_jacobian(state.trial), scales[state.steps]
        accepted = problem.cost(state.trial, there, scale) <= problem.cost(state.x, state.linearised, scale)
        x, linearised = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old), (state.trial, there), (state.x, state.linearised)
        )
        changed = jnp.clip(state.damping * jnp.where(accepted, DAMPING_CUT, DAMPING_RAISE), MIN_DAMPING, MAX_DAMPING)
        matrix, gradient = problem.normal_equations(x, linearised, next_scales[state.steps])
        diagonal = jnp.diagonal(matrix) if scale_free else jnp.ones(len(matrix), matrix.dtype)
        change = -jax.scipy.linalg.solve(matrix + changed * jnp.diag(diagonal), gradient, assume_a="pos")
        trial, length = problem.retract(x, change), jnp.linalg.norm(change)
        return SolverState(x, linearised, trial, length, state.trial_length, changed, state.steps + 1)

    far = jnp.full((), math.inf, jnp.float32)
    first = jnp.full((), damping, jnp.float32)
    start = SolverState(x0, problem.unseen, x0, far, far, first, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(unfinished, step, start)
