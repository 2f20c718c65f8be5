"""Checks of several commands before they import anything large: data sets, and objects to tell apart."""

from collections.abc import Sequence
from pathlib import Path

from i2t.files.kinds import MESH_SUFFIXES
from i2t.files.reading import why_no_touches
from i2t.objects.named import require_object


def require_dataset(flag: str, path: Path | None, *, tables: bool = False) -> None:
    """Refuse a data set that is not there, or a file of another kind; what is in it, `i2t.load_dataset` judges.

    Args:
        flag: The option that names it.
        path: A folder or a file; None where the option was left out.
        tables: Whether the command reads other files than those of touches too.

    Raises:
        ValueError: There is nothing, an empty folder, or a file of another kind.
    """
    if path is None:
        return
    if not path.exists():
        raise ValueError(f"{flag} {path}: there is no such data set; check the name")
    if path.is_dir() and not any(path.iterdir()):
        raise ValueError(f"{flag} {path}: is an empty folder; name one that holds touches")
    if path.is_file() and not (tables and path.suffix.lower() not in MESH_SUFFIXES) and (why := why_no_touches(path)):
        raise ValueError(f"{flag} {why}")


def require_objects(paths: Sequence[Path], unit: str | None, *, least: int = 2, catalogue: bool = True) -> None:
    """Refuse objects that are not there, that share a name, or that are too few.

    Args:
        paths: Of --objects: names of the catalogue or mesh files; none where the option was left out.
        unit: Of the files' lengths.
        least: How many there must be.
        catalogue: Whether names of the catalogue are welcome.

    Raises:
        ValueError: Any of these, or a file without a unit.
    """
    if not paths:
        if unit is not None:
            raise ValueError("--unit is of the mesh files of --objects; pass both, or leave --unit out")
        return
    for path in paths:
        require_object(str(path), unit, flag="--objects", catalogue=catalogue)
    if len(paths) < least:
        raise ValueError("--objects needs at least two objects to tell apart")
    seen: dict[str, Path] = {}
    for path in paths:
        if path.stem in seen:
            raise ValueError(
                f"--objects: {seen[path.stem]} and {path} are both called {path.stem}, and objects are told apart by "
                "name; rename one of them"
            )
        seen[path.stem] = path
