"""Checks of several commands before they import anything large: runs, data sets, and objects to tell apart."""

import json
from collections.abc import Sequence
from pathlib import Path

from experiments.common.runs import CONFIG, METRICS
from i2t.cli.options import require_path
from i2t.errors import closest
from i2t.files.kinds import MESH_SUFFIXES
from i2t.files.reading import why_no_touches
from i2t.models import READY_MODELS
from i2t.objects.named import require_object

DATASET_SUFFIX = ".h5"
KIND_OF_TRAIN = "TrainArgs"  # as runs of experiments.train note it


def finished_runs(folder: Path) -> list[Path]:
    """The folder of a run of `experiments.train`, or those of a study's pads and seeds.

    Args:
        folder: Named by the user.

    Returns:
        Folders of finished runs.

    Raises:
        ValueError: There is none.
    """
    folders = sorted(path.parent for path in folder.glob(f"pad-*-seed-*/{METRICS}")) or [folder]
    if why := _why_no_run(folder, folders[0]):
        raise ValueError(f"{folder} {why}")
    return folders


def _why_no_run(folder: Path, first: Path) -> str:
    """End of a sentence on a folder without a finished run of `experiments.train`; "" where it has one."""
    if folder.is_file():
        return "is a file and holds no finished run; name the folder that experiments.train wrote"
    if not folder.exists() or not any(folder.iterdir()):
        return f"holds no finished run; make one: python -m experiments.train --out {folder}"
    try:
        kind = json.loads((folder / CONFIG).read_text()).get("kind")
    except (OSError, ValueError, AttributeError):  # none, or another program's
        kind = None
    if kind not in (None, KIND_OF_TRAIN):
        return f"holds a run of another command ({kind}); name a folder that experiments.train wrote"
    if (first / METRICS).exists():
        return ""
    if kind == KIND_OF_TRAIN or (folder / CONFIG).exists():
        return "holds no finished run but one that was interrupted; go on with it: the same command with --resume"
    return "holds no finished run but other files; name a folder that experiments.train wrote"


def pad_name(folder: Path) -> str:
    """The pad of a finished run: its number, its file, or for recorded touches none."""
    return str(json.loads((folder / METRICS).read_text()).get("pad"))


def chosen_runs(folder: Path, pads: Sequence[str]) -> list[Path]:
    """Finished runs (`finished_runs`) with some pads.

    Args:
        folder: Named by the user.
        pads: Names of the pads; all runs where none is given.

    Returns:
        Folders of finished runs.

    Raises:
        ValueError: There is no run, or none with one of these pads.
    """
    folders = finished_runs(folder)
    if not pads:
        return folders
    names = [pad_name(each) for each in folders]
    missing = sorted(set(pads) - set(names))
    if missing:
        raise ValueError(
            f"{folder} has no run with pad {', '.join(missing)}; its pads are {', '.join(sorted(set(names)))}"
        )
    return [each for each, name in zip(folders, names, strict=True) if name in pads]


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


def require_pad(path: Path | None) -> None:
    """Refuse what --pad names where it is neither there nor the name of a ready model.

    Args:
        path: As given; None where the option was left out.

    Raises:
        ValueError: Nothing is there.
    """
    if path is not None and "pad_model.npz" not in READY_MODELS.get(str(path), ()):
        ready = [name for name, parts in READY_MODELS.items() if "pad_model.npz" in parts]
        if not path.exists() and (name := closest(str(path), ready)):
            raise ValueError(f"--pad {path}: there is no such file or folder; did you mean {name}?")
        require_path("--pad", path)


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
