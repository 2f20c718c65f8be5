"""Comparison of methods on simulated skins of several kinds, which the prior of `i2t.calibrate` was not fitted to."""

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from experiments.calibrate.arguments import CalibrateArgs
from experiments.calibrate.evaluate import Curves, append, explained, gains, predict_all, summarise
from experiments.calibrate.methods import CALIBRATED
from experiments.calibrate.report import count_table
from experiments.calibrate.skins import PressedSkinOfKind, simulate_skins
from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from i2t.recordings.presses import LoadedPresses, LoadName
from i2t.runtime.progress import progress
from i2t.skin.boards import eflesh_board, reskin_board

SKINS_SEED = 202  # unlike the seed of the prior's skins


class Case(NamedTuple):
    """A kind of skin, and the load that is measured."""

    kind: str
    load: str

    @property
    def name(self) -> str:
        """Name for tables."""
        return f"{self.kind}, {self.load}"


@dataclass(frozen=True)
class SimulatedPreset:
    """Settings of the comparison."""

    skins: int = 10  # skins of each kind
    counts: tuple[int, ...] = (5, 10, 20, 50, 100)  # numbers of training presses
    test_presses: int = 100  # test presses of each skin
    cases: tuple[Case, ...] = (
        Case("bonded", "travel"), Case("bonded", "force"), Case("loose", "force"), Case("weak", "force"),
        Case("lattice", "travel"), Case("displaced", "force"),
    )  # fmt: skip


PRESETS: dict[str, SimulatedPreset] = {
    "paper": SimulatedPreset(),
    "short": SimulatedPreset(4),
    "debug": SimulatedPreset(1, (5, 10), 12, (Case("lattice", "travel"),)),
}


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Score every method on every kind of skin."""
    started, cfg = time.perf_counter(), choose_preset(PRESETS, args.preset)
    begin(args, cfg)
    metrics = {
        "source": "simulated",
        "seed": SKINS_SEED,
        "skins_of_each_kind": cfg.skins,
        "cases": {case.name: _score(case, cfg) for case in cfg.cases},
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_json(args.out / "metrics.json", metrics)
    _report(metrics)
    return metrics


def _score(case: Case, cfg: SimulatedPreset) -> dict[str, Any]:
    """Compute R2 over skins of a kind, the lead of `i2t.calibrate`, and the share of readings in its 90 % range."""
    r2: Curves = {}
    coverage: Curves = {}
    most = max(cfg.counts)
    skins = simulate_skins(case.kind, SKINS_SEED, cfg.skins, most + cfg.test_presses)
    for skin in progress(skins, desc=case.name, unit="skins"):
        recording, test = _recording(skin, case.load), np.arange(most, most + cfg.test_presses)
        truth = recording.readings[test]
        for count in cfg.counts:
            predicted, inside = predict_all(recording, np.arange(count), test)
            for name, mean in predicted.items():
                append(r2, name, count, explained(truth, ((truth - mean) ** 2).sum(1)))
            append(coverage, CALIBRATED, count, float(np.mean(inside)))
    return {"r2": summarise(r2), "differences": summarise(gains(r2)), "inside_90": summarise(coverage)[CALIBRATED]}


def _recording(skin: PressedSkinOfKind, load: str) -> LoadedPresses:
    """Convert a skin's presses, with the board on which the skin was simulated."""
    kind: LoadName = "force" if load == "force" else "travel"
    board = eflesh_board() if skin.kind == "lattice" else reskin_board()
    return LoadedPresses(
        skin.position, skin.force if kind == "force" else skin.travel, skin.readings, kind, unnamed_board=board
    )


def _report(metrics: dict[str, Any]) -> None:
    """Print the tables."""
    for name, case in metrics["cases"].items():
        print(f"\n{name} (simulated), mean R2 of {metrics['skins_of_each_kind']} skins [95 % interval]")
        print(count_table(case["r2"] | case["differences"] | {"readings in its 90 % range": case["inside_90"]}))
