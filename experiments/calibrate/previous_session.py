"""Value of an earlier session of the same skin as the mean of a later one, laid over it first.

Between two sessions a skin moves: the earlier session's predictions are shifted, raised and scaled until they fit the
presses of the later one that a method may learn from (`i2t.unknowns.alignment`); where both were converted from one
robot's axes, that is where the search begins. How well the earlier session predicts without any press, as recorded and
from the robot's axes, is reported too.
"""

import json
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from experiments.calibrate import report
from experiments.calibrate.config import CalibrateArgs, preset_of
from experiments.calibrate.data import PressRecording, read_presses
from experiments.calibrate.evaluate import Curves, explained
from experiments.calibrate.methods import (
    HEIGHT,
    NEIGHBOURS,
    PREVIOUS_ALONE,
    PREVIOUS_MEAN,
    RESIDUAL_NOISE,
    Predictors,
    neighbours,
    predict,
    select,
)
from experiments.common.runs import begin
from i2t import dataset as data
from i2t.calibration.structured_gp import StructuredGP, hyperparameter_grid
from i2t.dataset import Dataset
from i2t.progress import progress
from i2t.unknowns import Finding, SessionMap, fit_session_map, lay_over, metrics_of

LATER_TEST = "second half of the later session"
MIN_CHIP_PRESSES = 10  # to say that chips changed places since the earlier session
FINDING_PRESSES = 120  # that the reported alignment is found from
REFERENCE_OF_SESSION = "reference of "  # of a data set's meta, as the converter of eFlesh writes it


@dataclass(frozen=True)
class SessionPair:
    """An earlier and a later session of one skin, in one frame as far as the robot's axes tell."""

    previous: PressRecording
    previous_rows: np.ndarray  # that may be used
    later: PressRecording  # positions and loads counted as the earlier session's
    load_known: bool  # whether loads of both count from about the same zero


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Score an earlier session: R2 on the second half in time of this one, from presses of its first half."""
    assert args.previous_session is not None
    assert args.dataset is not None
    started, cfg = time.perf_counter(), preset_of(args)
    datasets = {
        "previous": data.load_dataset(args.previous_session, skin=args.skin_name),
        "later": data.load_dataset(args.dataset, skin=args.skin_name),
    }
    sessions = {name: read_presses(one, args.load) for name, one in datasets.items()}
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
    pair = _in_one_frame(datasets, previous, recording, usable["previous"])

    session = _map_of(pair, pair.previous_rows)
    findings = _aligned(pair, session, pool[:: max(len(pool) // FINDING_PRESSES, 1)])[2]
    for finding in findings:
        print(finding.sentence)
    curves = _curves(pair, pool, test, cfg.counts, [(args.seed, draw) for draw in range(cfg.draws)])

    by_session = {name: report.warning_metrics(found) for name, found in warnings.items()}
    metrics: dict[str, Any] = {
        "source": datasets["later"].source,
        "seed": args.seed,
        "draws": cfg.draws,
        "load": recording.load_kind,
        **{key: {name: found[key] for name, found in by_session.items()} for key in by_session["later"]},
        "presses": {name: len(one.load) for name, one in sessions.items()},
        "held_out": {LATER_TEST: len(test)},
        "alignment": metrics_of(findings),
        "r2_without_presses": _without_presses(pair, recording, test),
        "r2": {LATER_TEST: report.summarise(curves)},
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.write(args.out, metrics)
    for name, value in metrics["r2_without_presses"].items():
        print(f"without any press, {name}: R2 {value:.3f}")
    return metrics


def _in_one_frame(
    datasets: dict[str, Dataset], previous: PressRecording, later: PressRecording, rows: np.ndarray
) -> SessionPair:
    """The pair with the later session's positions and depths counted as the earlier one's, where both say how their
    axes lie in the robot's.
    """
    references = {name: _reference(one) for name, one in datasets.items()}
    unknown_depth = not later.by_force and not np.isfinite(datasets["later"].touches.depth).any()
    before, after = references["previous"], references["later"]
    if before is None or after is None or later.by_force:
        return SessionPair(previous, rows, later, load_known=not unknown_depth)
    position = later.position + np.subtract(after["centre_m"], before["centre_m"])
    load, known = later.load, not unknown_depth
    if before["zero_m"] is not None and unknown_depth:
        load, known = np.full_like(load, before["zero_m"] - after["lowest_z_m"]), True
    elif before["zero_m"] is not None and after["zero_m"] is not None:
        load = load + before["zero_m"] - after["zero_m"]
    return SessionPair(previous, rows, replace(later, position=position, load=load), load_known=known)


def _reference(dataset: Dataset) -> dict[str, Any] | None:
    """Origin of positions and heights in the robot's axes, where one session of a robot states it."""
    texts = [text for key, text in dataset.meta.items() if key.startswith(REFERENCE_OF_SESSION)]
    return json.loads(texts[0]) if len(texts) == 1 else None


def _map_of(pair: SessionPair, rows: np.ndarray) -> SessionMap:
    return fit_session_map(pair.previous.position[rows], pair.previous.load[rows], pair.previous.readings[rows])


def _aligned(
    pair: SessionPair, session: SessionMap, rows: np.ndarray
) -> tuple[PressRecording, np.ndarray, list[Finding]]:
    """The later session with positions and loads as the earlier one counts them, and readings as it would read them:
    divided by the gains, with chips where they were; the gains (channels,); and what was found.
    """
    later = pair.later
    alignment, _, findings = lay_over(
        session, later.position[rows], later.load[rows], later.readings[rows], load_known=pair.load_known,
        unit="N" if later.by_force else "m",
    )  # fmt: skip
    todo = findings[-1].correction if len(rows) >= MIN_CHIP_PRESSES and findings[-1].wrong else {}
    readings = later.readings
    if "chip_order" in todo:
        by_chip = readings.reshape(len(readings), -1, 3)[:, np.asarray(todo["chip_order"])]
        readings = by_chip.reshape(readings.shape) * np.asarray(todo["channel_signs"])
    gains = np.repeat(alignment.gain, 3)
    moved = replace(
        later, position=later.position + alignment.shift, load=later.load + alignment.load, readings=readings / gains
    )
    return moved, gains, findings


def _without_presses(pair: SessionPair, as_recorded: PressRecording, test: np.ndarray) -> dict[str, float]:
    """R2 of the earlier session's predictions before any press of the later one."""
    gp = _previous_gp(pair, pair.previous_rows, 0)
    scores = {}
    for name, later in (("as recorded", as_recorded), ("in the robot's axes", pair.later)):
        error = ((later.readings[test] - _mean(gp, later, test)) ** 2).sum(1)
        scores[name] = explained(later.readings[test], error)
    return scores


def _previous_gp(pair: SessionPair, rows: np.ndarray, seed: int | tuple[int, int], most: int = 300) -> StructuredGP:
    """The structured GP of some presses of the earlier session."""
    past = np.random.default_rng(seed).permutation(rows)[:most]
    predictors = Predictors(pair.previous)
    return predictors.gp(predictors.hyperparameters, past, pair.previous.readings[past])


def _mean(gp: StructuredGP, recording: PressRecording, rows: np.ndarray) -> np.ndarray:
    return np.asarray(predict(gp, recording.presses(rows))[0], np.float64)


def _curves(
    pair: SessionPair, pool: np.ndarray, test: np.ndarray, counts: tuple[int, ...], seeds: list[tuple[int, int]]
) -> Curves:
    """R2 of each method at every number of presses, a value for each draw."""
    curves: Curves = {}
    later = pair.later
    for seed in progress(seeds, desc="draws", unit="draw"):
        order = np.random.default_rng(seed).permutation(pool)
        past = np.random.default_rng(seed).permutation(pair.previous_rows)[: max(*counts, 2)]
        gp, session = _previous_gp(pair, past, seed), _map_of(pair, past)
        unaligned = _mean(gp, later, test)
        for count in [count for count in counts if count <= len(order)]:
            rows = order[:count]
            predicted = {
                NEIGHBOURS: neighbours(later, rows, test),
                HEIGHT: Predictors(later).structured(rows, test),
                report.SESSION[PREVIOUS_ALONE]: unaligned,
            }
            for name, values in predicted.items():
                _append(curves, name, count, later.readings[test], values)
            moved, gains, _ = _aligned(pair, session, rows)
            truth = gains * moved.readings[test]
            mean = _mean(gp, moved, np.arange(len(moved.load)))
            _append(curves, report.ALIGNED_ALONE, count, truth, gains * mean[test])
            left = moved.readings[rows] - mean[rows]
            with_mean = mean[test] + _of_residuals(moved, rows, left, test)
            _append(curves, report.SESSION[PREVIOUS_MEAN], count, truth, gains * with_mean)
    return curves


def _of_residuals(moved: PressRecording, rows: np.ndarray, left: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Predictions of a GP of the residuals of the aligned earlier session."""
    predictors = Predictors(moved)
    # Heights were found by the previous session; the presses select how much of what it leaves is noise.
    candidates = hyperparameter_grid(predictors.hyperparameters._replace(height_std=0.0), RESIDUAL_NOISE)
    return predictors.gp_mean(select(candidates, moved, rows, left), rows, left, test)


def _append(curves: Curves, name: str, count: int, readings: np.ndarray, predicted: np.ndarray) -> None:
    error = ((readings - predicted) ** 2).sum(1)
    curves.setdefault(name, {}).setdefault(count, []).append(explained(readings, error))
