"""Cleaning of triangle meshes.

Equal vertices are merged, bad faces and dust are dropped, and bodies are turned outward. Every body of a mesh is kept.
Where two bodies meet, both may contain the wall between them; it lies inside the object, and its faces are dropped.
Holes are counted and left open: the renderer does not need a closed surface, and the tool might touch an invented one.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from i2t.objects.orientation import directed_edges, encloses, turn_outward
from i2t.objects.solids import Mesh


@dataclass(frozen=True)
class CleaningConfig:
    """Thresholds of mesh cleaning: distance (m) within which vertices merge, and relative area of pieces of dust."""

    merge_distance: float = 1e-8  # m, distance within which vertices are merged
    # largest area of one dropped grain relative to the largest piece, and of all grains to the mesh
    max_dust_fraction: float = 1e-3


@dataclass(frozen=True)
class CleaningReport:
    """Report on the cleaning of a mesh: what was merged, dropped and turned, and how many edges are still open; holes
    are not filled. `str` makes a sentence for the user.
    """

    path: str
    faces_read: int
    faces: int  # number of faces that were kept
    vertices_merged: int
    degenerate: int  # number of faces without area, which were dropped
    repeated: int  # number of repeated faces and walls between two bodies, which were dropped
    pieces: int  # number of edge-connected pieces that were kept
    pieces_dropped: int  # number of dropped pieces: dust, or all except the largest if only that was requested
    area_dropped: float  # fraction of the area that is in the dropped pieces
    turned: int  # number of faces whose winding was reversed
    open_edges: int  # number of edges with an odd number of faces; 0 is watertight
    size: tuple[float, float, float]  # m, edges of the mesh's bounding box

    @property
    def watertight(self) -> bool:
        """Whether the cleaned surface is closed."""
        return self.open_edges == 0

    def __str__(self) -> str:
        size = " x ".join(f"{1e3 * s:.1f}" for s in self.size)
        loose = f"dropped {self.pieces_dropped} loose pieces with {100 * self.area_dropped:.2g} % of the area"
        changes = (
            (self.vertices_merged, f"merged {self.vertices_merged} vertices"),
            (self.degenerate, f"dropped {self.degenerate} degenerate faces"),
            (self.repeated, f"dropped {self.repeated} repeated faces"),
            (self.pieces_dropped, loose),
            (self.turned, f"turned {self.turned} faces outward"),
        )
        summary = ", ".join(text for count, text in changes if count) or "nothing to clean"
        bodies = f" in {self.pieces} pieces" if self.pieces > 1 else ""
        closed = "watertight" if self.watertight else f"open at {self.open_edges} edges"
        return f"{self.path}: {self.faces} of {self.faces_read} faces{bodies}, {size} mm, {closed}; {summary}"


class CleanMesh(NamedTuple):
    """A mesh (m) after cleaning, the dropped pieces, which still obstruct the arm, and a report on the cleaning."""

    mesh: Mesh
    obstacles: Mesh  # pieces that were dropped but still obstruct the arm
    report: CleaningReport


def clean_mesh(
    mesh: Mesh, path: str = "mesh", *, largest_piece: bool = False, config: CleaningConfig = CleaningConfig()
) -> CleanMesh:
    """Merge equal vertices, drop bad faces and dust, turn faces outward, and report all of it.

    Args:
        mesh: The mesh, in metres.
        path: The mesh's name in messages.
        largest_piece: Whether only the connected piece of the largest area is kept.
        config: Thresholds for merging vertices and for dropping small pieces as dust.

    Returns:
        The clean mesh, the pieces that were dropped, and the report.

    Raises:
        ValueError: No face has an area.
    """
    work = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    work.remove_unreferenced_vertices()
    before = len(work.vertices)
    _merge_vertices(work, config.merge_distance)
    merged = before - len(work.vertices)
    solid = work.nondegenerate_faces()
    if not solid.any():
        raise ValueError(f"{path}: no face has an area; export the mesh again")
    work.update_faces(solid)
    single = _distinct_faces(work.vertices, work.faces, work.area_faces, config.max_dust_fraction)
    work.update_faces(single)

    vertices, faces = np.asarray(work.vertices, np.float64), np.asarray(work.faces)
    pieces, piece = _pieces(faces)
    areas = np.bincount(piece, work.area_faces, pieces)
    kept = np.arange(pieces) == areas.argmax() if largest_piece else ~_dust(areas, config.max_dust_fraction)
    obstacles = _compact(vertices, faces[~kept[piece]])
    clean = _compact(vertices, faces[kept[piece]])
    outward = turn_outward(clean)
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
    return CleanMesh(outward, obstacles, report)


def _merge_vertices(mesh: trimesh.Trimesh, distance: float) -> None:
    """Merge vertices that are nearer to each other than a distance (m), or than float32 can resolve."""
    mesh.merge_vertices(merge_tex=True, merge_norm=True)  # by a grid, which separates some close vertices
    near = max(distance, 2**-22 * float(np.abs(mesh.vertices).max()))
    pairs = cKDTree(mesh.vertices).query_pairs(near, output_type="ndarray")
    if len(pairs):
        count = len(mesh.vertices)
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (count, count))
        group = connected_components(graph, directed=False)[1]
        first = np.unique(group, return_index=True)[1]
        mesh.faces = first[group[mesh.faces]]
        mesh.remove_unreferenced_vertices()


def _dust(areas: NDArray, max_fraction: float) -> NDArray:
    """Mark the pieces that are dust of a scan. Small pieces with a large total area, such as screws, are not dust."""
    small = areas <= max_fraction * areas.max()
    return small & (areas[small].sum() <= max_fraction * areas.sum())


def _compact(vertices: NDArray, faces: NDArray) -> Mesh:
    """Make a mesh of some faces, with only the vertices that they use, in the same order."""
    used, corners = np.unique(faces, return_inverse=True)
    return Mesh(vertices[used], corners.reshape(-1, 3).astype(np.int32))


def _distinct_faces(vertices: NDArray, faces: NDArray, areas: NDArray, max_fin_fraction: float) -> NDArray:
    """Mark the faces to keep so that no two have the same corners.

    One of each repeated face is kept, except in small fins and in walls inside the object. Without such a wall, the
    surface around it encloses it and can be turned outward without a contradiction.
    """
    unique, first, times = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    keep = np.zeros(len(faces), bool)
    keep[first] = True
    repeated = np.flatnonzero(times > 1)
    if not len(repeated):
        return keep
    wall, spare, fin = _group_walls(unique, repeated, times == 1, areas[first], max_fin_fraction)
    removed = spare | fin
    keep[first[repeated[removed[wall]]]] = False
    if not spare.any() or not keep.any():
        return keep
    piece = _pieces(faces)[1]
    outward = turn_outward(Mesh(vertices, faces[keep])).faces
    restored = np.zeros(len(faces), bool)
    torn = _inconsistent_vertices(outward)
    for number in np.flatnonzero(spare):
        rows = first[repeated[wall == number]]
        around = vertices[outward[piece[keep] == piece[rows[0]]]]
        inside = encloses(around, vertices[faces[rows]])
        if not inside or len(np.intersect1d(faces[rows], torn)):
            restored[rows] = True
    return keep | restored


def _inconsistent_vertices(faces: NDArray) -> NDArray:
    """Find the vertices of edges through which faces do not run equally often in both directions."""
    directed = directed_edges(faces)
    edges, edge = np.unique(np.sort(directed, 1), axis=0, return_inverse=True)
    balance = np.bincount(edge.reshape(-1), np.where(directed[:, 0] < directed[:, 1], 1, -1), len(edges))
    return np.unique(edges[balance != 0])


def _group_walls(
    faces: NDArray, repeated: NDArray, single: NDArray, areas: NDArray, max_fin_fraction: float
) -> tuple[NDArray, NDArray, NDArray]:
    """Group repeated faces into walls, and mark the walls that are not needed and those that are fins.

    Connected repeated faces form a wall, and single faces meet it at its rim. If each edge of the rim has an even
    number of single faces, the surface is closed without the wall. A small wall that also has free edges is a fin.

    Args:
        faces: `(n, 3)` faces, no two with the same corners.
        repeated: `(k,)` rows of the faces that occur more than once.
        single: `(n,)` mask of the other faces.
        areas: `(n,)` areas of the faces (m^2).
        max_fin_fraction: The largest area of a fin, relative to that of all faces.

    Returns:
        The number of the wall of each repeated face (k,), a mask of the walls that are not needed, and one of fins.
    """
    edge = np.unique(_edges(faces), axis=0, return_inverse=True)[1].reshape(3, -1)
    others = np.bincount(edge[:, single].ravel(), minlength=int(edge.max()) + 1)
    edge = edge[:, repeated]
    walls, wall = _connected(np.where(others[edge] == 0, edge, -1))
    neighbours, copies = others[edge], np.bincount(edge.ravel(), minlength=len(others))[edge]

    def has(condition: NDArray) -> NDArray:
        return np.bincount(wall, condition.any(0), walls) > 0

    closed = has(neighbours > 0) & ~has(neighbours % 2 == 1)
    in_air = has((neighbours == 0) & (copies == 1))
    small = np.bincount(wall, areas[repeated], walls) <= max_fin_fraction * areas.sum()
    return wall, closed & ~in_air, closed & in_air & small


def _connected(edge: NDArray) -> tuple[int, NDArray]:
    """Count the groups of faces that share edges, and number them; `edge` is (3, faces), -1 for no edge."""
    faces = edge.shape[1]
    nodes = faces + int(edge.max(initial=-1)) + 1
    ends = np.tile(np.arange(faces), 3), faces + edge.ravel()
    there = edge.ravel() >= 0
    graph = coo_array((np.ones(int(there.sum())), (ends[0][there], ends[1][there])), (nodes, nodes))
    group = connected_components(graph, directed=False)[1][:faces]
    names, group = np.unique(group, return_inverse=True)
    return len(names), group


def _pieces(faces: NDArray) -> tuple[int, NDArray]:
    """Count the edge-connected pieces, and find the piece of each face."""
    return _connected(np.unique(_edges(faces), axis=0, return_inverse=True)[1].reshape(3, -1))


def _edges(faces: NDArray) -> NDArray:
    """List the edges of all faces as sorted pairs: all first edges, then all second, then all third ones."""
    return np.sort(directed_edges(faces), 1)
