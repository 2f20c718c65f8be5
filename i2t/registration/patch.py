"""A tool pose from one patch: Levenberg-Marquardt on rigid motions, through the derivatives of the renderer.

What was observed is turned into absolute heights, `y = min(nearest + depth, floor)` with `floor = nearest + reach`:
a pixel at the reach says that the surface lies no nearer than the floor, and so does a ray that misses. The model of a
pose is clipped to that floor, so that every pixel has a residual `r = min(h(T), floor) - y`, in metres, and those that
both call deep have none. What appears or disappears at an outline makes residuals of millimetres that no derivative
explains; the loss of Geman and McClure ("Statistical methods for tomographic image reconstruction", 1987), `rho(r) =
r^2 / (r^2 / c^2 + 1)`, lets them pass, and its scale c shrinks from step to step (graduated non-convexity: Blake and
Zisserman, "Visual reconstruction", 1987).

A motion is a twist `x` (6,) in the tool frame, `T from_twist(x)` (`i2t.geometry`): three translations in metres, then
three rotations times `TWIST_LEVER_M`, half the edge of a patch, which is how far they move its rim: all six in metres.
Then the Gauss-Newton matrix `mean_pixels(dh/dx dh/dx')` has no unit, and an eigenvalue is the mean square change of the
heights per square of the motion along its eigenvector: 1 for a motion along the tool axis, 1/3 for a tilt of a flat
surface, 0 for what one patch cannot tell, such as sliding along a plane. `resolvable_eigenvalue` is the least that
counts, by noise and the error that is asked for.

Everything is pure and works on one observation; lift it with `vmap`.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from i2t.geometry import from_twist, full_precision
from i2t.registration.levenberg_marquardt import LeastSquares, levenberg_marquardt
from i2t.rendering.render import render_patch
from i2t.types import Patch, Surface
from i2t.windows import PATCH_PIXELS, PATCH_WINDOW, REACH

INITIAL_DAMPING = 0.1  # of the Gauss-Newton matrix, whose eigenvalues are about 1 where a pose is known
EMPTY_FLOOR_M = -1e3  # floor of a patch without a surface
UNSEEN_RESIDUAL_M = 1.0  # of a pose that was not looked at yet: worse than any


@dataclass(frozen=True)
class PatchRegistrationConfig:
    """Options of pose search by a patch. Lengths in metres."""

    max_steps: int = 40
    initial_scale: float = 2e-3  # c of the robust loss in the first step
    final_scale: float = 0.1e-3  # and at the end; about three times the noise of a pixel where that is more
    scale_factor: float = 0.7  # of c, from step to step
    tolerance: float = 1e-6  # ends when a step at the final scale is shorter
    window: float = PATCH_WINDOW
    reach: float = REACH


class LinearisedPatch(NamedTuple):
    """Residuals of a pose and their derivatives by a twist."""

    residual: Float[Array, "n n"]  # m
    jacobian: Float[Array, "n n 6"]


class RefinedPose(NamedTuple):
    """A pose, its fit to the patch, and the patch's information about it."""

    T_o_t: Float[Array, "4 4"]
    cost: Float[Array, ""]  # m^2, mean robust loss at the final scale
    steps: Int[Array, ""]
    eigenvalues: Float[Array, "6"]  # of the Gauss-Newton matrix at this pose, smallest first
    directions: Float[Array, "6 6"]  # unit twists in columns, in that order


def refine_pose(
    surface: Surface,
    observed: Patch,
    T_o_t: Float[Array, "4 4"],
    config: PatchRegistrationConfig = PatchRegistrationConfig(),
) -> RefinedPose:
    """Find the pose near another at which a surface looks as observed.

    Args:
        surface: What was seen.
        observed: The patch; one that shows nothing (`nearest` infinite) leaves the pose where it is.
        T_o_t: Where the search starts; a start that is not finite stays so.
        config: How to search; static.

    Returns:
        The pose and what the patch tells about it.
    """
    scales = _scale_schedule(config)
    problem = _patch_problem(surface, observed, config)
    end = levenberg_marquardt(
        problem, T_o_t, scales[:-1], scales[1:], damping=INITIAL_DAMPING, tolerance=config.tolerance
    )
    eigenvalues, directions = jnp.linalg.eigh(_gauss_newton(end.linearised.jacobian))
    cost = robust_cost(end.linearised.residual, config.final_scale)
    return RefinedPose(end.x, cost, end.steps, eigenvalues, directions)


def pose_information(
    surface: Surface,
    T_o_t: Float[Array, "4 4"],
    config: PatchRegistrationConfig = PatchRegistrationConfig(),
    *,
    pixels: int = PATCH_PIXELS,
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Information about the pose in a patch seen there.

    Args:
        surface: What is seen.
        T_o_t: The pose.
        config: Window and reach of the patch; static.
        pixels: Along the patch's edge; static.

    Returns:
        Eigenvalues of the Gauss-Newton matrix, smallest first, and its eigenvectors (unit twists) in columns.
    """
    patch = render_patch(surface, T_o_t, window=config.window, pixels=pixels, reach=config.reach)
    return jnp.linalg.eigh(_gauss_newton(_linearise(surface, patch, T_o_t, config).jacobian))


def resolvable_eigenvalue(noise: float, error: float, pixels: int) -> float:
    """The eigenvalue from which on an error along a direction is two standard deviations of its estimate: the variance
    is noise^2 / (pixels^2 eigenvalue).

    Args:
        noise: Standard deviation (m) of each height, independent.
        error: The error (m) that is asked for.
        pixels: Along the patch's edge.

    Returns:
        The bound, without a unit.
    """
    return (2 * noise / (error * pixels)) ** 2


def robust_cost(residual: Float[Array, "n n"], scale: float | Float[Array, ""]) -> Float[Array, ""]:
    """Mean loss of Geman and McClure: a residual's square where it is small, `scale`^2 where it is large.

    Args:
        residual: Residuals (m).
        scale: Of the loss (m).

    Returns:
        The mean over all pixels (m^2).
    """
    square = residual**2
    return jnp.mean(square / (square / scale**2 + 1))


def _patch_problem(surface: Surface, observed: Patch, config: PatchRegistrationConfig) -> LeastSquares:
    """The search for the pose T_o_t."""
    shape, dtype = observed.depth.shape, observed.depth.dtype
    return LeastSquares(
        residual_and_jacobian=lambda T_o_t: _linearise(surface, observed, T_o_t, config),
        cost=lambda T_o_t, linearised, scale: robust_cost(linearised.residual, scale),
        normal_equations=lambda T_o_t, linearised, scale: _normal_equations(linearised, scale),
        retract=full_precision(lambda T_o_t, twist: T_o_t @ from_twist(twist)),
        unseen=LinearisedPatch(jnp.full(shape, UNSEEN_RESIDUAL_M, dtype), jnp.zeros((*shape, 6), dtype)),
    )


def _scale_schedule(config: PatchRegistrationConfig) -> Float[Array, " steps_and_one"]:
    """The scale (m) of the robust loss at every step, and at what would follow the last one."""
    scales = [np.float32(config.initial_scale)]
    for _ in range(config.max_steps):
        scales.append(max(scales[-1] * np.float32(config.scale_factor), np.float32(config.final_scale)))
    return jnp.asarray(scales)


@full_precision
def _linearise(
    surface: Surface, observed: Patch, T_o_t: Float[Array, "4 4"], config: PatchRegistrationConfig
) -> LinearisedPatch:
    """Residuals of a pose, and their derivatives by a twist.

    A patch that shows nothing has its floor in front of everything, where every pose looks like it. A face that crosses
    the reach within one pixel is an outline rather than a slope: its derivative holds for less than a pixel, and is
    left out.
    """
    pixels, reach = observed.depth.shape[-1], config.reach
    shown = jnp.isfinite(observed.nearest)
    start = jnp.where(shown, observed.nearest, 0)
    reference = jnp.where(shown, start + observed.depth, EMPTY_FLOOR_M)
    floor = jnp.where(shown, start + reach, EMPTY_FLOOR_M)
    far = 2 * reach  # so that a pose up to one reach nearer than the right one still shows all that it should

    def look(twist: Float[Array, "6"]) -> Float[Array, "n n"]:
        patch = render_patch(surface, T_o_t @ from_twist(twist), window=config.window, pixels=pixels, reach=far)
        return jnp.where(patch.depth < far, jnp.minimum(patch.depth + patch.nearest, floor), floor)

    heights, push = jax.linearize(look, jnp.zeros(6, T_o_t.dtype))
    slopes = jax.vmap(push, out_axes=-1)(jnp.eye(6, dtype=T_o_t.dtype))
    steep = jnp.hypot(slopes[..., 0], slopes[..., 1]) > reach * pixels / config.window
    return LinearisedPatch(heights - reference, jnp.where((steep | (heights >= floor))[..., None], 0, slopes))


def _normal_equations(
    linearised: LinearisedPatch, scale: Float[Array, ""]
) -> tuple[Float[Array, "6 6"], Float[Array, "6"]]:
    """The Gauss-Newton matrix and the gradient of the reweighted squares, as means over the pixels."""
    weight = (1 + (linearised.residual / scale) ** 2) ** -2  # of rho, as a square's
    weighted = linearised.jacobian * weight[..., None] / weight.size
    matrix = jnp.einsum("ijk,ijl->kl", weighted, linearised.jacobian, precision="highest")
    return matrix, jnp.einsum("ijk,ij->k", weighted, linearised.residual, precision="highest")


def _gauss_newton(jacobian: Float[Array, "n n 6"]) -> Float[Array, "6 6"]:
    return jnp.einsum("ijk,ijl->kl", jacobian, jacobian, precision="highest") / jacobian[..., 0].size
