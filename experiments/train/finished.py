"""Finished runs of `experiments.train`: the one place that says what is in their folders, for whoever reads them.

The folder of a run, or each folder `pad-P-seed-S` of a run of several pads or seeds, holds:

  training.json     its pad, the method of each predictor in checkpoint/, and why there is no pad model if there is none
  pad_model.npz     pad model of the skin (`i2t.load_pad_model`), fitted to the training touches
  checkpoint/       predictors: `predictor`, the best of all, and `on_pressure`, the best on predicted contact pressure
                    (`i2t.load_predictor`), and one for each network of the paper
  data.h5, pad.npz  touches that the run simulated, and the pad that it pressed (`i2t.load_dataset`, `i2t.load_pad`)
  metrics.json      scores; written last, so that a folder with it is finished

This module imports neither JAX nor NumPy, so that options are refused at once.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

from experiments.common.runs import CONFIG, METRICS, write_json
from i2t.cli.options import require_path
from i2t.errors import closest
from i2t.models import READY_MODELS

TRAINING, PAD_MODEL, CHECKPOINTS, TOUCHES, PAD = "training.json", "pad_model.npz", "checkpoint", "data.h5", "pad.npz"
KEPT, ON_PRESSURE = "predictor", "on_pressure"  # folders in CHECKPOINTS
FORMER_NAMES = {"--trained-run": "--pad-model", "--pad": "--pad-model"}  # of options that name a run or a pad model
OPTIONS_OF_TRAIN = "TrainArgs"  # the kind that runs of experiments.train note


@dataclass(frozen=True)
class FinishedRun:
    """One pad and seed of a finished run."""

    folder: Path
    pad: int | str | None  # number of a simulated pad, or its file; None where touches were recorded
    predictors: dict[str, str] = field(default_factory=dict)  # methods by their folders in CHECKPOINTS
    no_pad_model: str | None = None  # why there is none

    @property
    def pad_name(self) -> str:
        """Name of the pad in tables and in --pads."""
        return str(self.pad)

    @property
    def pad_model(self) -> Path:
        """File of the pad model.

        Raises:
            ValueError: The touches made none.
        """
        if self.no_pad_model:
            raise ValueError(f"{self.folder} has no pad model: {self.no_pad_model}")
        return self.folder / PAD_MODEL

    def checkpoint(self, method: str) -> Path | None:
        """Folder of a method's predictor.

        Args:
            method: Its title.

        Returns:
            The folder; None where it was not kept.
        """
        names = [name for name, title in self.predictors.items() if title == method]
        return self.folder / CHECKPOINTS / names[0] if names else None

    @property
    def on_pressure(self) -> Path:
        """Folder of the best predictor on predicted contact pressure, or of the best of all where there is none."""
        return self.folder / CHECKPOINTS / (ON_PRESSURE if ON_PRESSURE in self.predictors else KEPT)

    @property
    def simulated_pad(self) -> Path:
        """File of the pad that the run simulated its touches with.

        Raises:
            ValueError: They were recorded.
        """
        if self.pad is None:
            raise ValueError(
                f"{self.folder} was trained on recorded touches, and simulated episodes need a pad to simulate with; "
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
        run: What its folder holds.
    """
    write_json(run.folder / TRAINING, {name: value for name, value in asdict(run).items() if name != "folder"})


def read_run(folder: Path) -> FinishedRun:
    """Read the record of one pad and seed.

    Args:
        folder: Of a finished run.

    Returns:
        What it holds.

    Raises:
        ValueError: It is of an earlier version, which kept no pad model, or its record is damaged.
    """
    if not (folder / TRAINING).is_file():
        raise ValueError(
            f"{folder} is a run of an earlier version, which kept no pad model; make it again: python -m "
            f"experiments.train --overwrite, with the options that its {CONFIG} notes"
        )
    try:
        return FinishedRun(folder, **json.loads((folder / TRAINING).read_text()))
    except (OSError, ValueError, TypeError) as error:
        raise ValueError(f"{folder / TRAINING} cannot be read ({error}); restore a copy, or train again") from error


def finished_runs(folder: Path, pads: Sequence[str] = ()) -> dict[int, FinishedRun]:
    """A finished run, or those of every pad and seed.

    Args:
        folder: Named by the user; the pad model's file in it names it, too.
        pads: Names of the pads; all runs where none is given.

    Returns:
        The runs by their numbers among all that the folder holds, so that what is drawn for one does not depend on
        which others are chosen.

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
    """Refuse runs that simulated episodes cannot be played on.

    Args:
        folder: Named by the user, as in `finished_runs`.
        pads: Names of the pads; all runs where none is given.

    Raises:
        ValueError: There is none, it trained on recorded touches, or it has no pad model.
    """
    for run in finished_runs(folder, pads).values():
        _ = run.simulated_pad, run.pad_model


def find_pad_model(path: Path) -> tuple[str, FinishedRun | None]:
    """The pad model that --pad-model names.

    Args:
        path: The file of a pad model, the folder of a finished run, or the name of a ready model.

    Returns:
        What `i2t.load_pad_model` takes, and the run that made it, where the file is in its folder.

    Raises:
        ValueError: The folder holds none, or several.
    """
    if not path.is_dir() and not _is_kept_pad_model(path):
        return str(path), None
    runs = finished_runs(path)
    if len(runs) > 1:
        raise ValueError(f"--pad-model {path}: holds {len(runs)} pad models; name one, such as {runs[0].folder}")
    return str(runs[0].pad_model), runs[0]


def require_pad_model(path: Path) -> None:
    """Refuse what --pad-model names where it holds no pad model, and tell what makes one of it.

    Args:
        path: As in `find_pad_model`.

    Raises:
        ValueError: Nothing is there, or it holds something else.
    """
    ready = [name for name, parts in READY_MODELS.items() if PAD_MODEL in parts]
    if path.is_dir() or str(path) in ready:
        find_pad_model(path)
    elif not path.exists() and (near := closest(str(path), ready)):
        raise ValueError(f"--pad-model {path}: there is no such file or folder; did you mean {near}?")
    elif not path.exists() and not path.suffix:
        finished_runs(path)  # says what makes it
    else:
        require_path("--pad-model", path)
        _require_kind(path)


def _is_kept_pad_model(path: Path) -> bool:
    """Test whether a path is that of a pad model in the folder of a run."""
    return path.name == PAD_MODEL and path.with_name(TRAINING).is_file()


def _require_kind(path: Path) -> None:
    """Refuse touches and pads, of which a run makes a pad model (ValueError)."""
    from i2t.files.serialization import file_kind  # here, as it imports NumPy

    kind = "data set" if path.suffix == ".h5" else file_kind(path)
    if option := {"data set": "--dataset", "i2t pad": "--pad"}.get(kind):
        raise ValueError(
            f"--pad-model {path}: holds a {kind.removeprefix('i2t ')}; make a pad model of it, python -m "
            f"experiments.train {option} {path} --out runs/skin, and pass --pad-model runs/skin"
        )


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
    if kind not in (None, OPTIONS_OF_TRAIN):
        return f"holds a run of another command ({kind}); name a folder that experiments.train wrote"
    if (first / METRICS).exists():
        return ""
    if kind == OPTIONS_OF_TRAIN or (folder / CONFIG).exists():
        return "holds no finished run but one that was interrupted; go on with it: the same command with --resume"
    touches = next(folder.glob("*.h5"), None)
    remedy = f"; train on these touches: python -m experiments.train --dataset {folder}" if touches else ""
    return f"holds no finished run but other files; name a folder that experiments.train wrote{remedy}"
