"""Draw clusters of faces into tiles of pixels: the second half of `i2t.rendering.raycast`, which describes how the two
work together.

A pass takes up to `slots` clusters of each pose and sets them up as one dense list. A bit for each cluster marks the
tiles that it crosses. The tiles of all poses are lanes, which pop their bits in turn and keep the nearest hit.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, UInt

from i2t.patches.dimensions import STANDOFF
from i2t.rendering.bitset import (
    WORD_BITS,
    as_uint32,
    bitwise_or_reduce,
    lowest_set_bit,
    pack_bits,
    popcount,
    select_kth_set_bit,
)
from i2t.rendering.bvh import CLUSTERS_PER_GROUP
from i2t.rendering.ops import dynamic_slice, dynamic_update, fusion_barrier, indices, maximum, minimum

MIN_PROJECTED_AREA_M2 = 1e-16  # m^2, twice the projected area of a face below which it is edge on and not drawn
FACE_TERMS = 13  # number of terms of a face: 9 of its three edges, 3 of its plane, and its lowest corner's z

# Nearest hits so far as (p, tiles, pixels) arrays: heights (m) and, if requested, faces.
Hits: TypeAlias = tuple[Array, ...]


class ToolView(NamedTuple):
    """Map of points p to the tool frame, `linear (p - origin) + offset` (m). The last axes are those of the poses."""

    linear: Float[Array, "3 3"]
    origin: Float[Array, "3"]
    offset: Float[Array, "3"]


class PixelGrid:
    """Pixel centres of a window, and the square tiles that contain them (the last tiles may extend beyond the edge).

    Args:
        window: Edge (m) of the square.
        pixels: Number of pixels along the edge.
        tile_pixels: Number of pixels along the edge of a tile, at least.
    """

    def __init__(self, window: float, pixels: int, tile_pixels: int = 8) -> None:
        self.window, self.pixels, self.half, self.pitch = window, pixels, window / 2, window / pixels
        # Pixels along the edge of a tile, so that the columns of tiles fit a word.
        self.edge = tile_pixels * -(-pixels // (tile_pixels * (WORD_BITS - 1)))
        self.side = -(-pixels // self.edge)
        self.tiles = self.side**2
        self.centres = ((np.arange(self.side * self.edge) + 0.5) * self.pitch - self.half)[:pixels].astype(np.float32)
        all_centres = ((np.arange(self.side * self.edge) + 0.5) * self.pitch - self.half).astype(np.float32)
        blocks = np.broadcast_to(
            all_centres.reshape(1, self.side, 1, self.edge), (self.side, self.side, self.edge, self.edge)
        )
        self.x = np.ascontiguousarray(blocks).reshape(self.tiles, -1)
        self.y = np.ascontiguousarray(blocks.transpose(1, 0, 3, 2)).reshape(self.tiles, -1)
        # Range of a tile's pixels along an axis, widened by a twentieth of a pixel for rounding errors.
        first = all_centres.reshape(self.side, self.edge)
        self.low, self.high = first[:, 0] - self.pitch / 20, first[:, -1] + self.pitch / 20

    def images(self, tiles: Array) -> Array:
        """Assemble images from square tiles of pixels.

        Args:
            tiles: `(p, tiles, pixels of a tile)` values for p poses.

        Returns:
            `(p, n, n)` images of n pixels along an edge.
        """
        whole = tiles.reshape(-1, self.side, self.side, self.edge, self.edge).swapaxes(2, 3)
        return whole.reshape(len(tiles), self.side * self.edge, -1)[:, : self.pixels, : self.pixels]

    def columns(self, low: Float[Array, "*n"], high: Float[Array, "*n"]) -> UInt[Array, "*n"]:
        """Find the columns of tiles that intervals along x touch.

        Args:
            low: Lower ends (m) of the intervals.
            high: Upper ends (m) of the intervals.

        Returns:
            Words with a bit for each column.
        """
        width = self.edge * self.pitch
        first = jnp.clip(jnp.ceil((low - self.high[0]) / width), 0, self.side).astype(jnp.uint32)
        behind = jnp.clip(jnp.floor((high - self.low[0]) / width) + 1, 0, self.side).astype(jnp.uint32)
        return jnp.where(first < behind, (as_uint32(1) << behind) - (as_uint32(1) << first), as_uint32(0))


class FaceClusters(NamedTuple):
    """The faces of all meshes to render, in clusters of equal size: a row of corner coordinates (m) for each cluster,
    the index of each pose's mesh, and the numbers of clusters of a mesh and of faces of a cluster.
    """

    rows: Float[Array, "clusters size*9"]
    mesh: Int[Array, " p"]  # index of each pose's mesh
    per_mesh: int  # number of clusters of a mesh
    size: int  # number of faces of a cluster


class ClusterList(NamedTuple):
    """Clusters of faces that each pose needs for drawing: indices of groups, a word of bits for the 32 clusters of each
    group, and running sums of the set bits along the groups.
    """

    ids: Int[Array, "p groups"]
    words: UInt[Array, "p groups"]
    sums: Int[Array, "p groups"]


class _Queue(NamedTuple):
    """Clusters that tiles have still to draw: bits of the unopened words, the remaining bits of the current word, and
    its index.
    """

    full: UInt[Array, " tiles"]
    current: UInt[Array, " tiles"]
    word: Int[Array, " tiles"]


class _Table(NamedTuple):
    """Clusters set up for drawing; a row is a cluster, and the last row draws nothing."""

    faces: Float[Array, "rows terms"]
    names: Int[Array, " rows"]
    size: int  # number of faces of a cluster


class Scratch(NamedTuple):
    """Clusters set up for drawing, overwritten by every pass: terms of their faces, tiles that each face crosses
    (bits), and the cluster's index in its mesh. A row of `faces` and `names` is a cluster; the last row of `faces`
    draws nothing.
    """

    faces: Float[Array, "rows terms"]  # `FACE_TERMS` numbers of each face of the cluster
    spans: UInt[Array, "side faces"]  # columns of tiles (bits) that a face crosses in each row of tiles
    names: Int[Array, " rows"]  # index of the cluster in its mesh


class _Share(NamedTuple):
    """Part of every pose's list that a pass draws. Its clusters lie next to each other in the scratch table."""

    first: Int[Array, ""]  # number of the share's first cluster in a pose's list
    counts: Int[Array, " p"]  # number of clusters of each pose
    begins: Int[Array, " p"]  # first row of each pose's clusters in the table
    ends: Int[Array, " p"]  # row after the last of each pose's clusters in the table


def draw_clusters(
    listed: ClusterList,
    clusters: FaceClusters,
    view: ToolView,
    grid: PixelGrid,
    slots: int,
    number: Int[Array, ""],
    carry: tuple[Hits, Scratch],
) -> tuple[Hits, Scratch]:
    """Draw up to `slots` clusters of each pose into the tiles that they cross.

        list of each pose  ->  table of clusters, all poses one after another      (`_set_up`)
        spans of faces     ->  rows of tiles x table: columns of tiles, bits        (`_merge_faces`)
        rows x table       ->  tiles of all poses: clusters to draw, bits           (`_clusters_of_tiles`)
        bits of a tile     ->  hits on its pixels                                   (`_draw`)

    Args:
        listed: The clusters that each pose needs.
        clusters: The faces of all meshes.
        view: Map to the tool frame of each pose.
        grid: Pixels and tiles.
        slots: Number of clusters of a pose in a pass, a multiple of 32.
        number: Number of the pass.
        carry: Nearest hits so far, and the scratch table.

    Returns:
        Nearest hits and the scratch table after the pass.
    """
    best, scratch = carry
    poses = len(listed.ids)
    counts = jnp.clip(listed.sums[:, -1] - number * slots, 0, slots)
    ends = jnp.cumsum(counts)
    share = _Share(number * slots, counts, ends - counts, ends)
    scratch = _set_up(listed, clusters, view, grid, share, scratch)
    rows = _merge_faces(scratch.spans, share, clusters.size, (grid.side, slots * poses))
    tile_words = _clusters_of_tiles(rows, share, grid, slots)
    return _draw_all(tile_words, share, clusters.size, grid, scratch, best), scratch


def empty_scratch(poses: int, size: int, slots: int, grid: PixelGrid, dtype: DTypeLike) -> Scratch:
    """Create the empty scratch table of clusters, before the first pass of drawing.

    Args:
        poses: Number of poses that are drawn together.
        size: Number of faces in a cluster.
        slots: Number of clusters of a pose in a pass.
        grid: Pixels and tiles.
        dtype: Type of the numbers of a face.

    Returns:
        The table. Its last row draws nothing, because its edge functions are negative everywhere.
    """
    nothing = jnp.zeros((1, FACE_TERMS * size), dtype).at[:, 6 * size : 9 * size].set(-1)
    return Scratch(
        jnp.concatenate([jnp.zeros((slots * poses, FACE_TERMS * size), dtype), nothing]),
        jnp.zeros((grid.side, slots * poses * size), jnp.uint32),
        jnp.zeros(slots * poses + 1, jnp.int32),
    )


def _set_up(
    listed: ClusterList, clusters: FaceClusters, view: ToolView, grid: PixelGrid, share: _Share, scratch: Scratch
) -> Scratch:
    """Fill the table with the clusters of all poses, in rounds."""
    stride = WORD_BITS * len(listed.ids)  # clusters set up together
    rounds = -(-share.ends[-1] // stride)
    work = partial(_set_up_round, listed, clusters, view, grid, share, rounds)

    def store(i: Array, scratch: Scratch) -> Scratch:
        terms, span, name = fusion_barrier(work, i, i < rounds)
        return Scratch(
            dynamic_update(scratch.faces, terms, (i * stride, 0)),
            dynamic_update(scratch.spans, span, (0, i * stride * clusters.size)),
            dynamic_update(scratch.names, name, (i * stride,)),
        )

    return jax.lax.fori_loop(0, rounds, store, scratch)


def _set_up_round(
    listed: ClusterList,
    clusters: FaceClusters,
    view: ToolView,
    grid: PixelGrid,
    share: _Share,
    rounds: Int[Array, ""],
    i: Int[Array, ""],
) -> tuple[Array, Array, Array]:
    """Compute the terms (clusters, terms) of the i-th `WORD_BITS` clusters of each pose, the spans (side, faces) of
    their faces, and their names.
    """
    poses, size = len(listed.ids), clusters.size
    stride = WORD_BITS * poses
    item = i * stride + indices(stride)
    pose = jnp.minimum(jnp.searchsorted(share.ends, item, side="right"), poses - 1).astype(jnp.int32)
    order = item - share.begins[pose] + share.first
    at, bit = select_kth_set_bit(listed.words, listed.sums, pose, order)
    name = listed.ids.at[pose, at].get(mode="promise_in_bounds") * CLUSTERS_PER_GROUP + bit
    corners = clusters.rows.at[clusters.mesh[pose] * clusters.per_mesh + name].get(mode="promise_in_bounds")
    corners = corners.reshape(stride * size, 3, 3).transpose(2, 1, 0)  # axis, corner, face
    view = jax.tree.map(lambda part: jnp.repeat(part[..., pose], size, -1), view)
    view = jax.tree.map(lambda part: part[..., None, :], view)
    placed = fusion_barrier(lambda _: to_tool(corners, view), i, i < rounds)
    taken = i * stride + indices(stride * size) // size < share.ends[-1]
    terms = face_terms(placed, taken, grid.half, 0, i < rounds)
    solid = (terms[0][0] != 0) | (terms[1][0] != 0)  # faces without area have no edges
    drawn = taken & solid & (maximum(maximum(*placed[2][:2]), placed[2][2]) >= -STANDOFF)
    span = jnp.where(drawn[None], _spans(list(zip(*placed, strict=True)), grid), as_uint32(0))
    packed = fusion_barrier(lambda _: jnp.concatenate([*terms[:3], *(part[None] for part in terms[3:])]), i, i < rounds)
    return packed.reshape(FACE_TERMS, stride, size).swapaxes(0, 1).reshape(stride, FACE_TERMS * size), span, name


def _merge_faces(
    spans: UInt[Array, "side faces"], share: _Share, size: int, shape: tuple[int, int]
) -> UInt[Array, "side rows"]:
    """Unite the spans of the faces of each cluster."""
    side, rows = shape
    stride = WORD_BITS * len(share.counts)

    def merge(i: Array, merged: Array) -> Array:
        block = dynamic_slice(spans, (0, i * stride * size), (side, stride * size)).reshape(side, stride, size)
        return dynamic_update(merged, bitwise_or_reduce([block[..., f] for f in range(size)]), (0, i * stride))

    return jax.lax.fori_loop(0, -(-share.ends[-1] // stride), merge, jnp.zeros((side, rows), jnp.uint32))


def _clusters_of_tiles(
    rows: UInt[Array, "side rows"], share: _Share, grid: PixelGrid, slots: int
) -> UInt[Array, "words tiles"]:
    """Find the clusters that cross each tile: bit b of word w is cluster `w * WORD_BITS + b` of the tile's pose. Bits
    are transposed one word of clusters at a time.
    """
    poses = len(share.counts)
    column = jnp.arange(grid.side, dtype=jnp.uint32)[None, :, None]

    def transpose(i: Array, tile_words: Array) -> Array:
        number = i * WORD_BITS + indices(WORD_BITS)[None]
        block = rows.at[:, jnp.minimum(share.begins[:, None] + number, slots * poses - 1)].get(mode="promise_in_bounds")
        block = jnp.where((number < share.counts[:, None])[None], block, as_uint32(0))
        bits = pack_bits((block[:, None] >> column[..., None]) & as_uint32(1))
        return dynamic_update(tile_words, bits.reshape(1, grid.tiles, poses).swapaxes(1, 2).reshape(1, -1), (i, 0))

    tile_words = jnp.zeros((slots // WORD_BITS, poses * grid.tiles), jnp.uint32)
    return jax.lax.fori_loop(0, jnp.max(-(-share.counts // WORD_BITS)), transpose, tile_words)


def _draw_all(
    tile_words: UInt[Array, "words tiles"],
    share: _Share,
    size: int,
    grid: PixelGrid,
    scratch: Scratch,
    best: Hits,
    together_fraction: float = 0.25,
) -> Hits:
    """Draw the queues of the tiles: all tiles together while more than a fraction of them is busy, then the busiest."""
    words, lanes = tile_words.shape
    todo = sum((popcount(tile_words[w]) for w in range(words)), jnp.zeros(lanes, jnp.int32))
    full = bitwise_or_reduce([jnp.where(tile_words[w] != 0, as_uint32(1 << w), as_uint32(0)) for w in range(words)])
    queue = _Queue(full, jnp.zeros_like(full), jnp.zeros_like(todo))
    table = _Table(scratch.faces, scratch.names, size)
    begin = jnp.broadcast_to(share.begins[:, None], (len(share.begins), grid.tiles)).reshape(-1)
    x, y = (jnp.asarray(part, best[0].dtype) for part in (grid.x, grid.y))
    many = together_fraction * lanes
    together = jax.lax.while_loop(lambda t: jnp.sum(todo > t) > many, lambda t: t + 1, jnp.int32(0))
    queue, best = _draw(together, table, begin, tile_words, queue, best, x[None], y[None])
    return _draw_busiest(jnp.maximum(todo - together, 0), table, begin, tile_words, queue, best, (x, y))


def _draw_busiest(
    todo: Int[Array, " tiles"],
    table: _Table,
    begin: Int[Array, " tiles"],
    tile_words: UInt[Array, "words tiles"],
    queue: _Queue,
    best: Hits,
    pixels: tuple[Array, Array],
    num_shares: int = 8,
) -> Hits:
    """Draw the rest of the queues, the busiest tiles first, in shares that are each drawn to their end."""
    poses, tiles = best[0].shape[:2]
    lanes = poses * tiles
    shares = num_shares if poses >= num_shares else 1
    share = max(1, lanes // 4 // shares)

    def draw_share(amount: Array, busy: Array, k: Array, best: Hits) -> Hits:
        chosen = dynamic_slice(busy, (k * share,), (share,))
        take = partial(jax.tree.map, lambda a: a.at[chosen].get(mode="promise_in_bounds"))
        words = tile_words.at[:, chosen].get(mode="promise_in_bounds")
        trips = amount[k * share].astype(jnp.int32)
        across, down = (part[chosen % tiles] for part in pixels)
        _, drawn = _draw(trips, table, take(begin), words, take(queue), take(best), across, down)
        store = partial(jax.tree.map, lambda a, b: a.at[chosen].set(b, mode="promise_in_bounds", unique_indices=True))
        return store(best, drawn)

    def finish(_: Array, carry: tuple[Hits, Array]) -> tuple[Hits, Array]:
        best, todo = carry
        amount, busy = jax.lax.top_k(todo.astype(jnp.float32), share * shares)
        best = jax.lax.fori_loop(0, -(-jnp.sum(amount > 0) // share), partial(draw_share, amount, busy), best)
        return best, todo.at[busy].set(0, mode="promise_in_bounds", unique_indices=True)

    turns = -(-jnp.sum(todo > 0) // (share * shares))
    flat = jax.tree.map(lambda part: part.reshape(lanes, -1), best)
    flat, _ = jax.lax.fori_loop(0, turns, finish, (flat, todo))
    return jax.tree.map(lambda part, like: part.reshape(like.shape), flat, best)


def place_boxes(box: Sequence[Array] | Array, view: ToolView) -> tuple[list[Array], list[Array]]:
    """Transform boxes to the tool frame.

    Args:
        box: Centres x, y, z and half extents (m), six arrays of the same shape.
        view: Map to the tool frame of each pose.

    Returns:
        Centres and half extents (m) along the tool's axes, three arrays each.
    """
    stretch: list[Any] = [sum(jnp.abs(view.linear[i, j]) * box[3 + j] for j in range(3)) for i in range(3)]
    return to_tool(box[:3], view), stretch


def broadcast_view(view: ToolView, axes: int) -> ToolView:
    """Reshape a view of poses so that it broadcasts with arrays of more axes.

    Args:
        view: View of p poses.
        axes: Number of axes of length 1 that are added after the axis of the poses.

    Returns:
        The view with the additional axes.
    """
    return jax.tree.map(lambda part: part.reshape(*part.shape, *(1,) * axes), view)


def empty_buffers(poses: int, grid: PixelGrid, dtype: DTypeLike, with_faces: bool) -> Hits:
    """Create the buffers of hits before anything is drawn.

    Args:
        poses: Number of poses.
        grid: Pixels and tiles.
        dtype: Type of the heights.
        with_faces: Whether visible faces are requested.

    Returns:
        `(p, tiles, pixels)` infinite heights and, if requested, zeros for the indices of faces.
    """
    heights = jnp.full((poses, *grid.x.shape), jnp.inf, dtype)
    return (heights, jnp.zeros(heights.shape, jnp.int32)) if with_faces else (heights,)


def to_tool(point: Sequence[Array] | Array, view: ToolView) -> list[Array]:
    """Transform points to the tool frame. The view's origin is subtracted first, so that no digits are lost.

    Args:
        point: Coordinates x, y, z (m), three arrays.
        view: Map to the tool frame of each pose.

    Returns:
        Coordinates x, y, z (m) along the tool's axes.
    """
    local = [point[j] - view.origin[j] for j in range(3)]
    return [sum((view.linear[i, j] * local[j] for j in range(3)), view.offset[i]) for i in range(3)]


def _draw(
    trips: Int[Array, ""],
    table: _Table,
    begin: Int[Array, " tiles"],
    words: UInt[Array, "words tiles"],
    queue: _Queue,
    best: Hits,
    x: Array,
    y: Array,
) -> tuple[_Queue, Hits]:
    """Pop `trips` clusters from each tile's queue and keep the nearest hits.

    `begin` is the row of the table at which the clusters of the tile's pose begin. Tiles are a single axis, or the last
    of two axes.
    """
    lane = indices(len(begin))
    shape = best[0].shape
    nothing, size = len(table.faces) - 1, table.size

    def trip(_: Array, carry: tuple[_Queue, Hits]) -> tuple[_Queue, Hits]:
        (full, current, at), best = carry
        fresh = (current == 0) & (full != 0)
        at = jnp.where(fresh, lowest_set_bit(full), at)
        current = jnp.where(fresh, words.at[at, lane].get(mode="promise_in_bounds"), current)
        full = jnp.where(fresh, full & (full - as_uint32(1)), full)
        slot = jnp.where(current == 0, nothing, begin + at * WORD_BITS + lowest_set_bit(current))
        row = table.faces.at[slot].get(mode="promise_in_bounds").reshape(*shape[:-1], FACE_TERMS * size)
        for f in range(size):
            name = table.names.at[slot].get(mode="promise_in_bounds").reshape(shape[:-1]) * size + f
            best = closer_hit(
                best, x, y, [row[..., k * size + f][..., None] for k in range(FACE_TERMS)], name[..., None]
            )
        return _Queue(full, current & (current - as_uint32(1)), at), best

    return jax.lax.fori_loop(0, trips, trip, (queue, best))


def face_terms(
    corners: Sequence[Array], shown: Bool[Array, "..."], half: float, axis: int, holds: Bool[Array, ""]
) -> tuple[Array, ...]:
    """Compute the edge functions and planes of faces in the tool frame, from which pixels are drawn.

    Args:
        corners: Coordinates x, y and z (m), each with the three corners of a face along `axis`.
        shown: Whether a face is drawn; other faces have no inside.
        half: Half the edge (m) of the window.
        axis: Axis of the corners, and of the edges in A, B and C.
        holds: A condition that is true at run time (see `fusion_barrier`).

    Returns:
        A, B and C of the edge functions, the slopes of the faces' planes along x and y, the height of the plane at the
        origin, and that of the lowest corner.
    """
    x, y, _ = corners
    (xa, xb, xc), (ya, yb, yc), (za, zb, zc) = (
        [jax.lax.index_in_dim(part, k, axis, keepdims=False) for k in range(3)] for part in corners
    )

    def measure(_: Array) -> tuple[Array, Array]:
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        solid = (jnp.abs(area) >= MIN_PROJECTED_AREA_M2) & (jnp.abs(area) < jnp.inf) & shown
        return jnp.where(solid, jnp.sign(area), 0), 1 / jnp.where(solid, area, 1)

    side, share = fusion_barrier(measure, jnp.int32(0), holds)
    side = jnp.expand_dims(side, axis)
    xq, yq = (jnp.take(part, np.array([1, 2, 0]), axis) for part in (x, y))
    A, B = (jnp.where(side == 0, 0, side * run) for run in (y - yq, xq - x))
    tolerance = 4 * float(jnp.finfo(x.dtype).eps)  # four roundings of the corners' coordinates
    slack = tolerance * (jnp.abs(A) * (jnp.abs(x) + half) + jnp.abs(B) * (jnp.abs(y) + half))
    C = jnp.where(side == 0, -1, slack - (A * x + B * y))
    slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) * share
    slope_y = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) * share
    base = za - slope_x * xa - slope_y * ya
    # A steep plane is meaningless outside its edge, where the tolerance still draws it, so a corner limits its height.
    return A, B, C, slope_x, slope_y, base, minimum(minimum(za, zb), zc)


def closer_hit(best: Hits, x: Array, y: Array, face: Sequence[Array], name: Array) -> Hits:
    """Keep the nearest of the hits so far and those of a face.

    Args:
        best: Heights (m) so far and, if requested, their faces.
        x: Tool x (m) of the pixels.
        y: Tool y (m) of the pixels.
        face: The `FACE_TERMS` numbers of the face, as in `face_terms`.
        name: Index of the face.

    Returns:
        Hits of the same shape as `best`.
    """
    A0, A1, A2, B0, B1, B2, C0, C1, C2, slope_x, slope_y, base, low = face
    height = maximum(slope_x * x + (slope_y * y + base), low)
    inside = minimum(minimum(A0 * x + (B0 * y + C0), A1 * x + (B1 * y + C1)), A2 * x + (B2 * y + C2))
    height = jnp.where(minimum(inside, height + STANDOFF) >= 0, height, jnp.inf)
    if len(best) == 2:
        return minimum(best[0], height), jnp.where(height < best[0], name, best[1])
    return (minimum(best[0], height),)


def _spans(corners: list[tuple[Array, ...]], grid: PixelGrid) -> UInt[Array, "rows faces"]:
    """Find the tiles that faces cross: for each row of tiles (rows, faces), the columns (bits) between the ends of the
    face in that strip.
    """
    low, high = jnp.asarray(grid.low)[:, None], jnp.asarray(grid.high)[:, None]
    left, right = jnp.full((), jnp.inf), jnp.full((), -jnp.inf)
    for (xp, yp, _), (xq, yq, _) in zip(corners, corners[1:] + corners[:1], strict=True):
        rise = yq - yp
        slope = ((xq - xp) / jnp.where(jnp.abs(rise) < 1e-12, 1e-12, rise))[None]
        xp, yp, xq, yq = xp[None], yp[None], xq[None], yq[None]
        at_low, at_high = xp + (low - yp) * slope, xp + (high - yp) * slope
        in_strip = (maximum(yp, yq) >= low) & (minimum(yp, yq) <= high)
        start = maximum(minimum(at_low, at_high), minimum(xp, xq))
        end = minimum(maximum(at_low, at_high), maximum(xp, xq))
        left = jnp.where(in_strip, minimum(start, left), left)
        right = jnp.where(in_strip, maximum(end, right), right)
    return grid.columns(left, right)
