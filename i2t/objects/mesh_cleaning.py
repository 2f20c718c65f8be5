"""Cleaning of triangle meshes: equal vertices are merged, bad faces and dust are dropped, bodies turned outward.

Every body of a mesh is kept. A wall that two bodies give twice, where they meet, lies inside the object, and its faces
are dropped. Holes are counted and left open: the renderer needs no closed surface, and an invented one would be
touched as if it were there.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from i2t.objects.orientation import directed_edges, encloses, turned_outward
from i2t.objects.solids import Mesh

MERGE_M = 1e-8  # m
MAX_DUST_SHARE = 1e-3  # largest area of one grain of dust, of the largest piece, and of all dust, of the mesh


@dataclass(frozen=True)
class CleaningReport:
    """Report on the cleaning of a mesh; `str` is for people."""

    path: str
    faces_read: int
    faces: int  # kept
    vertices_merged: int
    degenerate: int  # faces without area, dropped
    repeated: int  # repeated faces and walls between two bodies, dropped
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
    outward = turned_outward(clean)
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
    """Mask of pieces that are dust of a scan. Small pieces with much area together, such as screws, are not dust."""
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
    outward = turned_outward(Mesh(vertices, faces[keep])).faces
    restored = np.zeros(len(faces), bool)
    torn = _torn_vertices(outward)
    for number in np.flatnonzero(spare):
        rows = first[repeated[wall == number]]
        around = vertices[outward[piece[keep] == piece[rows[0]]]]
        inside = encloses(around, vertices[faces[rows]])
        if not inside or len(np.intersect1d(faces[rows], torn)):
            restored[rows] = True
    return keep | restored


def _torn_vertices(faces: NDArray) -> NDArray:
    """Vertices of edges that faces do not run through equally often in both directions."""
    directed = directed_edges(faces)
    edges, edge = np.unique(np.sort(directed, 1), axis=0, return_inverse=True)
    balance = np.bincount(edge.reshape(-1), np.where(directed[:, 0] < directed[:, 1], 1, -1), len(edges))
    return np.unique(edges[balance != 0])


def _spare_walls(
    faces: NDArray, repeated: NDArray, single: NDArray, areas: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Walls of repeated faces: the wall of each of these faces, and which walls may be spared and which are fins.

    Connected repeated faces form a wall, and single faces meet it at its rim. Where each edge of the rim has an even
    number of single faces, the surface is closed without the wall. If it is small and has other edges, it is a fin.

    Args:
        faces: (n, 3) faces, no two with the same corners.
        repeated: (k,) rows of the faces that were given more than once.
        single: (n,) mask of the other faces.
        areas: (n,) areas of the faces (m^2).

    Returns:
        The number of the wall of each repeated face (k,), and masks of the walls that may be spared and of fins.
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
    return np.sort(directed_edges(faces), 1)
