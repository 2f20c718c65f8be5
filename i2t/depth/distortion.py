"""Projection through lenses: where points appear in a camera's image, and the line of sight of each pixel.

The models are those of librealsense (`rs_types.h`, `rsutil.h` and its document on projection), written for x / z and
y / z. Each has one direction in closed form; the other is solved by Newton's method:

    model                   closed form         formula
    none                    both                a pinhole
    brown_conrady           project             radial k1, k2, k3 and tangential p1, p2 (Brown, 1966), as in OpenCV
    modified_brown_conrady  project             the same, with the tangential part applied after the radial part
    inverse_brown_conrady   deproject           Brown-Conrady from the distorted image to a pinhole's

The polynomial of a wide lens may fold beyond the image, or in its corners. Beyond the first fold a pixel has no line of
sight and a point has no pixel: both are NaN.

This module departs from librealsense in one point. Since version 2.44 librealsense treats `inverse_brown_conrady` as
the modified model in both directions, against its own definition, which i2t keeps. For librealsense's behaviour, name
`modified_brown_conrady`.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.depth.camera import Camera, Distortion, brown_conrady, fold_radius, invert_brown_conrady


def project(camera: Camera, points: Float[Array, "*n 3"]) -> Float[Array, "*n 2"]:
    """Project points to the pixels at which the camera sees them.

    Args:
        camera: The camera.
        points: `(*n, 3)` points (m) in the camera frame C, in front of the camera.

    Returns:
        `(*n, 2)` pixels (column, row); NaN beyond the lens's fold.
    """
    return project_to_pixel(camera, points[..., 0] / points[..., 2], points[..., 1] / points[..., 2])


def deproject(camera: Camera, pixels: Float[Array, "*n 2"], depth: Float[Array, "*n"]) -> Float[Array, "*n 3"]:
    """Compute the 3-D points that pixels of known depth show.

    Args:
        camera: The camera.
        pixels: `(*n, 2)` pixels (column, row).
        depth: `(*n,)` depth (m) along the camera's axis.

    Returns:
        `(*n, 3)` points (m) in the camera frame C; NaN for pixels without a line of sight.
    """
    x, y = _undistort(camera, (pixels[..., 0] - camera.cx) / camera.fx, (pixels[..., 1] - camera.cy) / camera.fy)
    return jnp.stack([x * depth, y * depth, depth], -1)


def pixel_rays(camera: Camera) -> Float[Array, "2 height width"]:
    """Compute the line of sight of every pixel of a camera.

    Args:
        camera: The camera.

    Returns:
        `(2, height, width)` x / z and y / z of the rays; NaN for pixels without a line of sight.
    """
    u, v = jnp.meshgrid(jnp.arange(camera.width), jnp.arange(camera.height))
    return jnp.stack(_undistort(camera, (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy))


def project_to_pixel(camera: Camera, x: Float[Array, "*n"], y: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Compute the pixels at which lines of sight meet the image, with lens distortion.

    Args:
        camera: The camera.
        x: `(*n,)` x / z of the rays.
        y: `(*n,)` y / z of the rays.

    Returns:
        `(*n, 2)` pixels (column, row); NaN beyond the lens's fold.
    """
    x, y = _distort(camera, x, y)
    return jnp.stack([x * camera.fx + camera.cx, y * camera.fy + camera.cy], -1)


def _distort(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Distort lines of sight, from a pinhole to this lens."""
    match _model(camera):
        case Distortion.INVERSE_BROWN_CONRADY:
            return _invert(camera, x, y)
        case Distortion.BROWN_CONRADY | Distortion.MODIFIED_BROWN_CONRADY:
            return _unfolded(camera, x, y)
    return x, y


def _undistort(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Undistort lines of sight, from this lens to a pinhole."""
    match _model(camera):
        case Distortion.INVERSE_BROWN_CONRADY:
            return _unfolded(camera, x, y)
        case Distortion.BROWN_CONRADY | Distortion.MODIFIED_BROWN_CONRADY:
            return _invert(camera, x, y)
    return x, y


def _model(camera: Camera) -> str:
    """Return the model, which is a pinhole if all coefficients are zero, as many cameras report it."""
    return camera.model if any(camera.coefficients) else Distortion.NONE


def _unfolded(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Apply `brown_conrady` up to the lens's fold; beyond it return NaN."""
    u, v = brown_conrady(camera, x, y)
    radius = fold_radius(camera)
    if math.isinf(radius):
        return u, v
    before = x * x + y * y < radius**2
    return jnp.where(before, u, jnp.nan), jnp.where(before, v, jnp.nan)


def _invert(camera: Camera, x: Array, y: Array) -> tuple[Array, Array]:
    """Apply `invert_brown_conrady` with loops that are compiled once."""
    return invert_brown_conrady(
        camera, x, y, xp=jnp, repeat=lambda n, step, at: jax.lax.fori_loop(0, n, lambda _, at: step(at), at)
    )
