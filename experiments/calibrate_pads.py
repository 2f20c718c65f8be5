"""Question: how well do a few presses at a known force tell a ReSkin, when its layer is what physics says it is?

    python -m experiments.calibrate_pads                  8 random simulated pads, 10 to 300 presses
    python -m experiments.calibrate_pads --preset short   4 pads, 5, 20 and 100 presses, no network
    python -m experiments.calibrate_pads --preset debug   1 pad, 10 and 20 presses, too few to mean anything
    python -m experiments.calibrate_pads --population     what `FORCE` should be: chosen on 24 pads, tried on 32 others

Everything is simulated: pads of `sample_pad`, a spherical tip of 4 mm pressed to 0.2 to 1 N at random places, 0.02 N of
error in the force, 0.05 mm in each place, and 1.5 uT of noise. Ways: k nearest presses, a plain Gaussian process, the
structured process for forces, a network pretrained on other random pads, a pad fitted by physics, and that with a
structured process for what it leaves. All see the same presses. With --population no pad is fitted: the hyperparameters
of the structured process are searched, one after the other, from a guess by geometry, on boards with the faults of one
in order (`Faults.typical`) and tried on others with and without. Results go to --out:
metrics.json, config.json, curves.png, and pad.npz, the first pad as fitted to the most presses, which
`i2t.skin.files.load_pad` reads.
"""

import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from tqdm import tqdm

from experiments.calibrate.run import (
    NEIGHBOURS,
    PLAIN,
    Preset,
    Recording,
    Way,
    choose,
    fit,
    neighbours,
    predict,
    summarise,
)
from experiments.common.runs import begin, reported, write_json
from i2t import calibration
from i2t.calibration import Hyper, Presses, baseline_network, physics
from i2t.calibration.physics import Tip
from i2t.prediction.metrics import score
from i2t.skin import boards, faults
from i2t.skin.files import save_pad
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Pad
from i2t.viz import touches

STRUCTURED, PRETRAINED = "structured process", "network pretrained on random pads"
NOMINAL, FITTED, RESIDUAL = "physics, middling layer", "physics, fitted layer", "physics + structured process"
COLOURS = {
    NEIGHBOURS: touches.GREY, PLAIN: touches.ORANGE, STRUCTURED: touches.GREEN, PRETRAINED: "#8b5fbf", NOMINAL:
    "#7fb3d5", FITTED: touches.BLUE, RESIDUAL: touches.RED,
}  # fmt: skip
TIP = Tip("sphere", 4e-3)
HALF, FORCES = 8e-3, (0.2, 1.0)  # m, N
FORCE_ERROR, PLACE_ERROR, NOISE = 0.02, 0.05e-3, 1.5  # N, m, uT
# What geometry suggests for a layer of a few mm: a chip feels what happens within twice the layer's thickness, and the
# part that does not depend on the force is as large as the rest. The search for `FORCE` begins here.
GUESSED = calibration.FORCE._replace(
    offset=0.1, power=0.7, length=5e-3, bend=0.03, bend_length=5e-3, bend_width=1.0, standing=0.3, constant=0.1,
    noise=5e-2, reach=7e-3, floor=0.2,
)  # fmt: skip
# Not what does not depend on the force: simulated boards have none of it, real ones may.
SEARCHED = ("length", "noise", "power", "offset", "reach", "floor", "bend", "bend_length", "bend_width")
STEPS = (2.0, 1.4, 1.2)  # factors on one hyperparameter at a time
SWEEPS = 5  # through all of them with one factor, at most
GAIN = 1e-4  # of mean R2 that is worth a step


@dataclass(frozen=True)
class Pads:
    """How much is tried."""

    pads: int = 8
    counts: tuple[int, ...] = (10, 20, 50, 100, 300)
    held: int = 200
    others: int = 200  # random pads of 60 presses each, to pretrain on; 0: no network
    steps: int = 3000


PRESETS = {"full": Pads(), "short": Pads(4, (5, 20, 100), 200, 0), "debug": Pads(1, (10, 20), 40, 4, 20)}


@dataclass(frozen=True)
class Population:
    """Pads that hyperparameters are chosen on, and others that they are tried on."""

    pads: int = 24
    others: int = 32
    counts: tuple[int, ...] = (10, 20, 50, 100)
    held: int = 100


POPULATIONS = {"full": Population(), "short": Population(6, 6), "debug": Population(2, 2, (10, 20), 20)}


@dataclass(frozen=True)
class Args:
    """Calibration of simulated pads by force."""

    out: Path = Path("runs/calibrate_pads")  # folder for everything that is made
    preset: Literal["full", "short", "debug"] = "full"
    population: bool = False  # choose hyperparameters on a population of pads instead
    seed: int = 0
    overwrite: bool = False  # replace a run in --out


@partial(jax.jit, static_argnums=(1, 2))
def pressed(key: jax.Array, count: int, n: int) -> tuple[Pad, Presses, jax.Array]:
    """Random pads, (count,), n presses of each as a lab believes them, and their readings (count, n, 15) with noise."""
    keys = dict(zip(("pads", "place", "force", "misplace", "misforce", "noise"), jax.random.split(key, 6), strict=True))
    place = jax.random.uniform(keys["place"], (count, n, 2), minval=-HALF, maxval=HALF)
    force = jax.random.uniform(keys["force"], (count, n), minval=FORCES[0], maxval=FORCES[1])
    real = place + PLACE_ERROR * jax.random.normal(keys["misplace"], place.shape)
    true = force + FORCE_ERROR * jax.random.normal(keys["misforce"], force.shape)

    def skin(at: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[Pad, jax.Array]:
        pad = sample_pad(at[0])
        return pad, jax.lax.map(lambda p: press_force(pad, TIP.height(p[0]), p[1]).reading, at[1:], batch_size=8)

    pads, readings = jax.lax.map(skin, (jax.random.split(keys["pads"], count), real, true))
    return pads, Presses(place, force), readings + NOISE * jax.random.normal(keys["noise"], readings.shape)


@jax.jit
def in_a_run(key: jax.Array, readings: jax.Array) -> jax.Array:
    """Readings (pads, n, 15) with what goes wrong with boards in order from press to press (`Faults.typical`)."""
    poses = jnp.broadcast_to(jnp.eye(4), (readings.shape[1], 4, 4))

    def run(key: jax.Array, y: jax.Array) -> jax.Array:
        return faults.apply(key, y, poses, boards.reskin_board(), faults.Faults.typical())

    return jax.vmap(run)(jax.random.split(key, len(readings)), readings)


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.calibrate_pads")
    return reported(partial(population if args.population else run, args))


def run(args: Args) -> dict[str, Any]:
    """The experiment: pads, fits, table and figure."""
    started, cfg = time.perf_counter(), PRESETS[args.preset]
    begin(args.out, args, cfg, None, args.overwrite)
    key_pads, key_others, key_train = jax.random.split(jax.random.key(args.seed), 3)
    pads, presses, readings = pressed(key_pads, cfg.pads, max(cfg.counts) + cfg.held)
    told = None
    if cfg.others:
        told = baseline_network.pretrain(
            key_train, *pressed(key_others, cfg.others, 60)[1:], cfg.steps, (5, 10, 20, 50)
        )[0]
    r2: dict[str, dict[int, list[float]]] = {}
    maps: dict[int, list[float]] = {}
    inside: dict[int, list[float]] = {}
    misses: list[list[float]] = []
    for i in tqdm(range(cfg.pads), desc="pads", unit="pad"):
        pad, at = (jax.tree.map(lambda part, i=i: part[i], tree) for tree in (pads, presses))
        place, force, y = (np.asarray(part, np.float64) for part in (at.place, at.load, readings[i]))
        recording = Recording(place, force, y, True, boards.reskin_board().chips[:, :2])
        way = Way(recording, Preset(), 0.0)
        if told is not None:
            way = replace(
                way, seen=np.asarray(baseline_network.features(told, at), np.float64), noise=float(told.noise)
            )
        test = np.arange(len(y) - cfg.held, len(y))
        for count in cfg.counts:
            rows = np.arange(count)
            fitted, predicted = ways(way, rows, test)
            for name, mean in predicted.items():
                r2.setdefault(name, {}).setdefault(count, []).append(score(recording.readings[test], mean).r2)
            true_map = np.asarray(pad.magnetisation)
            wrong = np.sum((true_map - np.asarray(fitted.pad.magnetisation)) ** 2)
            maps.setdefault(count, []).append(float(1 - wrong / np.sum(true_map**2)))
            middle, std = physics.predict_pad(fitted, recording.presses(test), TIP, True)
            share = np.mean(np.abs(recording.readings[test] - middle) < calibration.WITHIN * np.asarray(std))
            inside.setdefault(count, []).append(float(share))
        tqdm.write(
            f"pad {i}: "
            + ", ".join(f"{name} {[round(float(v[-1]), 3) for v in by.values()]}" for name, by in r2.items())
        )
        gap = -pad.board.chips[0, 2] - pad.thickness
        true = {"thickness": pad.thickness, "gap": gap, "young": pad.young, "give": pad.give}
        misses.append([float((getattr(fitted.layer, n) - v) / getattr(fitted.spread, n)) for n, v in true.items()])
        if i == 0:
            save_pad(args.out / "pad.npz", fitted.pad, {"presses": max(cfg.counts), "source": "simulated"})
    base = r2[STRUCTURED]
    metrics: dict[str, Any] = {
        "source": "simulated",
        "seed": args.seed,
        "pads": cfg.pads,
        "r2": summarise(r2),
        "differences_to_structured": {
            name: summarise({"": {n: list(np.subtract(v, base[n])) for n, v in by.items()}})[""]
            for name, by in r2.items()
            if name != STRUCTURED
        },
        "map_r2": summarise({"": maps})[""],
        "inside_90_of_fitted": summarise({"": inside})[""],
        "layer_misses_in_spreads": {"of": list(true), "values": misses},
        "seconds": round(time.perf_counter() - started, 1),
    }
    touches.save(figure(metrics), args.out / "curves.png")
    write_json(args.out / "metrics.json", metrics)
    for name, by_count in metrics["r2"].items():
        cells = (f"{n}: {v['mean']:.3f} [{v['low']:.3f}, {v['high']:.3f}]" for n, v in by_count.items())
        print(f"{name:40}" + "  ".join(cells))
    print(f"\nsimulated; results, the figure and the fitted pad are in {args.out}")
    return metrics


def ways(way: Way, rows: np.ndarray, test: np.ndarray) -> tuple[physics.PadFit, dict[str, np.ndarray]]:
    """Readings at the test from those at rows in every way, and the pad fitted."""
    recording = way.recording
    at, y = recording.presses(rows), jnp.float32(recording.readings[rows])
    board, given = boards.reskin_board(), physics.prior()
    predicted = {
        NEIGHBOURS: neighbours(recording, rows, test),
        PLAIN: way.plain(rows, test),
        STRUCTURED: way.structured(rows, test),
    }
    if way.seen is not None:
        predicted[PRETRAINED] = way.pretrained(rows, test)
    middling = physics.solve_map(given.middle, given.spread, at, y, TIP, board, True)
    fitted = physics.fit_pad(at, y, TIP, board, True, given)
    for name, one in ((NOMINAL, middling), (FITTED, fitted)):
        predicted[name] = np.asarray(physics.predict_pad(one, recording.presses(test), TIP, True)[0], np.float64)
    left = y - fitted.left_out
    # What physics leaves is noise for the most part; how much is told by the presses.
    stacked = calibration.options(calibration.FORCE._replace(noise=100.0), {"noise": (1e-3, 1e-2, 0.1)})
    rest = fit(choose(stacked, recording, rows, np.asarray(left)), at, left, jnp.float32(recording.chips))
    predicted[RESIDUAL] = predicted[FITTED] + np.asarray(predict(rest, recording.presses(test))[0], np.float64)
    return fitted, predicted


def population(args: Args) -> dict[str, Any]:
    """Hyperparameters by the mean R2 of all pads and counts, and what they are worth on pads never seen."""
    started, cfg = time.perf_counter(), POPULATIONS[args.preset]
    begin(args.out, args, cfg, None, args.overwrite)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(args.seed), 1), 4)
    seen, others = (
        pressed(key, n, max(cfg.counts) + cfg.held)[1:] for key, n in zip(keys[:2], (cfg.pads, cfg.others), strict=True)
    )
    runs = in_a_run(keys[2], seen[1])
    with tqdm(desc="hyperparameters", unit="set") as bar:

        def mean_r2(hyper: Hyper) -> float:
            r2 = float(skins_r2(hyper, seen[0], runs, cfg.counts, cfg.held).mean())
            bar.update()
            return r2 if np.isfinite(r2) else -np.inf

        found = search(mean_r2, GUESSED)
        found = Hyper(*(float(f"{float(value):.2g}") for value in found))
        chosen = {"guessed": mean_r2(GUESSED), "found": mean_r2(found)}
    r2: dict[str, dict[str, np.ndarray]] = {}
    for what, readings in (
        ("boards in a run", in_a_run(keys[3], others[1])),
        ("the same pads without faults", others[1]),
    ):
        r2[what] = {
            name: skins_r2(hyper, others[0], readings, cfg.counts, cfg.held)
            for name, hyper in (("guessed", GUESSED), ("found", found), ("in use", calibration.FORCE))
        }
        r2[what][PLAIN] = plain_r2(others[0], readings, cfg.counts, cfg.held)
    metrics: dict[str, Any] = {
        "source": "simulated",
        "seed": args.seed,
        "pads": {"chosen on": cfg.pads, "tried on": cfg.others},
        "hyper": calibration.numbers(found),
        "r2_chosen_on": chosen,
        "r2": {what: by_pad(cfg.counts, by_name) for what, by_name in r2.items()},
        "differences": {
            what: by_pad(cfg.counts, {f"found - {n}": by_name["found"] - v for n, v in by_name.items() if n != "found"})
            for what, by_name in r2.items()
        },
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_json(args.out / "metrics.json", metrics)
    print(f"simulated; found on {cfg.pads} pads: {metrics['hyper']}\nmean R2 there: {chosen}; on {cfg.others} others:")
    for what in r2:
        print(what)
        for name, by_count in {**metrics["r2"][what], **metrics["differences"][what]}.items():
            cells = (f"{n}: {v['mean']:.3f} [{v['low']:.3f}, {v['high']:.3f}]" for n, v in by_count.items())
            print(f"{name:40}" + "  ".join(cells))
    print(f"\nresults are in {args.out}")
    return metrics


def by_pad(counts: tuple[int, ...], values: dict[str, np.ndarray]) -> dict[str, Any]:
    """Mean and 95 % interval over pads of values (pads, counts)."""
    return summarise({name: dict(zip(counts, v.T.tolist(), strict=True)) for name, v in values.items()})


def search(mean_r2: Callable[[Hyper], float], start: Hyper) -> Hyper:
    """Coordinate search upwards from a start: one hyperparameter at a time times a factor, in ever smaller steps."""
    best, most = start, mean_r2(start)
    for step in STEPS:
        for _ in range(SWEEPS):
            before = most
            for name in SEARCHED:
                for factor in (step, 1 / step):
                    tried = best._replace(**{name: getattr(best, name) * factor})
                    if tried.floor <= 1 and (r2 := mean_r2(tried)) > most + GAIN:
                        best, most = tried, r2
                        break
            if most == before:
                break
    return best


def skins_r2(hyper: Hyper, presses: Presses, readings: jax.Array, counts: tuple[int, ...], held: int) -> np.ndarray:
    """R2 (pads, counts) on the last presses of each pad, of the structured process told the first ones."""
    # One count after the other: batched factors that run side by side can wait for each other's threads for ever.
    return np.stack([np.asarray(told_r2(hyper, presses, readings, n, held), np.float64) for n in counts], axis=1)


@partial(jax.jit, static_argnums=(3, 4))
def told_r2(hyper: Hyper, presses: Presses, readings: jax.Array, n: int, held: int) -> jax.Array:
    """The same (pads,) for one count."""
    chips = jnp.asarray(boards.reskin_board().chips[:, :2], jnp.float32)

    def skin(one: tuple[Presses, jax.Array]) -> jax.Array:
        at, y = one
        known, test = Presses(at.place[:n], at.load[:n]), Presses(at.place[-held:], at.load[-held:])
        mean, truth = calibration.predict(calibration.fit(hyper, known, y[:n], chips), test)[0], y[-held:]
        return 1 - jnp.sum((truth - mean) ** 2) / jnp.sum((truth - jnp.mean(truth, axis=0, keepdims=True)) ** 2)

    return jax.lax.map(skin, (presses, readings))


def plain_r2(presses: Presses, readings: jax.Array, counts: tuple[int, ...], held: int) -> np.ndarray:
    """The same of the plain process, whose scales each pad's presses choose."""
    place, force, y = (np.asarray(part, np.float64) for part in (presses.place, presses.load, readings))
    test = np.arange(y.shape[1] - held, y.shape[1])
    skins = [Recording(*one, True) for one in zip(place, force, y, strict=True)]
    return np.array(
        [
            [score(skin.readings[test], Way(skin, Preset(), 0.0).plain(np.arange(n), test)).r2 for n in counts]
            for skin in skins
        ]
    )


def figure(metrics: dict[str, Any]) -> Figure:
    """R2 against the number of presses."""
    result = Figure(figsize=(7, 4.6), layout="constrained")
    axes = result.subplots()
    for method, by_count in metrics["r2"].items():
        counts = list(by_count)
        mean, low, high = ([by_count[n][key] for n in counts] for key in ("mean", "low", "high"))
        axes.plot(counts, mean, "o-", ms=3, color=COLOURS[method], label=method)
        axes.fill_between(counts, low, high, color=COLOURS[method], alpha=0.15, lw=0)
    axes.set(xscale="log", xlabel="presses to calibrate with", ylim=(0, 1), ylabel="R² of 15 channels")
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc="lower right")
    axes.set_title(f"Presses at a known force on {metrics['pads']} simulated pads (95 % over pads)")
    return result


if __name__ == "__main__":
    sys.exit(main())
