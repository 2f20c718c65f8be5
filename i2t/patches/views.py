"""Heights that are seen 25.5 mm wide become a patch and its surroundings, in one way for renderers and cameras:
`i2t.rendering.render.render_view`, `i2t.depth.patches.view_from_depth` and the simulated camera.

A patch shows 17 mm, and the skin is 20 mm wide: what lies around the patch is pressed too, and what stands out there
is met first. So a view counts from the *patch's* nearest point on all its pixels, and is negative where the
surroundings stand out before that point:

    wide = min(z - nearest, reach),   patch = its central pixels

Heights z are metres along tool z. They are clipped after the shift, so the middle of a view is always its patch,
whatever stands beside it; and not from below, since what is met first keeps its shape.
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.patches.dimensions import PAD_WINDOW, PATCH_PIXELS, REACH
from i2t.types import Array as AnyArray
from i2t.types import Patch, in_one_line

SAME_SURFACE_M = 1.5e-3  # m, five times a camera's depth noise: pixels closer in depth are taken for one surface
FILTER_PIXELS = 5  # edge of the square over which a camera's nearest surface is averaged
MIN_SURFACE_PIXELS = 10  # of that square, that must lie on the surface; few pixels would be the noisiest


@in_one_line
class WideView(NamedTuple):
    """View in front of the skin, and around it.

    Example:
        view = render_view(surface, T_o_t)
        reading = predictor.predict(view, force=1.0)
    """

    patch: Patch  # the central pixels
    wide: Float[Array, "*batch w w"]  # m behind the patch's nearest point, at most the reach; negative: it stands out


def view_of_heights(
    z: Float[Array, "w w"],
    nearest: Float[Array, ""] | None = None,
    *,
    reach: float = REACH,
    noise: float = 0.0,
    least: Float[Array, ""] | float = -jnp.inf,
) -> WideView:
    """A patch and its surroundings from heights.

    Args:
        z: m along tool z from the tool origin, +inf where nothing is seen; the patch is its central 48 x 48 pixels.
        nearest: m, height of the patch's nearest point, from which depths count; left out, its nearest pixel. Where
            there is none (+inf) they count from the tool origin.
        reach: m, at which depths are clipped.
        noise: m; what stands out by less is taken for the camera's noise and reads 0.
        least: m, height of the nearest surface anywhere; what is nearer is taken for noise on it.

    Returns:
        The view.
    """
    nearest = jnp.min(centre(z, PATCH_PIXELS)) if nearest is None else nearest
    start = jnp.where(jnp.isfinite(nearest), nearest, 0)
    behind = jnp.minimum(jnp.maximum(z, least) - start, reach)
    wide = jnp.where(behind < -noise, behind, jnp.maximum(behind, 0))
    patch = jnp.maximum(centre(wide, PATCH_PIXELS), 0)
    margin = (z.shape[-1] - PATCH_PIXELS) // 2
    return WideView(Patch(patch, nearest), jax.lax.dynamic_update_slice(wide, patch, (margin, margin)))


def camera_view(z: Float[Array, "w w"]) -> WideView:
    """A view from the heights of a noisy camera, of the default sizes.

    Its nearest surface is not its nearest pixel. It is the least mean over squares of 5 x 5 pixels, of which those on
    the square's nearest surface count (a sigma filter; Lee, CVGIP 24, 1983). These must be at least ten, or as many as
    there are anywhere: few pixels would be the noisiest rather than the nearest.

    Args:
        z: m along tool z from the tool origin, +inf where nothing is seen.

    Returns:
        The view, behind the patch's nearest surface. What stands out by less than `SAME_SURFACE_M` is noise.
    """
    inner = z.shape[-1] - FILTER_PIXELS + 1
    # Written out: a reduction over an axis of 25 squares takes a CPU twenty times as long as a chain of sums.
    squares = [z[i : i + inner, j : j + inner] for i in range(FILTER_PIXELS) for j in range(FILTER_PIXELS)]
    lowest = reduce(jnp.minimum, squares)
    limit = jnp.where(jnp.isfinite(lowest), lowest + SAME_SURFACE_M, -jnp.inf)
    same = [square <= limit for square in squares]
    count = sum(part.astype(jnp.int32) for part in same)
    total = sum(jnp.where(part, square, 0) for part, square in zip(same, squares, strict=True))
    mean = total / jnp.maximum(count, 1)

    def nearest(pixels: int) -> Float[Array, ""]:
        """Least height (m) of the squares in the middle; +inf where nothing is seen."""
        found = centre(count, pixels - FILTER_PIXELS + 1)
        enough = found >= jnp.clip(jnp.max(found), 1, MIN_SURFACE_PIXELS)
        return jnp.min(jnp.where(enough, centre(mean, pixels - FILTER_PIXELS + 1), jnp.inf))

    of_patch = nearest(PATCH_PIXELS)
    least = jnp.minimum(of_patch, nearest(z.shape[-1]))
    return view_of_heights(z, of_patch, noise=SAME_SURFACE_M, least=least)


def pixels_on_skin(pitch: float) -> int:
    """Pixels along the middle of a view whose centres lie on the skin.

    Args:
        pitch: m, edge of a pixel.

    Returns:
        An even number.
    """
    return 2 * int(PAD_WINDOW / pitch / 2)


def centre(view: AnyArray, pixels: int) -> AnyArray:
    """The central pixels of views.

    Args:
        view: (..., w, w).
        pixels: Along the edge of what is kept; w less an even number.

    Returns:
        (..., pixels, pixels), a view of NumPy's arrays.
    """
    margin = (view.shape[-1] - pixels) // 2
    return view[..., margin : margin + pixels, margin : margin + pixels]
