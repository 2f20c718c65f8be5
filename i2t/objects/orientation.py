"""Which side of a face is outside: meshes turned outward by winding numbers.

Faces joined by edges that two faces alone share are one *part*, whose faces are all turned alike. The generalized
winding number of all parts together is 1 in a body and 0 outside. It is negative where a part is inside out, whatever
the part's neighbours, holes and cavities are, and whether or not parts are joined. So the parts with negative numbers
beside them are turned. A sheet has no outside, and stays as it is.

Sources: Jacobson et al., "Robust inside-outside segmentation using generalized winding numbers", 2013; Barill et al.,
"Fast winding numbers for soups and clouds", 2018.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from i2t.objects.solids import Mesh

MIN_POINTS = 9  # fewest points on each side of a part at which winding numbers are evaluated
MAX_POINTS = 64  # most of them, where there are one or two parts
NEAR = 1e-5  # distance of these points from their face, relative to the mesh's size
FAR = 3.0  # distance, in radii of a part, from which the part counts as one dipole
BLOCK = 2**14  # pairs of faces and points that are held at once
ROUNDING = 1e-9  # relative error of sums of areas
MAX_JUDGED_PARTS = 2000  # with more parts, closed ones are judged by their own volume alone, and open ones not at all
MAX_HOLED_PARTS = 8  # with more parts with holes, each is judged by the mean winding number next to it alone
MIN_EVIDENCE = 0.65  # least evidence to turn a part, from 0 (a sheet) to 1 (a closed body); half a sphere has 0.63
MIN_OTHERS = 1.0  # least gain in whole winding numbers next to all parts, for a part with holes to be turned
NEGATIVE, NEGATIVE_SHARE = -0.9, 1e-3  # winding number below which a point lies inside out; least share of such area


def turned_outward(mesh: Mesh) -> Mesh:
    """Turn the faces of a mesh so that every part of it faces outward.

    Args:
        mesh: Any triangles (m), none without an area.

    Returns:
        The mesh with the same faces in the same order, some of them turned.
    """
    corners = mesh.vertices[mesh.faces]
    faces, parts = _wound_alike(mesh.faces, np.linalg.norm(_double_area(corners), axis=1))
    turned = _inside_out(mesh.vertices[faces], parts)[parts.of_face]
    return Mesh(mesh.vertices, np.where(turned[:, None], faces[:, ::-1], faces).astype(np.int32))


def directed_edges(faces: NDArray) -> NDArray:
    """The edges of faces in their direction.

    Args:
        faces: (n, 3) rows of vertices.

    Returns:
        (3 n, 2) rows of vertices: first all first edges, then all second, then all third ones.
    """
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


class _Parts(NamedTuple):
    """Faces that are turned together."""

    of_face: NDArray  # (n,) the part of each face
    closed: NDArray  # (parts,) whether its edges all have two faces
    holed: NDArray  # (parts,) whether an edge has one face
    halved: NDArray  # (parts,) whether half of its area was given turned


def _wound_alike(faces: NDArray, areas: NDArray) -> tuple[NDArray, _Parts]:
    """Faces of which neighbours run through their common edge in opposite directions, and their parts.

    Neighbours are two faces that alone share an edge. Every face is there twice, as it is and turned; neighbours that
    agree are connected. Of the two halves into which an orientable part falls, the one in which more of the area is as
    it was given stays.
    """
    n, directed = len(faces), directed_edges(faces)
    _, edge, uses = np.unique(np.sort(directed, 1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    pairs = order[uses[edge.reshape(-1)[order]] == 2].reshape(-1, 2)
    left, right = (pairs % n).T
    alike = (directed[pairs[:, 0]] == directed[pairs[:, 1]]).all(1)  # then one of the two has to be turned
    joined = np.concatenate([right + n * alike, right + n * ~alike])
    graph = coo_array((np.ones(2 * len(left)), (np.concatenate([left, left + n]), joined)), (2 * n, 2 * n))
    _, half = connected_components(graph, directed=False)
    given = np.bincount(half[:n], areas, int(half.max()) + 1)
    kept, flipped = half[:n], half[n:]  # the halves that hold a face as it is, and turned
    turned = (given[kept] < given[flipped]) | ((given[kept] == given[flipped]) & (kept > flipped))
    part = np.unique(np.minimum(kept, flipped), return_inverse=True)[1].reshape(-1)
    count = int(part.max()) + 1
    closed = 2 * np.bincount(part[pairs[:, 0] % n], minlength=count) == 3 * np.bincount(part)
    holed = np.bincount(part[np.flatnonzero(uses[edge.reshape(-1)] == 1) % n], minlength=count) > 0
    halved = np.zeros(count, bool)
    halved[part] = np.isclose(given[kept], given[flipped])
    return np.where(turned[:, None], faces[:, ::-1], faces), _Parts(part, closed, holed, halved)


class _Field(NamedTuple):
    """Winding numbers at points close to the faces of every part, on both sides of them."""

    owner: NDArray  # (k,) part of each point
    weight: NDArray  # (k,) area (m^2) that each point stands for
    shares: NDArray  # (parts, k) number that each part adds, as it is wound
    volume: NDArray  # (parts,) signed volume of each part, where it is closed
    parts: _Parts

    def mean(self, values: NDArray) -> NDArray:
        """Mean over the area of each part (parts,) of values at the points (k,)."""
        count = len(self.shares)
        return np.bincount(self.owner, self.weight * values, count) / np.bincount(self.owner, self.weight, count)


def _inside_out(corners: NDArray, parts: _Parts) -> NDArray:
    """Mask (parts,) of those that are to be turned so that no part encloses a negative winding number.

    Starting from the parts as they are, and from all of them turned, the part with the most negative number beside its
    faces is turned until none is left. Of both results the one with fewer negative numbers is taken.

    Args:
        corners: (m, 3, 3) corners of the faces (m).
        parts: The parts of the faces.

    Returns:
        The mask.
    """
    middle = corners - 0.5 * (corners.min((0, 1)) + corners.max((0, 1)))
    volume = np.bincount(parts.of_face, np.linalg.det(middle), len(parts.closed))
    inward = parts.closed & (volume < 0)
    plain = parts.closed.all() and (inward.all() or not inward.any()) and (len(inward) == 1 or not parts.halved.any())
    if plain or len(inward) > MAX_JUDGED_PARTS:
        return inward
    points, owner, weight = _points_beside(corners, parts.of_face)
    field = _Field(owner, weight, _winding_numbers(corners, parts.of_face, points), volume, parts)
    starts = [np.ones(len(volume)), -np.ones(len(volume))]
    if weight @ field.shares.sum(0) < -0.5 * MIN_EVIDENCE * weight.sum():
        starts.reverse()
    (first, negative), (second, second_negative) = (_settled(field, start) for start in starts)
    return (second if second_negative < negative - NEGATIVE_SHARE else first) < 0


def _settled(field: _Field, sign: NDArray) -> tuple[NDArray, float]:
    """Signs (parts,) after the parts that are inside out were turned, and the share of area with negative numbers."""
    number, parts = sign @ field.shares, field.parts
    rules = [(_evidence_beside, MIN_EVIDENCE)]
    if parts.holed.sum() <= MAX_HOLED_PARTS:
        rules.append((_evidence_of_all, MIN_OTHERS))
    for evidence, wanted in rules:
        for _ in range(2 * len(sign)):
            least = evidence(field, sign, number)
            worst = least.argmin()
            if least[worst] >= -wanted:
                break
            sign[worst] *= -1
            number += 2 * sign[worst] * field.shares[worst]
    # A part that was given half turned says nothing itself, and cavities are more usual than solids inside solids.
    enclosed = field.mean(number > 0.5) > 1 - ROUNDING
    sign[parts.closed & parts.halved & enclosed] *= -1
    return sign, float(field.weight[number < NEGATIVE].sum() / field.weight.sum())


def _evidence_beside(field: _Field, sign: NDArray, number: NDArray) -> NDArray:
    """How far each part is a body (1), a sheet (0) or inside out (-1), by the numbers beside it."""
    inside_out = (sign * field.volume < 0) & (field.mean(number < -0.5) > 0)  # else a closed part is a cavity
    return np.where(field.parts.closed, np.where(inside_out, -1.0, 1.0), 2 * field.mean(number))


def _evidence_of_all(field: _Field, sign: NDArray, number: NDArray) -> NDArray:
    """The same of parts with holes, by the numbers beside all parts, which two halves of one body make whole."""
    evidence, now = np.ones(len(sign)), field.weight @ _implausible(number)
    own = np.bincount(field.owner, field.weight, len(sign))
    for part in np.flatnonzero(field.parts.holed):
        turned = field.weight @ _implausible(number - 2 * sign[part] * field.shares[part])
        evidence[part] = 2 * (turned - now) / own[part]
    return evidence


def _implausible(number: NDArray) -> NDArray:
    """How far winding numbers are from whole ones, which a surface without holes has, and how far below zero."""
    return np.abs(number - np.round(number)) + np.maximum(-number, 0)


def _points_beside(corners: NDArray, part: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Points close to some faces of each part on both sides (k, 3), the part of each (k,), and the area it is for."""
    areas = np.linalg.norm(_double_area(corners), axis=1) / 2
    points, owner, weight = [], [], []
    count = max(MIN_POINTS, 2 * MAX_POINTS // max(int(part.max()) + 1, 2))
    # The R2 sequence (M. Roberts, 2018), which fills a square evenly, folded to a triangle.
    root, along = np.sqrt((np.arange(count) * 0.7548776662 + 0.5) % 1), (np.arange(count) * 0.5698402910 + 0.5) % 1
    spread = np.stack([1 - root, root * (1 - along), root * along], 1)
    near = NEAR * np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
    order = np.argsort(part, kind="stable")
    for rows in np.split(order, np.cumsum(np.bincount(part))[:-1]):
        reached = np.cumsum(areas[rows])
        wanted = (np.arange(count) + 0.5) / count * reached[-1]
        some = rows[np.minimum(np.searchsorted(reached, wanted), len(rows) - 1)]
        normal = _double_area(corners[some])
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        place = np.einsum("ki,kij->kj", spread, corners[some])
        points += [place - near * normal, place + near * normal]
        owner.append(np.full(2 * count, part[rows[0]]))
        weight.append(np.full(2 * count, reached[-1] / (2 * count)))
    return np.concatenate(points), np.concatenate(owner), np.concatenate(weight)


def _winding_numbers(corners: NDArray, part: NDArray, points: NDArray) -> NDArray:
    """Generalized winding number (parts, k) of each part around points (k, 3): 1 within a closed one, 0 outside.

    It is the sum of the solid angles of the triangles over 4 pi. Far away a part counts as one dipole.
    """
    order = np.argsort(part, kind="stable")
    surfaces = np.split(corners[order], np.cumsum(np.bincount(part))[:-1])
    numbers = np.empty((len(surfaces), len(points)))
    for number, surface in zip(numbers, surfaces, strict=True):
        centre = surface.reshape(-1, 3).mean(0)
        radius = np.linalg.norm(surface.reshape(-1, 3) - centre, axis=1).max()
        towards = centre - points
        distance = np.linalg.norm(towards, axis=1)
        far = distance > FAR * radius
        number[far] = (towards[far] @ (_double_area(surface).sum(0) / 2)) / (4 * np.pi * distance[far] ** 3)
        number[~far] = _solid_angles(surface, points[~far]) / (4 * np.pi)
    return numbers


def _solid_angles(surface: NDArray, points: NDArray) -> NDArray:
    """Solid angle (k,) of a surface (n, 3, 3) from points (k, 3), positive from behind its faces.

    By van Oosterom and Strackee, "The solid angle of a plane triangle", 1983.
    """
    flat = np.ascontiguousarray(surface.reshape(-1, 9).T)  # coordinates of the first, second and third corners
    angles = np.empty(len(points))
    block = max(1, BLOCK // len(surface))
    for i in range(0, len(points), block):
        some = points[i : i + block]
        ax, ay, az, bx, by, bz, cx, cy, cz = flat[:, None] - np.tile(some, 3).T[..., None]
        la, lb, lc = (np.sqrt(x * x + y * y + z * z) for x, y, z in ((ax, ay, az), (bx, by, bz), (cx, cy, cz)))
        below = la * lb * lc + (ax * bx + ay * by + az * bz) * lc
        below += (bx * cx + by * cy + bz * cz) * la + (cx * ax + cy * ay + cz * az) * lb
        volume = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        angles[i : i + block] = 2 * np.arctan2(volume, below).sum(1)
    return angles


def _double_area(corners: NDArray) -> NDArray:
    """Normals (n, 3) of triangles (n, 3, 3), twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def encloses(corners: NDArray, inner: NDArray) -> bool:
    """Test whether a surface, which may have holes, has most of some faces inside.

    Args:
        corners: (n, 3, 3) corners of the surface's faces (m).
        inner: (m, 3, 3) corners of the others.

    Returns:
        Whether the winding number at most of their centres is beyond 1/2.
    """
    points = inner[:: -(-len(inner) // MIN_POINTS)].mean(1)
    numbers = _winding_numbers(corners, np.zeros(len(corners), int), points)[0]
    return float(np.mean(np.abs(numbers) > 0.5)) > 0.5
