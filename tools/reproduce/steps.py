"""Steps of the reproduction in order, one for each command of the documents."""

import shlex
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple


class Step(NamedTuple):
    """A command whose results are in the documents."""

    name: str  # also the name of its folder in --out and of its file in docs/results
    command: str  # without --out and --pad-model
    uses: str | None = None  # step whose folder it takes as --pad-model
    minutes: int | None = None  # rough duration on two cores; None if not measured
    again: str | None = "--resume"  # option for an unfinished folder
    result: str = "metrics.json"  # file that exists when the step is done

    @property
    def needs(self) -> str | None:
        """Path in the command of a recording that is not part of the project, a folder or its first file."""
        words = shlex.split(self.command)
        flags = "--dataset", "--data", "--readings", "--objects"
        return next((path for flag, path in pairwise(words) if flag in flags), None)

    def arguments(self, out: Path, resume: bool) -> list[str]:
        """List the arguments of `python`.

        Args:
            out: Folder of all steps.
            resume: Whether there is an unfinished run.

        Returns:
            Words of the command after `python`.
        """
        words = [*shlex.split(self.command), "--out", str(out / self.name)]
        if self.uses:
            words += ["--pad-model", str(out / self.uses)]
        return words + ([self.again] if resume and self.again else [])


OVERWRITE = "--overwrite"  # for commands that restart
STEPS = (
    Step("train", "-m experiments.train", minutes=4),
    Step("study", "-m experiments.train --preset study", minutes=30),
    Step(
        "train_registered",
        "-m experiments.train --registered sessions --pads 0 1 2 3 4 5 --methods gp ridge-pressure nearest-pressure",
        minutes=35,
    ),
    Step(
        "train_camera",
        "-m experiments.train --registered camera --pads 0 1 2 3 4 5 --methods gp ridge-pressure nearest-pressure",
        minutes=35,
    ),
    Step(
        "paper",
        "-m experiments.recognize simulate --preset paper --method paper --paper-episodes 100",
        uses="study",
        minutes=85,
    ),
    Step(
        "recognize",
        "-m experiments.recognize simulate --preset paper --pads 0 1 2 3 4 5 --episodes 10 --paper-episodes 10",
        uses="study",
        minutes=60,
    ),
    Step("open_set", "-m experiments.studies open_set --pads 0 1 2 --episodes 10", uses="study", minutes=30),
    Step("mismatch", "-m experiments.studies mismatch --pads 0 1 2 --episodes 10", uses="study", minutes=30),
    Step("physics", "-m experiments.studies physics --episodes 10", uses="study", minutes=150),
    Step("stopping", "-m experiments.studies stopping --episodes 34", uses="study", minutes=90),
    Step("train_blocks", "-m experiments.train --dataset data/eflesh --split block --epochs 60", minutes=9),
    Step("train_time", "-m experiments.train --dataset data/eflesh --split time --epochs 60", minutes=6),
    Step("shapes", "-m experiments.shapes", minutes=15),
    Step(
        "strokes",
        "-m experiments.shapes --readings magnetic_digits/strokes.csv.gz --label digit "
        "--ignore first_row last_row stroke --samples 19",
        minutes=10,
    ),
    Step("tsne", "-m experiments.tsne", again=OVERWRITE),
    Step("calibrate_prior", "-m experiments.calibrate --prior", minutes=2, again=OVERWRITE),
    Step("calibrate_simulated", "-m experiments.calibrate --simulated --preset short", minutes=2, again=OVERWRITE),
    Step("calibrate_recovery", "-m experiments.calibrate --recovery", minutes=25, again=OVERWRITE),
    Step(
        "calibrate",
        "-m experiments.calibrate --dataset data/eflesh --preset short --draws 5",
        minutes=1,
        again=OVERWRITE,
    ),
    Step(
        "fidelity",
        "-m experiments.fidelity --preset short --dataset eflesh/spatial eflesh/normal eflesh/shear",
        minutes=5,
        again=OVERWRITE,
    ),
    Step("registration_frames", "-m experiments.registration frames --data DATA", minutes=1, again=OVERWRITE),
    Step("active_touch", "-m experiments.active_touch", minutes=10, again=OVERWRITE),
    Step("reconstruct", "-m experiments.reconstruct", minutes=10, again=OVERWRITE),
    Step(
        "reconstruct_objects",
        "-m experiments.reconstruct --objects random_urdfs --unit cm --across-mm 50 72 --train 800 --test 54",
        minutes=25,
        again=OVERWRITE,
    ),
    Step(
        "reconstruct_baselines",
        "-m experiments.reconstruct --objects random_urdfs --unit cm --across-mm 50 72 --train 800 --test 54 "
        '--touches 5 --conditions reading "contact pose only" "contact pose only, likeliest shapes"',
        minutes=8,
        again=OVERWRITE,
    ),
    Step(
        "reconstruct_fitted",
        "-m experiments.reconstruct --objects random_urdfs --unit cm --across-mm 50 72 --train 800 --test 54 "
        '--touches 5 --conditions "reading, fitted pad, 3 mm and 5 degrees" "contact pose only, 3 mm and 5 degrees" '
        '"contact pose only, likeliest shapes, 3 mm and 5 degrees"',
        minutes=25,
        again=OVERWRITE,
    ),
    Step(
        "reconstruct_policies",
        '-m experiments.reconstruct --test 280 --touches 5 --conditions "random sites" uncertainty reading oracle',
        minutes=50,
        again=OVERWRITE,
    ),
    Step("reconstruct_patch", "-m experiments.reconstruct patch", minutes=8, again=OVERWRITE),
    Step("reconstruct_patch_exact", "-m experiments.reconstruct patch --exact", minutes=8, again=OVERWRITE),
    Step(
        "grasps",
        "-m experiments.recognize recorded --label object --ignore slipped --readings biotac_sp/bts3v2_palm_45.csv.gz "
        "biotac_sp/bts3v2_palm_down.csv.gz biotac_sp/bts3v2_palm_side.csv.gz",
        minutes=3,
    ),
    Step("second_world", "-m tests.second_world", minutes=8, again=OVERWRITE),
    Step("faults", "-m tests.faults", minutes=120, again=None),
)
