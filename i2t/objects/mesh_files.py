"""Mesh files of other people: read with an explicit unit, cleaned, and honest about what was cleaned.

A file says nothing reliable about its unit, so the caller does. `i2t.objects.mesh_formats` reads its triangles.
Cleaning merges equal vertices, drops degenerate and repeated faces, keeps the largest connected piece by area (stray
facets of scans go) and turns faces outward. Holes are counted but left open: the renderer needs no closed surface,
and an invented one would be touched as if it were there.
"""

import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from i2t import files
from i2t.objects.mesh_formats import foreign_kind, parse_mesh
from i2t.objects.solids import Mesh, Object, place_on_table, transform_mesh

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 25.4e-3}  # m
STRAY_AREA = 1e-3  # share of the area, up to which loose pieces are stray facets of a scan
MIN_SIZE_M, MAX_SIZE_M = 2e-3, 2.0  # m, longest side of something to touch
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # from a frame whose y is up


@dataclass(frozen=True)
class CleaningReport:
    """Report on the cleaning of a mesh file; `str` is for people."""

    path: str
    faces_read: int
    faces: int  # kept
    vertices_merged: int
    degenerate: int  # faces without area, dropped
    repeated: int  # faces given twice and fins of two faces back to back, dropped
    pieces_dropped: int  # smaller connected pieces
    area_dropped: float  # fraction of the area, in those pieces
    turned: int  # faces whose winding was turned
    open_edges: int  # edges with other than two faces; 0 is watertight
    size: tuple[float, float, float]  # m

    @property
    def watertight(self) -> bool:
        """Tell whether the surface is closed."""
        return self.open_edges == 0

    def __str__(self) -> str:
        size = " x ".join(f"{1e3 * s:.1f}" for s in self.size)
        done = [
            text
            for count, text in (
                (self.vertices_merged, f"merged {self.vertices_merged} vertices"),
                (self.degenerate, f"dropped {self.degenerate} degenerate faces"),
                (self.repeated, f"dropped {self.repeated} repeated faces"),
                (
                    self.pieces_dropped,
                    f"dropped {self.pieces_dropped} loose pieces with {100 * self.area_dropped:.2g} % of the area",
                ),
                (self.turned, f"turned {self.turned} faces outward"),
            )
            if count
        ]
        closed = "watertight" if self.watertight else f"open at {self.open_edges} edges"
        return (
            f"{self.path}: {self.faces} of {self.faces_read} faces, {size} mm, {closed}; "
            f"{', '.join(done) or 'nothing to clean'}"
        )


def read_mesh(
    path: str | Path, unit: str, *, table: bool = True, largest: bool = True, up: str = "z"
) -> tuple[Object, CleaningReport]:
    """Read and clean a mesh file. (An OBJ file cut off between two lines cannot be distinguished from a whole one.)

    Args:
        path: An STL, OBJ, PLY, OFF, GLB or glTF file.
        unit: Of its coordinates: m, cm, mm or inch.
        table: Whether to place it on the table: box centred in x and y, lowest point on z = 0, without turning it;
            otherwise it keeps its own frame.
        largest: Whether to keep only the largest connected piece; switch it off for objects made of several bodies.
        up: The file's upward axis, "z" or "y" (GLB files usually say y).

    Returns:
        The object, named by the file, in metres, and what cleaning did.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is not something to touch; one sentence that names the file and a remedy.
    """
    path = Path(path)
    data = read_bytes(path, files.MESH_SUFFIXES)
    scale = to_metres(path, unit)
    if up not in ("z", "y"):
        raise ValueError(f"{path}: up={up!r} is not known; say up='z' or up='y'")
    vertices, faces, left_out = parse_mesh(path, data)
    if left_out:
        rule = "faces are read, and of several scenes the default one"
        warnings.warn(f"{path}: left out {' and '.join(left_out)}; {rule}", stacklevel=2)
    vertices = vertices * scale
    check_size(path, vertices[faces].reshape(-1, 3), unit)
    raw_mesh = Mesh(vertices, faces.astype(np.int32))
    mesh, report = clean_mesh(transform_mesh(raw_mesh, Y_UP) if up == "y" else raw_mesh, str(path), largest)
    return Object(path.stem, place_on_table(mesh) if table else mesh, "file"), report


def load_mesh(path: str | Path, unit: str, *, table: bool = True, largest: bool = True, up: str = "z") -> Mesh:
    """The mesh in a file, cleaned.

    Args:
        path: An STL, OBJ, PLY, OFF, GLB or glTF file.
        unit: Of its coordinates: m, cm, mm or inch.
        table: Whether to place it on the table: box centred in x and y, lowest point on z = 0, without turning it;
            otherwise it keeps its own frame.
        largest: Whether to keep only the largest connected piece, with a warning of what is dropped; switch it off for
            objects made of several bodies.
        up: The file's upward axis, "z" or "y" (GLB files usually say y).

    Returns:
        The mesh, in metres. `i2t.objects.read_mesh` says as well what cleaning did.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is not something to touch; one sentence that names the file and a remedy.

    Example:
        mesh = i2t.load_mesh("mug.stl", "mm")
    """
    (_, mesh, _), report = read_mesh(path, unit, table=table, largest=largest, up=up)
    if report.pieces_dropped:
        warnings.warn(f"{report}; largest=False keeps all of it", stacklevel=2)
    return mesh


def load_object(path: str | Path, unit: str) -> Object:
    """The object in a mesh file, standing on the table, with a warning where a body of it is left out.

    Args:
        path: An STL, OBJ, PLY, OFF, GLB or glTF file.
        unit: Of its coordinates: m, cm, mm or inch.

    Returns:
        The object, named by the file, in metres; its largest connected piece.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is not something to touch; one sentence that names the file and a remedy.
    """
    found, report = read_mesh(path, unit)
    if report.area_dropped > STRAY_AREA:
        warnings.warn(f"{report}; only the largest piece is touched: join the bodies, or touch each", stacklevel=2)
    return found


def clean_mesh(mesh: Mesh, path: str = "mesh", largest: bool = True) -> tuple[Mesh, CleaningReport]:
    """Merge vertices closer than 10 nm, drop bad faces and loose pieces, turn faces outward, and say so.

    Args:
        mesh: Any triangles (m).
        path: Its name in messages.
        largest: Whether to keep only the largest connected piece.

    Returns:
        The clean mesh, and what was done.

    Raises:
        ValueError: No face has an area.
    """
    work = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    work.remove_unreferenced_vertices()
    before = len(work.vertices)
    work.merge_vertices(merge_tex=True, merge_norm=True)
    merged = before - len(work.vertices)
    solid = work.nondegenerate_faces()
    if not solid.any():
        raise ValueError(f"{path}: no face has an area; export the mesh again")
    work.update_faces(solid)

    once = _once(work.faces)
    work.update_faces(once)
    pieces, label = _pieces(work.faces)
    areas = np.bincount(label, work.area_faces, pieces)
    dropped = 0.0
    if largest and pieces > 1:
        work.update_faces(label == areas.argmax())
        dropped = float(1 - areas.max() / areas.sum())
    work.remove_unreferenced_vertices()

    wound = work.faces.copy()
    if not work.is_winding_consistent:
        work.faces = _wound_alike(work.faces)
    with np.errstate(divide="ignore", invalid="ignore"):  # a flat body has no volume
        trimesh.repair.fix_inversion(work, multibody=not largest)
    turned = int((wound != work.faces).any(1).sum())
    uses = np.unique(_edges(work.faces), axis=0, return_counts=True)[1]
    size = np.ptp(work.vertices, axis=0)
    report = CleaningReport(
        path=path,
        faces_read=len(mesh.faces),
        faces=len(work.faces),
        vertices_merged=merged,
        degenerate=int((~solid).sum()),
        repeated=int((~once).sum()),
        pieces_dropped=pieces - 1 if largest else 0,
        area_dropped=dropped,
        turned=turned,
        open_edges=int((uses != 2).sum()),
        size=(float(size[0]), float(size[1]), float(size[2])),
    )
    return Mesh(np.asarray(work.vertices, np.float64), np.asarray(work.faces, np.int32)), report


def read_bytes(path: Path, suffixes: tuple[str, ...]) -> bytes:
    """Read a file of a known kind.

    Args:
        path: The file.
        suffixes: Endings that are welcome, in small letters.

    Returns:
        Its bytes.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It has another ending, is a folder or is empty.
    """
    if path.suffix.lower() not in suffixes:
        kind, remedy = foreign_kind(path.suffix)
        is_kind = f"is {kind}: " if kind else ""
        raise ValueError(f"{path}: {is_kind}its ending {path.suffix!r} is none of {', '.join(suffixes)}; {remedy}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the name")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    data = files.read_bytes(path, files.MAX_MESH_BYTES)
    if not data:
        raise ValueError(f"{path}: is empty; export it again")
    return data


def to_metres(path: Path, unit: str) -> float:
    """Say how long a unit is.

    Args:
        path: The file, for the message.
        unit: m, cm, mm or inch.

    Returns:
        Metres in one unit.

    Raises:
        ValueError: The unit is unknown.
    """
    if unit not in METRES_PER_UNIT:
        raise ValueError(
            f"{path}: unit {unit!r} is not known; say which of {', '.join(METRES_PER_UNIT)} its coordinates are in"
        )
    return METRES_PER_UNIT[unit]


def check_size(path: Path, points: NDArray, unit: str) -> None:
    """Refuse what is too small or too large to touch, with a hint at the unit that would fit.

    Args:
        path: The file, for the message.
        points: (n, 3) corners (m).
        unit: That was said to be the file's.

    Raises:
        ValueError: The longest side is not between `MIN_SIZE_M` and `MAX_SIZE_M`.
    """
    longest = float(np.ptp(points, axis=0).max())
    if MIN_SIZE_M <= longest <= MAX_SIZE_M:
        return
    drawn = longest / METRES_PER_UNIT[unit]
    fitting = [name for name, scale in METRES_PER_UNIT.items() if 1e-2 <= drawn * scale <= 1]
    hint = f"perhaps its unit is {' or '.join(fitting)}" if fitting else "check the unit, or scale the file"
    word = "small" if longest < MIN_SIZE_M else "large"
    raise ValueError(
        f"{path}: too {word} to touch, {longest:.3g} m across when its unit is {unit} "
        f"({MIN_SIZE_M:g} to {MAX_SIZE_M:g} m are allowed); {hint}"
    )


def _once(faces: NDArray) -> NDArray:
    """Mask of faces to keep so that no two have the same corners.

    Of repeated faces one stays, except of a fin: faces back to back that stand on a closed surface (scans have them),
    whose edges belong to two other faces or to none. The winding says nothing here, as it may be wrong.
    """
    unique, first, times = np.unique(np.sort(faces, 1), axis=0, return_index=True, return_counts=True)
    _, edge, uses = np.unique(_edges(unique), axis=0, return_inverse=True, return_counts=True)
    others = uses[edge.reshape(-1)].reshape(3, -1) - 1  # faces on the other side of each face's edges
    fin = (times > 1) & (others != 1).all(0) & (others == 2).any(0)
    keep = np.zeros(len(faces), bool)
    keep[first[~fin]] = True
    return keep


def _wound_alike(faces: NDArray) -> NDArray:
    """Faces of which neighbours run through their common edge in opposite directions, where their piece allows that.

    Every face is there twice, as it is and turned; neighbours that agree are connected. Of the two halves into which an
    orientable piece falls, the one that has its first face as it is stays.
    """
    n = len(faces)
    directed = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, edge, uses = np.unique(np.sort(directed, 1), axis=0, return_inverse=True, return_counts=True)
    order = np.argsort(edge.reshape(-1), kind="stable")
    pairs = order[uses[edge.reshape(-1)[order]] == 2].reshape(-1, 2)  # of directed edges of two faces
    one, other = (pairs % n).T
    alike = (directed[pairs[:, 0]] == directed[pairs[:, 1]]).all(1)  # then one of the two has to be turned
    joined = np.concatenate([other + n * alike, other + n * ~alike])
    graph = coo_array((np.ones(2 * len(one)), (np.concatenate([one, one + n]), joined)), (2 * n, 2 * n))
    _, label = connected_components(graph, False)
    piece = np.minimum(label[:n], label[n:])  # labels count from the first face on
    turned = label[:n] != piece
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _edges(faces: NDArray) -> NDArray:
    """The edges of all faces as sorted pairs: first all first edges, then all second, then all third ones."""
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)


def _pieces(faces: NDArray) -> tuple[int, NDArray]:
    """Number of edge-connected pieces, and the piece of each face."""
    _, edge = np.unique(_edges(faces), axis=0, return_inverse=True)
    face = np.tile(np.arange(len(faces)), 3)
    nodes = len(faces) + len(edge)
    _, label = connected_components(
        coo_array((np.ones(len(edge)), (face, len(faces) + edge.reshape(-1))), (nodes, nodes)), False
    )
    _, label = np.unique(label[: len(faces)], return_inverse=True)
    return int(label.max()) + 1, label
