"""Mesh files of other people: read with an explicit unit, cleaned, and honest about what was cleaned.

A file says nothing reliable about its unit, so the caller does. `i2t.objects.formats` reads its triangles.
Everything in a file is one object, whatever number of bodies it has (`i2t.objects.mesh_cleaning`). The object's frame
stands on the table, and `Object.T_file_object` leads back to the file's.
"""

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.files.kinds import MESH_SUFFIXES
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import read_bytes as read_file
from i2t.files.writing import as_path
from i2t.geometry import inverse
from i2t.objects.formats.kinds import foreign_kind
from i2t.objects.formats.parse import parse_mesh
from i2t.objects.mesh_cleaning import CleaningReport, clean_mesh
from i2t.objects.solids import IDENTITY, Mesh, Object, table_transform, transform_mesh

METRES_PER_UNIT = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "inch": 25.4e-3}  # m
MIN_SIZE_M, MAX_SIZE_M = 2e-3, 2.0  # m, longest side of something to touch
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # from a frame whose y is up


def read_mesh(
    path: str | Path, unit: str, *, table: bool = True, largest_piece: bool = False, up: str = "z"
) -> tuple[Object, CleaningReport]:
    """Read and clean a mesh file. (An OBJ file cut off between two lines cannot be distinguished from a whole one.)

    Args:
        path: An STL, OBJ, PLY, OFF, GLB or glTF file.
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
    path = as_path("path", path)
    data = read_bytes(path, MESH_SUFFIXES)
    scale = to_metres(path, unit)
    if up not in ("z", "y"):
        raise ValueError(f"{path}: up={up!r} is not known; say up='z' or up='y'")
    vertices, faces, skipped = parse_mesh(path, data)
    if skipped:
        rule = "faces are read, and of several scenes the default one"
        warnings.warn(f"{path}: left out {' and '.join(skipped)}; {rule}", stacklevel=2)
    vertices = vertices * scale
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
        path: An STL, OBJ, PLY, OFF, GLB or glTF file.
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
        path: An STL, OBJ, PLY, OFF, GLB or glTF file.
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
        kind, remedy = foreign_kind(path.suffix)
        is_kind = f"is {kind}: " if kind else ""
        raise ValueError(f"{path}: {is_kind}its ending {path.suffix!r} is none of {', '.join(suffixes)}; {remedy}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the name")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    data = read_file(path, READ_LIMITS.mesh_bytes)
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
