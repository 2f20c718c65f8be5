"""First hits of parallel rays on triangles: exact rasterisation of clustered faces in tiles of pixels.

In the tool frame a ray is a point (x, y) and a face a triangle whose inside is where its three edge functions `A x + B
y + C` are positive; the plane through its corners gives z. Neighbouring faces share their corners to the last bit, so a
tolerance of a few roundings on every edge closes the cracks between them.

Work goes from coarse to fine, and what it cannot need is never touched. Boxes name the groups, then the clusters, that
the window can see no deeper than the reach behind the nearest hit; their faces are turned into edge functions once a
pose; every tile keeps a bit for each cluster that crosses it, and draws the clusters of its bits.

Poses differ many times in their work, so a batch is not one pose after another in lanes that wait for the slowest: all
clusters of all poses make one dense list, and all tiles of all poses one set of lanes, of which the busiest few go on
alone when most are done. `vmap` arrives here as a longer axis of poses (`custom_vmap`). Lists are worked off in passes
of a fixed length, so that scratch memory is small and constant and no list can overflow.

Work is split where XLA should store an intermediate: inside one loop body it would rather compute a cheap value again
for each of its uses.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from i2t.bits import BITS, either, lowest, ones, pack, pick, running_sums, word
from i2t.clusters import GROUP
from i2t.types import STANDOFF, Surface

TILE = 8  # pixels along the edge of a tile
GROUPS = 64  # groups listed in one pass
SLOTS = 256  # clusters of a pose set up in one pass, a multiple of 32 and at most 1024
SLAB = 2  # reaches behind the first box: what is drawn first, to learn how near the surface is
ROUNDINGS = 4  # tolerance of an edge, in roundings of its corners' coordinates
FLAT = 1e-16  # m^2, below this projected area a face is seen edge on
TERMS = 13  # numbers of a face: three edges, its plane, its lowest corner
MANY = 0.25  # of the tiles: so many at work are quicker together than in shares
SHARES = 8  # into which the busiest lanes are cut, each as long as its own longest


class View(NamedTuple):
    """How points come to the tool frame: `linear (p - origin) + offset`. Of many poses, the last axes count them."""

    linear: Float[Array, "3 3"]
    origin: Float[Array, "3"]
    offset: Float[Array, "3"]


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def first_hit(surface: Surface, view: View, window: float, pixels: int, reach: float) -> Float[Array, "n n"]:
    """Tool z (m) of the first hit beyond -STANDOFF on each pixel's ray, +inf where there is none.

    Hits deeper than `reach` behind the nearest one may be missing (infinite reach: none is). Derivatives hold the
    visible faces fixed.
    """
    return _rasterise(surface, view, _Grid(window, pixels), reach, False)[0]


@first_hit.defjvp
def _first_hit_jvp(window, pixels, reach, primals, tangents):
    """Differentiate the planes of the faces that are seen."""
    surface, view = primals
    grid = _Grid(window, pixels)
    # What is seen is held fixed in derivatives of any order.
    heights, faces = _rasterise(jax.lax.stop_gradient(surface), jax.lax.stop_gradient(view), grid, reach, True)
    x, y = jnp.asarray(grid.centres)[None, :], jnp.asarray(grid.centres)[:, None]

    def plane(triangles, view):
        corners = jnp.moveaxis(triangles.at[faces].get(mode="promise_in_bounds"), (2, 3), (0, 1))
        (xa, ya, za), (xb, yb, zb), (xc, yc, zc) = (_to_tool(corner, view) for corner in corners)
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        seen = jnp.isfinite(heights) & (jnp.abs(area) >= FLAT)
        area = jnp.where(seen, area, 1)
        slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / area
        slope_y = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / area
        return jnp.where(seen, za + slope_x * (x - xa) + slope_y * (y - ya), 0)

    triangles = jnp.asarray(surface.triangles)
    _, change = jax.jvp(plane, (triangles, view), (tangents[0].triangles, tangents[1]))
    return heights, change


class _Grid:
    """Pixel centres of a window, and the square tiles that they fall into (the last ones may hang over the edge)."""

    def __init__(self, window: float, pixels: int):
        self.pixels, self.half, self.pitch = pixels, window / 2, window / pixels
        self.edge = TILE * -(-pixels // (TILE * (BITS - 1)))  # pixels; columns of tiles must fit a word
        self.side = -(-pixels // self.edge)
        self.tiles = self.side**2
        self.centres = ((np.arange(self.side * self.edge) + 0.5) * self.pitch - self.half)[:pixels].astype(np.float32)
        all_centres = ((np.arange(self.side * self.edge) + 0.5) * self.pitch - self.half).astype(np.float32)
        blocks = np.broadcast_to(
            all_centres.reshape(1, self.side, 1, self.edge), (self.side, self.side, self.edge, self.edge)
        )
        self.x = np.ascontiguousarray(blocks).reshape(self.tiles, -1)
        self.y = np.ascontiguousarray(blocks.transpose(1, 0, 3, 2)).reshape(self.tiles, -1)
        # What a tile's pixels span along one axis, with a twentieth of a pixel to spare for roundings.
        first = all_centres.reshape(self.side, self.edge)
        self.low, self.high = first[:, 0] - self.pitch / 20, first[:, -1] + self.pitch / 20

    def images(self, tiles):
        """(poses, tiles, pixels of a tile) -> (poses, n, n)."""
        whole = tiles.reshape(-1, self.side, self.side, self.edge, self.edge).swapaxes(2, 3)
        return whole.reshape(len(tiles), self.side * self.edge, -1)[:, : self.pixels, : self.pixels]

    def columns(self, low, high):
        """Bits of the columns of tiles that an interval along x touches."""
        width = self.edge * self.pitch
        first = jnp.clip(jnp.ceil((low - self.high[0]) / width), 0, self.side).astype(jnp.uint32)
        behind = jnp.clip(jnp.floor((high - self.low[0]) / width) + 1, 0, self.side).astype(jnp.uint32)
        return jnp.where(first < behind, (word(1) << behind) - (word(1) << first), word(0))


def _rasterise(surface: Surface, view: View, grid: _Grid, reach: float, with_faces: bool):
    """Heights (n, n) of the first hits and, if asked, the index of the face that each ray meets (n, n)."""

    @jax.custom_batching.custom_vmap
    def cast(meshes, mesh, linear, origin, offset):
        view = View(*(jnp.moveaxis(part, 0, -1) for part in (linear, origin, offset)))
        return _cast(meshes, mesh, view, grid, reach, with_faces)

    @cast.def_vmap
    def _(size, batched, meshes, mesh, *views):
        """A batch of batches of poses is a longer batch, and of meshes a longer list of them."""
        of_meshes, (of_mesh, *of_views) = batched[0], batched[1:]
        several = any(of_meshes)
        count = meshes[0].shape[1 if of_meshes[0] else 0]
        meshes, mesh, views = (
            jax.tree.map(lambda leaf, own: leaf if own else jnp.broadcast_to(leaf, (size, *leaf.shape)), *both)
            for both in (
                (meshes, tuple(own or not several for own in of_meshes)),
                (mesh, of_mesh),
                (tuple(views), tuple(of_views)),
            )
        )
        if several:
            meshes = jax.tree.map(_flat, meshes)
            mesh = mesh + count * _count(size)[:, None]
        hits = cast(meshes, _flat(mesh), *(_flat(part) for part in views))
        return jax.tree.map(lambda leaf: leaf.reshape(size, -1, *leaf.shape[1:]), hits), (True, True)

    meshes = tuple(jnp.asarray(part)[None] for part in (surface.triangles, surface.boxes, surface.groups))
    heights, faces = cast(meshes, jnp.zeros(1, jnp.int32), *(part[None] for part in view))
    poison = 0 * sum(jnp.sum(part) for part in view)  # a pose that is not finite gives an image that is not a number
    return heights[0] + poison, faces[0]


def _cast(meshes, mesh: Int[Array, " p"], view: View, grid: _Grid, reach: float, with_faces: bool):
    """Heights (p, n, n) that p poses see of their meshes, and the faces (p, n, n; zeros if not asked for)."""
    triangles, boxes, groups = meshes
    poses, count = len(mesh), boxes.shape[1]
    size = triangles.shape[1] // (count * GROUP)
    mesh_clusters = _Clusters(triangles.reshape(-1, size * 9), mesh, count * GROUP, size)
    boxes = boxes.reshape(-1, *boxes.shape[2:])
    listed = min(count, GROUPS)
    chunk = min(listed, 8)
    slots = min(SLOTS, listed * GROUP)
    every = _count(poses)[:, None]
    dtype = jnp.result_type(triangles.dtype, view.linear.dtype)

    seen, _ = _in_view(groups[mesh if len(groups) > 1 else slice(None)].swapaxes(0, 1), _spread(view, 1), grid.half)
    row = groups.shape[2] // BITS
    group_words = pack([seen[:, i * row : (i + 1) * row] for i in range(BITS)])
    group_sums = running_sums(group_words)

    def group_pass(number, carry):
        """Look into the groups of one pass: first at clusters near the front, then at what may still be in reach."""
        left = jnp.clip(group_sums[:, -1] - number * listed, 0, listed)
        at, bit = pick(group_words, group_sums, every, number * listed + _count(listed)[None])
        ids = jnp.minimum(bit * row + at, count - 1)

        def look(i):
            some = _cut(ids, (0, i * chunk), (poses, chunk))
            box = boxes.at[some + mesh[:, None] * count].get(mode="promise_in_bounds")
            hit, front = _in_view(jnp.moveaxis(box, 2, 0), _spread(view, 2), grid.half)
            hit &= (i * chunk + _count(chunk)[None] < left[:, None])[..., None]
            return jnp.where(hit, front, jnp.inf)

        chunks = jnp.max(-(-left // chunk))
        fronts = jnp.full((poses, listed, GROUP), jnp.inf, dtype)
        fronts = jax.lax.fori_loop(
            0, chunks, lambda i, fronts: _put(fronts, _apart(look, i, i < chunks), (0, i * chunk, 0)), fronts
        )
        slab = jnp.min(fronts, (1, 2)) + SLAB * reach

        def layer(i, carry):
            best = carry[0]
            low = jnp.where(i == 0, -jnp.inf, slab)[:, None, None]
            high = jnp.where(i == 0, slab, jnp.min(best[0], (1, 2)) + reach)[:, None, None]
            wanted = (fronts > low) & (fronts <= high) & (fronts < jnp.inf)
            words = pack([wanted[..., k] for k in range(GROUP)])
            sums = running_sums(words)
            passes = jnp.max(-(-sums[:, -1] // slots))
            draw = partial(_cluster_pass, _List(ids, words, sums), mesh_clusters, view, grid, slots)
            return jax.lax.fori_loop(0, passes, draw, carry)

        return jax.lax.fori_loop(0, 2, layer, carry)

    blank = jnp.full((poses, *grid.x.shape), jnp.inf, dtype)
    best = (blank, jnp.zeros(blank.shape, jnp.int32)) if with_faces else (blank,)
    # The last row of the scratch table, for tiles that have nothing to draw, has no inside.
    nothing = jnp.zeros((1, TERMS * size), dtype).at[:, 2 * size : 3 * size].set(-1)
    scratch = (
        jnp.concatenate([jnp.zeros((slots * poses, TERMS * size), dtype), nothing]),
        jnp.zeros((grid.side, slots * poses * size), jnp.uint32),
        jnp.zeros(slots * poses + 1, jnp.int32),
    )
    best, _ = jax.lax.fori_loop(0, jnp.max(-(-group_sums[:, -1] // listed)), group_pass, (best, scratch))
    heights = grid.images(best[0])
    return heights, grid.images(best[1]) if with_faces else jnp.zeros(heights.shape, jnp.int32)


class _Clusters(NamedTuple):
    """The faces of all meshes, a cluster a row."""

    rows: Float[Array, "clusters size*9"]
    mesh: Int[Array, " p"]  # of each pose
    per_mesh: int  # clusters
    size: int  # faces of a cluster


class _List(NamedTuple):
    """The clusters that each pose wants: bits of the groups it listed."""

    ids: Int[Array, "p groups"]
    words: UInt[Array, "p groups"]
    sums: Int[Array, "p groups"]


def _cluster_pass(wanted: _List, clusters: _Clusters, view: View, grid: _Grid, slots: int, number, carry):
    """Draw up to `slots` clusters of each pose into the tiles that they cross."""
    best, scratch = carry
    poses, size, dtype = len(wanted.ids), clusters.size, best[0].dtype
    now = jnp.clip(wanted.sums[:, -1] - number * slots, 0, slots)
    ends = jnp.cumsum(now)
    begins = ends - now  # of each pose's part of the list
    stride = BITS * poses  # clusters set up together
    rounds = -(-ends[-1] // stride)
    words_in_slots = slots // BITS

    def set_up(i):
        item = i * stride + _count(stride)
        pose = jnp.minimum(jnp.searchsorted(ends, item, side="right"), poses - 1).astype(jnp.int32)
        order = item - begins[pose] + number * slots
        at, bit = pick(wanted.words, wanted.sums, pose, order)
        name = wanted.ids.at[pose, at].get(mode="promise_in_bounds") * GROUP + bit
        corners = clusters.rows.at[clusters.mesh[pose] * clusters.per_mesh + name].get(mode="promise_in_bounds")
        corners = corners.reshape(stride * size, 3, 3).transpose(1, 2, 0)
        here = jax.tree.map(lambda part: jnp.repeat(part[..., pose], size, -1), view)
        placed = [_to_tool(corner, here) for corner in corners]
        terms, drawn = _face_terms(placed, grid.half)
        drawn &= i * stride + _count(stride * size) // size < ends[-1]
        span = jnp.where(drawn[None], _spans(placed, grid), word(0))
        terms = jnp.stack(terms).reshape(TERMS, stride, size).swapaxes(0, 1).reshape(stride, TERMS * size)
        return terms, span, name

    def store(i, carry):
        faces, spans, names = carry
        terms, span, name = _apart(set_up, i, i < rounds)
        return (
            _put(faces, terms, (i * stride, 0)),
            _put(spans, span, (0, i * stride * size)),
            _put(names, name, (i * stride,)),
        )

    faces, spans, names = jax.lax.fori_loop(0, rounds, store, scratch)

    def merge(i, rows):
        block = _cut(spans, (0, i * stride * size), (grid.side, stride * size)).reshape(grid.side, stride, size)
        return _put(rows, either([block[..., f] for f in range(size)]), (0, i * stride))

    rows = jax.lax.fori_loop(0, rounds, merge, jnp.zeros((grid.side, slots * poses), jnp.uint32))

    def turn(i, tile_words):
        mine = i * BITS + _count(BITS)[None]
        block = rows.at[:, jnp.minimum(begins[:, None] + mine, slots * poses - 1)].get(mode="promise_in_bounds")
        block = jnp.where((mine < now[:, None])[None], block, word(0))
        column = jnp.arange(grid.side, dtype=jnp.uint32)[None, :, None]
        bits = pack([(block[:, :, b][:, None] >> column) & word(1) for b in range(BITS)])
        return _put(tile_words, bits.reshape(1, grid.tiles, poses).swapaxes(1, 2).reshape(1, -1), (i, 0))

    lanes = poses * grid.tiles
    tile_words = jnp.zeros((words_in_slots, lanes), jnp.uint32)
    tile_words = jax.lax.fori_loop(0, jnp.max(-(-now // BITS)), turn, tile_words)
    todo = sum(ones(tile_words[w]) for w in range(words_in_slots))
    full = either([jnp.where(tile_words[w] != 0, word(1 << w), word(0)) for w in range(words_in_slots)])
    queue = _Queue(full, jnp.zeros_like(full), jnp.zeros_like(todo))
    table = _Table(faces, names, size)
    begin = jnp.broadcast_to(begins[:, None], (poses, grid.tiles)).reshape(-1)
    x, y = (jnp.asarray(part, dtype) for part in (grid.x, grid.y))

    # All tiles together while many are at work, then the busiest few, in shares that are each run to their end.
    together = jax.lax.while_loop(lambda t: jnp.sum(todo > t) > MANY * lanes, lambda t: t + 1, jnp.int32(0))
    queue, best = _draw(together, table, begin, tile_words, queue, best, x[None], y[None])
    todo = jnp.maximum(todo - together, 0)
    shares = SHARES if poses >= SHARES else 1
    share = max(1, lanes // 4 // shares)

    def finish(i, carry):
        best, todo = carry
        amount, busy = jax.lax.top_k(todo.astype(jnp.float32), share * shares)

        def run(k, best):
            those = _cut(busy, (k * share,), (share,))
            take = partial(jax.tree.map, lambda a: a.at[those].get(mode="promise_in_bounds"))
            words = tile_words.at[:, those].get(mode="promise_in_bounds")
            trips = amount[k * share].astype(jnp.int32)
            across, down = (part[those % grid.tiles] for part in (x, y))
            _, drawn = _draw(trips, table, take(begin), words, take(queue), take(best), across, down)
            put = partial(jax.tree.map, lambda a, b: a.at[those].set(b, mode="promise_in_bounds", unique_indices=True))
            return put(best, drawn)

        best = jax.lax.fori_loop(0, -(-jnp.sum(amount > 0) // share), run, best)
        return best, todo.at[busy].set(0, mode="promise_in_bounds", unique_indices=True)

    turns = -(-jnp.sum(todo > 0) // (share * shares))
    flat = jax.tree.map(lambda part: part.reshape(lanes, -1), best)
    flat, _ = jax.lax.fori_loop(0, turns, finish, (flat, todo))
    return jax.tree.map(lambda part, like: part.reshape(like.shape), flat, best), (faces, spans, names)


class _Queue(NamedTuple):
    """Clusters that tiles have still to draw: bits of the words not yet opened, bits left in the current word, its
    index.
    """

    full: UInt[Array, " tiles"]
    current: UInt[Array, " tiles"]
    word: Int[Array, " tiles"]


class _Table(NamedTuple):
    """Clusters set up for drawing, a cluster a row; the last row draws nothing."""

    faces: Float[Array, "rows terms"]
    names: Int[Array, " rows"]
    size: int  # faces of a cluster


def _draw(trips, table: _Table, begin, words, queue: _Queue, best, x, y):
    """Pop `trips` clusters from each tile's queue and keep the nearest hits.

    `begin` is where the pose's clusters begin in the table. Tiles are one axis, or a pose's tiles on the last of two.
    """
    lane = _count(len(begin))
    shape = best[0].shape
    nothing, size = len(table.faces) - 1, table.size

    def trip(_, carry):
        (full, current, at), best = carry
        fresh = (current == 0) & (full != 0)
        at = jnp.where(fresh, lowest(full), at)
        current = jnp.where(fresh, words.at[at, lane].get(mode="promise_in_bounds"), current)
        full = jnp.where(fresh, full & (full - word(1)), full)
        slot = jnp.where(current == 0, nothing, begin + at * BITS + lowest(current))
        row = table.faces.at[slot].get(mode="promise_in_bounds").reshape(*shape[:-1], TERMS * size)
        for f in range(size):
            A0, B0, C0, A1, B1, C1, A2, B2, C2, slope_x, slope_y, base, low = (
                row[..., k * size + f][..., None] for k in range(TERMS)
            )
            height = _larger(slope_x * x + (slope_y * y + base), low)
            inside = _smaller(_smaller(A0 * x + (B0 * y + C0), A1 * x + (B1 * y + C1)), A2 * x + (B2 * y + C2))
            height = jnp.where(_smaller(inside, height + STANDOFF) >= 0, height, jnp.inf)
            if len(best) == 2:
                name = table.names.at[slot].get(mode="promise_in_bounds").reshape(shape[:-1]) * size + f
                best = (_smaller(best[0], height), jnp.where(height < best[0], name[..., None], best[1]))
            else:
                best = (_smaller(best[0], height),)
        return _Queue(full, current & (current - word(1)), at), best

    return jax.lax.fori_loop(0, trips, trip, (queue, best))


def _face_terms(corners, half):
    """The numbers of faces in the tool frame, and which of them can be hit at all."""
    (xa, ya, za), (xb, yb, zb), (xc, yc, zc) = corners
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    flat = ~((jnp.abs(area) >= FLAT) & (jnp.abs(area) < jnp.inf))  # or not a number: never met
    side = jnp.sign(area)
    tolerance = ROUNDINGS * float(jnp.finfo(area.dtype).eps)

    def edge(xp, yp, xq, yq):
        A, B = (jnp.where(flat, 0, side * run) for run in (yp - yq, xq - xp))
        slack = tolerance * (jnp.abs(A) * (jnp.abs(xp) + half) + jnp.abs(B) * (jnp.abs(yp) + half))
        return A, B, jnp.where(flat, -1, slack - (A * xp + B * yp))

    A0, B0, C0 = edge(xa, ya, xb, yb)
    area = jnp.where(flat, 1, area)
    slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / area
    slope_y = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / area
    base = za - slope_x * xa - slope_y * ya
    # A steep plane means nothing beside its edge, where the tolerance still counts it: never nearer than a corner.
    lowest, highest = _smaller(_smaller(za, zb), zc), _larger(_larger(za, zb), zc)
    edges = (A0, B0, C0, *edge(xb, yb, xc, yc), *edge(xc, yc, xa, ya))
    return (*edges, slope_x, slope_y, base, lowest), ~flat & (highest >= -STANDOFF)


def _spans(corners, grid):
    """Bits of the tiles that faces cross: for each row of tiles (rows, faces), the columns between the ends of the
    face in that strip.
    """
    low, high = jnp.asarray(grid.low)[:, None], jnp.asarray(grid.high)[:, None]
    left, right = jnp.full((), jnp.inf), jnp.full((), -jnp.inf)
    for (xp, yp, _), (xq, yq, _) in zip(corners, corners[1:] + corners[:1], strict=True):
        rise = yq - yp
        slope = ((xq - xp) / jnp.where(jnp.abs(rise) < 1e-12, 1e-12, rise))[None]
        xp, yp, xq, yq = xp[None], yp[None], xq[None], yq[None]
        at_low, at_high = xp + (low - yp) * slope, xp + (high - yp) * slope
        in_strip = (_larger(yp, yq) >= low) & (_smaller(yp, yq) <= high)
        start = _larger(_smaller(at_low, at_high), _smaller(xp, xq))
        end = _smaller(_larger(at_low, at_high), _larger(xp, xq))
        left = jnp.where(in_strip, _smaller(start, left), left)
        right = jnp.where(in_strip, _larger(end, right), right)
    return grid.columns(left, right)


def _in_view(box, view, half):
    """Which boxes (centre and half extents, six arrays) the rays can meet, and the z where each begins."""
    centre = _to_tool(box[:3], view)
    reach = [sum(jnp.abs(view.linear[i, j]) * box[3 + j] for j in range(3)) for i in range(3)]
    front, back = centre[2] - reach[2], centre[2] + reach[2]
    inside = (jnp.abs(centre[0]) - reach[0] <= half) & (jnp.abs(centre[1]) - reach[1] <= half)
    return inside & (back >= -STANDOFF), jnp.maximum(front, -STANDOFF)


def _to_tool(point, view):
    """Coordinates (three arrays) in the tool frame; the origin is subtracted first, where it costs no digits."""
    local = [point[j] - view.origin[j] for j in range(3)]
    return [sum((view.linear[i, j] * local[j] for j in range(3)), view.offset[i]) for i in range(3)]


def _spread(view: View, axes: int) -> View:
    """The view of poses on the first of `axes` + 1 axes."""
    return jax.tree.map(lambda part: part.reshape(*part.shape, *(1,) * axes), view)


def _apart(work, i, holds):
    """work(i), kept apart from its storing by a condition that always holds: XLA would merge the two, and a merged one
    runs on a single core.
    """
    return jax.lax.cond(holds, work, lambda i: jax.tree.map(jnp.zeros_like, jax.eval_shape(work, i)), i)


def _flat(array):
    return array.reshape(-1, *array.shape[2:])


def _cut(array, start, shape):
    return jax.lax.dynamic_slice(array, [jnp.asarray(i, jnp.int32) for i in start], shape)


def _put(array, block, start):
    return jax.lax.dynamic_update_slice(array, block, [jnp.asarray(i, jnp.int32) for i in start])


def _count(n):
    return jnp.arange(n, dtype=jnp.int32)


def _smaller(a, b):
    """Minimum of numbers that are not NaN: one instruction, where `jnp.minimum` takes several to pass NaN on."""
    return jnp.where(a < b, a, b)


def _larger(a, b):
    return jnp.where(a > b, a, b)
