"""Question: how many presses of one skin does it take to predict all others, and which way takes the fewest?

    python -m experiments.calibrate --dataset DIR                  20 draws of 5 to 1000 presses
    python -m experiments.calibrate --dataset DIR --preset short   the same up to 300 presses, in a quarter of the time
    python -m experiments.calibrate --dataset DIR --preset debug   2 draws of up to 20 presses, too few to mean much
    python -m experiments.calibrate --dataset DIR --earlier DIR    only what an earlier session of the skin is worth
    python -m experiments.calibrate --dataset DIR --presses 1000 --draws 5    one column of the table

DIR is any recording of one tip on one skin (see python -m i2t.convert). Held out, for all draws alike: 1000 random
presses, and whole blocks of 6 mm; nothing is chosen by them. Random presses inside the blocks have no press near them
that may be told, so those outside are also scored alone. A last part asks what an earlier session is worth: the first
half in time predicts the second; with --earlier a session recorded before predicts the second half of this one,
and presses are drawn from the first half, so that one place or few are enough. Every method sees the same presses, so
that differences are paired. Intervals are over draws; as neighbouring presses are no independent tests, the best way
also has intervals over 6 mm blocks of what is held out. Results go to --out: metrics.json, config.json, curves.png, and
calibration.npz, what `i2t.calibration.load` reads: the skin as calibrated on all presses (of more than 1500, that many
at random). The pretrained network has pressed made-up skins of four magnets only.
"""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
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

from experiments.common.runs import begin, reported, write_json
from i2t import calibration
from i2t import dataset as data
from i2t.calibration import Hyper, Presses, baseline_network, lattice
from i2t.calibration.baseline_network import Network
from i2t.dataset import Dataset
from i2t.prediction.metrics import grouped_interval, nearest_neighbours, seed_interval, tuned
from i2t.types import ReturnCode
from i2t.viz import touches as plots

NEIGHBOURS, PLAIN = "k nearest presses", "plain Gaussian process"
STRUCTURED, HEIGHT = "structured process", "structured process + height"
CHOSEN = "structured process + height, scales by cross-validation"
PERIOD = "structured process + height, period given"
SCRATCH, PRETRAINED = "network from scratch", "network pretrained on made-up skins"
RESIDUAL, BEST = "pretrained network + structured process", "best way by cross-validation"
EARLIER, ALONE = "earlier half as the mean", "earlier half alone"
SESSION = {EARLIER: "earlier session as the mean", ALONE: "earlier session alone"}
STYLES = {
    NEIGHBOURS: (plots.GREY, "-"), PLAIN: (plots.ORANGE, "-"), STRUCTURED: (plots.BLUE, "-"),
    HEIGHT: (plots.GREEN, "-"), CHOSEN: (plots.RED, ":"), EARLIER: (plots.BLUE, "-"), ALONE: (plots.RED, "--"),
    PERIOD: (plots.GREEN, ":"), SCRATCH: (plots.GREY, "--"), PRETRAINED: (plots.ORANGE, "--"),
    RESIDUAL: (plots.BLUE, "--"), BEST: (plots.RED, "-"),
    SESSION[EARLIER]: (plots.BLUE, "-"), SESSION[ALONE]: (plots.RED, "--"),
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
    skins: int = 300  # made-up ones, of 125 presses each
    steps: int = 4000  # of pretraining
    scratch: int = 500  # steps of training from scratch
    kept: int = 1500  # presses in what is saved


PRESETS = {
    "full": Preset(),
    "short": Preset(counts=(5, 10, 20, 50, 100, 300)),
    "debug": Preset(2, (5, 20), skins=16, steps=50, scratch=50),
}


@dataclass(frozen=True)
class Args:
    """Learning curves of calibration on real (or simulated) presses."""

    dataset: Path  # a data set of one tip on one skin
    out: Path = Path("runs/calibrate")  # folder for everything that is made
    preset: Literal["full", "short", "debug"] = "full"
    load: Literal["auto", "depth", "force"] = "auto"  # what says how hard was pressed; auto: depth where measured
    earlier: Path | None = None  # a data set of an earlier session of the same skin with the same tip
    presses: tuple[int, ...] = ()  # how many to calibrate with; by default what the preset says
    draws: int = 0  # of the presses to calibrate with; 0: what the preset says
    period_mm: float = 0.0  # of a lattice along x and y, where it is known: another row of the table; 0: none
    seed: int = 0  # of what is held out and of the draws
    overwrite: bool = False  # replace a run in --out


@dataclass(frozen=True)
class Recording:
    """Presses as arrays: places (n, 2) m, loads (n,), readings (n, 15) uT, in the order of time."""

    place: np.ndarray
    load: np.ndarray
    readings: np.ndarray
    by_force: bool
    chips: np.ndarray | None = None  # (5, 2) m; given where each channel's amplitude falls with the distance

    def presses(self, rows: np.ndarray) -> Presses:
        """Some of them, for the process."""
        return Presses(jnp.float32(self.place[rows]), jnp.float32(self.load[rows]))

    def features(self, rows: np.ndarray) -> np.ndarray:
        """Place and load in their standard deviations, for neighbours."""
        both = np.column_stack([self.place, self.load])
        return (both / np.maximum(both.std(0), 1e-9))[rows]


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.calibrate")
    return reported(partial(run, args))


def run(args: Args) -> dict[str, Any]:
    """The experiment: data and its faults, what is held out, draws, table and figure."""
    if args.earlier is not None:
        return sessions(args, args.earlier)
    started, cfg = time.perf_counter(), tried(args)
    dataset = data.load(args.dataset)
    recording = read(dataset, args.load)
    held, blocks = hold_out(recording, cfg, args.seed)
    pool = np.flatnonzero(~held & ~blocks)
    later = np.arange(len(held)) >= len(held) // 2
    least = min(len(pool), 2 * int(later[pool].sum()))
    if least < 2 * min(cfg.counts) or min((held & ~blocks).sum(), blocks.sum(), (held & later).sum()) < 2:
        raise ValueError(f"{args.dataset} has {len(held)} usable presses, too few to calibrate on and to hold out")
    begin(args.out, args, cfg, None, args.overwrite)
    faults = calibration.check(recording.place, recording.load, recording.readings, by_force=recording.by_force)
    for sentence in faults.sentences():
        print(f"warning: {sentence}")
    usable = ~faults.stale
    in_blocks, second = f"blocks of {cfg.block:g} mm", "second half in time"
    tests = {
        "random presses": np.flatnonzero(held & usable),
        "those of them outside the blocks": np.flatnonzero(held & ~blocks & usable),
        in_blocks: np.flatnonzero(blocks & usable),
        second: np.flatnonzero(held & later & usable),
    }
    # All but the last are predicted from the same presses, and so with the same fits.
    first, pool = list(tests)[:-1], pool[usable[pool]]
    after, before = pool[later[pool]], pool[~later[pool]]
    values: dict[str, Any] = {name: {} for name in tests}
    missed: dict[str, Any] = {name: {} for name in tests}
    inside: dict[str, Any] = {name: {} for name in tests}
    way = Way(recording, cfg, args.period_mm * 1e-3)
    if not recording.by_force:
        told = pretrained(recording, cfg)
        seen = baseline_network.features(told, recording.presses(np.arange(len(held))))
        way = replace(way, seen=np.asarray(seen, np.float64), noise=float(told.noise))
    base = way.base
    for draw in tqdm(range(cfg.draws), desc="draws", unit="draw"):
        rng = np.random.default_rng((args.seed, draw))
        order, order_after, past = (rng.permutation(rows) for rows in (pool, after, before))
        past = past[: max(cfg.counts)]
        chips = None if recording.chips is None else jnp.float32(recording.chips)
        earlier = fit(base, recording.presses(past), jnp.float32(recording.readings[past]), chips)
        prior = np.asarray(predict(earlier, recording.presses(np.arange(len(held))))[0], np.float64)
        for names, rows, known in ((first, order, None), ([second], order_after, prior)):
            for count in (n for n in cfg.counts if n <= len(rows)):
                at = {name: tests[name] for name in names}
                errors, covered = compare(way, rows[:count], at, known)
                for name, by_method in errors.items():
                    for method, error in by_method.items():
                        missed[name].setdefault(method, {}).setdefault(count, []).append(error)
                        r2 = explained(recording.readings[at[name]], error)
                        values[name].setdefault(method, {}).setdefault(count, []).append(r2)
                for name, shares in covered.items():
                    for method, share in shares.items():
                        inside[name].setdefault(method, {}).setdefault(count, []).append(share)
    block = block_of(recording, cfg.block)
    everything = np.random.default_rng(args.seed).permutation(np.flatnonzero(usable))[: cfg.kept]
    kept = calibration.calibrate(
        recording.place[everything], recording.load[everything], recording.readings[everything],
        "force" if recording.by_force else "depth", about={"dataset": str(args.dataset), "source": dataset.source},
        board=dataset.board if recording.by_force else None,
    )  # fmt: skip
    kept.save(args.out / "calibration.npz")
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": cfg.draws,
        "presses": len(held),
        "load": "force" if recording.by_force else "depth",
        "warnings": faults.sentences(),
        "hyper": calibration.numbers(calibration.FORCE if recording.by_force else calibration.DEPTH),
        "stale_rows": int(faults.stale.sum()),
        "lag_r2": faults.lag_r2,
        "change": faults.change,
        "held_out": {name: len(test) for name, test in tests.items()},
        "r2": {name: summarise(methods) for name, methods in values.items()},
        "inside_90": {name: summarise(methods) for name, methods in inside.items()},
        "differences": {name: differences(methods) for name, methods in values.items()},
        "best_over_blocks": {
            name: over_blocks(recording.readings[tests[name]], missed[name], block[tests[name]]) for name in first
        },
        "presses_for_the_same_r2": {name: saved(methods) for name, methods in values.items()},
    }
    return finished(args, metrics, started)


def sessions(args: Args, source: Path) -> dict[str, Any]:
    """What an earlier session is worth: R2 on the second half in time of this one, from presses of its first half."""
    started, cfg = time.perf_counter(), tried(args)
    dataset = data.load(args.dataset)
    recording, before = read(dataset, args.load), read(data.load(source), args.load)
    if recording.by_force != before.by_force:
        raise ValueError("one session has depths and the other forces; choose a --load that both have")
    if min(len(recording.load) // 2, len(before.load)) < max(2, *cfg.counts[:1]):
        raise ValueError(f"{args.dataset} or {source} has too few usable presses to calibrate on")
    begin(args.out, args, cfg, None, args.overwrite)
    faults, told = {}, {"earlier": before, "later": recording}
    for name, one in told.items():
        faults[name] = calibration.check(one.place, one.load, one.readings, by_force=one.by_force)
        for sentence in faults[name].sentences():
            print(f"warning, {name} session: {sentence}")
    rows = {name: np.flatnonzero(~found.stale) for name, found in faults.items()}
    n = len(recording.load)
    pool, test = rows["later"][rows["later"] < n // 2], rows["later"][rows["later"] >= n // 2]
    way, name = Way(recording, cfg, 0.0), "second half of the later session"
    chips = None if recording.chips is None else jnp.float32(recording.chips)
    values: dict[str, dict[int, list[float]]] = {}
    for draw in tqdm(range(cfg.draws), desc="draws", unit="draw"):
        rng = np.random.default_rng((args.seed, draw))
        order, past = rng.permutation(pool), rng.permutation(rows["earlier"])[: max(cfg.counts)]
        known = fit(way.base, before.presses(past), jnp.float32(before.readings[past]), chips)
        prior = np.asarray(predict(known, recording.presses(np.arange(n)))[0], np.float64)
        for count in (count for count in cfg.counts if count <= len(order)):
            for method, error in compare(way, order[:count], {name: test}, prior)[0][name].items():
                r2 = explained(recording.readings[test], error)
                values.setdefault(SESSION.get(method, method), {}).setdefault(count, []).append(r2)
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": cfg.draws,
        "presses": {name: len(one.load) for name, one in told.items()},
        "load": "force" if recording.by_force else "depth",
        "warnings": {name: found.sentences() for name, found in faults.items()},
        "stale_rows": {name: int(found.stale.sum()) for name, found in faults.items()},
        "lag_r2": {name: found.lag_r2 for name, found in faults.items()},
        "change": {name: found.change for name, found in faults.items()},
        "held_out": {name: len(test)},
        "r2": {name: summarise(values)},
    }
    return finished(args, metrics, started)


def tried(args: Args) -> Preset:
    """The preset, with what is given instead."""
    cfg = PRESETS[args.preset]
    cfg = replace(cfg, draws=args.draws or cfg.draws, counts=tuple(sorted(set(args.presses))) or cfg.counts)
    if cfg.draws < 1 or min(cfg.counts) < 2:
        raise ValueError("--draws must be at least 1 and --presses at least 2")
    return cfg


def finished(args: Args, metrics: dict[str, Any], started: float) -> dict[str, Any]:
    """Write and print what was measured since `started` (s)."""
    metrics["seconds"] = round(time.perf_counter() - started, 1)
    plots.save(figure(metrics, metrics["source"]), args.out / "curves.png")
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
    chips = dataset.board.chips[:, :2] if by_force else None
    return Recording(T_t_o[good, :2, 3], amount[good], touches.reading[good].astype(np.float64), by_force, chips)


def hold_out(recording: Recording, cfg: Preset, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Random presses and whole blocks that no method sees; at most a quarter of the presses is taken at random."""
    rng = np.random.default_rng(seed)
    n, block = len(recording.load), block_of(recording, cfg.block)
    held = np.zeros(n, bool)
    held[rng.permutation(n)[: min(cfg.held, n // 4)]] = True
    chosen = rng.permutation(block.max() + 1)[: max(round(cfg.blocks * (block.max() + 1)), 1)]
    return held, np.isin(block, chosen)


def block_of(recording: Recording, edge: float) -> np.ndarray:
    """The square block of this edge (mm) in which each press lies, counted from 0."""
    place = 1e3 * recording.place
    cell = np.floor((place - place.min(0)) / edge).astype(int)
    return np.unique(cell, axis=0, return_inverse=True)[1].ravel()


@dataclass(frozen=True)
class Way:
    """Ways to predict readings at rows of a recording from other rows, all alike from outside."""

    recording: Recording
    cfg: Preset
    period: float  # m
    seen: np.ndarray | None = None  # (n, k) features of all rows by a pretrained network
    noise: float = 0.0  # its logarithm, see `Network`

    @property
    def base(self) -> Hyper:
        """Hyperparameters of the structured process."""
        return calibration.FORCE if self.recording.by_force else calibration.DEPTH

    def process(self, hyper: Hyper, rows: np.ndarray, target: np.ndarray, test: np.ndarray) -> np.ndarray:
        """A structured process of the target at rows."""
        presses, at = self.recording.presses(rows), self.recording.presses(test)
        chips = None if self.recording.chips is None else jnp.float32(self.recording.chips)
        return np.asarray(predict(fit(hyper, presses, jnp.float32(target), chips), at)[0], np.float64)

    def structured(self, rows: np.ndarray, test: np.ndarray, **changed: float) -> np.ndarray:
        """The structured process with heights."""
        return self.process(self.base._replace(**changed), rows, self.recording.readings[rows], test)

    def plain(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """A Gaussian process over place and load, its scales by cross-validation."""
        readings = self.recording.readings[rows]
        bare = Way(replace(self.recording, chips=None), self.cfg, self.period)
        hyper = choose(plain_options(self.recording), bare.recording, rows, readings - readings.mean(0))
        return readings.mean(0) + bare.process(hyper, rows, readings - readings.mean(0), test)

    def chosen(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The structured process, its scales by cross-validation."""
        readings = self.recording.readings[rows]
        hyper = choose(calibration.options(self.base, SCALES), self.recording, rows, readings)
        return self.process(hyper, rows, readings, test)

    def pretrained(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The last layer of the pretrained network, as `network.adapt`; NumPy, so that no number of rows compiles."""
        assert self.seen is not None
        phi, readings = self.seen[rows], self.recording.readings[rows]
        scale, noise = np.sqrt(np.mean(readings**2)) + 1e-6, np.exp(self.noise) + 1e-4
        weights = np.linalg.solve(phi.T @ phi / noise + np.eye(phi.shape[1]), phi.T @ readings / (noise * scale))
        return self.seen[test] @ weights * scale

    def residual(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The pretrained network, and a structured process of what it leaves of rows that it was not told."""
        fold = np.arange(len(rows)) % min(5, len(rows))
        left = np.empty((len(rows), self.recording.readings.shape[1]))
        for i in range(fold.max() + 1):
            left[fold == i] = self.pretrained(rows[fold != i], rows[fold == i])
        left = self.recording.readings[rows] - left
        hyper = self.base._replace(height=0.0)
        return self.pretrained(rows, test) + self.process(hyper, rows, left, test)

    def scratch(self, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
        """The same network, trained on the rows alone."""
        half, unit = np.abs(self.recording.place).max(), self.recording.load.max()
        readings = jnp.float32(self.recording.readings[rows])
        presses = self.recording.presses(rows)
        told, head = baseline_network.scratch(
            jax.random.key(0), presses, readings, jnp.float32(half), jnp.float32(unit), self.cfg.scratch
        )
        return np.asarray(predict_network(told, head, self.recording.presses(test))[0], np.float64)

    def ways(self) -> dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]]:
        """All of them by name."""
        ways: dict[str, Any] = {
            NEIGHBOURS: partial(neighbours, self.recording),
            PLAIN: self.plain,
            SCRATCH: self.scratch,
            STRUCTURED: partial(self.structured, height=0.0),
            HEIGHT: self.structured,
            CHOSEN: self.chosen,
        }
        if self.period:
            ways[PERIOD] = partial(self.structured, period=self.period)
        if self.seen is not None:
            ways |= {PRETRAINED: self.pretrained, RESIDUAL: self.residual}
        return ways


def best(ways: dict[str, Any], recording: Recording, rows: np.ndarray) -> str:
    """The way with the least error on fifths of at most LIMIT of the rows; the structured process with heights unless
    another is better by one standard error over presses.
    """
    rows = rows[:LIMIT]
    fold = np.arange(len(rows)) % min(5, len(rows))
    errors = {}
    for name in (HEIGHT, PRETRAINED, RESIDUAL, PERIOD):
        if name in ways:
            left = np.empty((len(rows), recording.readings.shape[1]))
            for i in range(fold.max() + 1):
                left[fold == i] = ways[name](rows[fold != i], rows[fold == i])
            errors[name] = ((recording.readings[rows] - left) ** 2).sum(1)
    gain = {name: errors[HEIGHT] - error for name, error in errors.items()}
    sure = {name: g.mean() for name, g in gain.items() if g.mean() > g.std() / np.sqrt(max(len(g) - 1, 1))}
    return max(sure, key=lambda name: sure[name]) if sure else HEIGHT


def compare(
    way: Way, rows: np.ndarray, tests: dict[str, np.ndarray], prior: np.ndarray | None
) -> tuple[dict[str, dict[str, np.ndarray]], dict[str, dict[str, float]]]:
    """Squared error (uT^2) at each held-out press of every method that learns from the same rows, and the share of
    readings in the stated 90 % range; `prior` is what an earlier session says of all rows.
    """
    recording, test = way.recording, np.concatenate(list(tests.values()))
    readings, base = recording.readings, way.base
    shares: dict[str, np.ndarray] = {}
    if prior is None:
        ways = way.ways()
        predicted = {name: ways[name](rows, test) for name in ways}
        predicted[BEST] = predicted[best(ways, recording, rows)]
        presses, chips = recording.presses(rows), None if recording.chips is None else jnp.float32(recording.chips)
        mean, std = predict(fit(base, presses, jnp.float32(readings[rows]), chips), recording.presses(test))
        wide = np.asarray(std * widening(base, presses, jnp.float32(readings[rows]), chips)[None])
        shares = {
            HEIGHT + ", as the process says": np.abs(readings[test] - mean) < calibration.WITHIN * std,
            HEIGHT + ", widened": np.abs(readings[test] - mean) < calibration.WITHIN * wide,
        }
    else:
        predicted = {NEIGHBOURS: neighbours(recording, rows, test), HEIGHT: way.structured(rows, test)}
        predicted[ALONE], left = prior[test], readings[rows] - prior[rows]
        # What the earlier session leaves is mostly noise: how much is told by the presses.
        rest = calibration.options(base._replace(height=0.0), {"noise": (1.0, 10.0, 100.0, 1e4)})
        predicted[EARLIER] = prior[test] + way.process(choose(rest, recording, rows, left), rows, left, test)
    ends = np.cumsum([len(part) for part in tests.values()])
    parts = {name: slice(end - len(tests[name]), end) for name, end in zip(tests, ends, strict=True)}
    wrong = {method: ((readings[test] - values) ** 2).sum(1) for method, values in predicted.items()}
    errors = {name: {method: error[part] for method, error in wrong.items()} for name, part in parts.items()}
    covered = {
        name: {method: float(np.mean(np.asarray(share)[part])) for method, share in shares.items()}
        for name, part in parts.items()
    }
    return errors, {name: share for name, share in covered.items() if share}


fit, predict, select = jax.jit(calibration.fit), jax.jit(calibration.predict), jax.jit(calibration.choose)
widening = jax.jit(calibration.widening)
predict_network = jax.jit(baseline_network.predict_network)


def pretrained(recording: Recording, cfg: Preset) -> Network:
    """A network that has pressed made-up skins of four magnets, over the places and depths of this recording."""
    half, deepest = float(np.abs(recording.place).max()), float(recording.load.max())
    make = jax.jit(lattice.skins, static_argnums=(1, 2, 3, 4))
    presses, readings = make(jax.random.key(0), cfg.skins, 125, half, deepest)
    return baseline_network.pretrain(jax.random.key(1), presses, readings, cfg.steps)[0]


def choose(stacked: Hyper, recording: Recording, rows: np.ndarray, target: np.ndarray) -> Hyper:
    """Hyperparameters by cross-validation on at most LIMIT of the rows, which come in random order."""
    chips = None if recording.chips is None else jnp.float32(recording.chips)
    return select(stacked, recording.presses(rows[:LIMIT]), jnp.float32(target[:LIMIT]), chips)


def plain_options(recording: Recording) -> Hyper:
    """The plain process, squared exponential over place and load: nothing but the bent part, without growth."""
    load = float(recording.load.std())
    plain = Hyper(
        unit=load, offset=0.0, power=0.0, length=8e-3, steady=0.0, bend=1.0, bend_length=8e-3, bend_width=2 * load,
        standing=0.0, constant=0.0, noise=1e-2, height=0.0, height_length=2e-3, reach=1.0, floor=1.0,
    )  # fmt: skip
    return calibration.options(
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
    """R2 of the structured process with heights minus that of each other method, draw by draw."""
    return {
        f"{HEIGHT} - {other}": summarise(
            {"": {n: list(np.subtract(methods[HEIGHT][n], methods[other][n])) for n in methods[other]}}
        )[""]
        for other in methods
        if other != HEIGHT
    }


def explained(readings: np.ndarray, error: np.ndarray) -> float:
    """R2 over all channels from readings (n, 15) and squared errors (n,)."""
    return float(1 - error.sum() / ((readings - readings.mean(0)) ** 2).sum())


def over_blocks(
    readings: np.ndarray, errors: dict[str, dict[int, list[np.ndarray]]], block: np.ndarray
) -> dict[str, Any]:
    """R2 of the best way, and by how much it is above each other, with 95 % intervals over whole blocks of the held-out
    presses (cluster bootstrap of the mean over draws): what other places of the skin would have given.
    """
    names, of = np.unique(block, return_inverse=True)
    inside = (of == np.arange(len(names))[:, None]).astype(float)  # sums over each block
    left = readings - readings.mean(0)
    presses, first, second = inside.sum(1), inside @ left, inside @ (left**2).sum(1)
    missed = {way: {n: inside @ np.mean(draws, axis=0) for n, draws in by.items()} for way, by in errors.items()}

    def share(error: np.ndarray, rows: np.ndarray) -> float:
        spread = second[rows].sum() - (first[rows].sum(0) ** 2).sum() / presses[rows].sum()
        return float(error[rows].sum() / spread)

    def r2(error: np.ndarray, rows: np.ndarray) -> float:
        return 1 - share(error, rows)

    def interval(statistic: Callable[[np.ndarray], float]) -> dict[str, float]:
        every = np.arange(len(names))
        return dict(zip(("mean", "low", "high"), (statistic(every), *grouped_interval(statistic, every)), strict=True))

    return {
        "blocks": len(names),
        "r2": {n: interval(partial(r2, error)) for n, error in missed[BEST].items()},
        "differences": {
            f"{BEST} - {other}": {n: interval(partial(share, error - missed[BEST][n])) for n, error in by.items()}
            for other, by in missed.items()
            if other != BEST
        },
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
    result = Figure(figsize=(max(6.5, 4.4 * len(metrics["r2"])), 4.4), layout="constrained")
    panels = result.subplots(1, len(metrics["r2"]), squeeze=False)[0]
    for axes, (name, methods) in zip(panels, metrics["r2"].items(), strict=True):
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
    for name, found in metrics.get("best_over_blocks", {}).items():
        print(f"\nheld out: {name}; {BEST} and its gain, 95 % over {found['blocks']} blocks of places")
        for what, by_count in {BEST: found["r2"], **found["differences"]}.items():
            cells = (f"{n}: {v['mean']:.3f} [{v['low']:.3f}, {v['high']:.3f}]" for n, v in by_count.items())
            print(f"{what.removeprefix(BEST + ' '):56}" + "  ".join(cells))
