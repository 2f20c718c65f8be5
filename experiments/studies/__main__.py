"""Questions about recognition by touch beyond `experiments.recognize`, each a study of its own:

    python -m experiments.studies policy        which next touch makes one sure soonest?
    python -m experiments.studies open          is it none of the objects that are known?
    python -m experiments.studies planar        what does it cost not to know where the object stands?
    python -m experiments.studies registered    what does a view tell that finds it where it may be 5 mm off?
    python -m experiments.studies pad           how many presses does a pad need that was never felt?
    python -m experiments.studies crossing      how well must poses be known for the paper's rules, and its baseline?
    python -m experiments.studies sites         what does a touch tell on a flat, an edge and a corner?
    python -m experiments.studies sensitivity   what do errors of pose, noise and harder presses do?
    python -m experiments.studies many          10, 25 and 50 objects, the meshes of a folder among them
    python -m experiments.studies policy --preset debug      a handful of sittings, to see it run

Each takes a finished run of `experiments.train` (--run, or a study's folder of several pads and seeds) and uses the
catalogue's test objects and the worlds of `experiments.recognize`; what was fixed before testing is in
docs/recognition.md. Everything is simulated. Results go to --out: metrics.json, config.json, figures, and what was
made of each pad and seed (npz), where --resume goes on.
"""

import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from experiments.common.runs import begin, load_part, reported, save_part, write_json
from experiments.recognize.config import PRESETS
from experiments.recognize.trained_run import finished_runs
from experiments.studies import (
    new_pad,
    object_count,
    open_set,
    planar,
    policy,
    pose_error,
    registered,
    sensitivity,
    sites,
)
from experiments.studies.lab import Args, Lab, prepare_lab, report_methods

STUDIES: dict[str, tuple[Callable[[Lab], Any], Callable[[Sequence[Any], Path], dict[str, Any]]]] = {
    "policy": (policy.play, policy.report),
    "open": (open_set.play, open_set.report),
    "planar": (planar.play, planar.report),
    "registered": (registered.play, registered.report),
    "crossing": (pose_error.play, pose_error.report),
    "sites": (sites.play, sites.report),
    "pad": (new_pad.play, report_methods),
    "sensitivity": (sensitivity.play, report_methods),
    "many": (object_count.play, object_count.report),
}


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.studies")
    return reported(partial(run, args), args.out or Path("runs") / args.study)


def run(args: Args) -> dict[str, Any]:
    """A study on every pad and seed, pooled."""
    out = args.out or Path("runs") / args.study
    play, report = STUDIES[args.study]
    begin(out, args, PRESETS[args.preset], args.resume, args.overwrite)
    made = []
    for i, folder in enumerate(finished_runs(args.run)):
        path = out / f"part-{i}.npz"
        if not path.exists():
            save_part(path, play(prepare_lab(args, folder, args.seed + i)))
        made.append(load_part(path))
    result = {"source": "simulated", "seeds": len(made), **report(made, out)}
    write_json(out / "metrics.json", result)
    print(f"\nresults and figures are in {out}")
    return result


if __name__ == "__main__":
    sys.exit(main())
