"""Question: how many presses of one skin does it take to predict all others, and which way takes the fewest?

    python -m experiments.calibrate --dataset DIR                  20 draws of 5 to 1000 presses
    python -m experiments.calibrate --dataset DIR --preset debug   2 draws of up to 50 presses, too few to mean much

DIR is any recording of one tip on one skin (see python -m i2t.convert). Held out, for all draws alike: 1000 random
presses, and whole blocks of 6 mm; nothing is chosen by them. A third part asks what an earlier session is worth: the
first half in time predicts the second. Every method sees the same presses, so that differences are paired. Results go
to --out: metrics.json, config.json, curves.png.
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments import plots
from experiments.evaluation import nearest_neighbours, score, seed_interval, tuned
from experiments.runs import begin, reported, write_json
from i2t import calibrate
from i2t import dataset as data
from i2t.calibrate import Hyper, Presses
from i2t.dataset import Dataset
from i2t.types import ReturnCode

NEIGHBOURS, PLAIN = "k nearest presses", "plain Gaussian process"
STRUCTURED, HEIGHT = "structured process", "structured process + height"
CHOSEN = "structured process + height, scales by cross-validation"
EARLIER, ALONE = "earlier half as the mean", "earlier half alone"
STYLES = {
    NEIGHBOURS: (plots.GREY, "-"), PLAIN: (plots.ORANGE, "-"), STRUCTURED: (plots.BLUE, "-"),
    HEIGHT: (plots.GREEN, "-"), CHOSEN: (plots.RED, ":"), EARLIER: (plots.BLUE, "-"), ALONE: (plots.RED, "--"),
}  # fmt: skip
LIMIT = 300  # presses that hyperparameters are chosen on: the cost grows with the cube
SCALES = {"length": (0.7, 1.0, 1.4), "bend": (0.3, 1.0, 3.0), "noise": (0.3, 1.0, 3.0)}


@dataclass(frozen=True)
class Preset:
    """How much is tried."""

    draws: int = 20
    counts: tuple[int, ...] = (5, 10, 20, 50, 100, 300, 1000)
    held: int = 1000  # random presses held out
    block: float = 6.0  # mm
    blocks: float = 0.2  # share of blocks held out


PRESETS = {"full": Preset(), "debug": Preset(draws=2, counts=(5, 20, 50))}


@dataclass(frozen=True)
class Args:
    """Learning curves of calibration on real (or simulated) presses."""

    dataset: Path  # a data set of one tip on one skin
    out: Path = Path("runs/calibrate")  # folder for everything that is made
    preset: Literal["full", "debug"] = "full"
    load: Literal["auto", "depth", "force"] = "auto"  # what says how hard was pressed; auto: depth where measured
    seed: int = 0  # of what is held out and of the draws
    overwrite: bool = False  # replace a run in --out


@dataclass(frozen=True)
class Recording:
    """Presses as arrays: places (n, 2) m, loads (n,), readings (n, 15) uT, in the order of time."""

    place: np.ndarray
    load: np.ndarray
    readings: np.ndarray
    by_force: bool

    def presses(self, rows: np.ndarray) -> Presses:
        """Some of them, for the process."""
        return Presses(jnp.float32(self.place[rows]), jnp.float32(self.load[rows]))

    def features(self, rows: np.ndarray) -> np.ndarray:
        """Place and load in their standard deviations, for neighbours."""
        both = np.column_stack([self.place, self.load])
        return (both / both.std(0))[rows]


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.calibrate")
    return reported(partial(run, args))


def run(args: Args) -> dict[str, Any]:
    """The experiment: data and its faults, what is held out, draws, table and figure."""
    started, cfg = time.perf_counter(), PRESETS[args.preset]
    dataset = data.load(args.dataset)
    recording = read(dataset, args.load)
    held, blocks = hold_out(recording, cfg, args.seed)
    pool = np.flatnonzero(~held & ~blocks)
    later = np.arange(len(held)) >= len(held) // 2
    least = min(len(pool), 2 * int(later[pool].sum()))
    if least < 2 * min(cfg.counts) or held.sum() < 2 or blocks.sum() < 2 or (held & later).sum() < 2:
        raise ValueError(f"{args.dataset} has {len(held)} usable presses, too few to calibrate on and to hold out")
    begin(args.out, args, cfg, None, args.overwrite)
    faults = calibrate.check(recording.place, recording.load, recording.readings)
    for sentence in faults.sentences():
        print(f"warning: {sentence}")
    usable = ~faults.stale
    in_blocks, second = f"blocks of {cfg.block:g} mm", "second half in time"
    tests = {
        "random presses": np.flatnonzero(held & usable),
        in_blocks: np.flatnonzero(blocks & usable),
        second: np.flatnonzero(held & later & usable),
    }
    # Random presses and blocks are predicted from the same presses, and so with the same fits.
    first, pool = list(tests)[:2], pool[usable[pool]]
    after, before = pool[later[pool]], pool[~later[pool]]
    values: dict[str, Any] = {name: {} for name in tests}
    for draw in tqdm(range(cfg.draws), desc="draws", unit="draw"):
        rng = np.random.default_rng((args.seed, draw))
        order, order_after, past = (rng.permutation(rows) for rows in (pool, after, before))
        for names, rows, known in ((first, order, None), ([second], order_after, past[: max(cfg.counts)])):
            for count in (n for n in cfg.counts if n <= len(rows)):
                at = {name: tests[name] for name in names}
                for name, scores in compare(recording, rows[:count], at, known).items():
                    for method, r2 in scores.items():
                        values[name].setdefault(method, {}).setdefault(count, []).append(r2)
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": cfg.draws,
        "presses": len(held),
        "load": "force" if recording.by_force else "depth",
        "warnings": faults.sentences(),
        "stale_rows": int(faults.stale.sum()),
        "lag_r2": faults.lag_r2,
        "change": faults.change,
        "held_out": {name: len(test) for name, test in tests.items()},
        "r2": {name: summarise(methods) for name, methods in values.items()},
        "differences": {name: differences(methods) for name, methods in values.items()},
        "presses_for_the_same_r2": {name: saved(methods) for name, methods in values.items()},
        "seconds": round(time.perf_counter() - started, 1),
    }
    plots.save(figure(metrics, dataset.source), args.out / "curves.png")
    write_json(args.out / "metrics.json", metrics)
    report(metrics)
    print(f"\nresults and the figure are in {args.out}")
    return metrics


def read(dataset: Dataset, load: str) -> Recording:
    """Places of the tool's origin on the skin, and depth or force; presses that failed or met air are left out."""
    touches = dataset.touches
    T_t_o = np.linalg.inv(touches.T_w_t.astype(np.float64)) @ touches.T_w_o
    good = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR, ReturnCode.FREE])
    by_force = load == "force" or (load == "auto" and not np.isfinite(touches.depth[good]).all())
    amount = (touches.force if by_force else touches.depth).astype(np.float64)
    good &= np.isfinite(amount) & np.isfinite(T_t_o).all((1, 2))
    if not good.any():
        raise ValueError(f"no press has a known place and {'force' if by_force else 'depth'}; choose another --load")
    if len(np.unique(touches.pad[good])) > 1:
        raise ValueError("the data set holds several skins; calibrate them one at a time")
    if len(np.unique(touches.object[good])) > 1:
        raise ValueError("the data set holds several objects; calibration needs presses of one tip")
    return Recording(T_t_o[good, :2, 3], amount[good], touches.reading[good].astype(np.float64), by_force)


def hold_out(recording: Recording, cfg: Preset, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random presses and whole blocks that no method sees; at most a quarter of the presses is taken at random."""
    rng = np.random.default_rng(seed)
    n, place = len(recording.load), 1e3 * recording.place
    held = np.zeros(n, bool)
    held[rng.permutation(n)[: min(cfg.held, n // 4)]] = True
    cell = np.floor((place - place.min(0)) / cfg.block).astype(int)
    names, block = np.unique(cell, axis=0, return_inverse=True)
    chosen = rng.permutation(len(names))[: max(round(cfg.blocks * len(names)), 1)]
    return held, np.isin(block.ravel(), chosen)


def compare(
    recording: Recording, rows: np.ndarray, tests: dict[str, np.ndarray], past: np.ndarray | None
) -> dict[str, dict[str, float]]:
    """R2 on each set of held-out presses of every method that learns from the same rows; `past` are rows of an earlier
    session.
    """
    test = np.concatenate(list(tests.values()))
    readings, base = recording.readings, calibrate.FORCE if recording.by_force else calibrate.DEPTH
    predicted = {NEIGHBOURS: neighbours(recording, rows, test)}
    process = processes(recording, rows, test)
    if past is None:
        mean = readings[rows].mean(0)
        plain = choose(plain_options(recording), recording, rows, readings[rows] - mean)
        predicted[PLAIN] = mean + process(plain, readings[rows] - mean)
        predicted[STRUCTURED] = process(base._replace(height=0.0), readings[rows])
        predicted[HEIGHT] = process(base, readings[rows])
        predicted[CHOSEN] = process(
            choose(calibrate.options(base, SCALES), recording, rows, readings[rows]), readings[rows]
        )
    else:
        predicted[HEIGHT] = process(base, readings[rows])
        before = fit(base, recording.presses(past), jnp.float32(readings[past]))
        prior, own = (np.asarray(predict(before, recording.presses(r))[0]) for r in (test, rows))
        predicted[ALONE] = prior
        # What the earlier session leaves is mostly noise: how much is told by the presses.
        rest = calibrate.options(base._replace(height=0.0), {"noise": (1.0, 10.0, 100.0, 1e4)})
        predicted[EARLIER] = prior + process(choose(rest, recording, rows, readings[rows] - own), readings[rows] - own)
    ends = np.cumsum([len(part) for part in tests.values()])
    parts = {name: slice(end - len(tests[name]), end) for name, end in zip(tests, ends, strict=True)}
    return {
        name: {method: score(readings[test[part]], values[part]).r2 for method, values in predicted.items()}
        for name, part in parts.items()
    }


fit, predict, select = jax.jit(calibrate.fit), jax.jit(calibrate.predict), jax.jit(calibrate.choose)


def processes(recording: Recording, rows: np.ndarray, test: np.ndarray) -> Callable[[Hyper, np.ndarray], np.ndarray]:
    """Fits to these rows, predictions at the test."""

    def process(hyper: Hyper, target: np.ndarray) -> np.ndarray:
        fitted = fit(hyper, recording.presses(rows), jnp.float32(target))
        return np.asarray(predict(fitted, recording.presses(test))[0], np.float64)

    return process


def choose(stacked: Hyper, recording: Recording, rows: np.ndarray, target: np.ndarray) -> Hyper:
    """Hyperparameters by cross-validation on at most LIMIT of the rows, which come in random order."""
    return select(stacked, recording.presses(rows[:LIMIT]), jnp.float32(target[:LIMIT]))


def plain_options(recording: Recording) -> Hyper:
    """The plain process, squared exponential over place and load: nothing but the bent part, without growth."""
    load = float(recording.load.std())
    plain = Hyper(
        unit=load, offset=0.0, power=0.0, length=8e-3, steady=0.0, bend=1.0, bend_length=8e-3, bend_width=2 * load,
        standing=0.0, constant=0.0, noise=1e-2, height=0.0, height_length=2e-3, reach=1.0, floor=1.0,
    )  # fmt: skip
    return calibrate.options(
        plain, {"bend_length": (0.5, 0.75, 1.0, 1.5), "bend_width": (0.5, 1.0, 2.0), "noise": (0.1, 1.0)}
    )


def neighbours(recording: Recording, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
    """k nearest presses in place and load, k by cross-validation."""

    def mean(x: np.ndarray, y: np.ndarray, at: np.ndarray, k: float) -> np.ndarray:
        return nearest_neighbours(x, y, at, int(k))

    x, at = recording.features(rows), recording.features(test)
    return tuned(mean, (1, 2, 3, 4, 6, 8), x, recording.readings[rows], np.arange(len(rows)), at)


def summarise(methods: dict[str, dict[int, list[float]]]) -> dict[str, Any]:
    """Mean R2 over draws with its 95 % interval (Student's t)."""
    return {
        name: {
            count: dict(zip(("mean", "low", "high"), seed_interval(r2), strict=True)) for count, r2 in by_count.items()
        }
        for name, by_count in methods.items()
    }


def differences(methods: dict[str, dict[int, list[float]]]) -> dict[str, Any]:
    """R2 of each method minus that of the method listed before it, draw by draw."""
    names = list(methods)
    return {
        f"{after} - {before}": summarise(
            {"": {n: list(np.subtract(methods[after][n], methods[before][n])) for n in methods[after]}}
        )[""]
        for before, after in pairwise(names)
    }


def saved(methods: dict[str, dict[int, list[float]]]) -> dict[str, Any]:
    """For each method and count, how many presses of every other method reach the same mean R2.

    Interpolated in the logarithm of the count; None where even the largest count does not.
    """
    curve = {name: {n: float(np.mean(r2)) for n, r2 in by_count.items()} for name, by_count in methods.items()}

    def needed(other: str, r2: float) -> float | None:
        counts = np.array(list(curve[other]))
        best = np.maximum.accumulate(list(curve[other].values()))
        if best[-1] < r2:
            return None
        after = int(np.argmax(best >= r2))
        if after == 0:
            return float(counts[0])
        share = (r2 - best[after - 1]) / (best[after] - best[after - 1])
        return float(np.exp(np.log(counts[after - 1]) * (1 - share) + np.log(counts[after]) * share))

    return {
        name: {n: {other: needed(other, r2) for other in curve if other != name} for n, r2 in by_count.items()}
        for name, by_count in curve.items()
    }


def figure(metrics: dict[str, Any], source: str) -> Figure:
    """R2 against the number of presses, a panel for each thing held out."""
    result = Figure(figsize=(13, 4.4), layout="constrained")
    for axes, (name, methods) in zip(result.subplots(1, len(metrics["r2"])), metrics["r2"].items(), strict=True):
        for method, by_count in methods.items():
            counts, (colour, line) = list(by_count), STYLES[method]
            mean, low, high = ([by_count[n][key] for n in counts] for key in ("mean", "low", "high"))
            axes.plot(counts, mean, "o" + line, ms=3, color=colour, label=method)
            axes.fill_between(counts, low, high, color=colour, alpha=0.2, lw=0)
        axes.set(xscale="log", xlabel="presses to calibrate with", ylim=(0, 1), title=f"held out: {name}")
        axes.set_xticks(counts, [str(n) for n in counts])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="lower right")
    result.axes[0].set_ylabel("R² of 15 channels")
    result.suptitle(f"Calibration of one skin ({source}): mean of {metrics['draws']} draws and 95 % interval")
    return result


def report(metrics: dict[str, Any]) -> None:
    """The table a person reads."""
    for name, methods in metrics["r2"].items():
        print(f"\n{metrics['source']}, held out: {metrics['held_out'][name]} ({name}); mean R2 [95 %] over draws")
        for method, by_count in methods.items():
            cells = (f"{n}: {v['mean']:.3f} [{v['low']:.3f}, {v['high']:.3f}]" for n, v in by_count.items())
            print(f"{method:56}" + "  ".join(cells))


if __name__ == "__main__":
    sys.exit(main())
