"""Calibration of simulated skins of many kinds, none of them seen by the prior: how many presses does each take?

Methods: k nearest presses, a plain Gaussian process with its hyperparameters fitted by marginal likelihood, the
Gaussian process of a population (`i2t.calibrate`), and an oracle: the one kernel that was best on other skins of the
same kind and load. All learn from the same presses.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from experiments.calibrate.data import PressRecording
from experiments.calibrate.methods import NEIGHBOURS, PLAIN, neighbours
from experiments.calibrate.report import summarise, table_row
from experiments.calibrate_pads.kinds import PressedSkinOfKind, simulate_skins
from experiments.common.intervals import with_interval
from experiments.common.runs import write_json
from i2t.calibration import calibrate
from i2t.calibration.model import LoadKind
from i2t.calibration.population_gp import SkinKernels
from i2t.calibration.population_gp.kernel import UNIFORM_FAR_AMPLITUDE, geometry, signal_covariances, take
from i2t.calibration.population_gp.left_out import Observed, condition_all, ungrouped
from i2t.calibration.population_gp.prior import prior_about
from i2t.calibration.structured_gp import STDS_WITHIN_90_PERCENT
from i2t.prediction.metrics import score
from i2t.progress import progress
from i2t.skin.boards import eflesh_board, reskin_board
from i2t.types import Board

POPULATION, ORACLE = "GP of a population", "oracle of its kind"
DIFFERENCE = f"{POPULATION} - {PLAIN}"
BLOCKS_ALONG_EDGE, HELD_OUT_BLOCKS = 3, 2  # 5.3 mm of a layer, 10 mm of a lattice
KINDS_SEED = 202  # of the skins; the prior's are others
KIND_LABEL_WIDTH = 44
PLAIN_STARTS = ((-0.5, 0.5, -4.0), (-1.5, 1.5, -2.0))  # log lengths in standard deviations, log noise


class Case(NamedTuple):
    """A kind of skin and what is known of its presses."""

    kind: str
    load: LoadKind
    knows_previous: bool = False  # the reading before each press
    blocks: bool = False  # whole blocks of the skin are held out, not presses

    @property
    def name(self) -> str:
        """Name for tables."""
        return (
            f"{self.kind}, {self.load}"
            + (", reading before" if self.knows_previous else "")
            + (", blocks" if self.blocks else "")
        )


CASES = (
    Case("bonded", "depth"), Case("bonded", "force"), Case("loose", "force"), Case("loose", "both"),
    Case("uniform", "depth"), Case("weak", "force"), Case("lattice", "depth"), Case("lattice", "force"),
    Case("displaced", "force"), Case("displaced", "force", True), Case("bonded", "force", blocks=True),
    Case("lattice", "depth", blocks=True), Case("displaced", "force", blocks=True),
)  # fmt: skip


@dataclass(frozen=True)
class KindsPreset:
    """Sizes of the experiment."""

    skins: int = 10  # of each kind
    draws: int = 2  # of each skin
    counts: tuple[int, ...] = (5, 10, 20, 50, 100)
    pool: int = 150  # presses to draw from
    test_presses: int = 100
    cases: tuple[Case, ...] = CASES


PRESETS: dict[str, KindsPreset] = {
    "paper": KindsPreset(),
    "short": KindsPreset(4, 1),
    "debug": KindsPreset(1, 1, (5, 10), 12, 12, (Case("lattice", "depth"),)),
}


def evaluate(cfg: KindsPreset) -> dict[str, Any]:
    """R2 and coverage of every method on every case, a value for each skin and draw."""
    started = time.perf_counter()
    found: dict[str, Any] = {}
    skins = {
        kind: simulate_skins(kind, KINDS_SEED, cfg.skins, cfg.pool + cfg.test_presses)
        for kind in dict.fromkeys(case.kind for case in cfg.cases)
    }
    for case in cfg.cases:
        r2: dict[str, dict[int, list[float]]] = {}
        coverage: dict[int, list[float]] = {}
        seconds: dict[int, list[float]] = {}
        tasks = [(i, draw) for i in range(cfg.skins) for draw in range(cfg.draws)]
        for i, draw in progress(tasks, desc=case.name, unit="draw"):
            skin = skins[case.kind][i]
            order, test = held_out(case, cfg, skin, np.random.default_rng((KINDS_SEED, i, draw)))
            for n in cfg.counts:
                predicted, inside, taken = predict_all(case, skin, order[:n], test)
                for name, mean in predicted.items():
                    value = float(score(skin.readings[test], mean).r2)
                    r2.setdefault(name, {}).setdefault(n, []).append(value)
                coverage.setdefault(n, []).append(inside)
                seconds.setdefault(n, []).append(taken)
        gain = {n: list(np.subtract(r2[POPULATION][n], r2[PLAIN][n])) for n in cfg.counts}
        found[case.name] = {
            "r2": summarise(r2),
            "difference": summarise({DIFFERENCE: gain})[DIFFERENCE],
            "inside_90": summarise({POPULATION: coverage})[POPULATION],
            "seconds": {n: float(np.median(taken)) for n, taken in seconds.items()},
        }
    return {
        "source": "simulated",
        "seed": KINDS_SEED,
        "skins_of_each_kind": cfg.skins,
        "draws_of_each_skin": cfg.draws,
        "cases": found,
        "seconds": round(time.perf_counter() - started, 1),
    }


def report(metrics: dict[str, Any], out: Path) -> None:
    """Write the metrics and print the tables."""
    write_json(out / "metrics.json", metrics)
    for name, case in metrics["cases"].items():
        print(f"\n{name} (simulated)")
        for method, by_count in case["r2"].items():
            print(table_row(method, by_count, KIND_LABEL_WIDTH))
        print(table_row(DIFFERENCE, case["difference"], KIND_LABEL_WIDTH))
        print(table_row("readings in the 90 % range", case["inside_90"], KIND_LABEL_WIDTH))
    (out / "table.md").write_text(markdown(metrics))


def markdown(metrics: dict[str, Any]) -> str:
    """The table of the documents: means, and the gain on a plain process with its interval."""
    counts = list(next(iter(metrics["cases"].values()))["difference"])
    lines = ["| skin and load | method | " + " | ".join(map(str, counts)) + " |", "| --- " * (len(counts) + 2) + "|"]
    for name, case in metrics["cases"].items():
        for method, by_count in case["r2"].items():
            lines.append(f"| {name} | {method} | " + " | ".join(f"{v['mean']:.2f}" for v in by_count.values()) + " |")
        gains = (with_interval(v["mean"], v["low"], v["high"], sign="+") for v in case["difference"].values())
        lines.append(f"| {name} | {DIFFERENCE} | " + " | ".join(gains) + " |")
        inside = (f"{v['mean']:.2f}" for v in case["inside_90"].values())
        lines.append(f"| {name} | readings in the 90 % range | " + " | ".join(inside) + " |")
    return "\n".join(lines) + "\n"


def held_out(
    case: Case, cfg: KindsPreset, skin: PressedSkinOfKind, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Presses to learn from, in random order, and those to predict: random ones, or all of two blocks in nine."""
    if not case.blocks:
        return rng.permutation(cfg.pool), np.arange(cfg.pool, cfg.pool + cfg.test_presses)
    edge = 2 * np.abs(skin.position).max() / BLOCKS_ALONG_EDGE
    cell = np.clip(np.floor(skin.position / edge + BLOCKS_ALONG_EDGE / 2), 0, BLOCKS_ALONG_EDGE - 1).astype(int)
    block = cell[:, 0] * BLOCKS_ALONG_EDGE + cell[:, 1]
    inside = np.isin(block, rng.permutation(BLOCKS_ALONG_EDGE**2)[:HELD_OUT_BLOCKS])
    return rng.permutation(np.flatnonzero(~inside)), np.flatnonzero(inside)


def predict_all(
    case: Case, skin: PressedSkinOfKind, rows: np.ndarray, test: np.ndarray
) -> tuple[dict[str, np.ndarray], float, float]:
    """Readings at the test by every method, the share of them in the 90 % range, and seconds of a calibration."""
    loads = loads_of(case, skin)
    started = time.perf_counter()
    previous = skin.previous_readings if case.knows_previous else None
    calibration = calibrate(
        skin.position[rows], loads[rows], skin.readings[rows], load_kind=case.load, board=board_of(skin),
        previous_readings=None if previous is None else previous[rows],
    )  # fmt: skip
    mean, std = calibration.predict(
        skin.position[test], loads[test], previous_readings=None if previous is None else previous[test]
    )
    taken = time.perf_counter() - started
    inside = float(np.mean(np.abs(skin.readings[test] - mean) < STDS_WITHIN_90_PERCENT * std))
    single = loads if loads.ndim == 1 else loads[:, -1]
    recording = PressRecording(skin.position, single, skin.readings, case.load == "force")
    features = np.column_stack([skin.position, loads])
    predicted = {
        NEIGHBOURS: neighbours(recording, rows, test),
        PLAIN: plain(features[rows], skin.readings[rows], features[test]),
        POPULATION: mean,
    }
    best = prior_about().get("best_of_kind", {}).get(f"{case.kind}, {'force' if case.load == 'both' else case.load}")
    if best is not None:
        kernels = SkinKernels(*(np.array([value]) for value in best))
        predicted[ORACLE] = one_kernel(kernels, skin, single, rows, test)
    return predicted, inside, taken


def loads_of(case: Case, skin: PressedSkinOfKind) -> np.ndarray:
    """Known loads of the presses, (n,) or (n, 2)."""
    each = {"depth": skin.depth, "force": skin.force}
    return np.column_stack([skin.depth, skin.force]) if case.load == "both" else each[case.load]


def board_of(skin: PressedSkinOfKind) -> Board:
    """The board whose chips lie where the skin's do."""
    return eflesh_board() if skin.kind == "lattice" else reskin_board()


def one_kernel(
    kernels: SkinKernels, skin: PressedSkinOfKind, load: np.ndarray, rows: np.ndarray, test: np.ndarray
) -> np.ndarray:
    """Predictions (m, c) of one kernel."""
    typical = np.sqrt(np.mean(load[rows] ** 2))
    chips = skin.chip_positions if kernels.far_amplitude[0] < UNIFORM_FAR_AMPLITUDE else None
    known, other = (geometry(skin.position[part], load[part] / typical, chips) for part in (rows, test))
    n, c = len(rows), skin.readings.shape[1]
    observed = Observed(skin.readings[rows], np.zeros((n, c, 0)), np.zeros(0), np.zeros((n, 1)))
    given = next(condition_all(kernels, known, observed))
    cross = signal_covariances(take(kernels, slice(0, 1)), other, known)[0]
    return ungrouped(cross @ given.weights.reshape(n, len(cross), -1).swapaxes(0, 1))


def plain(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> np.ndarray:
    """A plain Gaussian process: squared exponential over position and loads, length, widths and noise by the marginal
    likelihood of all channels, each with its own mean and scale.
    """
    mean, n = y.mean(0), len(y)
    unit = np.maximum(x.std(0), 1e-9)
    unit[:2] = max(float(np.sqrt(np.mean(unit[:2] ** 2))), 1e-9)
    a, b = x / unit, at / unit
    left = y - mean

    def kernel(p: np.ndarray, q: np.ndarray, log: np.ndarray) -> np.ndarray:
        square = ((p[:, None, :2] - q[None, :, :2]) ** 2).sum(-1) * np.exp(-2 * log[0])
        square = square + ((p[:, None, 2:] - q[None, :, 2:]) ** 2).sum(-1) * np.exp(-2 * log[1])
        return np.exp(-square / 2)

    def loss(log: np.ndarray) -> float:
        factor = cho_factor(kernel(a, a, log) + (np.exp(log[2]) + 1e-8) * np.eye(n), lower=True)
        square = np.sum(left * cho_solve(factor, left), axis=0) / n
        half = np.sum(np.log(np.diag(factor[0])))
        return float(left.shape[1] * half + n / 2 * np.sum(np.log(np.maximum(square, 1e-12))))

    limits = [(-3.0, 2.5), (-3.0, 3.0), (-9.0, 1.0)]
    tried = [minimize(loss, np.array(start), method="L-BFGS-B", bounds=limits) for start in PLAIN_STARTS]
    best = min(tried, key=lambda result: result.fun).x
    system = kernel(a, a, best) + (np.exp(best[2]) + 1e-8) * np.eye(n)
    return mean + kernel(b, a, best) @ np.linalg.solve(system, left)
