"""Checks that several commands run before slow imports: of data sets, and of objects to distinguish."""

from collections.abc import Sequence
from pathlib import Path

from i2t.files.kinds import MESH_SUFFIXES
from i2t.files.reading import explain_no_dataset
from i2t.objects.named import object_name, require_object, units_of


def require_dataset(flag: str, path: Path | None, *, tables: bool = False) -> None:
    """Refuse a data set that does not exist, or a file of another kind. `i2t.load_dataset` checks the contents.

    Args:
        flag: The option that names the data set.
        path: A folder or a file; None if the option was omitted.
        tables: Whether the command also reads files that are not touches.

    Raises:
        ValueError: The path does not exist, is an empty folder, or is a file of another kind.
    """
    if path is None:
        return
    if not path.exists():
        raise ValueError(f"{flag} {path}: there is no such data set; check the name")
    if path.is_dir() and not any(path.iterdir()):
        raise ValueError(f"{flag} {path}: is an empty folder; name one that holds touches")
    if (
        path.is_file()
        and not (tables and path.suffix.lower() not in MESH_SUFFIXES)
        and (why := explain_no_dataset(path))
    ):
        raise ValueError(f"{flag} {why}")


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
