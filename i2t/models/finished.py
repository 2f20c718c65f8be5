"""Layout of the folders of finished runs of `i2t fit` and `experiments.train`, and functions that find their files.

The folder of a run, or each folder `pad-P-seed-S` of a run of several pads or seeds, holds:

  training.json     its pad, the method of each predictor in checkpoint/, and the reason if there is no pad model
  pad_model.npz     pad model of the skin (`i2t.load_pad_model`), fitted to the training touches
  checkpoint/       predictors (`i2t.load_predictor`): `predictor`, the best of all, `on_pressure`, the best on
                    predicted contact pressure, and one for each network of the paper
  config.json       its options and package versions
  data.h5, pad.npz  touches that the run simulated, and their pad (`i2t.load_dataset`, `i2t.load_pad`)
  metrics.json      scores, written last, so that the run is finished if it exists

This module has no slow imports.
"""

import contextlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import cast

from i2t.cli.options import require_path
from i2t.errors import closest
from i2t.files.reading import read_json
from i2t.files.writing import write_json
from i2t.installation import training_command, training_commands
from i2t.models import READY_MODELS

CONFIG, METRICS = "config.json", "metrics.json"
TRAINING, PAD_MODEL, CHECKPOINTS, TOUCHES, PAD = "training.json", "pad_model.npz", "checkpoint", "data.h5", "pad.npz"
KEPT, ON_PRESSURE = "predictor", "on_pressure"  # folders in CHECKPOINTS
FORMER_NAMES = {"--trained-run": "--pad-model", "--pad": "--pad-model"}  # for options that name a run or a pad model


@dataclass(frozen=True)
class FinishedRun:
    """One pad and seed of a finished run."""

    folder: Path
    pad: int | str | None  # number of a simulated pad, or its file; None if touches were recorded
    predictors: dict[str, str] = field(default_factory=dict)  # titles of methods by their folders in CHECKPOINTS
    no_pad_model: str | None = None  # reason if there is no pad model

    @property
    def pad_name(self) -> str:
        """Name of the pad in tables and in --pads."""
        return str(self.pad)

    @property
    def pad_model(self) -> Path:
        """File of the pad model.

        Raises:
            ValueError: No pad model could be fitted to the touches.
        """
        if self.no_pad_model:
            raise ValueError(f"{self.folder} has no pad model: {self.no_pad_model}")
        return self.folder / PAD_MODEL

    def checkpoint(self, method: str) -> Path | None:
        """Find the folder of a method's predictor.

        Args:
            method: Title of the method.

        Returns:
            The folder, or None if the predictor was not saved.
        """
        names = [name for name, title in self.predictors.items() if title == method]
        return self.folder / CHECKPOINTS / names[0] if names else None

    @property
    def on_pressure(self) -> Path:
        """Folder of the best predictor on predicted contact pressure, or else of the best predictor of all."""
        return self.folder / CHECKPOINTS / (ON_PRESSURE if ON_PRESSURE in self.predictors else KEPT)

    @property
    def simulated_pad(self) -> Path:
        """File of the pad with which the run simulated its touches.

        Raises:
            ValueError: The touches were recorded.
        """
        if self.pad is None:
            raise ValueError(
                f"{self.folder} was trained on recorded touches, but simulated episodes need a simulated pad; "
                "recognise recorded touches with it (--dataset), or pass a run that simulated its touches"
            )
        return self.folder / PAD

    @property
    def touches(self) -> Path:
        """Data set of the touches that the run simulated."""
        return self.folder / TOUCHES


def write_training(run: FinishedRun) -> None:
    """Write training.json.

    Args:
        run: The record to write.
    """
    write_json(run.folder / TRAINING, {name: value for name, value in asdict(run).items() if name != "folder"})


def read_run(folder: Path) -> FinishedRun:
    """Read the record of one pad and seed.

    Args:
        folder: Folder of a finished run.

    Returns:
        The record of the run.

    Raises:
        ValueError: The run is of an earlier version without pad models, or its record is damaged.
    """
    if not (folder / TRAINING).is_file():
        raise ValueError(
            f"{folder} is a run of an earlier version, which kept no pad model; make it again: "
            f"{training_command()} --overwrite, with the options in its {CONFIG} (--config)"
        )
    try:
        return FinishedRun(folder, **json.loads((folder / TRAINING).read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{folder / TRAINING} cannot be read ({error}); restore a copy, or train again") from error


def kind_of_config(path: Path) -> str | None:
    """Read which options a config.json holds.

    Args:
        path: The file.

    Returns:
        Name of the dataclass of the options; None if the file does not name it or cannot be read.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError):  # missing, or of another program
        return cast("str | None", read_json(path).get("kind"))
    return None


def finished_runs(folder: Path, pads: Sequence[str] = ()) -> dict[int, FinishedRun]:
    """Read a finished run, or the runs of all pads and seeds.

    Args:
        folder: Folder of the run, or the pad model's file in it.
        pads: Names of the pads to select; all runs by default.

    Returns:
        The runs by their numbers among all runs in the folder, so that the random choices for a run do not depend on
        the selection.

    Raises:
        ValueError: There is no finished run, or none with one of these pads.
    """
    folder = folder.parent if _is_kept_pad_model(folder) else folder
    folders = sorted(path.parent for path in folder.glob(f"pad-*-seed-*/{METRICS}")) or [folder]
    if why := _why_no_run(folder, folders[0]):
        raise ValueError(f"{folder} {why}")
    runs = dict(enumerate(map(read_run, folders)))
    names = {run.pad_name for run in runs.values()}
    if missing := sorted(set(pads) - names):
        raise ValueError(f"{folder} has no run with pad {', '.join(missing)}; its pads are {', '.join(sorted(names))}")
    return {i: run for i, run in runs.items() if not pads or run.pad_name in pads}


def require_simulated_runs(folder: Path, pads: Sequence[str] = ()) -> None:
    """Refuse runs that cannot be used for simulated episodes.

    Args:
        folder: Folder or file, as in `finished_runs`.
        pads: Names of the pads to select; all runs by default.

    Raises:
        ValueError: There is no finished run, a run used recorded touches, or a run has no pad model.
    """
    for run in finished_runs(folder, pads).values():
        _ = run.simulated_pad, run.pad_model


def find_pad_model(path: Path) -> tuple[str, FinishedRun | None]:
    """Find the pad model that --pad-model names.

    Args:
        path: The file of a pad model, the folder of a finished run, or the name of a ready model.

    Returns:
        The argument of `i2t.load_pad_model`, and the run if the file is in the folder of a run.

    Raises:
        ValueError: The folder holds no pad model, or several.
    """
    if not path.is_dir() and not _is_kept_pad_model(path):
        return str(path), None
    runs = finished_runs(path)
    if len(runs) > 1:
        raise ValueError(f"--pad-model {path}: holds {len(runs)} pad models; name one, such as {runs[0].folder}")
    return str(runs[0].pad_model), runs[0]


def require_pad_model(path: Path) -> None:
    """Refuse a value of --pad-model that names no pad model, and explain how to make one.

    Args:
        path: File, folder or name, as in `find_pad_model`.

    Raises:
        ValueError: The path does not exist, or holds something else.
    """
    ready = [name for name, parts in READY_MODELS.items() if PAD_MODEL in parts]
    if path.is_dir() or str(path) in ready:
        find_pad_model(path)
    elif not path.exists() and (near := closest(str(path), ready)):
        raise ValueError(f"--pad-model {path}: there is no such file or folder; did you mean {near}?")
    elif not path.exists() and not path.suffix:
        finished_runs(path)  # its message explains how to make a run
    else:
        require_path("--pad-model", path)
        _require_kind(path)


def _is_kept_pad_model(path: Path) -> bool:
    """Test whether a path is that of a pad model in the folder of a run."""
    return path.name == PAD_MODEL and path.with_name(TRAINING).is_file()


def _require_kind(path: Path) -> None:
    """Refuse touches and pads, to which a pad model can be fitted (ValueError)."""
    from i2t.files.serialization import file_kind  # a slow import

    kind = "data set" if path.suffix == ".h5" else file_kind(path)
    if option := {"data set": "--dataset", "i2t pad": "--pad"}.get(kind):
        fit = f"i2t fit {path}" if option == "--dataset" else f"{training_command()} {option} {path}"
        raise ValueError(
            f"--pad-model {path}: holds a {kind.removeprefix('i2t ')}; fit a pad model to it, {fit} --out runs/skin, "
            "and pass --pad-model runs/skin"
        )


def _why_no_run(folder: Path, first: Path) -> str:
    """Complete the sentence on a folder without a finished run; empty if there is one."""
    if folder.is_file():
        return f"is a file and holds no finished run; name the folder that {training_commands()} wrote"
    if not folder.exists() or not any(folder.iterdir()):
        return f"holds no finished run; make one: {training_command()} --out {folder}"
    kind = kind_of_config(folder / CONFIG)
    if kind not in (None, "TrainArgs", "FitArgs"):
        return f"holds a run of another command ({kind}); name a folder that {training_commands()} wrote"
    if (first / METRICS).exists():
        return ""
    if (folder / CONFIG).exists():
        remedy = "repeat it with --overwrite" if kind == "FitArgs" else "continue it: the same command with --resume"
        return f"holds a run that was interrupted; {remedy}"
    touches = next(folder.glob("*.h5"), None)
    remedy = f"; train on these touches: i2t fit {folder}" if touches else ""
    return f"holds other files but no finished run; name a folder that {training_commands()} wrote{remedy}"
