"""Folders of runs: begun once, resumed if unfinished, never overwritten by accident; JSON and parts of results that
appear whole or not at all.
"""

import atexit
import contextlib
import hashlib
import json
import math
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from i2t.cli.exit_codes import exit_code_of
from i2t.cli.options import require_writable
from i2t.files.writing import replacing

CONFIG, METRICS = "config.json", "metrics.json"
LOG = ".log"  # of what a worker printed (`experiments.common.tasks`)
MAX_PICTURES_NAMED = 6
PACKAGES = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")  # whose versions a run notes
NO_SETTINGS = ("out", "resume", "overwrite", "workers")  # options that change no result
CONFIG_KEYS = {"args", "versions", "experiment"}  # by which a config.json is known to be ours
# Of arrays, or of such dicts: what an experiment made of one pad and seed. Its names are the experiment's own words,
# methods and conditions, which `i2t.files.serialization` cannot hold: that is for NamedTuples whose type is known.
Part = dict[str, Any]
BETWEEN = "/"  # names of a part's levels on disk


def exit_code_of_run(work: Callable[[], Any], resumable: Path | None = None) -> int:
    """The exit code of an experiment's work: what its user can mend is said in one sentence, and after Ctrl-C where a
    `resumable` run left its finished parts. A run that made nothing leaves nothing behind, nor does it take an earlier
    one's place.
    """
    try:
        return exit_code_of(work, lambda: _interrupted(resumable))
    finally:
        settle_begun()


def _interrupted(resumable: Path | None) -> str:
    """Explain the state of a run after Ctrl-C."""
    if not any(_made_something(out) for out in _BEGUN):
        return "interrupted; nothing was made"
    if resumable is None:
        return "interrupted; what was made is no complete run: the same command with --overwrite begins again"
    return f"interrupted; finished parts are in {resumable}, go on with --resume"


def settings(args: Any) -> dict[str, Any]:
    """Options of a run, from a dataclass, what the files that they name hold, and package versions; where results go,
    workers and resuming are no settings.
    """
    kept = {name: value for name, value in asdict(args).items() if name not in NO_SETTINGS}
    named = [each for value in kept.values() for each in (value if isinstance(value, tuple) else (value,))]
    return {
        "args": {name: str(value) if isinstance(value, Path) else value for name, value in kept.items()},
        "files": {str(path): _digest(path) for path in named if isinstance(path, Path) and path.is_file()},
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}},
    }


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def folder_of(args: Any) -> Path | None:
    """The folder of a run by its options: their `folder`, or `out`; None where nothing is written."""
    folder: Path | None = getattr(args, "folder", getattr(args, "out", None))
    return folder


def begin(args: Any, experiment: Any) -> None:
    """Make the folder of a run, or refuse one that is in use (ValueError); note what is run and with which versions.

    An unfinished run of the same settings goes on with `args.resume`, where the experiment has that option; what is
    there is replaced with `args.overwrite`, once this run has made something.

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
        before = json.loads(path.read_text())
        same = json.loads(json.dumps(config, default=str))
        if {"files": {}, **before, "versions": None, "kind": None} != {**same, "versions": None, "kind": None}:
            raise ValueError(f"{out} was begun with other settings or data ({path}); pass those, or --overwrite")
    place = out.resolve()
    if path.exists() and args.overwrite:
        shutil.rmtree(_aside(place), ignore_errors=True)
        place.rename(_aside(place))
    _BEGUN[place] = [parent for parent in place.parents if not parent.exists()]
    place.mkdir(parents=True, exist_ok=True)
    write_json(path, config)


def check_out(args: Any, out: Path) -> None:
    """Refuse a folder that a run of these options may not use (ValueError), as one that holds a run of others; makes
    nothing, and imports nothing large.
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
    """Refuse a folder for results that is a file, is below one, or may not be written (ValueError)."""
    if out.is_file():
        raise ValueError(f"--out {out}: {out} is a file; name a folder")
    require_writable("--out", out)


def settle_begun() -> None:
    """Take back folders that runs of this process began and made nothing in, with those above them that were made for
    them, and put what they were to replace in its place again; remove what was replaced for good.
    """
    while _BEGUN:
        out, made_above = _BEGUN.popitem()
        aside = _aside(out)
        if not _made_something(out):
            shutil.rmtree(out, ignore_errors=True)
            if aside.exists():
                aside.rename(out)
            with contextlib.suppress(OSError):  # something else has come into one of them
                for folder in made_above:
                    folder.rmdir()
        elif aside.exists():
            shutil.rmtree(aside)


def _made_something(out: Path) -> bool:
    """Test whether a folder that was begun holds more than the note of its beginning and the workers' logs."""
    return any(path.is_file() and path != out / CONFIG and path.suffix != LOG for path in out.rglob("*"))


_BEGUN: dict[Path, list[Path]] = {}  # folders that this process writes runs into; of each, those made above it
atexit.register(settle_begun)  # for runs that no command line began


def _aside(out: Path) -> Path:
    """Path of a replaced run until another has taken its place."""
    return out.with_name(f".{out.name}.replaced")


def _is_ours(config: Path, kind: str) -> bool:
    """Test whether a config.json was written by `begin` for options of this kind; early versions noted no kind."""
    try:
        about = json.loads(config.read_text())
    except (OSError, ValueError):
        return False
    return isinstance(about, dict) and about.keys() >= CONFIG_KEYS and about.get("kind", kind) == kind


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write at once or not at all; NaN becomes null."""

    def clean(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): clean(value) for key, value in node.items()}
        if isinstance(node, list | tuple):
            return [clean(value) for value in node]
        return None if isinstance(node, float) and not math.isfinite(node) else node

    with replacing(path) as temporary:
        temporary.write_text(json.dumps(clean(values), indent=1, default=str) + "\n")


def pictures_in(out: Path) -> str:
    """Names of a run's figures, the first few."""
    names = sorted(str(path.relative_to(out)) for path in out.rglob("*") if path.suffix in (".png", ".html", ".svg"))
    return ", ".join(names[:MAX_PICTURES_NAMED]) + (" ..." if len(names) > MAX_PICTURES_NAMED else "")


def save_part(path: Path, part: Part) -> None:
    """Write a part whole or not at all, for a resumed run to find.

    Args:
        path: An npz file for nested dicts of arrays, or a JSON file.
        part: What to write.

    Raises:
        DataError: It cannot be written.
    """
    if path.suffix == ".json":
        write_json(path, part)
        return
    import numpy as np

    with replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **_flat(part))


def load_part(path: Path) -> Part:
    """Read what `save_part` wrote.

    Args:
        path: Its file.

    Returns:
        The same nested dicts.
    """
    if path.suffix == ".json":
        return dict(json.loads(path.read_text()))
    import numpy as np

    part: Part = {}
    with np.load(path) as file:
        for key, array in file.items():
            *above, name = key.split(BETWEEN)
            level = part
            for each in above:
                level = level.setdefault(each, {})
            level[name] = array
    return part


def _flat(part: Part, prefix: str = "") -> dict[str, Any]:
    """Arrays by their levels' names, joined."""
    arrays: dict[str, Any] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            arrays |= _flat(value, f"{prefix}{name}{BETWEEN}")
        else:
            arrays[prefix + name] = value
    return arrays
