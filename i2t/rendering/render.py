"""Render depth patches from surfaces and tool poses, exactly: an orthographic first-hit ray caster on triangle meshes.

Rays run along tool z through the pixel centres of a square window and start `STANDOFF` behind the tool origin. A height
is the tool z of the first face that a ray meets, on either side of the face. Frames: W is the frame of the surface, T
the tool; metres. A patch is relative to its nearest point, `depth = min(z - nearest, reach)`, so that it shows shape,
and `nearest` is the distance at which that shape begins.

A mesh is prepared once on the host: `prepare_surface` checks it and pads it with faces without area to a size class.
All other functions are pure and take one pose and one surface. Lift them with `vmap` over poses, or over surfaces that
`stack_surfaces` brought together.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t import validation
from i2t.geometry import is_rigid
from i2t.patches.dimensions import CONTACT_TOLERANCE_M, PATCH_PIXELS, PATCH_WINDOW, REACH, VIEW_PIXELS
from i2t.patches.views import PatchView, view_of_heights
from i2t.rendering.bvh import build_bvh, pad_to_same_size
from i2t.rendering.raycast import first_hit
from i2t.rendering.tiles import ToolView
from i2t.types import Patch, Surface

MAX_COORDINATE_M = 100.0  # m, largest accepted coordinate of a vertex; there, adjacent float32 numbers differ by 8 um


def prepare_surface(mesh: Any) -> Surface:
    """Prepare a mesh for rendering: check it, order its faces and pad them to a size class (a power of two).

    Args:
        mesh: Any object with `vertices` (v, 3) in metres and `faces` (f, 3) of indices, such as an `i2t.objects.Mesh`
            or a `trimesh.Trimesh`, or with `vertices` and `triangles`, such as a mesh of Open3D. Meshes may be open and
            their faces may have any winding.

    Returns:
        The prepared surface, for `render_patch` and all functions that touch it.

    Raises:
        ValueError: The mesh is empty, not finite, larger than `MAX_COORDINATE_M`, or a face refers to a missing vertex.

    Example:
        surface = i2t.prepare_surface(i2t.load_mesh("mug.stl", "mm"))
    """
    corners = getattr(mesh, "faces", getattr(mesh, "triangles", None))  # the name in Open3D
    if not hasattr(mesh, "vertices") or corners is None:
        raise ValueError(f"mesh: a {type(mesh).__name__} has no vertices and faces; give an i2t.objects.Mesh")
    vertices, faces = np.asarray(mesh.vertices), np.asarray(corners)
    if vertices.dtype.kind not in "iuf" or faces.dtype.kind not in "iu":
        raise ValueError(
            f"mesh: vertices of {vertices.dtype} and faces of {faces.dtype} must be reals and integers; convert them"
        )
    vertices = vertices.astype(np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(
            f"mesh: vertices {vertices.shape} and faces {faces.shape} must be (v, 3) and (f, 3); triangulate it first"
        )
    if not len(vertices) or not len(faces):
        raise ValueError("mesh: it has no faces; give a mesh with at least one triangle")
    if not np.isfinite(vertices).all():
        raise ValueError("mesh: vertices hold NaN or infinity; remove or repair them")
    if np.abs(vertices).max() > MAX_COORDINATE_M:
        raise ValueError(
            f"mesh: a vertex lies {np.abs(vertices).max():g} m out; give metres, at most {MAX_COORDINATE_M:g}"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(
            f"mesh: faces refer to vertices {faces.min()} to {faces.max()} of 0 to {len(vertices) - 1}; repair the file"
        )
    return build_bvh(vertices[faces])


def stack_surfaces(surfaces: Sequence[Surface], *, faces: int = 1) -> Surface:
    """Bring surfaces to the size class of the largest and stack them along a new first axis, for `vmap`.

    Args:
        surfaces: Prepared surfaces.
        faces: Number of faces for which the size class must have room.

    Returns:
        A surface whose arrays have a leading axis.

    Raises:
        ValueError: The list is empty, or a surface was not prepared.
    """
    if not len(surfaces):
        raise ValueError("stack: there are no surfaces; give at least one")
    return Surface(
        *(
            np.stack(field)
            for field in zip(*pad_to_same_size([_prepared(surface) for surface in surfaces], faces), strict=True)
        )
    )


def render_patch(
    surface: Surface,
    T_o_t: Float[Array | np.ndarray, "4 4"],
    *,
    window: float = PATCH_WINDOW,
    pixels: int = PATCH_PIXELS,
    reach: float = REACH,
) -> Patch:
    """Render the depth patch in front of a tool.

    Args:
        surface: A prepared surface.
        T_o_t: Rigid pose of the tool in the surface's frame. A matrix that is not rigid (scaled, mirrored, not finite,
            transposed) gives NaN.
        window: Edge (m) of the patch; static.
        pixels: Number of pixels along the edge; static.
        reach: Depth (m) behind the nearest point to which the patch is clipped; static.

    Returns:
        The patch. Pixels read the reach if they show no surface or a deeper one. `nearest` is +inf if no ray of the
        window meets the surface.

    Raises:
        ValueError: A shape or size is out of range.

    Example:
        patch = i2t.render_patch(surface, T_o_t)
        patches = jax.jit(jax.vmap(functools.partial(i2t.render_patch, surface)))(T_o_ts)
    """
    _check(T_o_t, window, pixels)
    T_o_t = jnp.asarray(T_o_t)
    hint = "a length (m) above 0, or infinity for no end"
    if not (validation.is_traced(reach) or validation.numbers("reach", reach, hint) > 0):
        raise ValueError(f"reach: is {reach}; give {hint}")
    return _render(_prepared(surface), T_o_t, float(window), int(pixels), float(reach))


@partial(jax.jit, static_argnames=("window", "pixels", "reach"))
def _render(surface: Surface, T_o_t: Array, window: float, pixels: int, reach: float) -> Patch:
    view = ToolView(T_o_t[:3, :3].T, T_o_t[:3, 3], jnp.zeros_like(T_o_t[:3, 3]))
    heights = first_hit(surface, view, window, pixels, reach)
    nearest, rigid = jnp.min(heights), is_rigid(T_o_t)
    missed = heights == jnp.inf
    behind = jnp.where(missed, 0, heights) - jnp.where(nearest == jnp.inf, 0, nearest)
    depth = jnp.where(missed, reach, jnp.minimum(behind, reach))
    # A minimum may lose NaN (XLA on CPU), so it is inserted last.
    return Patch(jnp.where(rigid, depth, jnp.nan), jnp.where(rigid, nearest, jnp.nan))


def render_view(
    surface: Surface,
    T_o_t: Float[Array, "4 4"],
    *,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
) -> PatchView:
    """Render the exact view in front of a tool, with its surroundings.

    Args:
        surface: A prepared surface.
        T_o_t: Rigid pose of the tool in the surface's frame; a matrix that is not rigid gives NaN.
        window: Edge (m) of the patch; static.
        reach: Depth (m) at which the view is clipped; static.

    Returns:
        The view, whose patch equals that of `i2t.render_patch` at the same pose.
    """
    # Without a limit, because protruding surroundings must not hide deeper surfaces of the patch.
    seen = render_patch(surface, T_o_t, window=window * VIEW_PIXELS / PATCH_PIXELS, pixels=VIEW_PIXELS, reach=math.inf)
    z = jnp.where(jnp.isfinite(seen.nearest), seen.nearest, 0) + seen.depth
    return view_of_heights(z, reach=reach)


def render_heights(
    surface: Surface, A_t_w: Float[Array, "4 4"], window: float = PATCH_WINDOW, pixels: int = PATCH_PIXELS
) -> Float[Array, "n n"]:
    """Render the heights of a surface that is mapped by an affine map.

    Args:
        surface: A prepared surface.
        A_t_w: An affine map to the tool frame, which may scale and shear. Faces that it turns edge on are not seen.
        window: Edge (m) of the square of rays; static.
        pixels: Number of pixels along the edge; static.

    Returns:
        `(pixels, pixels)` tool z (m) of the first hit on each ray, +inf where there is none.
    """
    _check(A_t_w, window, pixels)
    view = ToolView(A_t_w[:3, :3], jnp.zeros_like(A_t_w[:3, 3]), A_t_w[:3, 3])
    return first_hit(_prepared(surface), view, float(window), int(pixels), math.inf)


def contact_mask(depth: Float[Array, "n n"], tolerance: float = CONTACT_TOLERANCE_M) -> Float[Array, "n n"]:
    """Compute the paper's binary image of contact.

    Args:
        depth: `(n, n)` depths (m) of a patch.
        tolerance: Largest depth (m) behind the nearest point that counts as contact.

    Returns:
        `(n, n)` mask: 1 within the tolerance of the nearest point, else 0.
    """
    return (depth <= jnp.min(depth) + tolerance).astype(depth.dtype)


def _prepared(surface: Surface) -> Surface:
    """Refuse a surface that was not prepared, or a stack of surfaces."""
    if surface.boxes is None or surface.groups is None:
        raise ValueError("surface: it holds bare triangles; make it with i2t.rendering.render.prepare_surface")
    shapes: list[tuple[int, ...]] = [np.shape(field) for field in (surface.triangles, surface.boxes, surface.groups)]
    if [len(shape) for shape in shapes] != [3, 3, 2] or 0 in sum(shapes, ()):
        raise ValueError(f"surface: its shapes {shapes} are not those of one prepared mesh; use vmap for a stack")
    return surface


def _check(pose: Any, window: Any, pixels: Any) -> None:
    if not validation.is_traced(pose):
        validation.numbers("T_o_t", pose, "a (4, 4) transform")
    validation.number("window", window, "a length (m) above 0", above=0)
    validation.count("pixels", pixels)
    if np.shape(pose) != (4, 4):
        raise ValueError(f"the pose has shape {np.shape(pose)} instead of (4, 4); use vmap for several")
