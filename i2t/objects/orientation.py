"""Orientation of meshes: faces are turned outward by means of winding numbers.

Faces that are joined by edges of exactly two faces form a *part*, whose faces are all oriented alike. The generalized
winding number of all parts together is 1 inside a body and 0 outside. It is negative where a part is inside out,
whatever the part's neighbours, holes and cavities are, and whether or not parts are joined. Parts next to negative
numbers are therefore turned. A sheet has no outside, and stays as it is.

Sources: Jacobson et al., "Robust inside-outside segmentation using generalized winding numbers", 2013; Barill et al.,
"Fast winding numbers for soups and clouds", 2018.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from i2t.objects.solids import Mesh


@dataclass(frozen=True)
class OrientationConfig:
    """Options for turning faces outward: points at which winding numbers are evaluated, numbers of parts above which
    cheaper rules apply, and the evidence (0 to 1) from which a part is turned.
    """

    min_points: int = 9  # points on each side of a part
    max_points: int = 64  # points on each side of a part, if there are at most two parts
    offset: float = 1e-5  # distance of these points from their face, relative to the mesh's size
    dipole_distance: float = 3.0  # distance, in radii of a part, beyond which the part is treated as one dipole
    max_judged_parts: int = 2000  # with more parts, closed ones are judged by their volume, and open ones not at all
    max_holed_parts: int = 8  # with more parts with holes, each is judged only by the mean winding number next to it
    # smallest evidence for turning a part: 0 for a sheet, 0.63 for half a sphere, 1 for a closed body
    min_evidence: float = 0.65
    min_gain: float = 1.0  # smallest evidence, from the numbers next to all parts, for turning a part with holes
    inside_out_number: float = -0.9  # winding number below which a point is in a body that is inside out
    # smallest difference of the area next to inside-out points, as a fraction, by which one result is better
    min_inside_out_fraction: float = 1e-3


def turn_outward(mesh: Mesh, config: OrientationConfig = OrientationConfig()) -> Mesh:
    """Turn the faces of each part of a mesh alike, and outward if winding numbers give enough evidence.

    Args:
        mesh: The mesh (m), whose faces all have an area.
        config: Options for the evaluation of winding numbers, and for how much evidence turns a part.

    Returns:
        The mesh with the same faces in the same order, some of them turned.
    """
    corners = mesh.vertices[mesh.faces]
    faces, parts = _orient_parts(mesh.faces, np.linalg.norm(_double_area(corners), axis=1))
    turned = _parts_to_turn(mesh.vertices[faces], parts, config)[parts.of_face]
    return Mesh(mesh.vertices, np.where(turned[:, None], faces[:, ::-1], faces).astype(np.int32))


def directed_edges(faces: NDArray) -> NDArray:
    """List the edges of faces with their direction.

    Args:
        faces: `(n, 3)` faces, as rows of vertices.

    Returns:
        `(3 n, 2)` edges, as rows of vertices: all first edges, then all second, then all third ones.
    """
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


class _Parts(NamedTuple):
    """Faces that are turned together."""

    of_face: NDArray  # (n,) index of the part of each face
    closed: NDArray  # (parts,) whether all edges of the part have two faces
    holed: NDArray  # (parts,) whether an edge of the part has only one face
    halved: NDArray  # (parts,) whether half of the part's area was given turned


def _orient_parts(faces: NDArray, areas: NDArray) -> tuple[NDArray, _Parts]:
    """Orient the faces of each part alike, so that neighbours run through their common edge in opposite directions.

    Neighbours are the two faces of an edge that no third face has. In a graph every face occurs twice, as given and
    turned, and neighbours that agree are connected. An orientable part consists of two components; the one in which
    more of the area is as given is kept.
    """
    n, directed = len(faces), directed_edges(faces)
    _, edge, uses = np.unique(np.sort(directed, 1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    pairs = order[uses[edge.reshape(-1)[order]] == 2].reshape(-1, 2)
    left, right = (pairs % n).T
    alike = (directed[pairs[:, 0]] == directed[pairs[:, 1]]).all(1)  # one of the two then has to be turned
    joined = np.concatenate([right + n * alike, right + n * ~alike])
    graph = coo_array((np.ones(2 * len(left)), (np.concatenate([left, left + n]), joined)), (2 * n, 2 * n))
    _, half = connected_components(graph, directed=False)
    given = np.bincount(half[:n], areas, int(half.max()) + 1)
    kept, flipped = half[:n], half[n:]  # components that contain a face as given, and turned
    turned = (given[kept] < given[flipped]) | ((given[kept] == given[flipped]) & (kept > flipped))
    part = np.unique(np.minimum(kept, flipped), return_inverse=True)[1].reshape(-1)
    count = int(part.max()) + 1
    closed = 2 * np.bincount(part[pairs[:, 0] % n], minlength=count) == 3 * np.bincount(part)
    holed = np.bincount(part[np.flatnonzero(uses[edge.reshape(-1)] == 1) % n], minlength=count) > 0
    halved = np.zeros(count, bool)
    halved[part] = np.isclose(given[kept], given[flipped])
    return np.where(turned[:, None], faces[:, ::-1], faces), _Parts(part, closed, holed, halved)


class _Field(NamedTuple):
    """Winding numbers at points close to the faces of every part, on both sides of the faces."""

    owner: NDArray  # (k,) part of each point
    weight: NDArray  # (k,) area (m^2) that each point represents
    shares: NDArray  # (parts, k) contribution of each part to the winding number, with its faces as given
    volume: NDArray  # (parts,) signed volume of each part that is closed
    parts: _Parts

    def mean(self, values: NDArray) -> NDArray:
        """Average values at the points (k,) over the area of each part (parts,)."""
        count = len(self.shares)
        return np.bincount(self.owner, self.weight * values, count) / np.bincount(self.owner, self.weight, count)


def _parts_to_turn(corners: NDArray, parts: _Parts, config: OrientationConfig) -> NDArray:
    """Mark the parts to turn so that no part encloses a negative winding number.

    Starting from the parts as given, and again from all parts turned, the part with the most negative number next to
    its faces is turned until no number is negative. The result with fewer negative numbers is used.

    Args:
        corners: `(m, 3, 3)` corners of the faces (m).
        parts: The parts of the faces.
        config: Options for the evaluation of winding numbers, and for how much evidence turns a part.

    Returns:
        `(parts,)` mask of the parts to turn.
    """
    middle = corners - 0.5 * (corners.min((0, 1)) + corners.max((0, 1)))
    volume = np.bincount(parts.of_face, np.linalg.det(middle), len(parts.closed))
    inward = parts.closed & (volume < 0)
    plain = parts.closed.all() and (inward.all() or not inward.any()) and (len(inward) == 1 or not parts.halved.any())
    if plain or len(inward) > config.max_judged_parts:
        return inward
    points, owner, weight = _points_near_faces(corners, parts.of_face, config)
    shares = _winding_numbers(corners, parts.of_face, points, config.dipole_distance)
    field = _Field(owner, weight, shares, volume, parts)
    starts = [np.ones(len(volume)), -np.ones(len(volume))]
    if weight @ field.shares.sum(0) < -0.5 * config.min_evidence * weight.sum():
        starts.reverse()
    (first, negative), (second, second_negative) = (_turn_parts(field, start, config) for start in starts)
    return (second if second_negative < negative - config.min_inside_out_fraction else first) < 0


def _turn_parts(field: _Field, sign: NDArray, config: OrientationConfig) -> tuple[NDArray, float]:
    """Turn parts that are inside out; return all signs (parts,), and the fraction of area with negative numbers."""
    number, parts = sign @ field.shares, field.parts
    rules = [(_evidence_nearby, config.min_evidence)]
    if parts.holed.sum() <= config.max_holed_parts:
        rules.append((_evidence_overall, config.min_gain))
    for judge, min_evidence in rules:
        for _ in range(2 * len(sign)):
            evidence = judge(field, sign, number)
            worst = evidence.argmin()
            if evidence[worst] >= -min_evidence:
                break
            sign[worst] *= -1
            number += 2 * sign[worst] * field.shares[worst]
    # A part that was given half turned is no evidence, and cavities are more common than solids inside solids.
    enclosed = field.mean(number > 0.5) > 1 - 1e-9
    sign[parts.closed & parts.halved & enclosed] *= -1
    return sign, float(field.weight[number < config.inside_out_number].sum() / field.weight.sum())


def _evidence_nearby(field: _Field, sign: NDArray, number: NDArray) -> NDArray:
    """Rate each part from body (1) over sheet (0) to inside out (-1), by the numbers next to it."""
    inside_out = (sign * field.volume < 0) & (field.mean(number < -0.5) > 0)  # otherwise a closed part is a cavity
    return np.where(field.parts.closed, np.where(inside_out, -1.0, 1.0), 2 * field.mean(number))


def _evidence_overall(field: _Field, sign: NDArray, number: NDArray) -> NDArray:
    """Rate parts with holes by the numbers next to all parts, which are integers if two halves form one body.

    The evidence is twice the growth of the implausibility of all numbers if the part is turned, per area of the part.
    """
    evidence, now = np.ones(len(sign)), field.weight @ _implausible(number)
    own = np.bincount(field.owner, field.weight, len(sign))
    for part in np.flatnonzero(field.parts.holed):
        turned = field.weight @ _implausible(number - 2 * sign[part] * field.shares[part])
        evidence[part] = 2 * (turned - now) / own[part]
    return evidence


def _implausible(number: NDArray) -> NDArray:
    """Measure how far winding numbers are from integers, which a surface without holes has, and how far below zero."""
    return np.abs(number - np.round(number)) + np.maximum(-number, 0)


def _points_near_faces(corners: NDArray, part: NDArray, config: OrientationConfig) -> tuple[NDArray, NDArray, NDArray]:
    """Choose points (k, 3) close to faces of each part, on both sides, with their parts (k,) and areas (k,)."""
    areas = np.linalg.norm(_double_area(corners), axis=1) / 2
    points, owner, weight = [], [], []
    count = max(config.min_points, 2 * config.max_points // max(int(part.max()) + 1, 2))
    # The R2 sequence (M. Roberts, 2018), which fills a square evenly, folded to a triangle.
    root, along = np.sqrt((np.arange(count) * 0.7548776662 + 0.5) % 1), (np.arange(count) * 0.5698402910 + 0.5) % 1
    spread = np.stack([1 - root, root * (1 - along), root * along], 1)
    near = config.offset * np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
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


def _winding_numbers(corners: NDArray, part: NDArray, points: NDArray, dipole_distance: float) -> NDArray:
    """Compute the generalized winding number (parts, k) of each part around points (k, 3).

    It is the sum of the solid angles of the triangles over 4 pi: 1 inside a closed part and 0 outside. Points beyond
    `dipole_distance` radii of a part see it as one dipole.
    """
    order = np.argsort(part, kind="stable")
    surfaces = np.split(corners[order], np.cumsum(np.bincount(part))[:-1])
    numbers = np.empty((len(surfaces), len(points)))
    for number, surface in zip(numbers, surfaces, strict=True):
        centre = surface.reshape(-1, 3).mean(0)
        radius = np.linalg.norm(surface.reshape(-1, 3) - centre, axis=1).max()
        towards = centre - points
        distance = np.linalg.norm(towards, axis=1)
        far = distance > dipole_distance * radius
        number[far] = (towards[far] @ (_double_area(surface).sum(0) / 2)) / (4 * np.pi * distance[far] ** 3)
        number[~far] = _solid_angles(surface, points[~far]) / (4 * np.pi)
    return numbers


def _solid_angles(surface: NDArray, points: NDArray) -> NDArray:
    """Compute the solid angle (k,) of a surface (n, 3, 3) from points (k, 3), positive from behind its faces.

    The formula is that of van Oosterom and Strackee, "The solid angle of a plane triangle", 1983.
    """
    flat = np.ascontiguousarray(surface.reshape(-1, 9).T)  # coordinates of the first, second and third corners
    angles = np.empty(len(points))
    block = max(1, 2**14 // len(surface))  # pairs of faces and points that are held in memory at the same time
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
    """Compute normals (n, 3) of triangles (n, 3, 3), whose lengths are twice the areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def encloses(corners: NDArray, inner: NDArray, config: OrientationConfig = OrientationConfig()) -> bool:
    """Test whether a surface, which may have holes, encloses most of some faces.

    Args:
        corners: `(n, 3, 3)` corners of the surface's faces (m).
        inner: `(m, 3, 3)` corners of the other faces (m).
        config: Options for winding numbers; it limits the number of centres at which they are evaluated.

    Returns:
        Whether the winding number at most of these centres is beyond 1/2.
    """
    points = inner[:: -(-len(inner) // config.min_points)].mean(1)
    numbers = _winding_numbers(corners, np.zeros(len(corners), int), points, config.dipole_distance)[0]
    return float(np.mean(np.abs(numbers) > 0.5)) > 0.5
