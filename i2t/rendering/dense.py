"""Find first hits on meshes of many small faces: the part of `i2t.rendering.raycast` for large size classes.

The window of a pose on such a mesh holds thousands of faces, each met by only a few pixels. Storing them in a table
costs more than drawing them, so only bits are stored. A box determines which columns and rows of tiles a cluster can
touch, and a tile draws the clusters whose bits are set in both its column and its row. In a single turn of a loop, a
tile pops a cluster, transforms its faces to the tool frame, converts them to edge functions and tests its pixels.

The tiles of all poses are sorted by the number of clusters they have to draw and are cut into shares, so that the tiles
of a share end at about the same time. A share fits the caches of two cores, and its lanes lie in blocks: XLA assigns
whole blocks to each core, so that a core reads what it wrote itself.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt

from i2t.patches.dimensions import STANDOFF
from i2t.rendering.bitset import (
    WORD_BITS,
    as_uint32,
    bitwise_or_reduce,
    cumulative_popcounts,
    lowest_set_bit,
    pack_bits,
    popcount,
    select_kth_set_bit,
)
from i2t.rendering.bvh import CLUSTERS_PER_GROUP
from i2t.rendering.ops import dynamic_slice, dynamic_update, fusion_barrier, indices
from i2t.rendering.tiles import (
    FaceClusters,
    Hits,
    PixelGrid,
    ToolView,
    broadcast_view,
    closer_hit,
    empty_buffers,
    face_terms,
    place_boxes,
)


@dataclass(frozen=True)
class DenseDrawing:
    """Sizes of the parts in which dense meshes are drawn."""

    lanes_per_block: int = 32  # number of tiles next to each other in memory
    blocks_per_share: int = 72
    groups_per_chunk: int = 8  # number of groups of a pose whose boxes are tested together
    # reaches behind the expected hit of the first group, up to which clusters are drawn first
    front_slab_reaches: float = 1.25


_DRAWING = DenseDrawing()  # sizes of the parts in which dense meshes are drawn


class _Scene(NamedTuple):
    """Constants of a batch of poses: meshes, poses and pixels."""

    boxes: Float[Array, "groups 6 clusters"]  # m, centres and half extents of the clusters
    clusters: FaceClusters
    view: ToolView  # poses to render
    grid: PixelGrid

    @property
    def groups_per_mesh(self) -> int:
        """Number of groups of 32 clusters in each mesh, which are its rows of `boxes`."""
        return self.clusters.per_mesh // CLUSTERS_PER_GROUP


class _Slab(NamedTuple):
    """Range of tool z (m) of each pose in which a box must begin to be drawn now."""

    low: Float[Array, "p 1"]  # m, nearer end of the slab, excluded
    high: Float[Array, "p 1"]  # m, farther end of the slab, included


class _Listed(NamedTuple):
    """Groups that a pass draws, and for each column and row of tiles the clusters (bits) that touch it."""

    ids: Int[Array, "p groups"]
    columns: UInt[Array, "p groups side"]
    rows: UInt[Array, "p groups side"]


class _Lanes(NamedTuple):
    """Tiles of a share with their poses, the poses' views of the mesh, and their pixels."""

    pose: Int[Array, "blocks lanes"]
    tile: Int[Array, "blocks lanes"]
    view: ToolView
    pixels: tuple[Array, ...]  # (blocks, lanes, pixels) m, x and y of the pixels in the tool frame


class _Queue(NamedTuple):
    """Clusters that tiles have still to draw: bits of the unopened groups, the remaining bits of the open group, and
    its index in the list.
    """

    full: tuple[UInt[Array, "blocks lanes"], ...]
    current: UInt[Array, "blocks lanes"]
    place: Int[Array, "blocks lanes"]


def cast_dense(
    boxes: Float[Array, "groups 6 clusters"],
    groups: Float[Array, "views 6 groups_of_mesh"],
    clusters: FaceClusters,
    view: ToolView,
    grid: PixelGrid,
    reach: float,
    listed: int,
    with_faces: bool,
) -> Hits:
    """Find the first hits of parallel rays on meshes of many small faces.

    Args:
        boxes: Centres and half extents (m) of the clusters of all meshes; a row is a group.
        groups: Centres and half extents (m) of the groups of each pose's mesh, or of the common mesh.
        clusters: The faces of all meshes.
        view: Map to the tool frame of each pose.
        grid: Pixels and tiles.
        reach: Depth (m) behind the nearest hit that counts.
        listed: Number of groups of a pose that are drawn in a pass.
        with_faces: Whether to return faces.

    Returns:
        `(p, tiles, pixels)` heights (m), +inf without a hit, and, if requested, the indices of the faces.
    """
    scene = _Scene(boxes, clusters, view, grid)
    poses, count = len(clusters.mesh), scene.groups_per_mesh
    listed = min(count, listed)
    shift, stretch = place_boxes(groups.swapaxes(0, 1), broadcast_view(view, 1))
    seen = (jnp.abs(shift[0]) - stretch[0] <= grid.half) & (jnp.abs(shift[1]) - stretch[1] <= grid.half)
    seen &= shift[2] + stretch[2] >= -STANDOFF
    fronts = jnp.where(seen, jnp.maximum(shift[2] - stretch[2], -STANDOFF), jnp.inf)
    # A group in the middle of the window is expected to be met at its centre, one at the edge perhaps only at its end.
    central = (jnp.abs(shift[0]) <= grid.half) & (jnp.abs(shift[1]) <= grid.half)
    expected = jnp.maximum(jnp.where(central, shift[2], shift[2] + stretch[2]), -STANDOFF)
    slab = jnp.min(jnp.where(seen, expected, jnp.inf), 1) + _DRAWING.front_slab_reaches * reach
    row = groups.shape[2] // WORD_BITS

    def layer(i: Array, best: Hits) -> Hits:
        """Draw the clusters near the front first, then those within reach behind the nearest hit."""
        low = jnp.where(i == 0, -jnp.inf, slab)[:, None]
        high = jnp.where(i == 0, slab, jnp.min(best[0], (1, 2)) + reach)[:, None]
        wanted = (fronts <= high) & (fronts < jnp.inf) & (low < high)
        words = pack_bits(wanted.reshape(len(wanted), WORD_BITS, row), 1)
        sums = cumulative_popcounts(words)

        def group_pass(number: Array, best: Hits) -> Hits:
            left = jnp.clip(sums[:, -1] - number * listed, 0, listed)
            at, bit = select_kth_set_bit(words, sums, indices(poses)[:, None], number * listed + indices(listed)[None])
            ids = jnp.minimum(bit * row + at, count - 1)
            return _draw(_list_tiles(ids, left, _Slab(low, high), scene), scene, best)

        return jax.lax.fori_loop(0, jnp.max(-(-sums[:, -1] // listed)), group_pass, best)

    dtype = jnp.result_type(clusters.rows.dtype, view.linear.dtype)
    return jax.lax.fori_loop(0, 2, layer, empty_buffers(poses, grid, dtype, with_faces))


def _list_tiles(ids: Int[Array, "p listed"], left: Int[Array, " p"], slab: _Slab, scene: _Scene) -> _Listed:
    """List the tiles of clusters whose boxes begin in the slab, for the first `left` groups of each list.

    Groups are tested in chunks, so that their boxes stay in the caches. Chunks beyond the longest list are skipped.
    """
    poses, listed = ids.shape
    side = scene.grid.side
    chunk = min(_DRAWING.groups_per_chunk, listed)
    chunks = jnp.max(-(-left // chunk))
    start = scene.clusters.mesh[:, None] * scene.groups_per_mesh
    first = jnp.minimum(indices(-(-listed // chunk)) * chunk, listed - chunk)  # the last chunk may overlap

    def test_boxes(k: Array) -> tuple[Array, Array]:
        groups = dynamic_slice(ids, (0, first[k]), (poses, chunk))
        box = scene.boxes.at[groups + start].get(mode="promise_in_bounds")
        of_list = (first[k] + indices(chunk)[None] < left[:, None])[..., None]
        return _tiles_of_boxes(box, of_list, slab, scene)

    def store(k: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        tiles = fusion_barrier(test_boxes, k, k < chunks)
        parts = fusion_barrier(lambda _: tuple(_clusters_of_tiles(words, side) for words in tiles), k, k < chunks)
        return tuple(dynamic_update(whole, part, (0, first[k], 0)) for whole, part in zip(carry, parts, strict=True))

    empty = jnp.zeros((poses, listed, side), jnp.uint32)
    return _Listed(ids, *jax.lax.fori_loop(0, chunks, store, (empty, empty)))


def _tiles_of_boxes(
    boxes: Float[Array, "p chunk 6 clusters"], of_list: Bool[Array, "p chunk 1"], slab: _Slab, scene: _Scene
) -> tuple[UInt[Array, "p chunk clusters"], UInt[Array, "p chunk clusters"]]:
    """Find the columns and rows of tiles (bits) that each box can touch; boxes outside the slab have no columns."""
    shift, stretch = place_boxes(jnp.moveaxis(boxes, 2, 0), broadcast_view(scene.view, 2))
    front, back = jnp.maximum(shift[2] - stretch[2], -STANDOFF), shift[2] + stretch[2]
    wanted = (back >= -STANDOFF) & (front > slab.low[..., None]) & (front <= slab.high[..., None])
    wanted &= of_list
    columns, rows = (scene.grid.columns(shift[j] - stretch[j], shift[j] + stretch[j]) for j in (0, 1))
    return jnp.where(wanted, columns, as_uint32(0)), rows


def _clusters_of_tiles(words: UInt[Array, "p chunk clusters"], side: int) -> UInt[Array, "p chunk side"]:
    """Transpose the bits of tiles for each cluster to bits of clusters for each column or row of tiles."""
    tile = jnp.arange(side, dtype=jnp.uint32).reshape(1, 1, -1, 1)
    cluster = jnp.arange(CLUSTERS_PER_GROUP, dtype=jnp.uint32).reshape(1, 1, 1, -1)
    flags = (words[:, :, None] >> tile) & as_uint32(1)
    return jnp.sum(flags << cluster, -1, dtype=jnp.uint32)


def _draw(listed: _Listed, scene: _Scene, best: Hits) -> Hits:
    """Draw the listed clusters, beginning with the tiles that have the largest number of them."""
    grid = scene.grid
    poses, count = listed.ids.shape
    lanes = poses * grid.tiles
    blocks = min(_DRAWING.blocks_per_share, -(-lanes // _DRAWING.lanes_per_block))
    share = blocks * _DRAWING.lanes_per_block
    shares = -(-lanes // share)

    def words(g: int) -> Array:
        return (listed.rows[:, g, :, None] & listed.columns[:, g, None, :]).reshape(-1)

    filled = [jnp.where(words(g) != 0, as_uint32(1 << g % WORD_BITS), as_uint32(0)) for g in range(count)]
    full = [bitwise_or_reduce(filled[i : i + WORD_BITS]) for i in range(0, count, WORD_BITS)]
    todo = sum(popcount(words(g)) for g in range(count))
    todo = jnp.pad(todo, (0, shares * share - lanes))
    amount, order = jax.lax.sort((-todo, indices(len(todo))), num_keys=1, is_stable=False)
    best = jax.tree.map(lambda part: part.reshape(lanes, -1), best)

    def draw_share(k: Array, best: Hits) -> Hits:
        selected = dynamic_slice(order, (k * share,), (share,))
        lane = jnp.minimum(selected, lanes - 1).reshape(blocks, _DRAWING.lanes_per_block)
        pose, tile = lane // grid.tiles, lane % grid.tiles

        def fetch(_: Array) -> tuple[_Queue, ToolView, list[Array], Hits]:
            queue = _Queue(
                tuple(_at(part, lane) for part in full), jnp.zeros_like(lane, jnp.uint32), jnp.zeros_like(lane)
            )
            view = jax.tree.map(lambda part: part[..., pose], scene.view)
            pixels = [_at(jnp.asarray(part, best[0].dtype), tile) for part in (grid.x, grid.y)]
            return queue, view, pixels, tuple(_at(part, lane) for part in best)

        queue, view, pixels, hits = fusion_barrier(fetch, k, k < shares)
        draw_next = partial(_draw_next, listed=listed, scene=scene, lanes=_Lanes(pose, tile, view, tuple(pixels)))
        _, hits = jax.lax.fori_loop(0, -amount[k * share], draw_next, (queue, hits))
        return tuple(
            part.at[selected].set(own.reshape(share, -1), mode="drop", unique_indices=True)
            for part, own in zip(best, hits, strict=True)
        )

    best = jax.lax.fori_loop(0, -(-jnp.sum(todo > 0) // share), draw_share, best)
    return jax.tree.map(lambda part: part.reshape(poses, grid.tiles, -1), best)


def _draw_next(
    turn: Int[Array, ""], carry: tuple[_Queue, Hits], *, listed: _Listed, scene: _Scene, lanes: _Lanes
) -> tuple[_Queue, Hits]:
    """Pop a cluster for each tile of a share, draw its faces, and keep the nearest hits."""
    queue, best = carry
    holds, size, side = turn >= 0, scene.clusters.size, scene.grid.side
    x, y = lanes.pixels
    queue, name = fusion_barrier(
        lambda _: _pop(queue, listed, lanes.pose, lanes.tile % side, lanes.tile // side), turn, holds
    )
    corners = fusion_barrier(lambda _: _corners_of(name, lanes.pose, scene.clusters), turn, holds)
    corners = corners.reshape(-1, 3, size, 3, _DRAWING.lanes_per_block)  # block, corner, face, axis, lane
    placed = fusion_barrier(lambda _: _to_tool(corners, lanes.view), turn, holds)
    shown = jnp.broadcast_to((name >= 0)[:, None], (len(name), size, _DRAWING.lanes_per_block))
    terms = fusion_barrier(lambda _: face_terms(placed, shown, scene.grid.half, 1, holds), turn, holds)
    for f in range(size):
        edges = [part[:, k, f, :, None] for part in terms[:3] for k in range(3)]
        plane = [part[:, f, :, None] for part in terms[3:]]
        best = closer_hit(best, x, y, edges + plane, name[..., None] * size + f)
    return queue, best


def _corners_of(
    name: Int[Array, "blocks lanes"], pose: Int[Array, "blocks lanes"], clusters: FaceClusters
) -> Float[Array, "blocks coordinates lanes"]:
    """Fetch the corners (m, mesh frame) of a cluster for each lane: the three coordinates of the first corners of all
    faces, then those of the second and third corners.
    """
    corner, face, axis = np.mgrid[:3, : clusters.size, :3]
    number = (face * 9 + corner * 3 + axis).ravel()  # column of a coordinate in its cluster's row
    row = jnp.maximum(name, 0) + clusters.mesh[pose] * clusters.per_mesh
    return _at(clusters.rows, (row[:, None], jnp.asarray(number, jnp.int32)[None, :, None]))


def _to_tool(corners: Float[Array, "blocks 3 faces 3 lanes"], view: ToolView) -> list[Array]:
    """Transform corners to the tool frames of their lanes: x, y and z (blocks, 3, faces, lanes) in m."""
    local = [corners[:, :, :, j] - view.origin[j][:, None, None] for j in range(3)]
    return [
        sum((view.linear[i, j][:, None, None] * local[j] for j in range(3)), view.offset[i][:, None, None])
        for i in range(3)
    ]


def _pop(
    queue: _Queue,
    listed: _Listed,
    pose: Int[Array, "blocks lanes"],
    column: Int[Array, "blocks lanes"],
    row: Int[Array, "blocks lanes"],
) -> tuple[_Queue, Int[Array, "blocks lanes"]]:
    """Pop a cluster from each queue. Return the rest, and the cluster's index in the mesh (-1 from an empty queue)."""
    count, side = listed.columns.shape[1:]
    union: Array = queue.full[0]
    place, rest = lowest_set_bit(union), [jnp.where(queue.current == 0, union & (union - as_uint32(1)), union)]
    for i, word in enumerate(queue.full[1:], 1):
        place = jnp.where(union != 0, place, i * WORD_BITS + lowest_set_bit(word))
        rest.append(jnp.where((queue.current == 0) & (union == 0), word & (word - as_uint32(1)), word))
        union = union | word
    fresh: Bool[Array, "blocks lanes"] = (queue.current == 0) & (union != 0)
    place = jnp.where(fresh, place, queue.place)
    at = pose * count + place
    opened = _at(listed.columns.reshape(-1), at * side + column) & _at(listed.rows.reshape(-1), at * side + row)
    current = jnp.where(fresh, opened, queue.current)
    name = jnp.where(current == 0, -1, _at(listed.ids.reshape(-1), at) * CLUSTERS_PER_GROUP + lowest_set_bit(current))
    return _Queue(tuple(rest), current & (current - as_uint32(1)), place), name


def _at(array: Array, index: Any) -> Array:
    return array.at[index].get(mode="promise_in_bounds")
