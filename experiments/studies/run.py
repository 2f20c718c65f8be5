"""Questions about recognition by touch beyond `experiments.recognize`, each a study of its own:

    python -m experiments.studies open_set      is the object an unknown one?
    python -m experiments.studies mismatch      what does it cost if chip, arm or object are not as believed?
    python -m experiments.studies physics       and if the skin's physics is not, but some of its touches are known?
    python -m experiments.studies stopping      how often is a belief wrong that stops when it is sure?
    python -m experiments.studies open_set --preset debug      a handful of episodes, to see it run

Each takes a finished run of `experiments.train` (--pad-model, or a study's folder of several pads and seeds) and uses
the catalogue's test objects and the worlds of `experiments.recognize`; what was fixed before testing is in
docs/recognition.md. Everything is simulated. Results go to --out: metrics.json, config.json, and what was made of each
pad and seed (npz), where --resume goes on.
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
from experiments.studies.lab import DEBUG_EPISODES, StudyLab, StudySize, prepare_lab
from experiments.studies.report import report_settings
from experiments.studies.tables import study_table
from experiments.train.finished import FinishedRun, finished_runs


class Study(NamedTuple):
    """Steps of a study: for each pad and seed, and for all of them."""

    evaluate: Callable[[StudyLab], Part]
    report: Callable[[Sequence[Part], Sequence[str]], dict[str, Any]]  # of the parts and their pads; has "tables"


STUDIES = {
    "open_set": Study(open_set.evaluate, open_set.report),
    "mismatch": Study(mismatch.evaluate, report_settings),
    "physics": Study(physics.evaluate, physics.report),
    "stopping": Study(stopping.evaluate, stopping.report),
}


def run(args: StudyArgs) -> dict[str, Any]:
    """A study on every pad and seed, pooled."""
    out = args.folder
    cfg = choose_preset(PRESETS, args.preset)
    begin(args, cfg)
    runs = finished_runs(args.pad_model, args.pads)
    size = StudySize(DEBUG_EPISODES if args.preset == "debug" else args.episodes, args.preset == "debug")
    work = partial(make_part, args.study, cfg, size)
    makers = {out / f"part-{i}.npz": partial(work, run, args.seed + i) for i, run in runs.items()}
    parts = make_parts(makers, args.workers)
    pads = [run.pad_name for run in runs.values()]
    found = STUDIES[args.study].report(parts, pads)
    result = {"source": "simulated", "pads": sorted(set(pads)), "runs": len(parts), **found}
    write_json(out / "metrics.json", result)
    print(f"{args.study}, simulated, {len(parts)} runs of {', '.join(result['pads'])}:")
    written = json.loads((out / "metrics.json").read_text())
    for name in result["tables"]:
        print(f"\n{name}:\n{study_table(name)(written)}")
    return result


def make_part(study: StudyName, cfg: Recognition, size: StudySize, run: FinishedRun, seed: int) -> Part:
    """The study on one pad and seed."""
    return STUDIES[study].evaluate(prepare_lab(cfg, size, run, seed))
