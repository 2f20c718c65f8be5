"""Mesh files of other people: read with an explicit unit, cleaned, and honest about what was cleaned.

A file says nothing reliable about its unit, so the caller does. Everything in a file is one object, whatever number of
bodies it has (`i2t.objects.mesh_cleaning`). The object's frame stands on the table, and `Object.T_file_object` leads
back to the file's.
"""

import io
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from i2t import files
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.objects.mesh_cleaning import CleaningReport, clean_mesh
from i2t.objects.solids import IDENTITY, Mesh, Object, table_transform, transform_mesh

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 25.4e-3}  # m
MAX_MESH_BYTES = 2**28  # of a file
MAX_NODES = 1000  # of a scene in a GLB file, whose parser walks them one by one
GLB_SCENE = 20  # bytes before the scene of a GLB file
MIN_SIZE_M, MAX_SIZE_M = 2e-3, 2.0  # m, longest side of something to touch
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # from a frame whose y is up


def read_mesh(
    path: str | Path, unit: str, *, table: bool = True, largest_piece: bool = False, up: str = "z"
) -> tuple[Object, CleaningReport]:
    """Read and clean a mesh file. (A text file cut off between two lines cannot be distinguished from a whole one.)

    Args:
        path: An STL, OBJ, PLY or GLB file.
        unit: Of its coordinates: m, cm, mm or inch.
        table: Whether to place it on the table: box centred in x and y, lowest point on z = 0, without turning it;
            otherwise it keeps its own frame.
        largest_piece: Whether only the largest connected piece is touched; `Object.left_out` has the rest.
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
    _check_whole(path, data)
    try:
        _check_scene(path, data)
        kind = path.suffix[1:].lower()
        raw = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False, skip_materials=True).to_mesh()
        vertices, faces = np.asarray(raw.vertices, np.float64) * scale, np.asarray(raw.faces, np.int64)
    except DataError:
        raise
    except Exception as error:  # whatever a parser trips over, the file is at fault
        kind, reason = path.suffix[1:].upper(), " ".join(f"{type(error).__name__} {error}".split())
        raise ValueError(
            f"{path}: cannot be read as {kind} ({reason}); export it again, or check its ending"
        ) from error
    if not len(faces):
        raise ValueError(
            f"{path}: holds no faces; export it as a mesh (a point cloud is made one first, for instance with Open3D)"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError(f"{path}: a face refers to a vertex that is not there; export it again")
    if not np.isfinite(vertices).all():
        raise ValueError(f"{path}: {np.sum(~np.isfinite(vertices).all(1))} vertices are not finite; repair the mesh")
    check_size(path, vertices[faces].reshape(-1, 3), unit)
    T_up_file = Y_UP if up == "y" else IDENTITY
    upright = transform_mesh(Mesh(vertices, faces.astype(np.int32)), T_up_file)
    mesh, left_out, report = clean_mesh(upright, str(path), largest_piece=largest_piece)
    T_o_up = table_transform(mesh) if table else IDENTITY
    placed, obstacles = transform_mesh(mesh, T_o_up), transform_mesh(left_out, T_o_up)
    T_file_object = inverse(T_o_up @ T_up_file)
    return Object(path.stem, placed, "file", T_file_object, obstacles if len(obstacles.faces) else None), report


def load_mesh(path: str | Path, unit: str, *, table: bool = True, largest_piece: bool = False, up: str = "z") -> Mesh:
    """The mesh in a file, cleaned.

    Args:
        path: An STL, OBJ, PLY or GLB file.
        unit: Of its coordinates: m, cm, mm or inch.
        table: Whether to place it on the table: box centred in x and y, lowest point on z = 0, without turning it;
            otherwise it keeps the file's frame.
        largest_piece: Whether to keep only the largest connected piece; otherwise every body is kept.
        up: The file's upward axis, "z" or "y" (GLB files usually say y).

    Returns:
        The mesh, in metres. `i2t.objects.read_mesh` also gives the transform to the file's frame, and reports what
        cleaning changed.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is not something to touch; one sentence that names the file and a remedy.

    Example:
        mesh = i2t.load_mesh("mug.stl", "mm")
    """
    return read_mesh(path, unit, table=table, largest_piece=largest_piece, up=up)[0].mesh


def load_object(path: str | Path, unit: str, *, largest_piece: bool = False) -> Object:
    """The object in a mesh file, standing on the table.

    Args:
        path: An STL, OBJ, PLY or GLB file.
        unit: Of its coordinates: m, cm, mm or inch.
        largest_piece: Whether only the largest connected piece is touched; `Object.left_out` has the rest.

    Returns:
        The object, named by the file, in metres.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It cannot be read, or is not something to touch; one sentence that names the file and a remedy.
    """
    return read_mesh(path, unit, largest_piece=largest_piece)[0]


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
        raise ValueError(
            f"{path}: its ending {path.suffix!r} is none of {', '.join(suffixes)}; convert it to one of them"
        )
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the name")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    data = files.read_bytes(path, MAX_MESH_BYTES)
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


def _check_whole(path: Path, data: bytes) -> None:
    """Compare the lengths that STL and GLB files announce with what is there; parsers do not."""
    suffix = path.suffix.lower()
    if suffix == ".stl":
        announced = 84 + 50 * int.from_bytes(data[80:84], "little")
        text = data.lstrip()[:5].lower() == b"solid"
        broken = b"endsolid" not in data.lower() if text and len(data) != announced else len(data) < max(announced, 84)
    elif suffix == ".glb":
        broken = data[:4] == b"glTF" and int.from_bytes(data[8:12], "little") > len(data)
    else:
        broken = False
    if broken:
        raise ValueError(f"{path}: is cut off or no {suffix[1:].upper()} file; export or copy it again")


def _check_scene(path: Path, data: bytes) -> None:
    """Refuse a scene of more parts than a parser reads in good time."""
    if path.suffix.lower() != ".glb" or data[:4] != b"glTF":
        return
    size = int.from_bytes(data[12:16], "little")
    parts = len(files.parse_json(data[GLB_SCENE : GLB_SCENE + size].decode(), path).get("nodes", ()))
    if parts > MAX_NODES:
        raise DataError(f"{path}: is a scene of {parts} parts, and at most {MAX_NODES} are read; join them to one mesh")
