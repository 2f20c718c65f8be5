"""Polygons in space to triangles, without new vertices.

CAD programs write the caps of channels, slots and holes as one polygon that need not be convex. A fan from its first
corner would fill the slot. A fan is used only where each of its triangles lies in the polygon; the other polygons are
cut by ear clipping in their plane (G. H. Meisters, "Polygons have ears", 1975). A polygon may touch itself, as one does
whose holes are joined to its rim by a bridge; one that crosses itself has no inside and is refused.

A corner in the middle of a straight side stays a corner of some triangle with an area: neighbouring faces use it, and a
surface without it would be open there.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError

ROUNDING = 1e-6  # of the surface's size: how straight a line is that a file gives with seven digits
BLOCK = 2**20  # corners that are looked at together, which bounds the memory
MAX_CLIPPED_SQUARED = 7000**2  # sum of squared corners of polygons that are clipped: the time of ear clipping
FULL_TURN = 2 * np.pi - 1e-3  # rad, that a fan may sweep around its first corner


def triangulate(
    vertices: NDArray[np.float64], corners: NDArray[np.int64], sizes: NDArray[np.int64], name: Callable[[int], str]
) -> NDArray[np.int64]:
    """Cut polygons into triangles.

    Args:
        vertices: Coordinates `(n, 3)` in any unit.
        corners: Indices of vertices `(sum of sizes,)`, polygon after polygon, each in order around it.
        sizes: Numbers of corners `(polygons,)`, at least three each.
        name: Says in messages which file and which polygon a number stands for.

    Returns:
        Triangles `(m, 3)` in the order of their polygons, turned as these are, of the same total area. A polygon
        without an area is one triangle without an area.

    Raises:
        DataError: A polygon crosses itself, or those that are not convex have too many corners.
    """
    if (sizes == 3).all():
        return corners.reshape(-1, 3)
    corners, sizes = _without_repeats(corners, sizes)
    starts, counts = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 1)
    places = np.cumsum(counts) - counts
    faces = np.full((counts.sum(), 3), -1)
    faces[places[sizes < 3]] = corners[np.minimum(starts[sizes < 3], max(len(corners) - 1, 0)), None]
    work, width = 0, _rounding(vertices[corners])
    for size in np.unique(sizes[sizes >= 3]):
        polygons = np.flatnonzero(sizes == size)
        for block in np.array_split(polygons, -(-len(polygons) * size // BLOCK)):
            loops = corners[starts[block, None] + np.arange(size)]
            fans, right = _fans(vertices, loops, width)
            faces[places[block, None] + np.arange(size - 2)] = fans
            work += int(size**2 * (~right).sum())
            if work > MAX_CLIPPED_SQUARED:
                raise DataError(
                    f"{name(int(block[0]))} and others are not convex and have {size} corners, which takes too long "
                    "here; split the polygons into triangles (in Blender: Triangulate Faces)"
                )
            for polygon, loop in zip(block[~right], loops[~right], strict=True):
                pieces = _clipped(vertices[loop], width)
                if pieces is None:
                    raise DataError(
                        f"{name(int(polygon))} has {size} corners and crosses itself; repair it, or split it into "
                        "triangles (in Blender: Triangulate Faces)"
                    )
                faces[places[polygon] : places[polygon] + size - 2] = -1
                faces[places[polygon] : places[polygon] + len(pieces)] = loop[pieces]
    return faces[faces[:, 0] >= 0]


def strip_triangles(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut a strip into its triangles.

    Args:
        corners: Indices of vertices `(n,)` along the strip.

    Returns:
        Triangles `(m, 3)`, each second one turned. Those with a repeated corner, which join strips, are left out.
    """
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], 1) if len(corners) > 2 else np.empty((0, 3), np.int64)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces[(faces != np.roll(faces, 1, 1)).all(1)]


def _rounding(points: NDArray) -> float:
    """How far corners may be from where they are meant to be, in a file with seven digits or in float32."""
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return 0.0
    low, high = points.min(0), points.max(0)
    return float(max(ROUNDING * (high - low).max(), np.finfo(np.float32).eps * max(abs(low).max(), abs(high).max())))


def _without_repeats(corners: NDArray, sizes: NDArray) -> tuple[NDArray, NDArray]:
    """Polygons without corners that repeat the one before them, as exporters of nothing but quads write triangles."""
    ends = np.cumsum(sizes)
    before = np.arange(len(corners)) - 1
    before[ends - sizes] = ends - 1
    fresh = corners != corners[before]
    fresh[ends - sizes] |= ~np.logical_or.reduceat(fresh, ends - sizes)  # one is left where all are the same
    return corners[fresh], np.add.reduceat(fresh.astype(np.int64), ends - sizes)


def _fans(vertices: NDArray, loops: NDArray, width: float) -> tuple[NDArray, NDArray]:
    """Triangles `(p, n - 2, 3)` of the fans of p polygons of n corners, and a mask `(p,)` of those that are right.

    A fan is right where all its triangles have the polygon's orientation and sweep less than a full turn. Of a quad,
    the fan from the second corner is used where that from the first is wrong.
    """
    count, size = loops.shape
    if size == 3:
        return loops[:, None], np.ones(count, bool)
    fans = _fan(loops)
    right = _is_right(vertices[fans], width)
    if size == 4 and not right.all():
        others = _fan(np.roll(loops[~right], -1, 1))
        swap = _is_right(vertices[others], width)
        fans[np.flatnonzero(~right)[swap]] = others[swap]
        right[~right] = swap
    return fans, right


def _fan(loops: NDArray) -> NDArray:
    return np.stack(np.broadcast_arrays(loops[:, :1], loops[:, 1:-1], loops[:, 2:]), 2)


def _is_right(triangles: NDArray, width: float) -> NDArray:
    """Mask `(p,)` of fans `(p, m, 3, 3)` that lie in their polygon."""
    a, b, c = np.moveaxis(triangles, 2, 0)
    ab, ac, bc = b - a, c - a, c - b
    areas = np.cross(ab, ac)
    normal = areas.sum(1)
    longest = np.max([np.einsum("pmi,pmi->pm", side, side) for side in (ab, ac, bc)], 0)
    along, squared = np.einsum("pmi,pi->pm", areas, normal), np.einsum("pi,pi->p", normal, normal)
    right = (along > width * np.sqrt(longest * squared[:, None])).all(1)
    if triangles.shape[1] > 2:
        sweep = np.arctan2(np.linalg.norm(areas, axis=2), np.einsum("pmi,pmi->pm", ab, ac))
        right &= sweep.sum(1) < FULL_TURN
    return right


def _clipped(points: NDArray, width: float) -> NDArray | None:
    """Triangles `(m, 3)`, as numbers of corners, of a polygon `(n, 3)`; None where it crosses itself."""
    size, none = len(points), np.zeros((1, 3), np.int64)
    if not np.isfinite(points).all():  # whoever asks for finite vertices is to see it
        return _fan(np.arange(size)[None])[0]
    centred = points - points.mean(0)
    _, spreads, axes = np.linalg.svd(centred, full_matrices=False)
    normal = np.cross(centred, np.roll(centred, -1, 0)).sum(0)
    if normal @ np.cross(axes[0], axes[1]) < 0:
        axes[1] = -axes[1]
    if np.linalg.norm(normal) > width * spreads[0]:  # else it is narrow, goes there and back, or crosses itself
        x = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        axes = np.stack([x / np.linalg.norm(x), np.cross(normal, x) / np.linalg.norm(np.cross(normal, x))])
    flattened = centred @ axes[:2].T
    pieces = None
    if not _crosses_itself(flattened, width):
        attempts = (_clip_ears(flattened, width, folded=folded) for folded in (False, True))
        pieces = next((attempt for attempt in attempts if attempt is not None), None)
    return none if pieces is not None and not len(pieces) else pieces


def _cross(a: NDArray, b: NDArray) -> NDArray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _crosses_itself(points: NDArray, width: float) -> bool:
    """Tell whether two sides of a polygon `(n, 2)` cross in their insides; to touch is no crossing."""
    ends = np.roll(points, -1, 0)
    along = ends - points
    along = along / np.maximum(np.linalg.norm(along, axis=1), np.finfo(float).tiny)[:, None]
    (left, bottom), (right, top) = np.minimum(points, ends).T, np.maximum(points, ends).T
    for i, (first, last, direction) in enumerate(zip(points, ends, along, strict=True)):
        near = (left <= right[i]) & (right >= left[i]) & (bottom <= top[i]) & (top >= bottom[i])
        p, q, way = points[near], ends[near], along[near]
        start, end = _cross(direction, p - first), _cross(direction, q - first)
        before, after = _cross(way, first - p), _cross(way, last - p)
        apart = np.minimum(np.minimum(abs(start), abs(end)), np.minimum(abs(before), abs(after))) > width
        if (apart & (start * end < 0) & (before * after < 0)).any():
            return True
    return False


def _clip_ears(points: NDArray, width: float, *, folded: bool = False) -> NDArray | None:
    """Triangles `(m, 3)` of a polygon `(n, 2)` that runs anticlockwise, ear after ear; None where it overlaps itself.

    After a cut only the two corners next to it can have become ears, so that each cut costs one look at the others.
    Spikes without a width, which run out and back, go first: a triangle next to one might cover it. With `folded` they
    are also those that run back by other corners than they ran out by.
    """
    size = len(points)
    before, after = np.roll(np.arange(size), 1).tolist(), np.roll(np.arange(size), -1).tolist()
    place = list(map(tuple, points.tolist()))
    there, left, triangles = np.ones(size, bool), size, []
    for tolerance, touching in ((math.inf, False), (width, False), (0.0, False), (0.0, True)):
        candidates = deque(np.flatnonzero(there).tolist())
        while candidates and left > 2:
            tip = candidates.popleft()
            a, c = before[tip], after[tip]
            if not there[tip]:
                continue
            flat = place[c] in (place[tip], place[a])  # then nothing is between the two sides
            flat = flat or (folded and _runs_back(place[a], place[tip], place[c], width))
            if not flat and (tolerance > width or not _is_ear(points[[a, tip, c]], points[there], tolerance, touching)):
                continue
            if not flat:
                triangles.append((a, tip, c))
            after[a], before[c], there[tip] = c, a, False
            left -= 1
            candidates.extend((a, c))
    pieces = np.array(triangles, np.int64).reshape(-1, 3)
    a, b, c = np.moveaxis(points[pieces], 1, 0)
    sides = np.roll(points, -1, 0) - points
    area, cut = _cross(points, sides).sum() / 2, _cross(b - a, c - a).sum() / 2
    return pieces if abs(cut - area) <= width * np.linalg.norm(sides, axis=1).sum() else None


def _runs_back(a: tuple[float, float], tip: tuple[float, float], c: tuple[float, float], width: float) -> bool:
    """Tell whether the side from a corner lies on the side to it."""
    ax, ay, cx, cy = a[0] - tip[0], a[1] - tip[1], c[0] - tip[0], c[1] - tip[1]
    longer = max(math.hypot(ax, ay), math.hypot(cx, cy))
    return ax * cx + ay * cy > 0 and abs(ax * cy - ay * cx) <= width * longer


def _is_ear(triangle: NDArray, others: NDArray, width: float, touching: bool) -> bool:
    """Tell whether a corner can be cut off: its triangle has an area, and no other corner of the polygon is in it.

    Corners at the same place as one of the triangle's own are of a bridge or of a point where the polygon touches
    itself, and do not count. On the triangle's sides others may lie only where `touching`.
    """
    (ax, ay), (bx, by), (cx, cy) = triangle.tolist()
    sides = (ax, ay, bx - ax, by - ay), (bx, by, cx - bx, cy - by), (cx, cy, ax - cx, ay - cy)
    longest = max(math.hypot(dx, dy) for _, _, dx, dy in sides)
    if not (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > width * longest:
        return False
    low, high = (min(ax, bx, cx) - width, min(ay, by, cy) - width), (max(ax, bx, cx) + width, max(ay, by, cy) + width)
    x, y = others.T
    near = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    x, y = x[near], y[near]
    inside = np.ones(len(x), bool)
    for fx, fy, dx, dy in sides:
        distance = (dx * (y - fy) - dy * (x - fx)) / math.hypot(dx, dy)
        inside &= ((distance > width) if touching else (distance >= -width)) & ((x != fx) | (y != fy))
    return not inside.any()
