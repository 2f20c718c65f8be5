"""What an earlier session of the same skin is worth as the mean of a later one."""

import time
from typing import Any

import numpy as np

from experiments.calibrate import report
from experiments.calibrate.config import CalibrateArgs, preset_of
from experiments.calibrate.data import read_presses
from experiments.calibrate.evaluate import previous_session_curves
from experiments.calibrate.methods import Predictors
from experiments.common.runs import begin
from i2t import dataset as data


def run(args: CalibrateArgs) -> dict[str, Any]:
    """What an earlier session is worth: R2 on the second half in time of this one, from presses of its first half."""
    assert args.previous_session is not None
    assert args.dataset is not None
    started, cfg = time.perf_counter(), preset_of(args)
    dataset = data.load_dataset(args.dataset)
    sessions = {
        "previous": read_presses(data.load_dataset(args.previous_session), args.load),
        "later": read_presses(dataset, args.load),
    }
    previous, recording = sessions.values()
    if recording.by_force != previous.by_force:
        raise ValueError("one session has depths and the other forces; choose a --load that both have")
    n = len(recording.load)
    if min(n // 2, len(previous.load)) < max(2, *cfg.counts[:1]):
        raise ValueError(f"{args.dataset} or {args.previous_session} has too few usable presses to calibrate on")
    begin(args.out, args, cfg, None, args.overwrite)
    warnings = {name: report.warn(one, f", {name} session") for name, one in sessions.items()}
    usable = {name: np.flatnonzero(~found.repeated) for name, found in warnings.items()}
    pool, test = (usable["later"][part] for part in (usable["later"] < n // 2, usable["later"] >= n // 2))
    tests = {"second half of the later session": test}

    scores = previous_session_curves(
        Predictors(recording), previous, usable["previous"], pool, tests,
        counts=cfg.counts, draws=cfg.draws, seed=args.seed,
    )  # fmt: skip

    named = {
        name: {report.SESSION.get(method, method): values for method, values in curves.items()}
        for name, curves in scores.r2.items()
    }
    by_session = {name: report.warning_metrics(found) for name, found in warnings.items()}
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": cfg.draws,
        "load": recording.load_kind,
        **{key: {name: found[key] for name, found in by_session.items()} for key in by_session["later"]},
        "presses": {name: len(one.load) for name, one in sessions.items()},
        "held_out": {name: len(rows) for name, rows in tests.items()},
        "r2": {name: report.summarise(curves) for name, curves in named.items()},
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.write(args.out, metrics)
    return metrics
