"""Folders of runs: begun once, resumed if unfinished, never overwritten by accident; JSON and parts of results that
appear whole or not at all.
"""

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from i2t.cli import exit_code_of
from i2t.prediction.checkpoint import PACKAGES

# Of arrays, or of such dicts: what an experiment made of one pad and seed. Its names are the experiment's own words,
# methods and conditions, which `i2t.serialization` cannot hold: that is for NamedTuples whose type is known.
Part = dict[str, Any]
BETWEEN = "/"  # names of a part's levels on disk


def exit_code_of_run(work: Callable[[], Any], resumable: Path | None = None) -> int:
    """The exit code of a command: what its user can mend is said in one sentence, and after Ctrl-C where a `resumable`
    run left its finished parts.
    """
    kept = "" if resumable is None else f"; finished parts are in {resumable}, go on with --resume"
    return exit_code_of(work, f"interrupted{kept}")


def settings(args: Any) -> dict[str, Any]:
    """What is run, from a dataclass, and with which versions; where it is kept and how it goes on is no setting."""
    kept = {name: value for name, value in asdict(args).items() if name not in ("out", "resume", "overwrite")}
    return {
        "args": {name: str(value) if isinstance(value, Path) else value for name, value in kept.items()},
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in PACKAGES}},
    }


def begin(out: Path, args: Any, experiment: Any, resume: bool | None, overwrite: bool) -> None:
    """Make the folder of a run, or refuse one that is in use (ValueError); note what is run and with which versions.

    `args` and `experiment` are dataclasses. An unfinished run of the same settings goes on with `resume` (None: this
    experiment cannot); what is there is removed with `overwrite`.
    """
    config = settings(args) | {"experiment": asdict(experiment)}
    path = out / "config.json"
    if path.exists() and overwrite:
        shutil.rmtree(out)
    if (out / "metrics.json").exists():
        raise ValueError(f"{out} holds a finished run; choose another --out, or pass --overwrite")
    if path.exists():
        if not resume:
            remedy = "pass --overwrite" if resume is None else "pass --resume to go on with it, or --overwrite"
            raise ValueError(f"{out} holds an unfinished run; {remedy}")
        before = json.loads(path.read_text())
        same = json.loads(json.dumps(config))
        if {**before, "versions": None} != {**same, "versions": None}:
            raise ValueError(f"{out} was begun with other settings ({path}); pass those, or --overwrite")
    elif out.exists() and any(out.iterdir()):
        raise ValueError(f"{out} is not empty and holds no run of this experiment; choose another --out")
    out.mkdir(parents=True, exist_ok=True)
    write_json(path, config)


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write at once or not at all; NaN becomes null."""

    def clean(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): clean(value) for key, value in node.items()}
        if isinstance(node, list | tuple):
            return [clean(value) for value in node]
        return None if isinstance(node, float) and not np.isfinite(node) else node

    part = path.with_suffix(".part")
    part.write_text(json.dumps(clean(values), indent=1, default=str) + "\n")
    part.replace(path)


def slug(name: str) -> str:
    """A folder name."""
    return "-".join("".join(c if c.isalnum() else " " for c in name.replace("'s", "")).split())


def save_part(path: Path, part: Part) -> None:
    """Write nested dicts of arrays whole or not at all, for a resumed run to find.

    Args:
        path: An npz file.
        part: What to write.

    Raises:
        OSError: It cannot be written.
    """
    partial = path.with_suffix(".part.npz")
    np.savez_compressed(partial, allow_pickle=False, **_flat(part))
    partial.replace(path)


def load_part(path: Path) -> Part:
    """What `save_part` wrote.

    Args:
        path: An npz file.

    Returns:
        The same nested dicts.
    """
    part: Part = {}
    with np.load(path) as file:
        for key, array in file.items():
            *above, name = key.split(BETWEEN)
            level = part
            for each in above:
                level = level.setdefault(each, {})
            level[name] = array
    return part


def _flat(part: Part, prefix: str = "") -> dict[str, np.ndarray]:
    """Arrays by their levels' names, joined."""
    arrays: dict[str, np.ndarray] = {}
    for name, value in part.items():
        if isinstance(value, dict):
            arrays |= _flat(value, f"{prefix}{name}{BETWEEN}")
        else:
            arrays[prefix + name] = np.asarray(value)
    return arrays
