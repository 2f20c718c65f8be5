"""Question: how well is a press located on a pad that was never seen, and how many presses of it does that take?

    python -m experiments.pads                   18 skins on 6 boards, as in ReSkin's study; about an hour on two cores
    python -m experiments.pads --skins 6         fewer skins
    python -m experiments.pads --preset debug    2 skins, too few to mean anything

ReSkin (Bhirangi et al., CoRL 2021) reports how often a press is located within 1 mm: 25 % with a network trained on one
other pad, 84 % on many, 87 % after 390 presses of the new pad whose positions nobody noted. Here skins, boards and
presses are simulated (`sample_pad` with the faults and the noise of a board in order): a tip of 4.6 mm at random
positions within 7 mm of the middle along x and y, 0.6-1.0 N, the force not known. Each skin is tested on presses of its
own that no method sees; networks that learn from other skins learn from those of the other boards only. The share
within 1 mm is the mean over skins with its 95 % interval (Student's t). Results go to --out: metrics.json, config.json,
accuracy.png, and the shares of each skin (skin-*.json), where --resume goes on.
"""

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from experiments.common.intervals import with_interval
from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from experiments.common.tasks import Task, run_tasks
from experiments.pads import methods
from experiments.pads.arguments import PadsArgs
from experiments.pads.simulate import PROBE_TIP, SkinSession, press_skin, sample_skins
from i2t import viz
from i2t.calibration.localize import GRID_SPACING_M
from i2t.calibration.physics import fit_pad, solve_map
from i2t.prediction.metrics import student_interval
from i2t.skin.boards import reskin_board

LAYER_FIT_PRESSES = 20  # that the layer is fitted to


@dataclass(frozen=True)
class LocalizationStudy:
    """Sizes of the experiment."""

    boards: int = 6
    labelled: tuple[int, ...] = (5, 20, 100, 390)
    unlabelled: int = 390
    own_presses: int = 1500  # of the pad itself that the ceiling learns from
    test_presses: int = 400
    epochs: int = 200  # of the networks
    spacing: float = GRID_SPACING_M  # of the press library


PRESETS: dict[str, LocalizationStudy] = {
    "study": LocalizationStudy(),
    "debug": LocalizationStudy(2, (), 10, 10, 20, 3, 3.5e-3),
}
DEFAULT_SKINS = {"study": 18, "debug": 2}


def run(args: PadsArgs) -> dict[str, Any]:
    """The experiment: prepare, evaluate, report."""
    study = choose_preset(PRESETS, args.preset)
    skins = DEFAULT_SKINS[args.preset] if args.skins is None else args.skins
    begin(args.out, args, study, args.resume, args.overwrite)
    sessions = simulate_sessions(jax.random.key(args.seed), skins, study)
    board = np.arange(skins) % study.boards  # alone on a board of its own where there are fewer skins
    tasks = []
    for i in range(skins):
        others = [sessions[j] for j in range(skins) if board[j] != board[i]]
        path = args.out / f"skin-{i}.json"
        tasks.append(Task(path.stem, path, partial(make_part, args.seed, i, sessions[i], others, study, path=path)))
    run_tasks(tasks, args.tasks)
    parts = [json.loads(task.finished.read_text()) for task in tasks]
    return report(args.out, {name: [part[name] for part in parts] for name in parts[0]}, skins)


def make_part(
    seed: int, skin: int, session: SkinSession, others: list[SkinSession], study: LocalizationStudy, *, path: Path
) -> None:
    """The shares of one skin, kept in `path`."""
    shares = evaluate(jax.random.fold_in(jax.random.key(seed), 1000 + skin), session, others, study)
    write_json(path, shares)
    print(f"{path.stem}: " + ", ".join(f"{name} {share:.2f}" for name, share in shares.items()), flush=True)


def simulate_sessions(key: Key[Array, ""], skins: int, study: LocalizationStudy) -> list[SkinSession]:
    """A session of presses of each skin."""
    sessions = []
    for i, pad in enumerate(sample_skins(jax.random.fold_in(key, 0), skins, study.boards)):
        sessions.append(press_skin(jax.random.fold_in(key, 1 + i), pad, study.own_presses + study.test_presses))
        print(f"\rpressed {i + 1} of {skins} skins", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return sessions


def evaluate(
    key: Key[Array, ""], session: SkinSession, others: list[SkinSession], study: LocalizationStudy
) -> dict[str, float]:
    """Share of the test presses of one skin located within 1 mm, by each method."""
    own, test = session.rows(slice(study.own_presses)), session.rows(slice(study.own_presses, None))
    unlabelled = [other.rows(slice(study.unlabelled)) for other in others]
    pooled = SkinSession(*(jnp.concatenate(part) for part in zip(*unlabelled, strict=True)))
    library = methods.press_library(methods.nominal_layer(), study.spacing)
    key_one, key_many, key_own = jax.random.split(key, 3)
    own_readings = own.reading[: study.unlabelled]
    located: dict[str, Array | np.ndarray] = {
        "network, one other skin": methods.by_network(key_one, unlabelled[0], test.reading, study.epochs),
        "network, skins of other boards": methods.by_network(key_many, pooled, test.reading, study.epochs),
        "physics, no press": methods.by_unpressed_pad(library, test.reading),
        f"physics, {study.unlabelled} presses without labels": methods.by_unlabelled_presses(
            library, own_readings, test.reading, study.spacing
        ),
    }
    located |= by_labelled_presses(own, test, study)
    located[f"network, {study.own_presses} presses"] = methods.by_network(key_own, own, test.reading, study.epochs)

    def share_right(positions: Array | np.ndarray) -> float:
        error = np.linalg.norm(np.asarray(positions) - np.asarray(test.position), axis=1)
        return float(np.mean(error <= methods.RIGHT_M))

    return {name: share_right(positions) for name, positions in located.items()}


def by_labelled_presses(own: SkinSession, test: SkinSession, study: LocalizationStudy) -> dict[str, Array | np.ndarray]:
    """Positions by physics and by neighbours, from more and more presses; the layer is fitted to at most 20 of them."""
    located: dict[str, Array | np.ndarray] = {}
    fitted = None
    pressed_by: dict[str, Any] = {"tip": PROBE_TIP, "board": reskin_board(), "by_force": True}
    for n in (*study.labelled, study.own_presses):
        some = own.rows(slice(n))
        if fitted is None or n <= LAYER_FIT_PRESSES:
            fitted = fit_pad(some.presses, some.reading, **pressed_by, max_layer_presses=LAYER_FIT_PRESSES)
            library = methods.press_library(fitted.layer, study.spacing)
        else:
            fitted = solve_map(fitted.layer, fitted.layer_std, some.presses, some.reading, **pressed_by)
        located[f"physics, {n} presses"] = methods.by_fitted_pad(library, fitted, test.reading)
        located[f"nearest presses, {n} presses"] = methods.by_neighbours(some, test.reading)
    return located


def report(out: Path, shares: dict[str, list[float]], skins: int) -> dict[str, Any]:
    """Write the metrics and the figure, and print the table."""
    intervals = {name: interval(values) for name, values in shares.items()}
    metrics = {
        "source": "simulated",
        "skins": skins,
        "within_1_mm": {name: dict(zip(("mean", "low", "high"), v, strict=True)) for name, v in intervals.items()},
        "each": shares,
    }
    write_json(out / "metrics.json", metrics)
    title = f"Presses located within 1 mm on {skins} unseen skins"
    viz.save_figure(viz.plot_intervals(intervals, title, "share of presses", True), out / "accuracy.png")
    print(f"\nlocated within 1 mm: mean of {skins} simulated skins [95 %]")
    for name, (mean, low, high) in intervals.items():
        print(f"{name:42s} {with_interval(mean, low, high)}")
    return metrics


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and 95 % interval over skins, within 0 and 1."""
    mean, low, high = student_interval(values)
    return float(mean), float(np.maximum(low, 0.0)), float(np.minimum(high, 1.0))  # NaN stays: one skin has none
