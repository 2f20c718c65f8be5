"""Triangulation of polygons in space, without new vertices.

CAD programs write the caps of channels, slots and holes as one polygon that need not be convex, and a fan from its
first corner would fill the slot. A fan is therefore used only if each of its triangles lies in the polygon. Other
polygons are cut by ear clipping in their plane (G. H. Meisters, "Polygons have ears", 1975). A polygon may touch
itself, as one does whose holes are joined to its rim by a bridge. A polygon that crosses itself has no inside and is
refused.

A corner in the middle of a straight side remains the corner of a triangle with an area: neighbouring faces use it, and
the surface would be open there without it.
"""

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError


def triangulate(
    vertices: NDArray[np.float64], corners: NDArray[np.int64], sizes: NDArray[np.int64], name: Callable[[int], str]
) -> NDArray[np.int64]:
    """Cut polygons in space into triangles, without new vertices.

    Args:
        vertices: `(n, 3)` coordinates in any unit.
        corners: `(sum of sizes,)` indices of vertices, polygon after polygon, each in order around the polygon.
        sizes: `(polygons,)` numbers of corners, at least three each.
        name: Names the file and the polygon of a given number, for messages.

    Returns:
        `(m, 3)` triangles in the order of their polygons, with the same orientation and total area. A polygon without
        an area becomes one triangle without an area.

    Raises:
        DataError: A polygon crosses itself, or the polygons that are not convex have too many corners.
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
        for block in np.array_split(polygons, -(-len(polygons) * size // 2**20)):  # corners, which bounds the memory
            loops = corners[starts[block, None] + np.arange(size)]
            fans, right = _fans(vertices, loops, width)
            faces[places[block, None] + np.arange(size - 2)] = fans
            work += int(size**2 * (~right).sum())
            if work > 7000**2:  # ear clipping takes time with the square of the number of corners
                raise DataError(
                    f"{name(int(block[0]))} and others are not convex and have {size} corners, which takes too long "
                    "here; split the polygons into triangles (in Blender: Triangulate Faces)"
                )
            for polygon, loop in zip(block[~right], loops[~right], strict=True):
                pieces = _clip_polygon(vertices[loop], width)
                if pieces is None:
                    raise DataError(
                        f"{name(int(polygon))} has {size} corners and crosses itself; repair it, or split it into "
                        "triangles (in Blender: Triangulate Faces)"
                    )
                faces[places[polygon] : places[polygon] + size - 2] = -1
                faces[places[polygon] : places[polygon] + len(pieces)] = loop[pieces]
    return faces[faces[:, 0] >= 0]


def strip_triangles(corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """Cut a triangle strip into its triangles.

    Args:
        corners: `(n,)` indices of vertices along the strip.

    Returns:
        `(m, 3)` triangles, every second one turned. Triangles with a repeated corner, which join strips, are left out.
    """
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], 1) if len(corners) > 2 else np.empty((0, 3), np.int64)
    faces[1::2] = faces[1::2, [1, 0, 2]]
    return faces[(faces != np.roll(faces, 1, 1)).all(1)]


def _rounding(points: NDArray) -> float:
    """Bound the rounding error of coordinates in a file with seven digits or in float32."""
    points = points[np.isfinite(points).all(1)]
    if not len(points):
        return 0.0
    low, high = points.min(0), points.max(0)
    return float(max(1e-6 * (high - low).max(), np.finfo(np.float32).eps * max(abs(low).max(), abs(high).max())))


def _without_repeats(corners: NDArray, sizes: NDArray) -> tuple[NDArray, NDArray]:
    """Drop corners that repeat the one before, by which exporters that support only quads write triangles."""
    ends = np.cumsum(sizes)
    before = np.arange(len(corners)) - 1
    before[ends - sizes] = ends - 1
    fresh = corners != corners[before]
    fresh[ends - sizes] |= ~np.logical_or.reduceat(
        fresh, ends - sizes
    )  # keep one corner of a polygon whose corners are all equal
    return corners[fresh], np.add.reduceat(fresh.astype(np.int64), ends - sizes)


def _fans(vertices: NDArray, loops: NDArray, width: float) -> tuple[NDArray, NDArray]:
    """Cut p polygons of n corners into fans `(p, n - 2, 3)`, and mark `(p,)` the fans that lie in their polygon.

    A fan lies in its polygon if all its triangles have the polygon's orientation and sweep less than a full turn. For a
    quad, the fan from the second corner is tried as well.
    """
    count, size = loops.shape
    if size == 3:
        return loops[:, None], np.ones(count, bool)
    fans = _fan(loops)
    right = _fits_polygon(vertices[fans], width)
    if size == 4 and not right.all():
        others = _fan(np.roll(loops[~right], -1, 1))
        swap = _fits_polygon(vertices[others], width)
        fans[np.flatnonzero(~right)[swap]] = others[swap]
        right[~right] = swap
    return fans, right


def _fan(loops: NDArray) -> NDArray:
    return np.stack(np.broadcast_arrays(loops[:, :1], loops[:, 1:-1], loops[:, 2:]), 2)


def _fits_polygon(triangles: NDArray, width: float) -> NDArray:
    """Mark `(p,)` the fans `(p, m, 3, 3)` that lie in their polygon."""
    a, b, c = np.moveaxis(triangles, 2, 0)
    ab, ac, bc = b - a, c - a, c - b
    areas = np.cross(ab, ac)
    normal = areas.sum(1)
    longest = np.max([np.einsum("pmi,pmi->pm", side, side) for side in (ab, ac, bc)], 0)
    along, squared = np.einsum("pmi,pi->pm", areas, normal), np.einsum("pi,pi->p", normal, normal)
    right = (along > width * np.sqrt(longest * squared[:, None])).all(1)
    if triangles.shape[1] > 2:
        sweep = np.arctan2(np.linalg.norm(areas, axis=2), np.einsum("pmi,pmi->pm", ab, ac))
        right &= sweep.sum(1) < 2 * np.pi - 1e-3  # around the first corner
    return right


def _clip_polygon(points: NDArray, width: float) -> NDArray | None:
    """Cut a polygon `(n, 3)` into triangles `(m, 3)` of its corners; return None if it crosses itself."""
    size, none = len(points), np.zeros((1, 3), np.int64)
    if not np.isfinite(points).all():  # the caller refuses vertices that are not finite
        return _fan(np.arange(size)[None])[0]
    centred = points - points.mean(0)
    _, spreads, axes = np.linalg.svd(centred, full_matrices=False)
    normal = np.cross(centred, np.roll(centred, -1, 0)).sum(0)
    if normal @ np.cross(axes[0], axes[1]) < 0:
        axes[1] = -axes[1]
    if np.linalg.norm(normal) > width * spreads[0]:  # otherwise it is narrow, runs out and back, or crosses itself
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
    """Test whether two sides of a polygon `(n, 2)` cross; sides that only touch do not cross."""
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
    """Cut ears off an anticlockwise polygon `(n, 2)`; return triangles `(m, 3)`, or None if it overlaps itself.

    After a cut only the two corners next to it can have become ears, so that each cut needs one pass over the others.
    Spikes without a width, which run out and back, are removed first, because a triangle next to one might cover it.
    With `folded`, this includes spikes that run back along other corners than they ran out.
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
            flat = place[c] in (place[tip], place[a])  # the two sides enclose nothing
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
    """Test whether the side that leaves a corner lies on the side that arrives at it."""
    ax, ay, cx, cy = a[0] - tip[0], a[1] - tip[1], c[0] - tip[0], c[1] - tip[1]
    longer = max(math.hypot(ax, ay), math.hypot(cx, cy))
    return ax * cx + ay * cy > 0 and abs(ax * cy - ay * cx) <= width * longer


def _is_ear(triangle: NDArray, others: NDArray, width: float, touching: bool) -> bool:
    """Test whether a corner can be cut off: its triangle has an area, and no other corner of the polygon is in it.

    Corners that coincide with one of the triangle's own belong to a bridge, or to a point where the polygon touches
    itself, and are ignored. Others may lie on the triangle's sides only if `touching`.
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
