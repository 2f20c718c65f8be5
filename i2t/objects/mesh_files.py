"""Reading of mesh files, cleaned, with a report on the cleaning.

STL, OBJ, PLY and OFF files state no unit, so the caller has to give it. glTF files are in metres, and their y axis
points up. `i2t.objects.formats` reads the triangles.
Everything in a file is one object, however many bodies it has (`i2t.objects.mesh_cleaning`). The object's frame stands
on the table, and `Object.T_file_object` transforms it back to the file's frame.
"""

import warnings
from pathlib import Path

import numpy as np

from i2t.files.kinds import MESH_SUFFIXES, METRE_SUFFIXES, METRES_PER_UNIT
from i2t.files.limits import READ_LIMITS
from i2t.files.reading import read_bytes
from i2t.files.writing import as_path
from i2t.geometry import inverse
from i2t.objects.formats.kinds import foreign_kind
from i2t.objects.formats.parse import parse_mesh
from i2t.objects.mesh_cleaning import CleaningReport, clean_mesh
from i2t.objects.solids import Mesh, Object, table_transform, transform_mesh

MIN_SIZE_M, MAX_SIZE_M = 2e-3, 2.0  # m, smallest and largest accepted longest side of an object
MIN_USUAL_M, MAX_USUAL_M = 5e-3, 1.0  # m, longest sides outside which the unit of a glTF file is doubted in a warning


def read_mesh(
    path: str | Path, unit: str | None = None, *, table: bool = True, largest_piece: bool = False, up: str | None = None
) -> tuple[Object, CleaningReport]:
    """Read and clean a mesh file.

    An OBJ file that was cut off between two lines cannot be distinguished from a complete one.

    Args:
        path: The path of an STL, OBJ, PLY, OFF, GLB or glTF file.
        unit: The unit of the file's coordinates: m, cm, mm or inch. It is required unless the file is glTF, which is in
            metres.
        table: Whether to place the object on the table, with its bounding box centred in x and y and its lowest point
            on z = 0, without turning it. Otherwise it keeps the file's frame.
        largest_piece: Whether only the largest connected piece is touched; `Object.obstacles` holds the others.
        up: The file's upward axis, "y" or "z". By default, it is y in a glTF file, as its standard defines, and z in
            others. A glTF mesh that keeps the file's frame (`table=False`) is turned only if `up` is given.

    Returns:
        The object, named by the file, in metres, and a report on the cleaning.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, or its mesh cannot be touched; one sentence names the file and a remedy.
    """
    path = as_path("path", path)
    data = _mesh_bytes(path)
    known_unit = _unit_of(path, unit)
    if up is None:
        up = "y" if table and path.suffix.lower() in METRE_SUFFIXES else "z"
    elif up not in ("z", "y"):
        raise ValueError(f"{path}: up={up!r} is not known; give up='z' or up='y'")
    vertices, faces, skipped = parse_mesh(path, data)
    if skipped:
        rule = "faces are read, and of several scenes the default one"
        warnings.warn(f"{path}: left out {' and '.join(skipped)}; {rule}", stacklevel=2)
    vertices = vertices * METRES_PER_UNIT[known_unit]
    longest = float(np.ptp(vertices[faces].reshape(-1, 3), axis=0).max())
    _check_size(path, longest, known_unit)
    if path.suffix.lower() in METRE_SUFFIXES and (doubt := _doubt_unit(longest, unit)):
        warnings.warn(f"{path}: {doubt}", stacklevel=2)
    T_up_file = np.eye(4)
    if up == "y":
        T_up_file[1:3, 1:3] = [[0, -1], [1, 0]]
    upright = transform_mesh(Mesh(vertices, faces.astype(np.int32)), T_up_file)
    mesh, dropped, report = clean_mesh(upright, str(path), largest_piece=largest_piece)
    T_o_up = table_transform(mesh) if table else np.eye(4)
    placed, obstacles = transform_mesh(mesh, T_o_up), transform_mesh(dropped, T_o_up)
    T_file_object = inverse(T_o_up @ T_up_file)
    return Object(path.stem, placed, "file", T_file_object, obstacles if len(obstacles.faces) else None), report


def load_mesh(
    path: str | Path, unit: str | None = None, *, table: bool = True, largest_piece: bool = False, up: str | None = None
) -> Mesh:
    """Read the mesh in a file, cleaned.

    Args:
        path: The path of an STL, OBJ, PLY, OFF, GLB or glTF file.
        unit: The unit of the file's coordinates: m, cm, mm or inch. It is required unless the file is glTF, which is in
            metres.
        table: Whether to place the mesh on the table, with its bounding box centred in x and y and its lowest point on
            z = 0, without turning it. Otherwise it keeps the file's frame.
        largest_piece: Whether to keep only the largest connected piece; otherwise every body is kept.
        up: The file's upward axis, "y" or "z". By default, it is y in a glTF file, as its standard defines, and z in
            others. A glTF mesh that keeps the file's frame (`table=False`) is turned only if `up` is given.

    Returns:
        The mesh, in metres. `i2t.objects.read_mesh` also returns the transform to the file's frame and a report on the
        cleaning.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, or its mesh cannot be touched; one sentence names the file and a remedy.

    Example:
        mesh = i2t.load_mesh("mug.stl", "mm")
    """
    return read_mesh(path, unit, table=table, largest_piece=largest_piece, up=up)[0].mesh


def load_object(path: str | Path, unit: str | None = None, *, largest_piece: bool = False) -> Object:
    """Read the object in a mesh file and place it on the table.

    Args:
        path: The path of an STL, OBJ, PLY, OFF, GLB or glTF file.
        unit: The unit of the file's coordinates: m, cm, mm or inch. It is required unless the file is glTF, which is in
            metres.
        largest_piece: Whether only the largest connected piece is touched; `Object.obstacles` holds the others.

    Returns:
        The object, named by the file, in metres.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: The file cannot be read, or its mesh cannot be touched; one sentence names the file and a remedy.
    """
    return read_mesh(path, unit, largest_piece=largest_piece)[0]


def _mesh_bytes(path: Path) -> bytes:
    """Read the bytes of a mesh file after checking its suffix."""
    if path.suffix.lower() not in MESH_SUFFIXES:
        kind, remedy = foreign_kind(path.suffix)
        is_kind = f"is {kind}: " if kind else ""
        raise ValueError(f"{path}: {is_kind}its ending {path.suffix!r} is none of {', '.join(MESH_SUFFIXES)}; {remedy}")
    if not path.exists():
        raise FileNotFoundError(f"{path}: there is no such file; check the name")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    data = read_bytes(path, READ_LIMITS.mesh_bytes)
    if not data:
        raise ValueError(f"{path}: is empty; export it again")
    return data


def _unit_of(path: Path, unit: str | None) -> str:
    """Return the unit of a file, which is the metre by default for glTF; refuse a missing or unknown unit."""
    if unit is None:
        if path.suffix.lower() not in METRE_SUFFIXES:
            raise ValueError(f"{path}: its unit is missing; give it, for instance unit='mm'")
        return "m"
    if unit not in METRES_PER_UNIT:
        raise ValueError(
            f"{path}: unit {unit!r} is not known; give the unit of its coordinates, one of {', '.join(METRES_PER_UNIT)}"
        )
    return unit


def _doubt_unit(longest: float, unit: str | None) -> str:
    """Word a doubt about the unit of a glTF file whose longest side is given (m); empty if there is none."""
    if unit not in (None, "m"):
        return f"is read in {unit}, as given, although glTF is in metres by its standard; it is {longest:.3g} m across"
    if unit is None and not MIN_USUAL_M <= longest <= MAX_USUAL_M:
        remedy = "give another unit, such as cm" if longest > MAX_USUAL_M else "export it again in metres"
        return f"is {longest:.3g} m across in metres, the unit of glTF; if that is wrong, {remedy}"
    return ""


def _check_size(path: Path, longest: float, unit: str) -> None:
    """Refuse a mesh whose longest side (m) is too small or too large to touch, and suggest a unit that would fit."""
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
