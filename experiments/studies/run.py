"""Studies of recognition by touch beyond `experiments.recognize`. Each answers one question:

    python -m experiments.studies open_set      is the touched object unknown?
    python -m experiments.studies mismatch      what is the cost of wrong assumptions about chip, arm or object?
    python -m experiments.studies physics       what is the cost of wrong physics, given some touches of the skin?
    python -m experiments.studies stopping      how often is a belief wrong when it stops at a requested error?
    python -m experiments.studies open_set --preset debug      a few episodes, to see it run

Each study uses a finished run of `experiments.train` (--pad-model, or a folder of several pads and seeds), the
catalogue's test objects, and the worlds of `experiments.recognize`; docs/recognition.md lists the choices made before
testing. Everything is simulated. Results go to --out: metrics.json, config.json, and one npz file for each pad and
seed, from which --resume continues.
"""

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

from experiments.common.presets import choose_preset
from experiments.common.runs import Part, begin, write_json
from experiments.common.tasks import make_parts
from experiments.recognize.config import PRESETS, Recognition
from experiments.studies import mismatch, open_set, physics, stopping
from experiments.studies.arguments import StudyArgs, StudyName
from experiments.studies.lab import StudyLab, StudySize, prepare_lab
from experiments.studies.report import report_settings
from experiments.studies.tables import study_table
from i2t.models.finished import FinishedRun, finished_runs


class Study(NamedTuple):
    """Steps of a study: evaluation of each pad and seed, and the report of all."""

    evaluate: Callable[[StudyLab], Part]
    report: Callable[
        [Sequence[Part], Sequence[str]], dict[str, Any]
    ]  # from the parts and their pads; contains "tables"


STUDIES = {
    "open_set": Study(open_set.evaluate, open_set.report),
    "mismatch": Study(mismatch.evaluate, report_settings),
    "physics": Study(physics.evaluate, physics.report),
    "stopping": Study(stopping.evaluate, stopping.report),
}


def run(args: StudyArgs) -> dict[str, Any]:
    """Run a study on every pad and seed, print its tables and write the report."""
    out = args.folder
    cfg = choose_preset(PRESETS, args.preset)
    begin(args, cfg)
    runs = finished_runs(args.pad_model, args.pads)
    size = StudySize(2 if args.preset == "debug" else args.episodes, args.preset == "debug")
    work = partial(make_part, args.study, cfg, size)
    makers = {out / f"part-{i}.npz": partial(work, run, args.seed + i) for i, run in runs.items()}
    parts = [_with_new_labels(part) for part in make_parts(makers, args.workers)]
    pads = [run.pad_name for run in runs.values()]
    report = STUDIES[args.study].report(parts, pads)
    result = {"source": "simulated", "pads": sorted(set(pads)), "runs": len(parts), **report}
    write_json(out / "metrics.json", result)
    print(f"{args.study}, simulated, {len(parts)} runs of {', '.join(result['pads'])}:")
    written = json.loads((out / "metrics.json").read_text())
    for name in result["tables"]:
        print(f"\n{name}:\n{study_table(name)(written)}")
    return result


def make_part(study: StudyName, cfg: Recognition, size: StudySize, run: FinishedRun, seed: int) -> Part:
    """Run a study on one pad and seed."""
    return STUDIES[study].evaluate(prepare_lab(cfg, size, run, seed))


def _with_new_labels(part: Part) -> Part:
    """Replace labels of conditions in the parts of runs that an earlier version began."""
    former = {
        "half as far": "half as large",
        "twice as far": "twice as large",
        "chip remembers twice as much": "twice the hysteresis",
        "ambient once, before the episode": "ambient measured only before the episode",
        "camera biased by 1 mm and degree": "camera biased by 1 mm and 1 degree",
        "skin remounted by 0.5 mm": "skin remounted 0.5 mm off",
        "as many as the run": "all",
    }
    renamed: Part = {}
    for name, value in part.items():
        label = next((name.replace(before, now) for before, now in former.items() if before in name), name)
        renamed[label] = _with_new_labels(value) if isinstance(value, dict) else value
    return renamed
