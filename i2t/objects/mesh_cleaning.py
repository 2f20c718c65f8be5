"""Cleaning of triangle meshes: equal vertices are merged, bad faces and dust are dropped, bodies turned outward.

Every body of a mesh is kept. A wall that two bodies give twice, where they meet, lies inside the object, and its faces
are dropped. Holes are counted and left open: the renderer needs no closed surface, and an invented one would be
touched as if it were there.

Faces that share an edge belong to one *part*, whose faces are all turned alike. Where four or more faces share an edge,
as where two bodies touch, faces that follow each other around the edge are neighbours. Each part is turned outward by
its own signed volume, after its holes are closed by fans. Two kinds of parts stay as the file has them: one inside
another that is wound the other way is a cavity or the inner side of a wall, and one with wide holes is a sheet, unless
another part of the file faces outward.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from i2t.objects.solids import Mesh

MERGE_M = 1e-8  # m
MAX_DUST_SHARE = 1e-3  # of the area: of the largest piece for a grain of dust, of the mesh for all of them
MAX_HOLE_SHARE = (
    0.45  # area of a part's holes over its own, up to which its volume tells its outside; half a sphere has 0.5
)
INSIDE_POINTS = 9  # of a part, that tell whether it is inside another
MIN_VOLUME = 1e-6  # volume over area^1.5 (a sphere has 0.094), below which a part is flat and has no outside


@dataclass(frozen=True)
class CleaningReport:
    """Report on the cleaning of a mesh; `str` is for people."""

    path: str
    faces_read: int
    faces: int  # kept
    vertices_merged: int
    degenerate: int  # faces without area, dropped
    repeated: int  # faces given twice and walls between two bodies, dropped
    pieces: int  # edge-connected pieces that were kept
    pieces_dropped: int  # dust, or all but the largest piece where only that was asked for
    area_dropped: float  # fraction of the area, in those pieces
    turned: int  # faces whose winding was turned
    open_edges: int  # edges with an odd number of faces; 0 is watertight
    size: tuple[float, float, float]  # m

    @property
    def watertight(self) -> bool:
        """Tell whether the surface is closed."""
        return self.open_edges == 0

    def __str__(self) -> str:
        size = " x ".join(f"{1e3 * s:.1f}" for s in self.size)
        loose = f"dropped {self.pieces_dropped} loose pieces with {100 * self.area_dropped:.2g} % of the area"
        counted = (
            (self.vertices_merged, f"merged {self.vertices_merged} vertices"),
            (self.degenerate, f"dropped {self.degenerate} degenerate faces"),
            (self.repeated, f"dropped {self.repeated} repeated faces"),
            (self.pieces_dropped, loose),
            (self.turned, f"turned {self.turned} faces outward"),
        )
        changes = ", ".join(text for count, text in counted if count) or "nothing to clean"
        bodies = f" in {self.pieces} pieces" if self.pieces > 1 else ""
        closed = "watertight" if self.watertight else f"open at {self.open_edges} edges"
        return f"{self.path}: {self.faces} of {self.faces_read} faces{bodies}, {size} mm, {closed}; {changes}"


class CleanMesh(NamedTuple):
    """A mesh after cleaning, and what was left out of it."""

    mesh: Mesh
    left_out: Mesh  # pieces that were dropped; an arm must not run into them either
    report: CleaningReport


def clean_mesh(mesh: Mesh, path: str = "mesh", *, largest_piece: bool = False) -> CleanMesh:
    """Merge equal vertices, drop bad faces and dust, turn faces outward, and report all of it.

    Args:
        mesh: Any triangles (m).
        path: The mesh's name in messages.
        largest_piece: Whether only the connected piece of the largest area is kept.

    Returns:
        The clean mesh, the pieces that were left out, and the report.

    Raises:
        ValueError: No face has an area.
    """
    work = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    work.remove_unreferenced_vertices()
    before = len(work.vertices)
    _merge_vertices(work)
    merged = before - len(work.vertices)
    solid = work.nondegenerate_faces()
    if not solid.any():
        raise ValueError(f"{path}: no face has an area; export the mesh again")
    work.update_faces(solid)
    single = _single_faces(work.vertices, work.faces, work.area_faces)
    work.update_faces(single)

    vertices, faces = np.asarray(work.vertices, np.float64), np.asarray(work.faces)
    pieces, piece = _pieces(faces)
    areas = np.bincount(piece, work.area_faces, pieces)
    kept = np.arange(pieces) == areas.argmax() if largest_piece else ~_dust(areas)
    left_out = _compact(vertices, faces[~kept[piece]])
    clean = _compact(vertices, faces[kept[piece]])
    outward = _turned_outward(clean)
    uses = np.unique(_edges(outward.faces), axis=0, return_counts=True)[1]
    x, y, z = np.ptp(outward.vertices, axis=0).tolist()
    report = CleaningReport(
        path=path,
        faces_read=len(mesh.faces),
        faces=len(outward.faces),
        vertices_merged=merged,
        degenerate=int((~solid).sum()),
        repeated=int((~single).sum()),
        pieces=int(kept.sum()),
        pieces_dropped=int((~kept).sum()),
        area_dropped=float(areas[~kept].sum() / areas.sum()),
        turned=int((outward.faces != clean.faces).any(1).sum()),
        open_edges=int((uses % 2).sum()),
        size=(x, y, z),
    )
    return CleanMesh(outward, left_out, report)


def _merge_vertices(mesh: trimesh.Trimesh) -> None:
    """Merge vertices that are nearer to each other than `MERGE_M`, or than float32 tells them apart."""
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # most of them, by a grid, which parts some that are close
    near = max(MERGE_M, 2**-22 * float(np.abs(mesh.vertices).max()))
    pairs = cKDTree(mesh.vertices).query_pairs(near, output_type="ndarray")
    if len(pairs):
        count = len(mesh.vertices)
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
        group = connected_components(graph, directed=False)[1]
        first = np.unique(group, return_index=True)[1]
        mesh.faces = first[group[mesh.faces]]
        mesh.remove_unreferenced_vertices()


def _dust(areas: NDArray) -> NDArray:
    """Mask of pieces that are dust of a scan; none where small pieces add up to more, as the screws of a machine do."""
    small = areas <= MAX_DUST_SHARE * areas.max()
    return small & (areas[small].sum() <= MAX_DUST_SHARE * areas.sum())


def _compact(vertices: NDArray, faces: NDArray) -> Mesh:
    """A mesh of some faces with the vertices that they use, in their order."""
    used, corners = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], corners.reshape(-1, 3).astype(np.int32))


def _single_faces(vertices: NDArray, faces: NDArray, areas: NDArray) -> NDArray:
    """Mask of faces to keep so that no two have the same corners.

    One of each repeated face stays, except of small fins, and of walls that lie inside the object: without such a wall
    the surface around it can be turned outward without a contradiction, and encloses it.
    """
    unique, first, times = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    keep = np.zeros(len(faces), bool)
    keep[first] = True
    repeated = np.flatnonzero(times > 1)
    if not len(repeated):
        return keep
    wall, spare, fin = _spare_walls(unique, repeated, times == 1, areas[first])
    removed = spare | fin
    keep[first[repeated[removed[wall]]]] = False
    if not spare.any() or not keep.any():
        return keep
    piece = _pieces(faces)[1]
    outward = _turned_outward(Mesh(vertices, faces[keep])).faces
    restored = np.zeros(len(faces), bool)
    torn = _torn_vertices(outward)
    for number in np.flatnonzero(spare):
        rows = first[repeated[wall == number]]
        around = vertices[outward[piece[keep] == piece[rows[0]]]]
        inside = _encloses(around, _some_centres(vertices[faces[rows]]))
        if not inside or len(np.intersect1d(faces[rows], torn)):
            restored[rows] = True
    return keep | restored


def _torn_vertices(faces: NDArray) -> NDArray:
    """Vertices of edges that faces do not run through equally often in both directions."""
    directed = _directed_edges(faces)
    edges, edge = np.unique(np.sort(directed, 1), axis=0, return_inverse=True)
    balance = np.bincount(edge.reshape(-1), np.where(directed[:, 0] < directed[:, 1], 1, -1), len(edges))
    return np.unique(edges[balance != 0])


def _spare_walls(
    faces: NDArray, repeated: NDArray, single: NDArray, areas: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Walls of repeated faces: the wall of each of these faces, and which walls may be spared and which are fins.

    Repeated faces that are connected are a wall, and the edges of its rim have single faces. Where these are two at
    each edge of the rim, the surface is closed without the wall. A wall with other edges that end in the air is a fin,
    if it is small.

    Args:
        faces: (n, 3) faces, no two with the same corners.
        repeated: Rows of those that were given more than once.
        single: (n,) mask of the others.
        areas: (n,) of the faces.

    Returns:
        The wall (number) of each repeated face, and two masks of walls.
    """
    edge = np.unique(_edges(faces), axis=0, return_inverse=True)[1].reshape(3, -1)
    others = np.bincount(edge[:, single].ravel(), minlength=int(edge.max()) + 1)
    edge = edge[:, repeated]
    walls, wall = _connected(np.where(others[edge] == 0, edge, -1))
    beside, copies = others[edge], np.bincount(edge.ravel(), minlength=len(others))[edge]

    def has(condition: NDArray) -> NDArray:
        return np.bincount(wall, condition.any(0), walls) > 0

    closed = has(beside > 0) & ~has(beside % 2 == 1)
    in_air = has((beside == 0) & (copies == 1))
    small = np.bincount(wall, areas[repeated], walls) <= MAX_DUST_SHARE * areas.sum()
    return wall, closed & ~in_air, closed & in_air & small


def _connected(edge: NDArray) -> tuple[int, NDArray]:
    """Number of groups of faces that share edges, and the group of each; `edge` is (3, faces), -1 for no edge."""
    faces = edge.shape[1]
    nodes = faces + int(edge.max(initial=-1)) + 1
    ends = np.tile(np.arange(faces), 3), faces + edge.ravel()
    there = edge.ravel() >= 0
    graph = coo_array((np.ones(int(there.sum())), (ends[0][there], ends[1][there])), (nodes, nodes))
    group = connected_components(graph, directed=False)[1][:faces]
    names, group = np.unique(group, return_inverse=True)
    return len(names), group


def _pieces(faces: NDArray) -> tuple[int, NDArray]:
    """Number of edge-connected pieces, and the piece of each face."""
    return _connected(np.unique(_edges(faces), axis=0, return_inverse=True)[1].reshape(3, -1))


def _edges(faces: NDArray) -> NDArray:
    """The edges of all faces as sorted pairs: first all first edges, then all second, then all third ones."""
    return np.sort(_directed_edges(faces), 1)


def _directed_edges(faces: NDArray) -> NDArray:
    """The edges of all faces as pairs in their direction, in the order of `_edges`."""
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def _turned_outward(mesh: Mesh) -> Mesh:
    """The mesh with faces turned so that every part of it faces outward."""
    vertices, faces = mesh.vertices, np.asarray(mesh.faces)
    pairs = _neighbours(vertices, faces)
    alike, part = _wound_alike(faces, pairs, np.linalg.norm(_double_area(vertices[faces]), axis=1))
    turned = _inside_out(vertices, alike, part, pairs)
    return Mesh(vertices, np.where(turned[part][:, None], alike[:, ::-1], alike).astype(np.int32))


def _neighbours(vertices: NDArray, faces: NDArray) -> NDArray:
    """Pairs (n, 2) of directed edges (rows of `_directed_edges`) at which two faces continue each other.

    The faces around an edge of four or more are sorted by their angle. Neighbours bound an empty wedge or a solid one.
    Of the two ways to pair all of them, the one that turns fewer faces is taken, or the one that has the narrowest
    wedge, so that walls that lie on each other are paired. An edge with an odd number of faces connects none.
    """
    directed = _directed_edges(faces)
    _, edge, uses = np.unique(np.sort(directed, 1), axis=0, return_inverse=True, return_counts=True)
    edge = edge.reshape(-1)
    order = np.argsort(edge, kind="stable")
    pairs = order[uses[edge[order]] == 2].reshape(-1, 2)
    many = order[(uses[edge[order]] > 2) & (uses[edge[order]] % 2 == 0)]
    if not len(many):
        return pairs
    angle = _angles(vertices, faces, directed, many, edge[many])
    by_angle = np.lexsort((angle, edge[many]))
    many, angle = many[by_angle], angle[by_angle]
    group = np.unique(edge[many], return_inverse=True)[1].reshape(-1)
    size = np.bincount(group)
    start = np.cumsum(size) - size
    place = np.arange(len(many)) - start[group]
    following = start[group] + (place + 1) % size[group]
    gap = np.where(place + 1 < size[group], 0, 2 * np.pi) + angle[following] - angle
    disagree = (directed[many] == directed[many[following]]).all(1)
    disagreeing = np.bincount(2 * group + place % 2, disagree, 2 * len(size)).reshape(-1, 2)
    narrowest = place[np.lexsort((gap, group))[start]] % 2
    way = np.where(disagreeing[:, 0] == disagreeing[:, 1], narrowest, disagreeing.argmin(1))
    first = place % 2 == way[group]
    return np.concatenate([pairs, np.stack([many, many[following]], 1)[first]])


def _angles(vertices: NDArray, faces: NDArray, directed: NDArray, rows: NDArray, edge: NDArray) -> NDArray:
    """Angle (rad) of the faces of some directed edges around these edges, from any direction of each edge."""
    low, high = np.sort(directed[rows], 1).T
    axis = vertices[high] - vertices[low]
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    opposite = faces[rows % len(faces), (rows // len(faces) + 2) % 3]
    across = vertices[opposite] - vertices[low]
    across -= np.sum(across * axis, 1, keepdims=True) * axis
    _, representative, group = np.unique(edge, return_index=True, return_inverse=True)
    x = across[representative[group.reshape(-1)]]
    y = np.cross(axis, x)
    return np.arctan2(np.sum(across * y, 1), np.sum(across * x, 1))


def _wound_alike(faces: NDArray, pairs: NDArray, areas: NDArray) -> tuple[NDArray, NDArray]:
    """Faces of which neighbours run through their common edge in opposite directions, and the part of each face.

    Every face is there twice, as it is and turned; neighbours that agree are connected. Of the two halves into which an
    orientable part falls, the one in which more of the area is as it was given stays.
    """
    n, directed = len(faces), _directed_edges(faces)
    one, other = (pairs % n).T
    alike = (directed[pairs[:, 0]] == directed[pairs[:, 1]]).all(1)  # then one of the two has to be turned
    joined = np.concatenate([other + n * alike, other + n * ~alike])
    graph = coo_array((np.ones(2 * len(one)), (np.concatenate([one, one + n]), joined)), (2 * n, 2 * n))
    _, half = connected_components(graph, directed=False)
    given = np.bincount(half[:n], areas, int(half.max()) + 1)
    one, other = half[:n], half[n:]
    turned = (given[one] < given[other]) | ((given[one] == given[other]) & (one > other))
    part = np.unique(np.minimum(half[:n], half[n:]), return_inverse=True)[1].reshape(-1)
    return np.where(turned[:, None], faces[:, ::-1], faces), part


def _inside_out(vertices: NDArray, faces: NDArray, part: NDArray, pairs: NDArray) -> NDArray:
    """Mask (parts,) of those whose faces look inward and are to be turned."""
    parts = int(part.max()) + 1
    low, high = np.full((parts, 3), np.inf), np.full((parts, 3), -np.inf)
    np.minimum.at(low, part, vertices[faces].min(1))
    np.maximum.at(high, part, vertices[faces].max(1))
    corners = vertices[faces] - 0.5 * (low + high)[part][:, None]
    area = np.bincount(part, np.linalg.norm(_double_area(corners), axis=1) / 2, parts)
    rim = np.ones(3 * len(faces), bool)
    rim[pairs.ravel()] = False
    hole, fan = _holes(faces, part, corners, np.flatnonzero(rim))
    volume = np.bincount(part, np.linalg.det(corners) / 6, parts) + fan
    inward = volume < -MIN_VOLUME * area**1.5
    wide = hole > MAX_HOLE_SHARE * area
    turned = inward & (~wide | (volume > MIN_VOLUME * area**1.5).any())
    if inward.all() or not inward.any():
        return turned
    box = np.prod(high - low, 1)
    surfaces = np.split(vertices[faces[np.argsort(part, kind="stable")]], np.cumsum(np.bincount(part))[:-1])
    for child in np.argsort(-box, kind="stable"):
        around = (low <= low[child]).all(1) & (high >= high[child]).all(1) & (inward != inward[child])
        points = _some_centres(surfaces[child])
        parents = [p for p in np.flatnonzero(around) if _encloses(surfaces[p], points)]
        if parents:  # it stays as it was given, relative to what encloses it
            turned[child] = turned[min(parents, key=lambda p: box[p])]
    return turned


def _double_area(corners: NDArray) -> NDArray:
    """Normals (n, 3) of triangles (n, 3, 3), twice as long as their areas."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _holes(faces: NDArray, part: NDArray, corners: NDArray, rim: NDArray) -> tuple[NDArray, NDArray]:
    """Area of the holes of each part, and the volume of the fans that close them.

    Connected edges of a rim are one hole, closed by a fan around the mean of its corners. `rim` holds rows of
    `_directed_edges`.
    """
    parts = int(part.max()) + 1
    if not len(rim):
        return np.zeros(parts), np.zeros(parts)
    face, side = rim % len(faces), rim // len(faces)
    begin, end = corners[face, side], corners[face, (side + 1) % 3]
    nodes = np.stack([faces[face, side], faces[face, (side + 1) % 3]]) + (int(faces.max()) + 1) * part[face]
    names, node = np.unique(nodes, return_inverse=True)
    graph = coo_array((np.ones(len(rim)), tuple(node.reshape(2, -1))), (len(names), len(names)))
    count, loop = connected_components(graph, directed=False)
    loop = loop[node.reshape(2, -1)[0]]
    centre = np.stack([np.bincount(loop, begin[:, i], count) for i in range(3)], 1) / np.bincount(loop)[:, None]
    fan = np.stack([end, begin, centre[loop]], 1)
    normals = np.stack([np.bincount(loop, _double_area(fan)[:, i], count) for i in range(3)], 1) / 2
    home = np.zeros(count, int)
    home[loop] = part[face]
    area = np.bincount(home, np.linalg.norm(normals, axis=1), parts)
    return area, np.bincount(part[face], np.linalg.det(fan) / 6, parts)


def _some_centres(corners: NDArray) -> NDArray:
    """Centres of a few faces (n, 3, 3), at most `INSIDE_POINTS`, evenly over their order."""
    return corners[:: -(-len(corners) // INSIDE_POINTS)].mean(1)


def _encloses(corners: NDArray, points: NDArray) -> bool:
    """Whether most of the points (m, 3) are inside a surface (n, 3, 3), which may have holes.

    Inside, the generalized winding number is beyond 1/2 (Jacobson et al., "Robust inside-outside segmentation using
    generalized winding numbers", 2013). It is the sum of the solid angles of the triangles over 4 pi, each by van
    Oosterom and Strackee, "The solid angle of a plane triangle", 1983.
    """
    inside = 0
    for point in points:
        a, b, c = np.moveaxis(corners - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        below = la * lb * lc + np.sum(a * b, 1) * lc + np.sum(b * c, 1) * la + np.sum(c * a, 1) * lb
        half_angle = np.arctan2(np.sum(a * np.cross(b, c), 1), below)
        inside += abs(float(half_angle.sum())) > np.pi
    return 2 * inside > len(points)
