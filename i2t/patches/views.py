"""Patches and their surroundings from heights that are seen 25.5 mm wide. Renderers, cameras and the simulated camera
(`i2t.rendering.render.render_view`, `i2t.depth.patches.view_from_depth`) share this definition.

A patch shows 17 mm, and the skin is 20 mm wide. The surroundings of the patch are therefore pressed too, and the skin
meets protruding surroundings first. Depths of the whole view are measured from the nearest point of the *patch*, and
are negative where the surroundings stand out before that point:

    view = min(z - nearest, reach),   patch = its central pixels

Heights z are metres along tool z. They are clipped after the shift, so the centre of a view is always its patch,
whatever stands next to it. Negative depths are not clipped, so that protruding surroundings keep their shape.
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.patches.dimensions import PAD_WINDOW, PATCH_PIXELS, REACH
from i2t.types import Array as AnyArray
from i2t.types import Patch, in_one_line

# m, depth difference below which pixels count as one surface: five times a camera's depth noise
SAME_SURFACE_M = 1.5e-3


@in_one_line
class PatchView(NamedTuple):
    """A depth patch in front of the skin, and the wider view around it: depths (m) behind the patch's nearest point.

    Example:
        view = render_view(surface, T_o_t)
        reading = predictor.predict(view, force=1.0)
    """

    patch: Patch  # the central pixels
    depth: Float[Array, "*batch w w"]  # m behind the patch's nearest point, at most the reach; negative before it


def view_of_heights(
    z: Float[Array, "w w"],
    nearest: Float[Array, ""] | None = None,
    *,
    reach: float = REACH,
    noise: float = 0.0,
    lowest: Float[Array, ""] | float = -jnp.inf,
) -> PatchView:
    """Compute a depth patch and its surroundings from heights along tool z.

    Args:
        z: `(w, w)` heights (m) along tool z from the tool origin, growing away from the skin; +inf where nothing is
            seen. The patch is the central 48 x 48 of the w x w pixels.
        nearest: Height (m) from which depths are measured, by default that of the patch's nearest pixel. If it is +inf,
            depths are measured from the tool origin.
        reach: Depth (m) at which the view is clipped.
        noise: A pixel in front of `nearest` by at most this much (m) is taken for camera noise and gets depth 0.
        lowest: Smallest possible height (m), that of the surface nearest to the tool; smaller heights are noise and are
            raised to it.

    Returns:
        The patch, and with its surroundings as `(w, w)` depths (m); negative in front of `nearest`.
    """
    nearest = jnp.min(centre(z, PATCH_PIXELS)) if nearest is None else nearest
    start = jnp.where(jnp.isfinite(nearest), nearest, 0)
    behind = jnp.minimum(jnp.maximum(z, lowest) - start, reach)
    depth = jnp.where(behind < -noise, behind, jnp.maximum(behind, 0))
    patch = jnp.maximum(centre(depth, PATCH_PIXELS), 0)
    margin = (z.shape[-1] - PATCH_PIXELS) // 2
    return PatchView(Patch(patch, nearest), jax.lax.dynamic_update_slice(depth, patch, (margin, margin)))


def view_of_noisy_heights(z: Float[Array, "w w"], *, filter_pixels: int = 5, min_surface_pixels: int = 10) -> PatchView:
    """Compute a patch with its surroundings, w pixels along an edge, from the heights of a noisy camera.

    The nearest pixel of a noisy image is not its nearest surface. That surface is the lowest mean over small squares of
    pixels, where each mean includes only pixels on the square's nearest surface (a sigma filter; Lee, CVGIP 24, 1983).

    Args:
        z: `(w, w)` heights (m) along tool z from the tool origin, +inf where nothing is seen.
        filter_pixels: Edge of a square in pixels.
        min_surface_pixels: Number of pixels of a square that must lie on its surface, or the largest number in any
            square if that is smaller. The mean of fewer pixels would be dominated by noise.

    Returns:
        The view, whose depths are measured from the patch's nearest surface. Protrusions below `SAME_SURFACE_M` are
        taken for noise.
    """
    inner = z.shape[-1] - filter_pixels + 1
    # Sums are written out, because a reduction over an axis of 25 squares takes a CPU twenty times as long.
    squares = [z[i : i + inner, j : j + inner] for i in range(filter_pixels) for j in range(filter_pixels)]
    lowest = reduce(jnp.minimum, squares)
    limit = jnp.where(jnp.isfinite(lowest), lowest + SAME_SURFACE_M, -jnp.inf)
    same = [square <= limit for square in squares]
    count = sum(part.astype(jnp.int32) for part in same)
    total = sum(jnp.where(part, square, 0) for part, square in zip(same, squares, strict=True))
    mean = total / jnp.maximum(count, 1)

    def nearest(pixels: int) -> Float[Array, ""]:
        """Find the lowest height (m) of the central squares; +inf if nothing is seen."""
        surface_pixels = centre(count, pixels - filter_pixels + 1)
        enough = surface_pixels >= jnp.clip(jnp.max(surface_pixels), 1, min_surface_pixels)
        return jnp.min(jnp.where(enough, centre(mean, pixels - filter_pixels + 1), jnp.inf))

    patch_nearest = nearest(PATCH_PIXELS)
    lowest = jnp.minimum(patch_nearest, nearest(z.shape[-1]))
    return view_of_heights(z, patch_nearest, noise=SAME_SURFACE_M, lowest=lowest)


def pixels_on_skin(pitch: float) -> int:
    """Count the pixels along the middle of a view whose centres lie on the skin.

    Args:
        pitch: Edge (m) of a pixel.

    Returns:
        The number of pixels, which is even.
    """
    return 2 * int(PAD_WINDOW / pitch / 2)


def complete_views(view: Float[np.ndarray, "n w w"], patch: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, "n w w"]:
    """Fill the missing central pixels of cropped views with their patches.

    Args:
        view: Depths (m) of views, NaN where they were cropped.
        patch: Depths (m) of the patches in the middle of the views.

    Returns:
        `(n, w, w)` copy of the views of w x w pixels; the surroundings of cropped views stay NaN.
    """
    views = np.array(view)
    middle = centre(views, patch.shape[-1])
    middle[...] = np.where(np.isnan(middle), patch, middle)
    return views


def centre(view: AnyArray, pixels: int) -> AnyArray:
    """Crop views to their central pixels.

    Args:
        view: `(..., w, w)` pixels.
        pixels: Number of pixels along the edge to keep; it differs from w by an even number.

    Returns:
        `(..., pixels, pixels)` central pixels; of a NumPy array a view, not a copy.
    """
    margin = (view.shape[-1] - pixels) // 2
    return view[..., margin : margin + pixels, margin : margin + pixels]
