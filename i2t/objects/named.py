"""Objects by their names on a command line: a name in the catalogue, or a mesh file with its unit.

The unit of a mesh file is that of `--unit`, or ends its name, as in `mug.stl:mm`, which takes precedence. A glTF file,
such as `mug.glb`, is in metres unless a unit is given, and its y axis points up.

Modules that load or read meshes are imported inside functions, so that the help of a command appears without delay.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from i2t.errors import DataError, did_you_mean
from i2t.files.kinds import MESH_SUFFIXES, METRE_SUFFIXES, METRES_PER_UNIT

if TYPE_CHECKING:
    from i2t.objects.solids import Mesh, Object

# Remedy in messages about an object name that is not in the catalogue.
CATALOGUE_HINT = 'see its names with: python -c "import i2t.objects; print(i2t.objects.NAMES)"'


def split_unit(name: str) -> tuple[str, str | None]:
    """Split the name of an object into the name without its unit, and the unit.

    Args:
        name: A name in the catalogue, or the path of a mesh file, perhaps followed by a colon and the file's unit.
            Other colons belong to the path, such as those of `C:\\mug.stl` and of an existing file `mug.stl:mm`.

    Returns:
        The name without unit, and the unit, which is None if the name has none.

    Raises:
        ValueError: The word after the colon is not a unit.
    """
    file, _, unit = name.rpartition(":")
    if Path(file).suffix.lower() not in MESH_SUFFIXES or not unit.isalpha() or Path(name).is_file():
        return name, None
    if unit not in METRES_PER_UNIT:
        raise ValueError(f"{name}: {unit} is not a unit of length; {did_you_mean(unit, METRES_PER_UNIT)}")
    return file, unit


def object_name(name: str) -> str:
    """Return the name by which data sets and messages call an object.

    Args:
        name: The object as a command line names it.

    Returns:
        Its name in the catalogue, or the name of its file without folder, ending and unit.

    Raises:
        ValueError: The word after the last colon is not a unit.
    """
    return Path(split_unit(name)[0]).stem


def units_of(names: Sequence[str], unit: str | None) -> list[str | None]:
    """Determine which unit `--unit` gives to each of several objects.

    Args:
        names: The objects as a command line names them.
        unit: The unit of the files that have none, as `--unit` gives it; None if it was left out.

    Returns:
        The unit of each object, for `read_object`. A unit in the name of a file stays there. A glTF file keeps its
        metres if another file needs the unit.

    Raises:
        ValueError: The word after the last colon of a name is not a unit.
    """
    split_names = [split_unit(name) for name in names]
    suffixes = [Path(file).suffix.lower() if own is None else "" for file, own in split_names]
    needed = any(suffix in MESH_SUFFIXES and suffix not in METRE_SUFFIXES for suffix in suffixes)
    return [None if needed and suffix in METRE_SUFFIXES else unit for suffix in suffixes]


def require_object(name: str, unit: str | None, *, flag: str = "", catalogue: bool = True) -> None:
    """Refuse a name that is neither an object of the catalogue nor a mesh file with its unit.

    Args:
        name: A name in the catalogue, or the path of a mesh file, perhaps with its unit.
        unit: The unit of the file; None if none was given.
        flag: The option by which the name was given, for messages; empty if there is none.
        catalogue: Whether names in the catalogue are allowed.

    Raises:
        ValueError: The name is neither, or the unit is missing.
    """
    from i2t.objects.catalogue import NAMES

    if catalogue and name in NAMES:
        return
    file, own_unit = split_unit(name)
    subject, path = f"{flag} {file}".strip(), Path(file)
    if not path.is_file():
        what = "is neither a mesh file nor an object of the catalogue" if catalogue else "is not a mesh file"
        if path.is_dir():
            raise ValueError(f"{subject}: {what} but a folder; name a file in it")
        if path.suffix or len(path.parts) > 1:
            raise ValueError(f"{subject}: {what}, as there is no such file; check the name{_folder_hint(path)}")
        raise ValueError(f"{subject}: {what}" + (f"; {did_you_mean(name, NAMES, CATALOGUE_HINT)}" if catalogue else ""))
    if own_unit is None and unit is None and path.suffix.lower() not in METRE_SUFFIXES:
        raise ValueError(f"{subject}: its unit is missing; give it, for instance --unit mm or {file}:mm")


def read_object(name: str, unit: str | None, *, largest_piece: bool = False) -> "Object":
    """Load an object of the catalogue, or read one from a mesh file.

    Args:
        name: A name in the catalogue, or the path of a mesh file, perhaps with its unit.
        unit: The unit of the mesh file: m, cm, mm or inch. It is ignored for an object of the catalogue and for a file
            whose name ends in its unit.
        largest_piece: Whether only the largest connected piece of a mesh file is touched.

    Returns:
        The object, standing on the table, in metres.

    Raises:
        ValueError: The name is neither in the catalogue nor a file, the unit is missing, or the file holds no usable
            mesh.
    """
    from i2t.objects.catalogue import NAMES, make_object
    from i2t.objects.mesh_files import load_object

    require_object(name, unit)
    if name in NAMES:
        return make_object(name)
    file, own_unit = split_unit(name)
    return load_object(file, own_unit or unit, largest_piece=largest_piece)


def require_objects(paths: Sequence[Path], unit: str | None, *, minimum: int = 2, catalogue: bool = True) -> None:
    """Refuse objects that do not exist, that share a name, or that are too few.

    Args:
        paths: Values of --objects: names of the catalogue or mesh files; empty if the option was omitted.
        unit: Unit of the files whose names have none.
        minimum: Minimum number of objects.
        catalogue: Whether names of the catalogue are allowed.

    Raises:
        ValueError: The objects are refused, or a file has no unit.
    """
    if not paths:
        if unit is not None:
            raise ValueError("--unit is the unit of the mesh files of --objects; pass both, or omit --unit")
        return
    names = list(map(str, paths))
    for name, own_unit in zip(names, units_of(names, unit), strict=True):
        require_object(name, own_unit, flag="--objects", catalogue=catalogue)
    if len(paths) < minimum:
        raise ValueError("--objects needs at least two objects to distinguish")
    seen: dict[str, str] = {}
    for name in names:
        own = object_name(name)
        if own in seen:
            raise ValueError(
                f"--objects: {seen[own]} and {name} are both called {own}, and objects are identified by name; rename "
                "one of them"
            )
        seen[own] = name


def read_meshes(names: Sequence[str | Path], unit: str | None = None) -> dict[str, "Mesh"]:
    """Read the meshes of several objects.

    Args:
        names: The objects as a command line names them: names in the catalogue, or mesh files.
        unit: The unit of the mesh files that have none; see `units_of`.

    Returns:
        The meshes (m) by `object_name`, standing on the table.

    Raises:
        ValueError: An object cannot be read, as in `read_object`.
    """
    texts = list(map(str, names))
    units = units_of(texts, unit)
    return {object_name(text): read_object(text, own).mesh for text, own in zip(texts, units, strict=True)}


def meshes_of_dataset(names: Sequence[str], dataset: str) -> dict[str, "Mesh"]:
    """Load the meshes of a data set's objects from the catalogue.

    Args:
        names: Names of the objects of the data set.
        dataset: Name of the data set, for messages.

    Returns:
        The meshes by name.

    Raises:
        DataError: The catalogue lacks an object, or there is only one object.
    """
    from i2t.objects.catalogue import NAMES

    if missing := [name for name in names if name not in NAMES]:
        raise DataError(
            f"{dataset} has touches of {', '.join(missing)}, of which there is no mesh; name all objects to "
            f"distinguish, with a mesh of that name, for instance --objects star {missing[0]}.stl --unit mm"
        )
    if len(names) < 2:
        raise DataError(f"{dataset} has touches of {names[0]} only; name the objects to distinguish: --objects")
    return read_meshes(names)


def describe_placement(thing: "Object") -> str:
    """Describe how an object's frame differs from that of its mesh file, and which pieces are not touched.

    Args:
        thing: The object, as `read_object` returns it.

    Returns:
        A sentence for the user; empty if the frames are the same and no piece is left out.
    """
    from i2t.geometry import inverse

    T_object_file = inverse(thing.T_file_object)
    x, y, z = (1e3 * T_object_file[:3, 3]).tolist()
    turned = "turned from y up to z up and " if T_object_file[2, 1] > 0.5 else ""
    sentences = []
    if turned or max(abs(x), abs(y), abs(z)) >= 0.005:  # smaller shifts are 0.00 mm in the sentence
        sentences.append(
            f"the mesh was {turned}moved by {x:.2f}, {y:.2f}, {z:.2f} mm from its file's frame, to stand on z = 0 with "
            "its box centred in x and y"
        )
    if thing.obstacles is not None:
        sentences.append(
            f"{len(thing.obstacles.faces)} faces of other pieces are not touched, and the arm keeps clear of them"
        )
    return f"{thing.name}: {'; '.join(sentences)}" if sentences else ""


def _folder_hint(path: Path) -> str:
    """Word a hint for a missing file: the most similar name in its folder, or that the folder is missing."""
    if not path.parent.is_dir():
        return f", and there is no folder {path.parent}"
    hint = did_you_mean(path.name, (other.name for other in path.parent.iterdir()), "")
    return f"; {hint}" if hint else ""
