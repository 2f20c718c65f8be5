"""First hits of parallel rays on triangles: exact rasterisation of clustered faces in tiles of pixels.

In the tool frame a ray is a point (x, y) and a face a triangle whose inside is where its three edge functions `A x + B
y + C` are positive; the plane through its corners gives z. Neighbouring faces share their corners to the last bit, so a
tolerance of a few roundings on every edge closes the cracks between them.

Work goes from coarse to fine, and what it cannot need is never touched. Boxes name the groups, then the clusters, that
the window can see no deeper than the reach behind the nearest hit; their faces are turned into edge functions once a
pose; every tile keeps a bit for each cluster that crosses it, and tiles pop their bits together, a cluster at a time.
When most tiles are done the busiest few go on alone. All lists are worked off in passes of a fixed length, so that
scratch memory is small and constant and no list can overflow.

Loops end when the whole batch is done (`_most`), so their counters are plain numbers under `vmap` and no result has to
be masked. Work is split where XLA should store an intermediate: inside one loop body it would rather compute a cheap
value again for each of its uses.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt

from i2t.clusters import GROUP
from i2t.types import STANDOFF, Surface

TILE = 8  # pixels along the edge of a tile
GROUPS = 64  # groups listed in one pass
SLOTS = 96  # clusters set up in one pass, a multiple of 32
SLAB = 2  # reaches behind the first box: what is drawn first, to learn how near the surface is
ROUNDINGS = 4  # tolerance of an edge, in roundings of its corners' coordinates
FLAT = 1e-16  # m^2, below this projected area a face is seen edge on
BITS = 32
TERMS = 13  # numbers of a face: three edges, its plane, its lowest corner


class View(NamedTuple):
    """How points come to the tool frame: `linear (p - origin) + offset`."""

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
    heights, faces = _rasterise(surface, view, grid, reach, True)
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

    def image(self, tiles):
        """(tiles, pixels of a tile) -> (n, n)."""
        whole = tiles.reshape(self.side, self.side, self.edge, self.edge).transpose(0, 2, 1, 3)
        return whole.reshape(self.side * self.edge, -1)[: self.pixels, : self.pixels]

    def columns(self, low, high):
        """Bits of the columns of tiles that an interval along x touches."""
        width = self.edge * self.pitch
        first = jnp.clip(jnp.ceil((low - self.high[0]) / width), 0, self.side).astype(jnp.uint32)
        behind = jnp.clip(jnp.floor((high - self.low[0]) / width) + 1, 0, self.side).astype(jnp.uint32)
        return jnp.where(first < behind, (_word(1) << behind) - (_word(1) << first), _word(0))


def _rasterise(surface: Surface, view: View, grid: _Grid, reach: float, with_faces: bool):
    """Heights (n, n) of the first hits and, if asked, the index of the face that each ray meets (n, n)."""
    triangles, boxes, groups = jnp.asarray(surface.triangles), jnp.asarray(surface.boxes), jnp.asarray(surface.groups)
    count = boxes.shape[0]
    size = triangles.shape[0] // (count * GROUP)
    clusters = triangles.reshape(count * GROUP, size * 9)
    listed = min(count, GROUPS)
    chunk = min(listed, 8)
    slots = min(SLOTS, listed * GROUP)
    words_in_slots = slots // BITS
    lanes = max(1, grid.tiles // 4)
    dtype = jnp.result_type(triangles.dtype, view.linear.dtype)
    x, y = jnp.asarray(grid.x, dtype), jnp.asarray(grid.y, dtype)

    seen, _ = _in_view(list(groups), view, grid.half)
    row = groups.shape[1] // BITS
    group_words = _pack([seen[i * row : (i + 1) * row] for i in range(BITS)])
    group_sums = _running_sum(group_words)

    def group_pass(number, best):
        """Look into the groups of one pass: first at clusters near the front, then at what may still be in reach."""
        left = jnp.clip(group_sums[-1] - number * listed, 0, listed)
        word, bit = _pick(group_words, group_sums, number * listed + _count(listed))
        ids = jnp.minimum(bit * row + word, count - 1)

        def look(i, fronts):
            some = _cut(ids, (i * chunk,), (chunk,))
            box = boxes.at[some].get(mode="promise_in_bounds")
            hit, front = _in_view([box[:, k] for k in range(6)], view, grid.half)
            hit &= (i * chunk + _count(chunk) < left)[:, None]
            return _put(fronts, jnp.where(hit, front, jnp.inf), (i * chunk, 0))

        chunks = -(-left // chunk)
        fronts = jax.lax.fori_loop(0, _most(chunks), look, jnp.full((listed, GROUP), jnp.inf, dtype))
        slab = jnp.min(fronts) + SLAB * reach

        def layer(i, best):
            low = jnp.where(i == 0, -jnp.inf, slab)
            high = jnp.where(i == 0, slab, jnp.min(best[0]) + reach)
            wanted = (fronts > low) & (fronts <= high) & (fronts < jnp.inf)
            cluster_words = _pack([wanted[:, k] for k in range(GROUP)])
            cluster_sums = _running_sum(cluster_words)
            passes = -(-cluster_sums[-1] // slots)
            draw = partial(cluster_pass, ids, cluster_words, cluster_sums)
            return jax.lax.fori_loop(0, _most(passes), draw, best)

        return jax.lax.fori_loop(0, 2, layer, best)

    def cluster_pass(ids, cluster_words, cluster_sums, number, best):
        """Draw the clusters of one pass into the tiles that they cross."""
        now = jnp.clip(cluster_sums[-1] - number * slots, 0, slots)
        rounds = _most(-(-now // BITS))

        def set_up(i, carry):
            faces, spans, names = carry
            word, bit = _pick(cluster_words, cluster_sums, number * slots + i * BITS + _count(BITS))
            name = ids.at[word].get(mode="promise_in_bounds") * GROUP + bit
            corners = clusters.at[name].get(mode="promise_in_bounds").reshape(BITS, size, 9)
            corners = corners.transpose(2, 0, 1).reshape(3, 3, BITS * size)
            placed = [_to_tool(corner, view) for corner in corners]
            terms, drawn = _face_terms(placed, grid.half)
            terms = jnp.stack(terms).reshape(TERMS, BITS, size).transpose(1, 0, 2).reshape(BITS, TERMS * size)
            drawn &= i * BITS + _count(BITS * size) // size < now
            span = jnp.where(drawn[None], _spans(placed, grid), _word(0))
            return (
                _put(faces, terms, (i * BITS, 0)),
                _put(spans, span, (0, i * BITS * size)),
                _put(names, name, (i * BITS,)),
            )

        blank = (
            jnp.zeros((slots, TERMS * size), dtype),
            jnp.zeros((grid.side, slots * size), jnp.uint32),
            jnp.zeros(slots, jnp.int32),
        )
        faces, spans, names = jax.lax.fori_loop(0, rounds, set_up, blank)

        def merge(i, rows):
            block = _cut(spans, (0, i * BITS * size), (grid.side, BITS * size))
            block = block.reshape(grid.side, BITS, size)
            row = _either([block[..., f] for f in range(size)])
            return _put(rows, row, (0, i * BITS))

        rows = jax.lax.fori_loop(0, rounds, merge, jnp.zeros((grid.side, slots), jnp.uint32))

        def turn(i, tile_words):
            block = _cut(rows, (0, i * BITS), (grid.side, BITS))
            column = jnp.arange(grid.side, dtype=jnp.uint32)[None, :]
            word = _pack([(block[:, b][:, None] >> column) & 1 for b in range(BITS)])
            return _put(tile_words, word.reshape(1, grid.tiles), (i, 0))

        tile_words = jax.lax.fori_loop(0, rounds, turn, jnp.zeros((words_in_slots, grid.tiles), jnp.uint32))
        todo = sum(_ones(tile_words[w]) for w in range(words_in_slots))
        full = _either([jnp.where(tile_words[w] != 0, _word(1 << w), _word(0)) for w in range(words_in_slots)])
        queue = _Queue(full, jnp.zeros_like(full), jnp.zeros_like(todo))

        # All tiles together for the mean of their work, then the busiest quarter at a time to its end.
        together = _most(-(-jnp.sum(todo) // grid.tiles))
        queue, best = _draw(together, faces, names, size, tile_words, queue, best, x, y)
        todo = jnp.maximum(todo - together, 0)

        def finish(i, carry):
            best, todo = carry
            _, busy = jax.lax.top_k(todo.astype(jnp.float32), lanes)
            those = partial(jax.tree.map, lambda a: a.at[busy].get(mode="promise_in_bounds"))
            words = tile_words.at[:, busy].get(mode="promise_in_bounds")
            trips = _most(jnp.max(those(todo)))
            _, drawn = _draw(trips, faces, names, size, words, those(queue), those(best), those(x), those(y))
            put = partial(jax.tree.map, lambda a, b: a.at[busy].set(b, mode="promise_in_bounds", unique_indices=True))
            return put(best, drawn), todo.at[busy].set(0, mode="promise_in_bounds", unique_indices=True)

        turns = _most(-(-jnp.sum(todo > 0) // lanes))
        return jax.lax.fori_loop(0, turns, finish, (best, todo))[0]

    blank = jnp.full(grid.x.shape, jnp.inf, dtype)
    best = (blank, jnp.zeros(grid.x.shape, jnp.int32)) if with_faces else (blank,)
    best = jax.lax.fori_loop(0, _most(-(-group_sums[-1] // listed)), group_pass, best)
    poison = 0 * sum(jnp.sum(part) for part in view)  # a pose that is not finite gives an image that is not a number
    return grid.image(best[0]) + poison, grid.image(best[1]) if with_faces else None


class _Queue(NamedTuple):
    """Clusters that tiles have still to draw: bits of the words not yet opened, bits left in the current word, its
    index.
    """

    full: UInt[Array, " tiles"]
    current: UInt[Array, " tiles"]
    word: Int[Array, " tiles"]


def _draw(trips, faces, names, size, words, queue, best, x, y):
    """Pop `trips` clusters from each tile's queue and keep the nearest hits; a tile that is done draws some cluster
    again, which changes nothing.
    """
    lane = _count(x.shape[0])

    def trip(_, carry):
        (full, current, word), best = carry
        fresh = (current == 0) & (full != 0)
        word = jnp.where(fresh, _lowest(full), word)
        current = jnp.where(fresh, words.at[word, lane].get(mode="promise_in_bounds"), current)
        full = jnp.where(fresh, full & (full - _word(1)), full)
        slot = jnp.where(current == 0, 0, word * BITS + _lowest(current))
        row = faces.at[slot].get(mode="promise_in_bounds")
        for f in range(size):
            A0, B0, C0, A1, B1, C1, A2, B2, C2, slope_x, slope_y, base, lowest = (
                row[:, k * size + f][:, None] for k in range(TERMS)
            )
            height = _larger(slope_x * x + (slope_y * y + base), lowest)
            inside = _smaller(_smaller(A0 * x + (B0 * y + C0), A1 * x + (B1 * y + C1)), A2 * x + (B2 * y + C2))
            height = jnp.where(_smaller(inside, height + STANDOFF) >= 0, height, jnp.inf)
            if len(best) == 2:
                name = names.at[slot].get(mode="promise_in_bounds") * size + f
                best = (_smaller(best[0], height), jnp.where(height < best[0], name[:, None], best[1]))
            else:
                best = (_smaller(best[0], height),)
        return _Queue(full, current & (current - _word(1)), word), best

    return jax.lax.fori_loop(0, trips, trip, (queue, best))


def _face_terms(corners, half):
    """The numbers of faces in the tool frame, and which of them can be hit at all."""
    (xa, ya, za), (xb, yb, zb), (xc, yc, zc) = corners
    area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    flat = jnp.abs(area) < FLAT
    side = jnp.where(flat, 0, jnp.sign(area))
    tolerance = ROUNDINGS * float(jnp.finfo(area.dtype).eps)

    def edge(xp, yp, xq, yq):
        A, B = side * (yp - yq), side * (xq - xp)
        slack = tolerance * (jnp.abs(A) * (jnp.abs(xp) + half) + jnp.abs(B) * (jnp.abs(yp) + half))
        return A, B, slack - (A * xp + B * yp)

    A0, B0, C0 = edge(xa, ya, xb, yb)
    area = jnp.where(flat, 1, area)
    slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / area
    slope_y = ((zc - za) * (xb - xa) - (zb - za) * (xc - xa)) / area
    base = za - slope_x * xa - slope_y * ya
    # A steep plane means nothing beside its edge, where the tolerance still counts it: never nearer than a corner.
    lowest, highest = _smaller(_smaller(za, zb), zc), _larger(_larger(za, zb), zc)
    edges = (A0, B0, jnp.where(flat, -1, C0), *edge(xb, yb, xc, yc), *edge(xc, yc, xa, ya))
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


def _pick(words, sums, order):
    """Word and bit of the set bits of number `order` in a bit list, whose running sums of set bits are `sums`."""
    order = order.astype(jnp.int32)
    word, before = jnp.zeros_like(order), jnp.zeros_like(order)
    for i in range(words.shape[0] - 1):
        past = order >= sums[i]
        word, before = jnp.where(past, i + 1, word), jnp.where(past, sums[i], before)
    rest, bits, bit = order - before, words.at[word].get(mode="promise_in_bounds"), jnp.zeros_like(order)
    for width in (16, 8, 4, 2, 1):
        below = _ones(bits & _word((1 << width) - 1))
        upper = rest >= below
        bit = jnp.where(upper, bit + width, bit)
        rest, bits = jnp.where(upper, rest - below, rest), jnp.where(upper, bits >> _word(width), bits)
    return word, bit


def _pack(flags):
    """Words whose bit i is flags[i]."""
    return _either([flag.astype(jnp.uint32) << _word(i) for i, flag in enumerate(flags)])


def _either(words):
    """All set bits of several words."""
    total = words[0]
    for word in words[1:]:
        total = total | word
    return total


def _running_sum(words):
    """How many bits are set up to and including each word, as a product with a triangle of ones (exact below 2^24)."""
    ones = _ones(words).astype(jnp.float32)
    return (ones @ jnp.triu(jnp.ones((len(words), len(words)), jnp.float32))).astype(jnp.int32)


def _cut(array, start, shape):
    return jax.lax.dynamic_slice(array, [jnp.asarray(i, jnp.int32) for i in start], shape)


def _put(array, block, start):
    return jax.lax.dynamic_update_slice(array, block, [jnp.asarray(i, jnp.int32) for i in start])


def _count(n):
    return jnp.arange(n, dtype=jnp.int32)


def _ones(words):
    return jax.lax.population_count(words).astype(jnp.int32)


def _lowest(words):
    """Index of the lowest set bit (-1 if there is none)."""
    return 31 - jax.lax.clz(words & (~words + _word(1))).astype(jnp.int32)


def _word(value):
    return np.uint32(value)


def _smaller(a, b):
    """Minimum of numbers that are not NaN: one instruction, where `jnp.minimum` takes several to pass NaN on."""
    return jnp.where(a < b, a, b)


def _larger(a, b):
    return jnp.where(a > b, a, b)


@jax.custom_batching.custom_vmap
def _most(n):
    """A loop's trip count: the largest in the batch, for all of it."""
    return n


@_most.def_vmap
def _most_of_batch(axis_size, in_batched, n):
    return _most(jnp.max(n)), False
