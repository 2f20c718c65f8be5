"""A tool pose from one patch: Levenberg-Marquardt on rigid motions, through the derivatives of the renderer.

What was observed is turned into absolute heights, `y = min(nearest + depth, floor)` with `floor = nearest + reach`:
a pixel at the reach says that the surface lies no nearer than the floor, and so does a ray that misses. The model of a
pose is cut at the same floor, so that every pixel has a residual `r = min(h(T), floor) - y`, in metres, and those that
both call deep have none. What appears or disappears at an outline makes residuals of millimetres that no derivative
explains; the loss of Geman and McClure ("Statistical methods for tomographic image reconstruction", 1987), `rho(r) =
r^2 / (r^2 / c^2 + 1)`, lets them pass, and its scale c shrinks from step to step (graduated non-convexity: Blake and
Zisserman, "Visual reconstruction", 1987). Steps are those of Levenberg and Marquardt on the reweighted squares.

A motion is a twist `x` (6,) in the tool frame, `T exp(x)`: three translations in metres, then three rotations times
LEVER, half the edge of a patch, which is how far they move its rim: all six in metres. Then the Gauss-Newton matrix
`mean_pixels(dh/dx dh/dx')` has no unit, and an eigenvalue is the mean square change of the heights per square of the
motion along its eigenvector: 1 for a motion along the tool axis, 1/3 for a tilt of a flat surface, 0 for what one patch
cannot tell, such as sliding along a plane. `observable` compares it with a bound, `resolvable` derives the bound from
noise and the error that is asked for.

Everything is pure and works on one observation; lift it with `vmap`. Steps return `(state, info)`.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key

from i2t.geometry import full_precision, random_motion, so3_exp, transform
from i2t.rendering.render import render_patch
from i2t.types import PATCH_WINDOW, REACH, TWIST_LEVER_M, Patch, Surface

# Of the Gauss-Newton matrix, whose eigenvalues are about 1 where a pose is known.
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e6
NOTHING = -1e3  # m, floor of a patch without a surface
UNSEEN = 1.0  # m, residual of a pose that was not looked at yet: worse than any
EASE, STIFFEN = 1 / 3, 4.0  # of the damping, after a step that helped and one that did not


@dataclass(frozen=True)
class PatchRegistrationConfig:
    """How a pose is sought. Lengths in metres."""

    steps: int = 40  # at most
    coarse: float = 2e-3  # c of the robust loss in the first step
    fine: float = 0.1e-3  # and at the end; about three times the noise of a pixel where that is more
    shrink: float = 0.7  # of c, from step to step
    settled: float = 1e-6  # ends when a step at the fine scale is shorter
    window: float = PATCH_WINDOW
    reach: float = REACH


class Linearised(NamedTuple):
    """Residuals of a pose and how they change with a twist."""

    residual: Float[Array, "n n"]  # m
    slopes: Float[Array, "n n 6"]


class RefinementState(NamedTuple):
    """What the next step needs."""

    T_w_t: Float[Array, "4 4"]
    here: Linearised
    damping: Float[Array, ""]
    scale: Float[Array, ""]  # m, c of the robust loss
    moved: Float[Array, ""]  # m, length of the last twist that was tried
    tried: Int[Array, ""]  # steps so far


class RefinementInfo(NamedTuple):
    """What a person looks at after a step."""

    cost: Float[Array, ""]  # m^2, mean robust loss of the pose that was kept, at this step's scale
    accepted: Bool[Array, ""]
    scale: Float[Array, ""]  # m
    damping: Float[Array, ""]


class RefinedPose(NamedTuple):
    """A pose, how well it explains the patch, and what the patch says about it."""

    T_w_t: Float[Array, "4 4"]
    cost: Float[Array, ""]  # m^2, mean robust loss at the fine scale
    steps: Int[Array, ""]
    eigenvalues: Float[Array, "6"]  # of the Gauss-Newton matrix at this pose, smallest first
    directions: Float[Array, "6 6"]  # unit twists in columns, in that order


def refine_pose(
    surface: Surface,
    observed: Patch,
    T_w_t: Float[Array, "4 4"],
    how: PatchRegistrationConfig = PatchRegistrationConfig(),
) -> RefinedPose:
    """The pose near `T_w_t` at which the surface looks as `observed`.

    A patch that shows nothing (`nearest` infinite) leaves the pose where it is; a start that is not finite stays so.
    """
    state = jax.lax.while_loop(
        lambda state: ~terminate(state, how),
        lambda state: step(surface, observed, state, how)[0],
        init(observed, T_w_t, how),
    )
    eigenvalues, directions = jnp.linalg.eigh(_gauss_newton(state.here.slopes))
    return RefinedPose(state.T_w_t, robust_cost(state.here.residual, how.fine), state.tried, eigenvalues, directions)


@full_precision
def refine_pose_multistart(
    key: Key[Array, ""],
    surface: Surface,
    observed: Patch,
    T_w_t: Float[Array, "4 4"],
    distance: float,
    angle: float,
    how: PatchRegistrationConfig = PatchRegistrationConfig(),
    draws: int = 32,
    starts: int = 4,
) -> RefinedPose:
    """`refine` from the `starts` best of `draws` poses around `T_w_t`, and the best of what they became.

    For objects with edges, where the heights of a pose two millimetres off have little to do with the right one's.
    Poses are drawn with standard deviations `distance` (m) and `angle` (rad) on each axis; the first is `T_w_t` itself.
    Best is the smallest robust cost, at the coarse scale before and at the fine scale after.
    """
    keys = jax.random.split(key, draws - 1)
    motions = jax.vmap(random_motion, (0, None, None))(keys, distance, angle)
    poses = jnp.concatenate([T_w_t[None], T_w_t @ motions])
    pixels = observed.depth.shape[-1]
    target, floor = reference_heights(observed, how.reach)
    costs = jax.vmap(
        lambda T: robust_cost(visible_heights(surface, T, floor, pixels, how.window, how.reach) - target, how.coarse)
    )(poses)
    _, best = jax.lax.top_k(-costs, starts)
    ends = jax.vmap(refine_pose, (None, None, 0, None))(surface, observed, poses[best], how)
    first = jnp.argmin(jnp.where(jnp.isnan(ends.cost), jnp.inf, ends.cost))
    return jax.tree.map(lambda leaf: leaf[first], ends)


def init(observed: Patch, T_w_t: Float[Array, "4 4"], how: PatchRegistrationConfig) -> RefinementState:
    """The state before the first step, which only looks: so the renderer is compiled once."""
    one = jnp.ones((), T_w_t.dtype)
    blind = Linearised(jnp.full_like(observed.depth, UNSEEN), jnp.zeros((*observed.depth.shape, 6), T_w_t.dtype))
    return RefinementState(T_w_t, blind, 0.1 * one, how.coarse * one, math.inf * one, jnp.zeros((), jnp.int32))


@full_precision
def step(
    surface: Surface, observed: Patch, state: RefinementState, how: PatchRegistrationConfig
) -> tuple[RefinementState, RefinementInfo]:
    """Try one damped Gauss-Newton step, and keep it if the robust cost falls."""
    weight = (1 + (state.here.residual / state.scale) ** 2) ** -2  # of rho, as a square's
    slopes = state.here.slopes
    weighted = slopes * weight[..., None] / weight.size
    matrix = jnp.einsum("ijk,ijl->kl", weighted, slopes, precision="highest")
    gradient = jnp.einsum("ijk,ij->k", weighted, state.here.residual, precision="highest")
    twist = -jnp.linalg.solve(matrix + state.damping * jnp.eye(6), gradient)
    T_w_t = state.T_w_t @ motion(twist)
    there = linearise(surface, observed, T_w_t, how)
    before, after = (robust_cost(at.residual, state.scale) for at in (state.here, there))
    better = after < before
    kept_pose, kept = jax.tree.map(
        lambda new, old: jnp.where(better, new, old), (T_w_t, there), (state.T_w_t, state.here)
    )
    damping = jnp.clip(state.damping * jnp.where(better, EASE, STIFFEN), LEAST_DAMPING, MOST_DAMPING)
    scale = jnp.maximum(state.scale * how.shrink, how.fine)
    info = RefinementInfo(jnp.where(better, after, before), better, state.scale, state.damping)
    return RefinementState(kept_pose, kept, damping, scale, jnp.linalg.norm(twist), state.tried + 1), info


def terminate(state: RefinementState, how: PatchRegistrationConfig) -> Bool[Array, ""]:
    """Whether the steps are used up or have become too short to matter."""
    return (state.tried >= how.steps) | ((state.moved < how.settled) & (state.scale <= how.fine))


def linearise(
    surface: Surface, observed: Patch, T_w_t: Float[Array, "4 4"], how: PatchRegistrationConfig
) -> Linearised:
    """Residuals of a pose and their derivatives by a twist."""
    target, floor = reference_heights(observed, how.reach)
    heights, slopes = slopes_of(surface, T_w_t, floor, target.shape[-1], how.window, how.reach)
    return Linearised(heights - target, slopes)


def pose_information(
    surface: Surface, T_w_t: Float[Array, "4 4"], pixels: int, window: float = PATCH_WINDOW, reach: float = REACH
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Eigenvalues of the Gauss-Newton matrix of a patch seen at a pose, smallest first, and its eigenvectors in
    columns.
    """
    patch = render_patch(surface, T_w_t, window, pixels, reach)
    _, floor = reference_heights(patch, reach)
    _, slopes = slopes_of(surface, T_w_t, floor, pixels, window, reach)
    return jnp.linalg.eigh(_gauss_newton(slopes))


def observable_directions(eigenvalues: Float[Any, "*n"], bound: float) -> Bool[Any, "*n"]:
    """Which directions a patch tells, given the smallest eigenvalue that counts (see `resolvable`)."""
    return eigenvalues >= bound


def resolvable_eigenvalue(noise: float, error: float, pixels: int) -> float:
    """The eigenvalue from which on `error` (m) along a direction is two standard deviations of its estimate, where each
    of pixels^2 heights has its own `noise` (m, standard deviation): the variance is noise^2 / (pixels^2 eigenvalue).
    """
    return (2 * noise / (error * pixels)) ** 2


def motion(twist: Float[Array, "6"]) -> Float[Array, "4 4"]:
    """The rigid motion of a small twist: its rotation, then its translation."""
    return transform(so3_exp(twist[3:] / TWIST_LEVER_M), twist[:3])


def robust_cost(residual: Float[Array, "n n"], scale: float | Float[Array, ""]) -> Float[Array, ""]:
    """Mean loss of Geman and McClure (m^2): a residual's square where it is small, `scale`^2 where it is large."""
    square = residual**2
    return jnp.mean(square / (square / scale**2 + 1))


def reference_heights(observed: Patch, reach: float) -> tuple[Float[Array, "n n"], Float[Array, ""]]:
    """Absolute heights of a patch (m), cut at its floor, and that floor; one that shows nothing has its floor in front
    of everything, where every pose looks like it.
    """
    seen = jnp.isfinite(observed.nearest)
    start = jnp.where(seen, observed.nearest, 0)
    return jnp.where(seen, start + observed.depth, NOTHING), jnp.where(seen, start + reach, NOTHING)


def visible_heights(
    surface: Surface, T_w_t: Float[Array, "4 4"], floor: Float[Array, ""], pixels: int, window: float, reach: float
) -> Float[Array, "n n"]:
    """Heights of a pose, cut at the floor."""
    far = 2 * reach  # so that a pose up to one reach nearer than the right one still shows all that it should
    patch = render_patch(surface, T_w_t, window, pixels, far)
    return jnp.where(patch.depth < far, jnp.minimum(patch.depth + patch.nearest, floor), floor)


@full_precision
def slopes_of(
    surface: Surface, T_w_t: Float[Array, "4 4"], floor: Float[Array, ""], pixels: int, window: float, reach: float
) -> tuple[Float[Array, "n n"], Float[Array, "n n 6"]]:
    """Cut heights of a pose and their derivatives by a twist.

    A face that crosses the reach within one pixel is an outline rather than a slope: its derivative holds for less
    than a pixel, and is left out.
    """

    def look(twist):
        return visible_heights(surface, T_w_t @ motion(twist), floor, pixels, window, reach)

    heights, push = jax.linearize(look, jnp.zeros(6, T_w_t.dtype))
    slopes = jax.vmap(push, out_axes=-1)(jnp.eye(6, dtype=T_w_t.dtype))
    steep = jnp.hypot(slopes[..., 0], slopes[..., 1]) > reach * pixels / window
    return heights, jnp.where((steep | (heights >= floor))[..., None], 0, slopes)


def _gauss_newton(slopes: Float[Array, "n n 6"]) -> Float[Array, "6 6"]:
    return jnp.einsum("ijk,ijl->kl", slopes, slopes, precision="highest") / slopes[..., 0].size
