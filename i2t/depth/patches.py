"""Depth patches from real depth images: the patch of `i2t.rendering.render.render_patch`, as a camera sees it.

Every ray of the patch runs along tool z, as in the renderer, and is followed through the depth image. Three measured
neighbours form a triangle of surface. On it inverse depth is linear in the pixel, as on any plane seen by a pinhole.
Along a ray inverse depth is linear in the image as well, so the ray meets the surface where the two are equal.
Triangles seen at a grazing angle span a depth edge and are not surface. This also leaves out flying pixels, since a
pixel between two surfaces has a depth edge on both sides.

A camera measures free space as well as surface: everything in front of the surface is free. A ray that gets behind the
image without meeting a triangle, because it started there or came in through a hole, is lost, and what it meets later
is unknown. So a pixel is

    seen    if its ray meets the surface, or is free to deeper than the reach behind the nearest point
    filled  if it is in a hole between two seen pixels of its row, column or diagonal, at most 2 mm apart
    neither if it is in a larger hole; its depth is then the reach, as where there is no surface

Frames: W world, C camera (z forward, x along columns, y along rows), T tool; metres.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num

from i2t import validation
from i2t.depth.camera import Camera, check_image, check_view, measured_mask
from i2t.depth.distortion import pixel_rays, project_to_pixel
from i2t.geometry import is_rigid
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH, STANDOFF, VIEW_PIXELS, VIEW_WINDOW
from i2t.patches.views import PatchView, view_of_noisy_heights
from i2t.types import Patch, in_one_line


@dataclass(frozen=True)
class SurfaceTracing:
    """Settings of the tracing of rays through a depth image to its surface.

    Example:
        tracing = i2t.SurfaceTracing(max_depth_step=3e-3)  # for a coarse camera
        patch = i2t.patch_from_depth(image, camera, T_w_c, T_w_t, tracing=tracing)
    """

    # rad, smallest angle between a triangle and the line of sight; a smaller one spans a depth edge
    grazing_angle: float = math.radians(10)
    # m, depth step within which neighbours are surface at any angle; more than one step of a file in mm
    max_depth_step: float = 1.5e-3
    stride: float = 0.5  # distance in image pixels between successive samples of a ray
    # number of refinements of a crossing; the first is exact unless the surface folds in between
    crossing_steps: int = 6
    crossing_tolerance: float = 1e-4  # relative error of a crossing's depth: 10 um at the paper's distance


class _DepthPatch(NamedTuple):
    patch: Patch
    valid_mask: Bool[Array, "n n"]  # True for pixels on whose ray the depth was measured
    inpainted_mask: Bool[Array, "n n"]  # True for interpolated pixels, which are not valid ones


@in_one_line
class DepthPatch(_DepthPatch):
    """A depth patch extracted from a camera's depth image, and masks of its measured and interpolated pixels.

    Attributes:
        window: The edge of the patch (m) that `patch_from_depth` was given.
        reach: The depth (m) behind the nearest point at which the patch is clipped. Both are static and not part of
            the tuple, so they become None, which means unknown, in a transformation of JAX.
    """

    window: float | None = None
    reach: float | None = None


@in_one_line
class DepthView(NamedTuple):
    """A depth patch and its surroundings, extracted from a camera's depth image, with a mask of its known pixels."""

    view: PatchView
    known_mask: Bool[Array, "w w"]  # True for pixels that were measured or interpolated


def patch_from_depth(
    depth: Num[Array | np.ndarray, "height width"],
    camera: Camera,
    T_w_c: Float[Array | np.ndarray, "4 4"],
    T_w_t: Float[Array | np.ndarray, "4 4"],
    *,
    window: float = PATCH_WINDOW,
    pixels: int = PATCH_PIXELS,
    reach: float = REACH,
    fill: float = 2e-3,
    tracing: SurfaceTracing = SurfaceTracing(),
) -> DepthPatch:
    """Extract the depth patch in front of a tool from a depth image; `render_patch` does the same for a mesh.

    All arguments except `depth` and the two poses are static. The function has no reverse-mode derivative. A hole is
    bridged from side to side. Where its sides differ in depth by more than its width, it is filled to the deeper side,
    since what a nearer surface hides lies behind that surface.

    Args:
        depth: `(height, width)` depth (m) along the camera's axis, with holes as `i2t.depth.camera.measured_mask`
            recognises them.
        camera: The camera.
        T_w_c: `(4, 4)` pose of the camera in the world.
        T_w_t: `(4, 4)` pose of the tool in the world, along whose z axis the patch is seen.
        window: The edge of the patch (m).
        pixels: The number of pixels along the edge.
        reach: The depth (m) behind the nearest point at which the patch is clipped.
        fill: The largest width (m) of a hole that is bridged.
        tracing: How rays are followed to the surface.

    Returns:
        The patch with masks of its measured and interpolated pixels. `nearest` is the nearest measured point. Where
        nothing is measured, `nearest` is +inf and the depth is the reach. Under `jit` and `vmap`, where values cannot
        be checked, a pose that is not rigid or not finite gives NaN and no valid pixel.

    Raises:
        ValueError: The image has another size than the camera's. Outside of `jit` and `vmap` also: no pixel is
            measured, the image is not in metres (nearly all nearer than 2 cm or farther than 5 m), or a pose is not
            rigid.
        TypeError: An argument holds no real numbers.

    Example:
        seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)
        reading, std = predictor.predict(seen, force=1.0)
    """
    if not validation.is_traced(depth, T_w_c, T_w_t):
        depth = validation.numbers("depth", depth, "an image of metres")
        check_view(depth, camera, T_w_c, T_w_t)
    validation.number("window", window, "a length (m) above 0", above=0)
    validation.number("reach", reach, "a length (m) above 0, such as 4e-3", above=0)
    validation.count("pixels", pixels)
    validation.number("fill", fill, "a length (m), 0 for none", minimum=0)
    depth, T_w_c, T_w_t = (jnp.asarray(value) for value in (depth, T_w_c, T_w_t))
    check_image(depth, camera)
    depth = depth.astype(jnp.promote_types(depth.dtype, jnp.float32))  # float16 resolves 0.1 m to 0.06 mm
    sizes = {"window": window, "reach": reach, "fill": fill}
    seen = _patch_from_depth(depth, T_w_c, T_w_t, camera=camera, pixels=int(pixels), **sizes, tracing=tracing)
    seen.window, seen.reach = window, reach
    return seen


def view_from_depth(
    depth: Num[Array | np.ndarray, "height width"],
    camera: Camera,
    T_w_c: Float[Array | np.ndarray, "4 4"],
    T_w_t: Float[Array | np.ndarray, "4 4"],
    *,
    reach: float = 80e-3,
) -> DepthView:
    """Extract a depth patch with its surroundings from a depth image, in the form of simulated views.

    A model that was trained on simulated views accepts these views as well.

    Args:
        depth: `(height, width)` depth (m), as for `patch_from_depth`.
        camera: The camera; static.
        T_w_c: `(4, 4)` pose of the camera in the world.
        T_w_t: `(4, 4)` pose of the tool in the world.
        reach: The depth (m) behind the nearest point to which the view is followed; static.

    Returns:
        The view, with depths (m) along tool z behind the patch's nearest surface point, and a mask of its measured or
        interpolated pixels. The others are at the view's reach.

    Raises:
        ValueError: As for `patch_from_depth`.
        TypeError: An argument holds no real numbers.

    Example:
        seen = view_from_depth(image, camera, T_w_c, T_w_t)
        reading, std = predictor.predict(seen, force=1.0)
    """
    seen = patch_from_depth(depth, camera, T_w_c, T_w_t, window=VIEW_WINDOW, pixels=VIEW_PIXELS, reach=reach)
    known_mask = seen.valid_mask | seen.inpainted_mask
    z = jnp.where(known_mask & (seen.patch.depth < reach), seen.patch.nearest + seen.patch.depth, jnp.inf)
    return DepthView(view_of_noisy_heights(z), known_mask)


@partial(jax.jit, static_argnames=("camera", "pixels", "window", "reach", "fill", "tracing"))
def _patch_from_depth(
    depth: Array, T_w_c: Array, T_w_t: Array, *, camera: Camera, pixels: int, window: float, reach: float, fill: float,
    tracing: SurfaceTracing,
) -> DepthPatch:  # fmt: skip
    """Compute `patch_from_depth`; compiled once for each camera and each set of sizes."""
    # Holes at the patch's border are filled from pixels beyond it.
    margin = max(math.ceil(fill / window * pixels) - 1, 0)
    T_c_t = _relative(T_w_c, T_w_t)
    rigid = is_rigid(T_w_c) & is_rigid(T_w_t)
    T_c_t = jnp.where(rigid, T_c_t, jnp.eye(3, 4))
    rays = _rays(depth, camera, T_c_t, window=window, pixels=pixels, margin=margin, stride=tracing.stride)
    inner = (slice(margin, margin + pixels),) * 2
    met, clear = _follow(rays, _cells(depth, camera, tracing), camera, reach, inner, tracing)
    nearest = jnp.min(met[inner])
    seen = ((met < jnp.inf) | (clear >= nearest + reach)) & (nearest < jnp.inf)
    bridged = _bridge(met, seen, window / pixels, fill)
    heights, seen = jnp.where(seen, met, bridged)[inner], seen[inner]
    behind = jnp.where(heights < jnp.inf, heights - jnp.where(nearest < jnp.inf, nearest, 0), reach)
    patch = Patch(
        jnp.where(rigid, jnp.clip(behind, 0, reach), jnp.nan), jnp.where(rigid, nearest, jnp.nan).astype(depth.dtype)
    )
    return DepthPatch(patch, seen & rigid, ~seen & ~jnp.isnan(bridged[inner]) & rigid)


class _Rays(NamedTuple):
    """The section of each ray that lies in the camera's field of view.

    From its start to its end, the position in the image, the inverse depth, and tool z times inverse depth are linear
    in a number from 0 to 1.
    """

    x: Array  # (2, n, n) x / z in C of both ends of each ray
    y: Array  # (2, n, n) y / z in C of both ends of each ray
    inverse: Array  # (2, n, n) 1/m, 1 / z in C of both ends of each ray
    height: Array  # (2, n, n) tool z divided by camera z at both ends of each ray
    steps: Array  # (n, n) number of samples of each ray; 0 for a ray outside the field of view


def _rays(
    depth: Array, camera: Camera, T_c_t: Array, *, window: float, pixels: int, margin: int, stride: float
) -> _Rays:
    """Clip (n + 2 margin)^2 rays to the camera's field of view, between the image's smallest and largest depth.

    Each bound is a half space a + b s >= 0 of tool z s (Liang and Barsky, "A new concept and method for line clipping",
    1984).
    """
    along = ((jnp.arange(pixels + 2 * margin) - margin + 0.5) / pixels - 0.5) * window
    x, y = jnp.meshgrid(along, along)
    start = [row[0] * x + row[1] * y + row[3] for row in T_c_t[:3]]
    go = T_c_t[:3, 2]
    directions = pixel_rays(camera)
    measured = measured_mask(depth)
    near = jnp.min(jnp.where(measured, depth, jnp.inf)) * (1 - 1e-3)
    far = jnp.max(jnp.where(measured, depth, 0)) * (1 + 1e-3)
    low, high = jnp.full_like(x, -STANDOFF), jnp.full_like(x, jnp.inf)
    bounds: list = [(2, 1.0, 0, 0.0, -near), (2, -1.0, 0, 0.0, far)]
    for axis in (0, 1):
        bounds += [(axis, 1.0, 2, -jnp.nanmin(directions[axis]), 0.0), (axis, -1.0, 2, jnp.nanmax(directions[axis]), 0)]
    for i, p, j, q, r in bounds:
        a, b = p * start[i] + q * start[j] + r, p * go[i] + q * go[j]
        at = -a / jnp.where(b == 0, 1, b)
        low = jnp.where(b > 0, jnp.maximum(low, at), low)
        high = jnp.where(b < 0, jnp.minimum(high, at), high)
        high = jnp.where((b == 0) & (a < 0), -jnp.inf, high)
    inside = (low < high) & (high < jnp.inf) & (near < jnp.inf)

    def end(s: Array) -> tuple[Array, Array, Array, Array]:
        s = jnp.where(inside, s, 0)
        z = jnp.where(inside, start[2] + go[2] * s, 1)
        return (start[0] + go[0] * s) / z, (start[1] + go[1] * s) / z, 1 / z, s / z

    u, v, inverse, height = (jnp.stack(ends) for ends in zip(end(low), end(high), strict=True))
    length = jnp.hypot((u[1] - u[0]) * camera.fx, (v[1] - v[0]) * camera.fy)
    return _Rays(u, v, inverse, height, jnp.where(inside, jnp.ceil(length / stride) + 1, 0))


def _cells(depth: Array, camera: Camera, tracing: SurfaceTracing) -> Float[Array, "cells 6"]:
    """Describe every square of four pixels, as ((h - 1)(w - 1), 6).

    The first four columns are the pixels' inverse depths (1/m): upper left, upper right, lower left, lower right. The
    last two are whether the triangles at the upper left and at the lower right corner are surface.
    """
    x, y = pixel_rays(camera)
    measured = measured_mask(depth) & jnp.isfinite(x) & jnp.isfinite(y)
    z = jnp.where(measured, depth, 1)
    points = jnp.stack([jnp.where(measured, x, 0) * z, jnp.where(measured, y, 0) * z, z])
    inverse = jnp.where(measured, 1 / z, 0)

    def corners(image: Array) -> tuple[Array, Array, Array, Array]:
        return image[..., :-1, :-1], image[..., :-1, 1:], image[..., 1:, :-1], image[..., 1:, 1:]

    a, b, c, d = corners(points)
    at_a, at_b, at_c, at_d = corners(measured)

    def is_surface(corner: Array, right: Array, left: Array) -> Array:
        normal = jnp.cross(right - corner, left - corner, axis=0)
        facing = jnp.abs(jnp.sum(normal * corner, 0))
        steep = facing < math.sin(tracing.grazing_angle) * jnp.sqrt(jnp.sum(normal**2, 0) * jnp.sum(corner**2, 0))
        depths = jnp.stack([corner[2], right[2], left[2]])
        return ~steep | (jnp.max(depths, 0) - jnp.min(depths, 0) <= tracing.max_depth_step)

    upper = at_a & at_b & at_c & is_surface(a, b, c)
    lower = at_d & at_b & at_c & is_surface(d, c, b)
    cells = jnp.stack([*corners(inverse), upper.astype(depth.dtype), lower.astype(depth.dtype)], -1)
    return cells.reshape(-1, cells.shape[-1])


class _March(NamedTuple):
    """State of the rays while they are followed, (n, n) each. A ray is free in front of the surface."""

    going: Array  # True while the ray is still followed
    free: Array  # whether the last sample of the ray is in free space
    clear: Array  # m, tool z up to which the ray is free
    hit: Array  # number of the sample behind the surface that follows a free sample; 0 if there is none


_Gap: TypeAlias = Callable[[Array], tuple[Array, Array]]  # `_gap` with the rays, cells and camera filled in


def _follow(
    rays: _Rays, cells: Float[Array, "cells 6"], camera: Camera, reach: float, inner: tuple[slice, slice],
    tracing: SurfaceTracing,
) -> tuple[Array, Array]:  # fmt: skip
    """Find tool z (m) where rays meet the surface, +inf where they do not, and tool z to which they are free.

    Rays are sampled from their start until a sample is free and the next one is behind the surface. The crossing
    between the two is then refined.
    """
    gap = partial(_gap, rays, cells, camera)
    steps = jnp.maximum(rays.steps, 1)
    end = _march(rays, gap, reach, inner)
    part, on_surface = _crossing(gap, (end.hit - 1) / steps, end.hit / steps, tracing)
    met = (end.hit > 0) & on_surface(_between(rays.inverse, part))
    return jnp.where(met, _height(rays, part), jnp.inf), end.clear


def _gap(rays: _Rays, cells: Float[Array, "cells 6"], camera: Camera, part: Array) -> tuple[Array, Array]:
    """Compute how far rays are behind the surface, as a difference of inverse depths (1/m), and whether it is there.

    `part` (n, n) is the position on the rays, from 0 at their start to 1 at their end.
    """
    pixel = project_to_pixel(camera, _between(rays.x, part), _between(rays.y, part))
    u, v = pixel[..., 0], pixel[..., 1]
    column = jnp.clip(jnp.floor(u), 0, camera.width - 2)
    row = jnp.clip(jnp.floor(v), 0, camera.height - 2)
    cell = cells[row.astype(jnp.int32) * (camera.width - 1) + column.astype(jnp.int32)]
    a, b, c, d, upper, lower = jnp.moveaxis(cell, -1, 0)
    across, down = u - column, v - row
    in_upper = across + down < 1  # the triangle of the square that the pixel is in
    inverse = jnp.where(
        in_upper, a + across * (b - a) + down * (c - a), d + (1 - across) * (c - d) + (1 - down) * (b - d)
    )
    in_image = (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
    return inverse - _between(rays.inverse, part), in_image & (jnp.where(in_upper, upper, lower) > 0)


def _height(rays: _Rays, part: Array) -> Array:
    """Compute tool z (m) at a position on the rays."""
    return _between(rays.height, part) / _between(rays.inverse, part)


def _march(rays: _Rays, gap: _Gap, reach: float, inner: tuple[slice, slice]) -> _March:
    """Follow all rays until each has met the surface, has ended, or is deeper than the patch shows."""
    steps = jnp.maximum(rays.steps, 1)

    def step(state: tuple[Array, Array, _March]) -> tuple[Array, Array, _March]:
        k, last, march = state
        part = jnp.minimum(k / steps, 1)
        behind, on = gap(part)
        behind_now = march.going & on & (behind >= 0)
        met = behind_now & march.free
        free = on & (behind < 0)
        clear = jnp.where(march.going & free, _height(rays, part), march.clear)
        # Deeper than this the patch shows nothing.
        last = jnp.minimum(last, jnp.min(jnp.where(met, _height(rays, part), jnp.inf)[inner]))
        going = march.going & ~behind_now & (k < rays.steps) & (clear <= last + reach)
        return k + 1, last, _March(going, free, clear, jnp.where(met, k, march.hit))

    none, zero = jnp.zeros(steps.shape, bool), jnp.zeros_like(steps)
    start = _March(rays.steps > 0, none, jnp.full_like(steps, -jnp.inf), zero)
    first = (jnp.zeros((), steps.dtype), jnp.full((), jnp.inf, steps.dtype), start)
    return jax.lax.while_loop(lambda state: jnp.any(state[2].going), step, first)[2]


def _crossing(gap: _Gap, low: Array, high: Array, tracing: SurfaceTracing) -> tuple[Array, Callable[[Array], Array]]:
    """Find where rays cross the surface between a free position `low` and a position `high` behind it.

    The Illinois method is used (Dowell and Jarratt, 1971). Also return a function that tests, given the inverse depth
    of the crossing, whether it lies on surface.
    """

    def chord(ends: tuple[Array, ...]) -> Array:
        low, high, at_low, at_high = ends
        return low - at_low * (high - low) / jnp.where(at_high > at_low, at_high - at_low, 1)

    def refine(_: Array, ends: tuple[Array, ...]) -> tuple[Array, ...]:
        low, high, at_low, at_high = ends
        middle = chord(ends)
        behind, on = gap(middle)
        free = on & (behind < 0)
        return (
            jnp.where(free, middle, low),
            jnp.where(free, high, middle),
            jnp.where(free, behind, at_low / 2),
            jnp.where(free, at_high / 2, jnp.where(on, behind, at_high)),
        )

    ends = (low, high, jnp.minimum(gap(low)[0], 0), jnp.maximum(gap(high)[0], 0))
    part = chord(jax.lax.fori_loop(0, tracing.crossing_steps, refine, ends))
    behind, on = gap(part)
    return part, lambda inverse: on & (jnp.abs(behind) <= tracing.crossing_tolerance * inverse)


def _bridge(met: Float[Array, "m m"], seen: Bool[Array, "m m"], pitch: float, fill: float) -> Float[Array, "m m"]:
    """Interpolate heights (n, n) across holes, NaN elsewhere.

    A hole is bridged between two seen pixels of its row, column or diagonal that are at most `fill` apart. Of several
    such pairs the nearest is used.
    """
    n = seen.shape[0]

    def shift(image: Array, i: int, j: int) -> Array:
        """Shift an image so that its pixel (k, l) is image[k - i, l - j], and zero beyond the border."""
        wide = jnp.pad(image, ((max(i, 0), max(-i, 0)), (max(j, 0), max(-j, 0))))
        return wide[max(-i, 0) : max(-i, 0) + n, max(-j, 0) : max(-j, 0) + n]

    def first(i: int, j: int, max_steps: int) -> tuple[Array, Array]:
        """Find the first seen height in a direction, and its distance in steps."""
        height, away = jnp.zeros_like(met), jnp.full(seen.shape, n)
        for k in range(max_steps - 1, 0, -1):
            here = shift(seen, k * i, k * j)
            height, away = jnp.where(here, shift(met, k * i, k * j), height), jnp.where(here, k, away)
        return height, away

    heights, spans = [], []
    for i, j in ((0, 1), (1, 0), (1, 1), (1, -1)):
        length = pitch * math.hypot(i, j)
        max_steps = int(fill / length * (1 + 1e-6))
        (a, before), (b, behind) = first(i, j, max_steps), first(-i, -j, max_steps)
        span = before + behind
        even = jnp.isfinite(a) & jnp.isfinite(b) & (jnp.abs(b - a) <= span * length)
        heights.append(jnp.where(even, a + jnp.where(even, b - a, 0) * before / span, jnp.maximum(a, b)))
        spans.append(jnp.where(~seen & (span <= max_steps), span * length, jnp.inf))
    shortest = jnp.minimum(jnp.minimum(spans[0], spans[1]), jnp.minimum(spans[2], spans[3]))
    chosen = [(span == shortest) & (shortest < jnp.inf) for span in spans]
    total = sum(jnp.where(which, height, 0) for which, height in zip(chosen, heights, strict=True))
    return jnp.where(
        shortest < jnp.inf, total / jnp.maximum(sum(which.astype(met.dtype) for which in chosen), 1), jnp.nan
    )


def _between(ends: Array, part: Array) -> Array:
    """Interpolate linearly, from the first end at 0 to the second at 1."""
    return ends[0] + part * (ends[1] - ends[0])


def _relative(T_w_a: Float[Array, "4 4"], T_w_b: Float[Array, "4 4"]) -> Float[Array, "3 4"]:
    """Compute the first three rows of T_a_b, with full precision on accelerators as well."""
    R_a_w = T_w_a[:3, :3].T
    moved = jnp.concatenate([T_w_b[:3, :3], (T_w_b[:3, 3] - T_w_a[:3, 3])[:, None]], 1)
    return jnp.matmul(R_a_w, moved, precision=jax.lax.Precision.HIGHEST)
