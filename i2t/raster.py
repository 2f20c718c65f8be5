"""First hits of parallel rays on triangles, by edge functions.

In the tool frame a ray is a point (x, y) and a face a triangle whose inside is where its three edge functions `A x + B
y + C` agree in sign with its area; the plane through its corners then gives z. Neighbours share their corners to the
last bit, so a tolerance of a few roundings on every edge closes all cracks between them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.types import STANDOFF, Surface

CHUNK = 16  # faces rasterised together
ROUNDINGS = 4  # tolerance of an edge, in float roundings of its corners' coordinates


def first_hit(
    surface: Surface,
    linear: Float[Array, "3 3"],
    origin: Float[Array, "3"],
    offset: Float[Array, "3"],
    window: float,
    pixels: int,
) -> Float[Array, "n n"]:
    """Tool z (m) of the first hit beyond -STANDOFF on each pixel's ray, +inf where there is none; points map to
    `linear (p - origin) + offset`.
    """
    centres = ((jnp.arange(pixels) + 0.5) / pixels - 0.5) * window
    x, y = centres[None, :], centres[:, None]
    chunks = jnp.asarray(surface.triangles).reshape(-1, CHUNK, 3, 3)

    def step(heights, triangles):
        local = triangles - origin[None, None]
        corners = jnp.einsum("fcj,ij->fci", local, linear, precision="highest") + offset[None, None]
        return jnp.minimum(heights, jnp.min(jax.vmap(_cover, (0, None, None))(corners, x, y), axis=0)), None

    return jax.lax.scan(step, jnp.full((pixels, pixels), jnp.inf), chunks)[0]


def _cover(corners, x, y):
    """Tool z of one face over the pixels it covers, +inf elsewhere."""
    (xa, ya, za), (xb, yb, zb), (xc, yc, zc) = corners
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    flat = area == 0
    turn = jnp.sign(area)

    def edge(xp, yp, xq, yq):
        A, B = turn * (yp - yq), turn * (xq - xp)
        slack = jnp.finfo(x.dtype).eps * ROUNDINGS * (jnp.abs(A) * jnp.abs(xp) + jnp.abs(B) * jnp.abs(yp))
        return A * (x - xp) + B * (y - yp) + slack

    inside = jnp.minimum(jnp.minimum(edge(xa, ya, xb, yb), edge(xb, yb, xc, yc)), edge(xc, yc, xa, ya)) >= 0
    safe = jnp.where(flat, 1, area)
    slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / safe
    slope_y = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / safe
    low, high = jnp.minimum(jnp.minimum(za, zb), zc), jnp.maximum(jnp.maximum(za, zb), zc)
    z = jnp.clip(za + slope_x * (x - xa) + slope_y * (y - ya), low, high)
    return jnp.where(inside & ~flat & (z >= -STANDOFF), z, jnp.inf)
