"""First hits on meshes of many small faces: the part of `i2t.rendering.raycast` for large size classes.

A pose of such a mesh has thousands of faces in its window, each met by a pixel or two. To keep them in a table costs
more than to draw them, so nothing is kept but bits: a box says which columns and rows of tiles a cluster can touch, and
what a tile has to draw are the bits that its column and its row have in common. A tile pops a cluster, brings its faces
to the tool frame, turns them into edge functions and tests its pixels, all in one turn of a loop.

Tiles of all poses are sorted by how much they have to draw and cut into shares, so that the tiles of a share end
together. A share is small enough for the caches of two cores, and its lanes lie in blocks of `LANES`: XLA gives each
core some whole blocks, and a core then reads what it wrote itself.
"""

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

LANES_PER_BLOCK = 32  # tiles side by side in memory
BLOCKS_PER_SHARE = 72  # of lanes in a share
GROUPS_PER_CHUNK = 8  # groups of each pose looked into together
DENSE_FRONT_SLAB_REACHES = 1.25  # reaches behind where the first group should be met: what is drawn first


class _Scene(NamedTuple):
    """Constants of a batch of poses to draw: meshes, poses and pixels."""

    boxes: Float[Array, "groups 6 clusters"]  # m, centres and half extents of clusters
    clusters: FaceClusters
    view: ToolView  # of each pose
    grid: PixelGrid

    @property
    def groups_per_mesh(self) -> int:
        """Rows of `boxes` that belong to one mesh."""
        return self.clusters.per_mesh // CLUSTERS_PER_GROUP


class _Slab(NamedTuple):
    """The range of tool z (m) of each pose in which a box has to begin so that it is drawn now."""

    low: Float[Array, "p 1"]  # not itself
    high: Float[Array, "p 1"]


class _Listed(NamedTuple):
    """The groups that a pass looks into, and the columns and rows of tiles of their clusters (bits)."""

    ids: Int[Array, "p groups"]
    columns: UInt[Array, "p groups side"]
    rows: UInt[Array, "p groups side"]


class _Lanes(NamedTuple):
    """The tiles of a share, side by side: their poses, the poses' views of the mesh, and their pixels."""

    pose: Int[Array, "blocks lanes"]
    tile: Int[Array, "blocks lanes"]
    view: ToolView
    pixels: tuple[Array, ...]  # (blocks, lanes, pixels) m, x and y in the tool frame


class _Queue(NamedTuple):
    """Clusters that tiles have still to draw: bits of the groups not yet opened, bits left of the group that is open,
    its place in the list.
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
    """Find the first hits.

    Args:
        boxes: Centres and half extents (m) of the clusters of all meshes, a group a row.
        groups: Those of the groups of each pose's mesh, or of the one mesh.
        clusters: The faces of all meshes.
        view: Of each pose.
        grid: Pixels and tiles.
        reach: Depth (m) behind the nearest hit that counts.
        listed: Groups of a pose that are worked off in one pass.
        with_faces: Whether faces are asked for.

    Returns:
        Heights (p, tiles, pixels) in metres, and the faces if asked for.
    """
    scene = _Scene(boxes, clusters, view, grid)
    poses, count = len(clusters.mesh), scene.groups_per_mesh
    listed = min(count, listed)
    shift, stretch = place_boxes(groups.swapaxes(0, 1), broadcast_view(view, 1))
    seen = (jnp.abs(shift[0]) - stretch[0] <= grid.half) & (jnp.abs(shift[1]) - stretch[1] <= grid.half)
    seen &= shift[2] + stretch[2] >= -STANDOFF
    fronts = jnp.where(seen, jnp.maximum(shift[2] - stretch[2], -STANDOFF), jnp.inf)
    # A group in the middle should be met at its own middle, one at the edge of the window perhaps only at its end.
    central = (jnp.abs(shift[0]) <= grid.half) & (jnp.abs(shift[1]) <= grid.half)
    met = jnp.maximum(jnp.where(central, shift[2], shift[2] + stretch[2]), -STANDOFF)
    slab = jnp.min(jnp.where(seen, met, jnp.inf), 1) + DENSE_FRONT_SLAB_REACHES * reach
    row = groups.shape[2] // WORD_BITS

    def layer(i: Array, best: Hits) -> Hits:
        """Draw first clusters near the front, then those still in reach behind the nearest hit."""
        low = jnp.where(i == 0, -jnp.inf, slab)[:, None]
        high = jnp.where(i == 0, slab, jnp.min(best[0], (1, 2)) + reach)[:, None]
        wanted = (fronts <= high) & (fronts < jnp.inf) & (low < high)
        words = pack_bits(wanted.reshape(len(wanted), WORD_BITS, row), 1)
        sums = cumulative_popcounts(words)

        def group_pass(number: Array, best: Hits) -> Hits:
            left = jnp.clip(sums[:, -1] - number * listed, 0, listed)
            at, bit = select_kth_set_bit(words, sums, indices(poses)[:, None], number * listed + indices(listed)[None])
            ids = jnp.minimum(bit * row + at, count - 1)
            return _draw(_look(ids, left, _Slab(low, high), scene), scene, best)

        return jax.lax.fori_loop(0, jnp.max(-(-sums[:, -1] // listed)), group_pass, best)

    dtype = jnp.result_type(clusters.rows.dtype, view.linear.dtype)
    return jax.lax.fori_loop(0, 2, layer, empty_buffers(poses, grid, dtype, with_faces))


def _look(ids: Int[Array, "p listed"], left: Int[Array, " p"], slab: _Slab, scene: _Scene) -> _Listed:
    """Tiles of the clusters of the first `left` groups of each list whose boxes begin in the slab.

    Groups are looked into in chunks, so that their boxes stay in the caches; chunks behind the longest list are not
    looked into.
    """
    poses, listed = ids.shape
    side = scene.grid.side
    chunk = min(GROUPS_PER_CHUNK, listed)
    chunks = jnp.max(-(-left // chunk))
    start = scene.clusters.mesh[:, None] * scene.groups_per_mesh
    first = jnp.minimum(indices(-(-listed // chunk)) * chunk, listed - chunk)  # the last chunk may repeat some

    def look(k: Array) -> tuple[Array, Array]:
        some = dynamic_slice(ids, (0, first[k]), (poses, chunk))
        box = scene.boxes.at[some + start].get(mode="promise_in_bounds")
        of_list = (first[k] + indices(chunk)[None] < left[:, None])[..., None]
        return _tiles_of_boxes(box, of_list, slab, scene)

    def store(k: Array, carry: tuple[Array, ...]) -> tuple[Array, ...]:
        found = fusion_barrier(look, k, k < chunks)
        found = fusion_barrier(lambda _: tuple(_clusters_of_tiles(words, side) for words in found), k, k < chunks)
        return tuple(dynamic_update(whole, part, (0, first[k], 0)) for whole, part in zip(carry, found, strict=True))

    nothing = jnp.zeros((poses, listed, side), jnp.uint32)
    return _Listed(ids, *jax.lax.fori_loop(0, chunks, store, (nothing, nothing)))


def _tiles_of_boxes(
    boxes: Float[Array, "p chunk 6 clusters"], of_list: Bool[Array, "p chunk 1"], slab: _Slab, scene: _Scene
) -> tuple[UInt[Array, "p chunk clusters"], UInt[Array, "p chunk clusters"]]:
    """Columns and rows of tiles (bits) that each box can touch; no column if it is not to be drawn now."""
    shift, stretch = place_boxes(jnp.moveaxis(boxes, 2, 0), broadcast_view(scene.view, 2))
    front, back = jnp.maximum(shift[2] - stretch[2], -STANDOFF), shift[2] + stretch[2]
    wanted = (back >= -STANDOFF) & (front > slab.low[..., None]) & (front <= slab.high[..., None])
    wanted &= of_list
    columns, rows = (scene.grid.columns(shift[j] - stretch[j], shift[j] + stretch[j]) for j in (0, 1))
    return jnp.where(wanted, columns, as_uint32(0)), rows


def _clusters_of_tiles(words: UInt[Array, "p chunk clusters"], side: int) -> UInt[Array, "p chunk side"]:
    """Bits of tiles for each cluster turned into bits of clusters for each column or row of tiles."""
    tile = jnp.arange(side, dtype=jnp.uint32).reshape(1, 1, -1, 1)
    cluster = jnp.arange(CLUSTERS_PER_GROUP, dtype=jnp.uint32).reshape(1, 1, 1, -1)
    flags = (words[:, :, None] >> tile) & as_uint32(1)
    return jnp.sum(flags << cluster, -1, dtype=jnp.uint32)


def _draw(found: _Listed, scene: _Scene, best: Hits) -> Hits:
    """Draw the found clusters, the tiles that have most to draw first."""
    grid = scene.grid
    poses, listed = found.ids.shape
    lanes = poses * grid.tiles
    blocks = min(BLOCKS_PER_SHARE, -(-lanes // LANES_PER_BLOCK))
    share = blocks * LANES_PER_BLOCK
    shares = -(-lanes // share)

    def words(g: int) -> Array:
        return (found.rows[:, g, :, None] & found.columns[:, g, None, :]).reshape(-1)

    filled = [jnp.where(words(g) != 0, as_uint32(1 << g % WORD_BITS), as_uint32(0)) for g in range(listed)]
    full = [bitwise_or_reduce(filled[i : i + WORD_BITS]) for i in range(0, listed, WORD_BITS)]
    todo = sum(popcount(words(g)) for g in range(listed))
    todo = jnp.pad(todo, (0, shares * share - lanes))
    amount, order = jax.lax.sort((-todo, indices(len(todo))), num_keys=1, is_stable=False)
    best = jax.tree.map(lambda part: part.reshape(lanes, -1), best)

    def draw_share(k: Array, best: Hits) -> Hits:
        those = dynamic_slice(order, (k * share,), (share,))
        lane = jnp.minimum(those, lanes - 1).reshape(blocks, LANES_PER_BLOCK)
        pose, tile = lane // grid.tiles, lane % grid.tiles

        def fetch(_: Array) -> tuple[_Queue, ToolView, list[Array], Hits]:
            queue = _Queue(
                tuple(_at(part, lane) for part in full), jnp.zeros_like(lane, jnp.uint32), jnp.zeros_like(lane)
            )
            here = jax.tree.map(lambda part: part[..., pose], scene.view)
            pixels = [_at(jnp.asarray(part, best[0].dtype), tile) for part in (grid.x, grid.y)]
            return queue, here, pixels, tuple(_at(part, lane) for part in best)

        queue, here, pixels, mine = fusion_barrier(fetch, k, k < shares)
        draw_next = partial(_draw_next, found=found, scene=scene, lanes=_Lanes(pose, tile, here, tuple(pixels)))
        _, mine = jax.lax.fori_loop(0, -amount[k * share], draw_next, (queue, mine))
        return tuple(
            part.at[those].set(own.reshape(share, -1), mode="drop", unique_indices=True)
            for part, own in zip(best, mine, strict=True)
        )

    best = jax.lax.fori_loop(0, -(-jnp.sum(todo > 0) // share), draw_share, best)
    return jax.tree.map(lambda part: part.reshape(poses, grid.tiles, -1), best)


def _draw_next(
    turn: Int[Array, ""], carry: tuple[_Queue, Hits], *, found: _Listed, scene: _Scene, lanes: _Lanes
) -> tuple[_Queue, Hits]:
    """One turn of the loop: each tile of a share pops a cluster, draws its faces, and keeps the nearest hits."""
    queue, best = carry
    holds, size, side = turn >= 0, scene.clusters.size, scene.grid.side
    x, y = lanes.pixels
    queue, name = fusion_barrier(
        lambda _: _pop(queue, found, lanes.pose, lanes.tile % side, lanes.tile // side), turn, holds
    )
    corners = fusion_barrier(lambda _: _corners_of(name, lanes.pose, scene.clusters), turn, holds)
    corners = corners.reshape(-1, 3, size, 3, LANES_PER_BLOCK)  # block, corner, face, axis, lane
    placed = fusion_barrier(lambda _: _to_tool(corners, lanes.view), turn, holds)
    shown = jnp.broadcast_to((name >= 0)[:, None], (len(name), size, LANES_PER_BLOCK))
    terms = fusion_barrier(lambda _: face_terms(placed, shown, scene.grid.half, 1, holds), turn, holds)
    for f in range(size):
        edges = [part[:, k, f, :, None] for part in terms[:3] for k in range(3)]
        plane = [part[:, f, :, None] for part in terms[3:]]
        best = closer_hit(best, x, y, edges + plane, name[..., None] * size + f)
    return queue, best


def _corners_of(
    name: Int[Array, "blocks lanes"], pose: Int[Array, "blocks lanes"], clusters: FaceClusters
) -> Float[Array, "blocks coordinates lanes"]:
    """The corners (m, mesh frame) of a cluster for each lane: of its first corners those of all faces, each three
    coordinates, then of its second and third.
    """
    corner, face, axis = np.mgrid[:3, : clusters.size, :3]
    number = (face * 9 + corner * 3 + axis).ravel()  # of a coordinate in its cluster's row
    row = jnp.maximum(name, 0) + clusters.mesh[pose] * clusters.per_mesh
    return _at(clusters.rows, (row[:, None], jnp.asarray(number, jnp.int32)[None, :, None]))


def _to_tool(corners: Float[Array, "blocks 3 faces 3 lanes"], view: ToolView) -> list[Array]:
    """x, y and z (blocks, 3, faces, lanes) of corners in the tool frames of their lanes (m)."""
    local = [corners[:, :, :, j] - view.origin[j][:, None, None] for j in range(3)]
    return [
        sum((view.linear[i, j][:, None, None] * local[j] for j in range(3)), view.offset[i][:, None, None])
        for i in range(3)
    ]


def _pop(
    queue: _Queue,
    found: _Listed,
    pose: Int[Array, "blocks lanes"],
    column: Int[Array, "blocks lanes"],
    row: Int[Array, "blocks lanes"],
) -> tuple[_Queue, Int[Array, "blocks lanes"]]:
    """Take a cluster from each queue: the rest, and the cluster's index in the mesh (-1 from an empty queue)."""
    listed, side = found.columns.shape[1:]
    some: Array = queue.full[0]
    place, left = lowest_set_bit(some), [jnp.where(queue.current == 0, some & (some - as_uint32(1)), some)]
    for i, more in enumerate(queue.full[1:], 1):
        place = jnp.where(some != 0, place, i * WORD_BITS + lowest_set_bit(more))
        left.append(jnp.where((queue.current == 0) & (some == 0), more & (more - as_uint32(1)), more))
        some = some | more
    fresh: Bool[Array, "blocks lanes"] = (queue.current == 0) & (some != 0)
    place = jnp.where(fresh, place, queue.place)
    at = pose * listed + place
    opened = _at(found.columns.reshape(-1), at * side + column) & _at(found.rows.reshape(-1), at * side + row)
    current = jnp.where(fresh, opened, queue.current)
    name = jnp.where(current == 0, -1, _at(found.ids.reshape(-1), at) * CLUSTERS_PER_GROUP + lowest_set_bit(current))
    return _Queue(tuple(left), current & (current - as_uint32(1)), place), name


def _at(array: Array, index: Any) -> Array:
    return array.at[index].get(mode="promise_in_bounds")
