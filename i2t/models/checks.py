"""Checks of options that name a data set or a predictor, before slow imports."""

from pathlib import Path

from i2t.files.checkpoints import is_checkpoint
from i2t.files.kinds import MESH_SUFFIXES
from i2t.files.reading import explain_no_dataset
from i2t.models import explain_no_predictor, ready_hint, ready_path


def require_dataset(flag: str, path: Path | None, *, tables: bool = False) -> None:
    """Refuse a data set that does not exist, or a file of another kind. `i2t.load_dataset` checks the contents.

    Args:
        flag: The option that names the data set.
        path: A folder, a file or the name of a ready data set; None if the option was omitted.
        tables: Whether the command also reads files that are not touches.

    Raises:
        ValueError: The path does not exist, is an empty folder, or is a file of another kind.
    """
    if path is None:
        return
    hint = ready_hint(path, "touches.h5", list_all=False)
    path = path if tables else ready_path(str(path), "touches.h5")
    if not path.exists():
        raise ValueError(f"{flag} {path}: there is no such data set{hint or '; check the name'}")
    if path.is_dir() and not any(path.iterdir()):
        raise ValueError(f"{flag} {path}: is an empty folder; name one that holds touches")
    if (
        path.is_file()
        and not (tables and path.suffix.lower() not in MESH_SUFFIXES)
        and (why := explain_no_dataset(path))
    ):
        raise ValueError(f"{flag} {why}")


def require_predictor(flag: str, name: str) -> None:
    """Refuse a folder that holds no predictor.

    Args:
        flag: The option that names the predictor.
        name: Name of a ready predictor, or a folder in which one was trained.

    Raises:
        ValueError: There is no predictor.
    """
    folder = ready_path(name, "predictor")
    if not any(is_checkpoint(folder / part) for part in ("", "checkpoint/predictor")):
        raise ValueError(f"{flag} {name}: {explain_no_predictor(name)}")
