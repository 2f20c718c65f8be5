"""Folders of runs, which are started once, resumed if unfinished, and never overwritten by accident; and JSON files and
parts of results that are written atomically.
"""

import atexit
import contextlib
import hashlib
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from i2t.cli.exit_codes import exit_code_of
from i2t.cli.options import require_writable
from i2t.files.writing import replacing, write_json
from i2t.models.finished import CONFIG, METRICS
from i2t.objects.named import split_unit

# options that do not affect results, which config.json therefore leaves out
RUN_OPTIONS = ("out", "resume", "overwrite", "workers", "config")
# Nested dict of arrays: results of an experiment for one pad and seed. Its keys are names of methods and conditions,
# which `i2t.files.serialization` cannot store, because it stores NamedTuples of known types.
Part = dict[str, Any]


def exit_code_of_run(work: Callable[[], Any], resumable: Path | None = None) -> int:
    """Run an experiment's work and return its exit code. A user's mistake is explained in one sentence. After Ctrl-C, a
    message names the folder of the finished parts if the run is `resumable`. A run without results is removed and does
    not replace an earlier one.
    """
    try:
        return exit_code_of(work, lambda: _interrupted(resumable))
    finally:
        settle_begun()


def _interrupted(resumable: Path | None) -> str:
    """Explain the state of a run after Ctrl-C."""
    if not any(_has_results(out) for out in _BEGUN):
        return "interrupted; nothing was made"
    if resumable is None:
        return "interrupted; the run is incomplete: pass --overwrite to start again"
    return f"interrupted; finished parts are in {resumable}, go on with --resume"


def settings(args: Any) -> dict[str, Any]:
    """Collect the options of a run from a dataclass, digests of the files that they name, and package versions. Options
    that do not affect results, such as the output folder and the workers, are left out.
    """
    packages = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")
    kept = {k: v for k, v in asdict(args).items() if k not in RUN_OPTIONS}
    named = [item for value in kept.values() for item in (value if isinstance(value, tuple) else (value,))]
    return {
        "args": {name: str(value) if isinstance(value, Path) else value for name, value in kept.items()},
        "files": {str(path): _digest(path) for path in map(_file_of, named) if path is not None and path.is_file()},
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in packages}},
    }


def _file_of(value: Any) -> Path | None:
    """Return the file that an option names, without the unit of a mesh; None for an option of another kind."""
    return Path(split_unit(str(value))[0]) if isinstance(value, Path) else None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def folder_of(args: Any) -> Path | None:
    """Find the folder of a run from its options: `folder`, or `out`; None if nothing is written."""
    folder: Path | None = getattr(args, "folder", getattr(args, "out", None))
    return folder


def begin(args: Any, experiment: Any) -> None:
    """Create the folder of a run and record its settings and package versions; refuse a used folder (ValueError).

    With `args.resume`, if the experiment has that option, an unfinished run with the same settings is continued. With
    `args.overwrite`, an earlier run is replaced as soon as this run has results.

    Args:
        args: The options, a dataclass.
        experiment: The settings, a dataclass.
    """
    out = folder_of(args)
    assert out is not None
    config = settings(args) | {"experiment": asdict(experiment), "kind": type(args).__name__}
    path = out / CONFIG
    check_out(args, out)
    if path.exists() and not args.overwrite:
        before = json.loads(path.read_text(), object_hook=_with_new_names)
        same = json.loads(json.dumps(config, default=str))
        before = _with_new_settings(before, same)
        if {"files": {}, **before, "versions": None, "kind": None} != {**same, "versions": None, "kind": None}:
            raise ValueError(f"{out} was begun with other settings or data ({path}); pass those, or --overwrite")
    place = out.resolve()
    if path.exists() and args.overwrite:
        shutil.rmtree(_replaced(place), ignore_errors=True)
        place.rename(_replaced(place))
    _BEGUN[place] = [parent for parent in place.parents if not parent.exists()]
    place.mkdir(parents=True, exist_ok=True)
    write_json(path, config)


def _with_new_names(values: dict[str, Any]) -> dict[str, Any]:
    """Replace names of settings of earlier versions."""
    former = {
        "half": "half_edge", "judging": "selection", "looked_from": "tool_offset_at_capture", "worn_pad": "pad_file",
    }  # fmt: skip
    return {former.get(name, name): value for name, value in values.items()}


def _with_new_settings(before: Any, now: Any) -> Any:
    """Add settings that were constants in earlier versions, such as the forces of `experiments.shapes` (N)."""
    if not isinstance(before, dict) or not isinstance(now, dict):
        return before
    constants = {"forces": [1.0, 3.0]}
    added = {name: value for name, value in constants.items() if name in now}
    return added | {name: _with_new_settings(value, now.get(name)) for name, value in before.items()}


def check_out(args: Any, out: Path) -> None:
    """Refuse a folder that a run with these options may not use (ValueError), such as one that holds another run. This
    creates nothing and has no slow imports.
    """
    check_folder(out)
    path = out / CONFIG
    begun = path.exists()
    if not _is_ours(path, type(args).__name__) if begun else out.exists() and any(out.iterdir()):
        raise ValueError(f"{out} is not empty and holds no run of this experiment; choose another --out")
    if not begun:
        return
    if args.overwrite:
        if Path.cwd().is_relative_to(out.resolve()):
            raise ValueError(f"{out} is the folder in which this command runs; --overwrite does not replace it")
        return
    if (out / METRICS).exists():
        raise ValueError(f"{out} holds a finished run; choose another --out, or pass --overwrite")
    resumable = hasattr(args, "resume")
    if not (resumable and args.resume):
        remedy = "pass --resume to go on with it, or --overwrite" if resumable else "pass --overwrite"
        raise ValueError(f"{out} holds an unfinished run; {remedy}")


def check_folder(out: Path) -> None:
    """Refuse an output folder that is a file, is below a file, or is not writable (ValueError)."""
    if out.is_file():
        raise ValueError(f"--out {out}: {out} is a file; name a folder")
    require_writable("--out", out)


def settle_begun() -> None:
    """Remove run folders of this process that hold no results, with the parent folders created for them, and restore
    the runs that they were to replace. Delete replaced runs if there are results.
    """
    while _BEGUN:
        out, new_parents = _BEGUN.popitem()
        replaced = _replaced(out)
        if not _has_results(out):
            shutil.rmtree(out, ignore_errors=True)
            if replaced.exists():
                replaced.rename(out)
            with contextlib.suppress(OSError):  # another process has written to one of the parents
                for folder in new_parents:
                    folder.rmdir()
        elif replaced.exists():
            shutil.rmtree(replaced)


def _has_results(out: Path) -> bool:
    """Test whether a run folder holds more than its config.json and the workers' logs."""
    return any(path.is_file() and path != out / CONFIG and path.suffix != ".log" for path in out.rglob("*"))


_BEGUN: dict[Path, list[Path]] = {}  # run folders of this process, with the parent folders created for each
atexit.register(settle_begun)  # for runs that were not started by a command


def _replaced(out: Path) -> Path:
    """Return the path at which a replaced run is kept until the new run has results."""
    return out.with_name(f".{out.name}.replaced")


def _is_ours(config: Path, kind: str) -> bool:
    """Test whether `begin` wrote a config.json for options of this kind. Early versions did not record the kind."""
    try:
        about = json.loads(config.read_text())
    except (OSError, ValueError):
        return False
    ours = isinstance(about, dict) and about.keys() >= {"args", "versions", "experiment"}
    return ours and about.get("kind", kind) == kind


def pictures_in(out: Path) -> str:
    """List the names of a run's first few figures."""
    names = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.suffix in (".png", ".html", ".svg"))
    return ", ".join(names[:6]) + (" ..." if len(names) > 6 else "")


def save_part(path: Path, part: Part) -> None:
    """Write a part atomically, so that a resumed run can load it.

    Args:
        path: An npz file for nested dicts of arrays, or a JSON file.
        part: The part.

    Raises:
        DataError: The part cannot be written.
    """
    if path.suffix == ".json":
        write_json(path, part)
        return
    import numpy as np

    with replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **_flat(part))


def load_part(path: Path) -> Part:
    """Read a part that `save_part` wrote.

    Args:
        path: Path of its file.

    Returns:
        The same nested dicts.
    """
    if path.suffix == ".json":
        return dict(json.loads(path.read_text()))
    import numpy as np

    part: Part = {}
    with np.load(path) as file:
        for key, array in file.items():
            *above, name = key.split("/")
            level = part
            for key in above:
                level = level.setdefault(key, {})
            level[name] = array
    return part


def _flat(part: Part, prefix: str = "") -> dict[str, Any]:
    """Flatten nested dicts to arrays by their names, joined by "/"."""
    arrays: dict[str, Any] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            arrays |= _flat(value, f"{prefix}{name}/")
        else:
            arrays[prefix + name] = value
    return arrays
