"""Denoising of depth views by robust local planes.

A skin 2 mm thick responds to tenths of a millimetre, and the pixels of a depth camera have a noise of 0.3 mm. Surfaces
are smooth between edges, so each pixel is replaced by the value of a plane fitted to its neighbourhood. Neighbours are
weighted by distance (Gaussian, `sigma` pixels) and by agreement with the plane of the previous pass (Welsch weights of
width `edges`), which preserves steps. This is moving least squares (Levin, 1998) with the robust weights of Fleishman,
Cohen-Or and Silva (SIGGRAPH 2005).
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from i2t.types import Array as AnyArray


def fill(depth: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Fill the unknown border of a depth view: copy the nearest known pixel, along rows and then columns.

    Args:
        depth: Depth view (m), known in a central square and NaN around it.

    Returns:
        `(n, n)` depth view (m) without NaN; known pixels are unchanged.
    """
    n = depth.shape[0]
    index = jnp.arange(n)

    def nearest_known(known: AnyArray) -> AnyArray:
        distance = jnp.abs(index[:, None] - index[None, :]) + jnp.where(known[None, :], 0, 10 * n)
        return jnp.argmin(distance, axis=1)

    rows = nearest_known(jnp.any(jnp.isfinite(depth), axis=1))
    columns = nearest_known(jnp.any(jnp.isfinite(depth), axis=0))
    return depth[rows][:, columns]


def local_planes(
    depth: Float[Array, "n n"],
    *,
    sigma: float = 2.2,
    edges: tuple[float, ...] = (1.5e-3, 0.8e-3, 0.5e-3),
    radius: int = 5,
) -> Float[Array, "n n"]:
    """Smooth a depth view, keeping its edges: replace each pixel by a robust plane through its neighbourhood.

    Args:
        depth: Depth view (m), NaN where it is unknown.
        sigma: Width (pixels) of the Gaussian weights.
        edges: For each pass, the difference of depth (m) from the plane beyond which a pixel loses weight.
        radius: Half the edge (pixels) of the square neighbourhood.

    Returns:
        `(n, n)` smoothed depth view (m), NaN where `depth` is.
    """
    n, width = depth.shape[0], 2 * radius + 1
    padded = jnp.pad(depth, radius, constant_values=jnp.nan)
    offsets = jnp.stack(jnp.meshgrid(jnp.arange(width), jnp.arange(width), indexing="ij"), -1).reshape(-1, 2)
    # Value of the plane at each pixel, and its slopes along rows and columns per pixel.
    plane = (depth, jnp.zeros_like(depth), jnp.zeros_like(depth))

    for edge in edges:

        def add(
            moments: tuple[AnyArray, ...],
            offset: AnyArray,
            plane: tuple[AnyArray, AnyArray, AnyArray] = plane,
            edge: float = edge,
        ) -> tuple[tuple[AnyArray, ...], None]:
            y, x = (offset - radius).astype(depth.dtype)
            z = jax.lax.dynamic_slice(padded, offset, (n, n))
            residual = z - (plane[0] + plane[1] * y + plane[2] * x)
            is_known = jnp.isfinite(z)
            w = jnp.where(is_known, jnp.exp(-(x * x + y * y) / (2 * sigma**2) - residual**2 / (2 * edge**2)), 0)
            z = jnp.where(is_known, z, 0)
            terms = (w, w * y, w * x, w * y * y, w * x * y, w * x * x, w * z, w * y * z, w * x * z)
            return tuple(m + t for m, t in zip(moments, terms, strict=True)), None

        (s, sy, sx, syy, sxy, sxx, sz, syz, sxz), _ = jax.lax.scan(add, (jnp.zeros_like(depth),) * 9, offsets)
        # Normal equations of z = a + b y + c x about the weighted mean. A small ridge bounds the slopes where few
        # pixels agree.
        my, mx, mz = sy / s, sx / s, sz / s
        ridge = 0.05
        cyy, cxx, cxy = syy / s - my * my + ridge, sxx / s - mx * mx + ridge, sxy / s - mx * my
        cyz, cxz = syz / s - my * mz, sxz / s - mx * mz
        determinant = cyy * cxx - cxy**2
        by = (cyz * cxx - cxz * cxy) / determinant
        bx = (cxz * cyy - cyz * cxy) / determinant
        plane = (mz - by * my - bx * mx, by, bx)
    return plane[0]
