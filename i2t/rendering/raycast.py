"""Find the first hits of parallel rays on triangles: exact rasterisation of clustered faces in tiles of pixels.

In the tool frame a ray is a point (x, y), and a face is a triangle whose inside is where its three edge functions `A x
+ B y + C` are positive. The plane through its corners gives z. Neighbouring faces share their corners to the last bit,
so a tolerance of a few roundings on every edge closes the cracks between them.

The work goes from coarse to fine and skips what cannot contribute. Boxes select the groups, then the clusters, that the
window can see within the reach behind the nearest hit. Their faces are converted to edge functions once for each pose.
Every tile keeps a bit for each cluster that crosses it, and draws the clusters of its bits.

The amount of work differs widely between poses, so that poses in parallel lanes would wait for the slowest. Instead,
the clusters of all poses form one dense list, and the tiles of all poses one set of lanes, of which the busiest few
continue alone when most are done. `vmap` becomes a longer axis of poses (`_batch_cast`). Lists are processed in passes
of a fixed length, so that scratch memory is small and constant and no list can overflow.

Meshes of many faces that are hardly larger than a pixel are drawn without a table of faces (`i2t.rendering.dense`).

Work is split where XLA should store an intermediate result. Inside a single loop body it would compute a cheap value
again for each of its uses.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import ShapeDtypeStruct as ShapeDtype
from jaxtyping import Array, Bool, Float, Int

from i2t.patches.dimensions import STANDOFF
from i2t.rendering.bitset import WORD_BITS, cumulative_popcounts, pack_bits, select_kth_set_bit
from i2t.rendering.bvh import CLUSTER_SIZES, CLUSTERS_PER_GROUP
from i2t.rendering.dense import cast_dense
from i2t.rendering.ops import dynamic_slice, dynamic_update, fusion_barrier, indices
from i2t.rendering.tiles import (
    MIN_PROJECTED_AREA_M2,
    ClusterList,
    FaceClusters,
    Hits,
    PixelGrid,
    Scratch,
    ToolView,
    broadcast_view,
    draw_clusters,
    empty_buffers,
    empty_scratch,
    place_boxes,
    to_tool,
)
from i2t.runtime.jax_internals import single_operation
from i2t.types import Surface


@dataclass(frozen=True)
class PassSizes:
    """Sizes of the passes in which the renderer draws the clusters of faces that a pose needs."""

    groups: int = 64  # number of groups listed in a pass
    groups_per_chunk: int = 8  # number of groups whose boxes are tested together
    clusters: int = 256  # number of clusters set up in a pass, a multiple of 32 and at most 1024
    # reaches behind the first box, up to which clusters are drawn first, to find out how near the surface is
    front_slab_reaches: int = 2


PASS_SIZES = PassSizes()  # sizes of the passes in which the clusters of a pose are drawn


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def first_hit(surface: Surface, view: ToolView, window: float, pixels: int, reach: float) -> Float[Array, "n n"]:
    """Find where the rays of the pixels first meet a surface. Derivatives keep the visible faces fixed.

    Args:
        surface: A prepared surface.
        view: Map of the surface's points to the tool frame.
        window: Edge (m) of the square of pixels.
        pixels: Number of pixels along the edge.
        reach: Depth (m) behind the nearest hit beyond which hits may be missing; infinite to find all.

    Returns:
        `(pixels, pixels)` tool z (m) of the first hit beyond -STANDOFF on each ray, +inf where there is none.
    """
    return _rasterise(surface, view, PixelGrid(window, pixels), reach, False)[0]


@first_hit.defjvp
def _first_hit_jvp(
    window: float,
    pixels: int,
    reach: float,
    primals: tuple[Surface, ToolView],
    tangents: tuple[Surface, ToolView],
) -> tuple[Array, Array]:
    """Differentiate the planes of the visible faces."""
    surface, view = primals
    grid = PixelGrid(window, pixels)
    # The visible faces are fixed in derivatives of any order.
    heights, faces = _rasterise(jax.lax.stop_gradient(surface), jax.lax.stop_gradient(view), grid, reach, True)
    x, y = jnp.asarray(grid.centres)[None, :], jnp.asarray(grid.centres)[:, None]

    def plane(triangles: Array, view: ToolView) -> Array:
        corners = jnp.moveaxis(triangles.at[faces].get(mode="promise_in_bounds"), (2, 3), (0, 1))
        (xa, ya, za), (xb, yb, zb), (xc, yc, zc) = (to_tool(corner, view) for corner in corners)
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        seen = jnp.isfinite(heights) & (jnp.abs(area) >= MIN_PROJECTED_AREA_M2)
        area = jnp.where(seen, area, 1)
        slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / area
        slope_y = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / area
        return jnp.where(seen, za + slope_x * (x - xa) + slope_y * (y - ya), 0)

    triangles = jnp.asarray(surface.triangles)
    _, change = jax.jvp(plane, (triangles, view), (tangents[0].triangles, tangents[1]))
    return heights, change


def _rasterise(
    surface: Surface, view: ToolView, grid: PixelGrid, reach: float, with_faces: bool
) -> tuple[Float[Array, "n n"], Int[Array, "n n"]]:
    """Compute heights (n, n) of the first hits and, if requested, the index of the face that each ray meets (n, n)."""
    meshes = tuple(jnp.asarray(part)[None] for part in (surface.triangles, surface.boxes, surface.groups))
    views = [jnp.asarray(part)[None] for part in view]
    options = {"window": grid.window, "pixels": grid.pixels, "reach": reach, "with_faces": with_faces}
    heights, faces = _cast_operation(*meshes, jnp.zeros(1, jnp.int32), *views, **options)
    poison = 0 * sum(jnp.sum(part) for part in view)  # a non-finite pose gives an image of NaN
    return heights[0] + poison, faces[0]


def _cast_arrays(
    triangles: Array, boxes: Array, groups: Array, mesh: Array, *views: Array,
    window: float, pixels: int, reach: float, with_faces: bool,
) -> tuple[Array, Array]:  # fmt: skip
    """Call `_cast` with arrays whose axis 0 is that of meshes (the first three) or poses."""
    view = ToolView(*(jnp.moveaxis(part, 0, -1) for part in views))
    return _cast((triangles, boxes, groups), mesh, view, PixelGrid(window, pixels), reach, with_faces)


def _result_shapes(
    triangles: ShapeDtype, boxes: ShapeDtype, groups: ShapeDtype, mesh: ShapeDtype, *views: ShapeDtype,
    pixels: int, **options: Any,
) -> tuple[ShapeDtype, ShapeDtype]:  # fmt: skip
    shape = (*mesh.shape, pixels, pixels)
    return ShapeDtype(shape, jnp.result_type(triangles.dtype, views[0].dtype)), ShapeDtype(shape, jnp.int32)


def _batch_cast(arrays: Sequence[Array], axes: Sequence[int | None], **options: Any) -> tuple[list[Array], list[int]]:
    """Merge a batch of batches of poses into a longer batch, and a batch of meshes into a longer list."""
    size = next(array.shape[axis] for array, axis in zip(arrays, axes, strict=True) if axis is not None)
    several_meshes = any(axis is not None for axis in axes[:3])

    def leading(array: Array, axis: int | None) -> Array:
        return jnp.broadcast_to(array, (size, *array.shape)) if axis is None else jnp.moveaxis(array, axis, 0)

    meshes, (mesh, *views) = arrays[:3], [leading(*pair) for pair in zip(arrays[3:], axes[3:], strict=True)]
    if several_meshes:
        meshes = [leading(*pair) for pair in zip(meshes, axes[:3], strict=True)]
        mesh = mesh + meshes[0].shape[1] * indices(size)[:, None]
        meshes = [_flat(part) for part in meshes]
    hits = _cast_operation(*meshes, _flat(mesh), *(_flat(part) for part in views), **options)
    return [hit.reshape(size, -1, *hit.shape[1:]) for hit in hits], [0, 0]


_cast_operation = single_operation(
    "i2t_cast",
    _cast_arrays,
    result_shapes=_result_shapes,
    batch=_batch_cast,
    static_argnames=("window", "pixels", "reach", "with_faces"),
)


def _cast(
    meshes: tuple[Array, Array, Array],
    mesh: Int[Array, " p"],
    view: ToolView,
    grid: PixelGrid,
    reach: float,
    with_faces: bool,
) -> tuple[Array, Array]:
    """Compute heights (p, n, n) that p poses see of their meshes, and the faces (p, n, n; zeros if not requested)."""
    triangles, boxes, groups = meshes
    count = boxes.shape[1]
    size = triangles.shape[1] // (count * CLUSTERS_PER_GROUP)
    clusters = FaceClusters(triangles.reshape(-1, size * 9), mesh, count * CLUSTERS_PER_GROUP, size)
    boxes = boxes.reshape(-1, *boxes.shape[2:])
    groups = groups[mesh if len(groups) > 1 else slice(None)]
    if size >= CLUSTER_SIZES.dense:
        best = cast_dense(boxes, groups, clusters, view, grid, reach, PASS_SIZES.groups, with_faces)
    else:
        best = _cast_listed(boxes, groups, clusters, view, grid, reach, with_faces)
    heights = grid.images(best[0])
    return heights, grid.images(best[1]) if len(best) == 2 else jnp.zeros(heights.shape, jnp.int32)


def _cast_listed(
    boxes: Float[Array, "groups 6 clusters"],
    groups: Float[Array, "views 6 groups_of_mesh"],
    clusters: FaceClusters,
    view: ToolView,
    grid: PixelGrid,
    reach: float,
    with_faces: bool,
) -> Hits:
    """Find hits on meshes of large or few faces, whose clusters are set up in a table: list the groups in view and draw
    the list in passes.
    """
    poses, count = len(clusters.mesh), clusters.per_mesh // CLUSTERS_PER_GROUP
    listed = min(count, PASS_SIZES.groups)
    slots = min(PASS_SIZES.clusters, listed * CLUSTERS_PER_GROUP)
    dtype = jnp.result_type(clusters.rows.dtype, view.linear.dtype)

    seen, _ = _in_view(groups.swapaxes(0, 1), broadcast_view(view, 1), grid.half)
    row = groups.shape[2] // WORD_BITS
    words = pack_bits(seen.reshape(poses, WORD_BITS, row), 1)
    sums = cumulative_popcounts(words)

    def group_pass(number: Array, carry: tuple[Hits, Scratch]) -> tuple[Hits, Scratch]:
        left = jnp.clip(sums[:, -1] - number * listed, 0, listed)
        order = number * listed + indices(listed)[None]
        at, bit = select_kth_set_bit(words, sums, indices(poses)[:, None], order)
        ids = jnp.minimum(bit * row + at, count - 1)
        fronts = _fronts(ids, left, boxes, clusters, view, grid)
        return _draw_layers(ids, fronts, clusters, view, grid, reach, slots, carry)

    best = empty_buffers(poses, grid, dtype, with_faces)
    scratch = empty_scratch(poses, clusters.size, slots, grid, dtype)
    best, _ = jax.lax.fori_loop(0, jnp.max(-(-sums[:, -1] // listed)), group_pass, (best, scratch))
    return best


def _fronts(
    ids: Int[Array, "p listed"],
    left: Int[Array, " p"],
    boxes: Float[Array, "groups 6 clusters"],
    clusters: FaceClusters,
    view: ToolView,
    grid: PixelGrid,
) -> Float[Array, "p listed clusters"]:
    """Compute the tool z (m) at which the boxes of clusters in the first `left` groups begin, +inf out of view."""
    poses, listed = ids.shape
    chunk = min(listed, PASS_SIZES.groups_per_chunk)
    count = clusters.per_mesh // CLUSTERS_PER_GROUP
    chunks = jnp.max(-(-left // chunk))
    dtype = jnp.result_type(clusters.rows.dtype, view.linear.dtype)

    def test_boxes(i: Array) -> Array:
        chosen = dynamic_slice(ids, (0, i * chunk), (poses, chunk))
        box = boxes.at[chosen + clusters.mesh[:, None] * count].get(mode="promise_in_bounds")
        hit, front = _in_view(jnp.moveaxis(box, 2, 0), broadcast_view(view, 2), grid.half)
        hit &= (i * chunk + indices(chunk)[None] < left[:, None])[..., None]
        return jnp.where(hit, front, jnp.inf)

    def store(i: Array, fronts: Array) -> Array:
        return dynamic_update(fronts, fusion_barrier(test_boxes, i, i < chunks), (0, i * chunk, 0))

    return jax.lax.fori_loop(0, chunks, store, jnp.full((poses, listed, CLUSTERS_PER_GROUP), jnp.inf, dtype))


def _draw_layers(
    ids: Int[Array, "p listed"],
    fronts: Float[Array, "p listed clusters"],
    clusters: FaceClusters,
    view: ToolView,
    grid: PixelGrid,
    reach: float,
    slots: int,
    carry: tuple[Hits, Scratch],
) -> tuple[Hits, Scratch]:
    """Draw the clusters near the front, then those that may be within reach behind the nearest hit."""
    slab = jnp.min(fronts, (1, 2)) + PASS_SIZES.front_slab_reaches * reach

    def layer(i: Array, carry: tuple[Hits, Scratch]) -> tuple[Hits, Scratch]:
        best = carry[0]
        low = jnp.where(i == 0, -jnp.inf, slab)[:, None, None]
        high = jnp.where(i == 0, slab, jnp.min(best[0], (1, 2)) + reach)[:, None, None]
        wanted = (fronts > low) & (fronts <= high) & (fronts < jnp.inf)
        words = pack_bits(wanted)
        sums = cumulative_popcounts(words)
        draw = partial(draw_clusters, ClusterList(ids, words, sums), clusters, view, grid, slots)
        return jax.lax.fori_loop(0, jnp.max(-(-sums[:, -1] // slots)), draw, carry)

    return jax.lax.fori_loop(0, 2, layer, carry)


def _in_view(box: Array, view: ToolView, half: float) -> tuple[Bool[Array, "..."], Float[Array, "..."]]:
    """Test which boxes (centres and half extents, six arrays) the rays can meet, and at which z (m) each box begins."""
    centre, extent = place_boxes(box, view)
    front, back = centre[2] - extent[2], centre[2] + extent[2]
    inside = (jnp.abs(centre[0]) - extent[0] <= half) & (jnp.abs(centre[1]) - extent[1] <= half)
    return inside & (back >= -STANDOFF), jnp.maximum(front, -STANDOFF)


def _flat(array: Array) -> Array:
    """Merge the first two axes."""
    return array.reshape(-1, *array.shape[2:])
