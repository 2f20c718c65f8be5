"""Question: how well does a model trained on two objects predict the touch of objects it has never met?

    python -m experiments.train                      the paper's set, simulated: 1630 touches, one pad, one seed
    python -m experiments.train --preset debug       the same in about a minute, too small to mean anything
    python -m experiments.train --seeds 5            means and 95 % intervals over seeds
    python -m experiments.train --preset study       3 pads x 5 seeds
    python -m experiments.train --dataset DIR        any recorded or converted set (see python -m i2t.convert)

Hexagon and parallelogram train, one tool validates, all other primitives and tools test. Every method sees the same
touches: baselines that look up or regress patches, the paper's network (contact mask or depth), and two models on
imagined pressure, of which the better on the validation object is kept as the predictor. A ceiling shows what the same
model would reach if the camera and the arm made no error. Results go to --out: metrics.json, config.json, figures, the
data (data.h5) and checkpoint/, which `i2t.load_predictor` reads.
"""

import json
import os
import sys
import time
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

# Factors of a few hundred rows are too small to share: waiting threads of LAPACK cost more than they give.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from tqdm import tqdm

from experiments import plots
from experiments.configs import PRESETS, TrainExperiment
from experiments.evaluation import Score, baselines, grouped_interval, score, seed_interval
from i2t import checkpoint, gp, objects, training, world
from i2t import dataset as data
from i2t import predictor as predicting
from i2t.dataset import DataError, Dataset
from i2t.imagine import Imagination
from i2t.model import Inputs, ModelConfig
from i2t.predictor import Network, Predictor, Reading
from i2t.render import prepare
from i2t.skin.pad import sample_pad
from i2t.training import Batch
from i2t.types import Board, ReturnCode, Touches

PROCESS = "Gaussian process on imagined pressure"
CEILING = "ceiling: process without camera and arm errors"


@dataclass(frozen=True)
class Args:
    """Train a touch predictor and report how well it does on unseen objects (or unseen places)."""

    out: Path = Path("runs/train")  # folder for everything that is made
    preset: Literal["paper", "debug", "study"] = "paper"
    dataset: Path | None = None  # a data set to train on instead of simulating one
    split: Literal["auto", "object", "run", "block", "time"] = "auto"  # what is held out of --dataset
    seed: int = 0  # of everything random
    seeds: int | None = None  # how many seeds, from --seed on
    epochs: int | None = None  # of the networks
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished run in --out


@dataclass(frozen=True)
class Split:
    """Rows to train on, to validate on and to test on, and the groups that are never torn apart."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray
    groups: np.ndarray
    how: str


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.train")
    try:
        run(args)
    except (DataError, ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\ninterrupted; finished parts are in {args.out}, go on with --resume", file=sys.stderr)
        return 130
    return 0


def run(args: Args) -> dict[str, Any]:
    """The experiment: every pad and seed, then the table over them."""
    cfg = PRESETS[args.preset]
    if args.epochs is not None:
        cfg = replace(cfg, training=replace(cfg.training, epochs=args.epochs))
    seeds = range(args.seed, args.seed + (args.seeds or cfg.seeds))
    pads = (None,) if args.dataset else cfg.pads
    _open(args, cfg)
    several = len(seeds) * len(pads) > 1
    parts = []
    for pad in pads:
        for seed in seeds:
            place = args.out / f"pad-{pad or 0}-seed-{seed}" if several else args.out
            finished = place / "metrics.json"
            if not finished.exists():
                run_one(args, cfg, seed, pad, place)
            parts.append(json.loads(finished.read_text()))
    result = parts[0] if not several else summarise(parts, args.out)
    report(result)
    print(f"\nresults, figures and the predictor are in {args.out}")
    return result


def run_one(args: Args, cfg: TrainExperiment, seed: int, pad: int | None, out: Path) -> None:
    """One pad and seed: data, split, methods, scores, figures, predictor."""
    started = time.perf_counter()
    out.mkdir(parents=True, exist_ok=True)
    dataset = data.load(args.dataset) if args.dataset else simulate(cfg, seed, pad or 0, out / "data.h5")
    split = split_dataset(dataset, cfg, args.split, seed)
    touches, readings = dataset.touches, dataset.touches.reading
    simulated = dataset.source != "real"
    noise = None if touches.truth is None else (readings - touches.truth.reading).std(0)
    print(
        f"{len(dataset)} touches ({dataset.source}), split by {split.how}: {split.train.sum()} train, "
        f"{split.validation.sum()} validate, {split.test.sum()} test"
    )

    measured = conditions_of(touches, split)
    values = np.stack([getattr(touches, name) for name in measured], -1) if measured else np.zeros((len(dataset), 0))
    predicted = baselines(
        touches.patch[split.train], values[split.train], readings[split.train], split.groups[split.train],
        touches.patch[split.test], values[split.test],
    )  # fmt: skip
    spreads: dict[str, np.ndarray] = {}

    print("imagining pressures")
    imagination = imagination_of(dataset, measured, cfg)
    views = views_of(dataset)
    imagined = predicting.imagine_all(imagination, views, touches.force, touches.depth)
    candidates: dict[str, Predictor] = {}
    curves: dict[str, np.ndarray] = {}
    for name, network in cfg.networks.items():
        network, images = fit_network_to(network, dataset, imagined, measured)
        trained, curve = train_network(
            name, network, replace(cfg.training, seed=seed), images, touches, split, out / "checkpoint" / slug(name)
        )
        on_pressure = network.input == "image"
        candidates[name] = describe(
            Predictor(None, trained, imagination if on_pressure else None, dataset.window, dataset.reach, 1.0, 0.3e-3),
            dataset,
            split,
        )
        curves |= curve
    process = fit_process(imagined, readings, split, seed)
    candidates[PROCESS] = describe(
        Predictor(process, None, imagination, dataset.window, dataset.reach, 1.0, 0.3e-3), dataset, split
    )

    validation: dict[str, float] = {}
    held = split.validation | split.test
    tuning = split.validation[held]
    for name, candidate in candidates.items():
        reading = predict(candidate, dataset, held, imagined)
        seen = Reading(reading.mean[tuning], reading.std[tuning])
        spread = predicting.spread_of(readings[split.validation], seen)
        validation[name] = score(readings[split.validation], seen.mean).r2
        predicted[name], spreads[name] = reading.mean[~tuning], spread * reading.std[~tuning]
        candidates[name] = replace(candidate, spread=spread)
    best = max(
        (name for name in candidates if candidates[name].imagination is not None), key=lambda name: validation[name]
    )
    if touches.truth is not None:
        predicted[CEILING] = ceiling(dataset, imagination, split, seed)

    truth = readings[split.test]
    groups = split.groups[split.test]
    metrics: dict[str, Any] = {
        "source": dataset.source,
        "seed": seed,
        "pad": pad,
        "split": split.how,
        "counts": {part: int(getattr(split, part).sum()) for part in ("train", "validation", "test")},
        "groups": len(np.unique(groups)),
        "noise_uT": None if noise is None else noise.tolist(),
        "best": best,
        "validation_r2": validation,
        "methods": {name: scored(truth, mean, groups, noise, spreads.get(name)) for name, mean in predicted.items()},
        "by_object": by_object(dataset, split, truth, predicted),
        "seconds": 0.0,
    }
    predicting.save(
        out / "checkpoint" / "predictor",
        replace(candidates[best], about={"method": best, "source": dataset.source, "seed": seed}),
    )
    figures(out, dataset, split, predicted, best, curves, noise, metrics, simulated)
    metrics["seconds"] = round(time.perf_counter() - started, 1)
    write_json(out / "metrics.json", metrics)


def simulate(cfg: TrainExperiment, seed: int, pad_seed: int, path: Path) -> Dataset:
    """The embedded default: simulated touches of the preset with one pad, kept in `path` for a resumed run."""
    if path.exists():
        return data.load(path)
    plan = cfg.simulation
    surfaces = [prepare(objects.make(name).mesh) for name in plan.objects]
    pad = sample_pad(jax.random.key(1000 + pad_seed))
    with tqdm(total=plan.touches, desc="simulating touches", unit="touch") as bar:
        touches = world.simulate(
            jax.random.key(seed), surfaces, pad, plan.errors, plan.counts(),
            limits=plan.limits, touches_per_run=plan.touches_per_run, progress=bar.update,
        )  # fmt: skip
    runs = tuple(f"run {i:03d}" for i in range(int(touches.run.max()) + 1))
    board = Board(*(np.asarray(field) for field in pad.board))
    made = Dataset(
        touches,
        plan.objects,
        (f"simulated pad {pad_seed}",),
        runs,
        board,
        "simulated",
        meta={"made by": f"experiments.train, seed {seed}"},
    )
    data.save(path, made)
    return made


def split_dataset(dataset: Dataset, cfg: TrainExperiment, how: str, seed: int) -> Split:
    """Hold out objects, runs, blocks of places or the last touches in time; presses that failed or met air are left
    out.
    """
    touches = dataset.touches
    usable = ~np.isin(touches.code, [ReturnCode.FAILED, ReturnCode.AIR])
    plan = cfg.simulation
    if how == "auto":
        known = set(plan.objects) <= set(dataset.objects)
        how = "object" if known or len(dataset.objects) >= 3 else "block"
    rng = np.random.default_rng(seed)
    groups = touches.run.copy()
    if how == "object":
        names = dataset.objects
        if set(plan.objects) <= set(names):
            test, validation = plan.test, plan.validation
        else:
            order = [names[i] for i in rng.permutation(len(names))]
            third = max(len(names) // 3, 1)
            test, validation = tuple(order[:third]), tuple(order[third : third + 1])
        held, tuning = data.holdout_names(dataset, "object", test), data.holdout_names(dataset, "object", validation)
        if len(np.unique(groups)) < 4:  # one long run: neighbours in place stay together
            groups = data.spatial_blocks(dataset, cfg.block)
    elif how == "run":
        order = [dataset.runs[i] for i in rng.permutation(len(dataset.runs))]
        fifth = max(len(order) // 5, 1)
        held = data.holdout_names(dataset, "run", order[:fifth])
        tuning = data.holdout_names(dataset, "run", order[fifth : 2 * fifth])
    elif how == "block":
        groups = data.spatial_blocks(dataset, cfg.block)
        held = data.holdout_blocks(dataset, cfg.block, 0.2, seed)
        rest = np.flatnonzero(~held)
        tuning = np.zeros(len(dataset), bool)
        tuning[rest[data.holdout_blocks(dataset.select(rest), cfg.block, 0.1, seed)]] = True
    else:
        groups = np.arange(len(dataset)) // 20
        held = data.holdout_last(dataset, 0.2)
        tuning = data.holdout_last(dataset, 0.3) & ~held
    split = Split(usable & ~held & ~tuning, usable & tuning & ~held, usable & held, groups, how)
    for part in ("train", "validation", "test"):
        if getattr(split, part).sum() < 2:
            raise DataError(
                f"splitting by {how} leaves {getattr(split, part).sum()} touches to {part}; choose another --split"
            )
    return split


def conditions_of(touches: Touches, split: Split) -> tuple[str, ...]:
    """Which of force, nearest and depth were measured at every touch."""
    used = split.train | split.validation | split.test
    return tuple(name for name in ("force", "nearest", "depth") if np.isfinite(getattr(touches, name)[used]).all())


def imagination_of(dataset: Dataset, measured: tuple[str, ...], cfg: TrainExperiment) -> Imagination:
    """How touches of this set are imagined: by force where it was measured, else by depth; smoothed where views are
    noisy.
    """
    patches = dataset.touches.patch
    curvature = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    noisy = float(np.median(np.abs(curvature))) > 20e-6  # a surface alone curves less than this over a pixel
    large = dataset.window > 25e-3
    return Imagination(
        pitch=dataset.window / patches.shape[1],
        window=round(dataset.window * 500) / 500 if large else Imagination.window,
        smooth=noisy,
        tilt=cfg.hidden_tilt if noisy else 0.0,
        control="force" if "force" in measured else "depth",
        cell=1e-3 if large else Imagination.cell,
    )


def views_of(dataset: Dataset) -> np.ndarray:
    """Wide views where they were recorded, else patches."""
    wide = dataset.touches.wide
    centre = wide.shape[-1] // 2
    return dataset.touches.patch if np.isnan(wide[:, centre, centre]).any() else wide


def fit_network_to(
    network: ModelConfig, dataset: Dataset, imagined: gp.Imagined, measured: tuple[str, ...]
) -> tuple[ModelConfig, np.ndarray]:
    """The configuration and images of a network on this data set."""
    conditions = tuple(name for name in network.conditions if name in measured)
    images = np.asarray(imagined.pressure) if network.input == "image" else dataset.touches.patch
    return replace(network, pixels=images.shape[1], reach=dataset.reach, conditions=conditions), images


def train_network(
    name: str,
    network: ModelConfig,
    cfg: training.TrainConfig,
    images: np.ndarray,
    touches: Touches,
    split: Split,
    folder: Path,
) -> tuple[Network, dict[str, np.ndarray]]:
    """Train with a bar, saving every chunk; goes on from what an interrupted run saved."""

    def batch(rows: np.ndarray) -> Batch:
        values = [getattr(touches, condition)[rows] for condition in network.conditions]
        stacked = np.stack(values, -1) if values else np.zeros((int(rows.sum()), 0))
        return Batch(Inputs(jnp.asarray(images[rows]), jnp.float32(stacked)), jnp.asarray(touches.reading[rows]))

    train, validation = batch(split.train), batch(split.validation)
    training.check(train, network, "training")
    training.check(validation, network, "validation")
    norm = training.normalisation(train)
    prepared = jax.jit(training.prepare, static_argnums=0)
    ready, ready_validation = (prepared(network, norm, part) for part in (train, validation))
    state, history = jax.jit(partial(training.start, network, cfg, len(train.target)))(), []
    if checkpoint.exists(folder):  # an interrupted run got this far
        state, _, about = checkpoint.restore(folder)
        history = about.extra["history"]
    done = int(np.max(state.epoch))
    with tqdm(total=cfg.epochs, initial=done, desc=f"training {name}", unit="epoch") as bar:

        def log(epoch: int, info: training.EpochInfo) -> None:
            history.append([float(np.mean(info.train.squared)), float(np.mean(info.validation.squared))])
            bar.update()
            bar.set_postfix(validation=f"{history[-1][1]:.3f}")

        state = training.fit(
            state, network, cfg, ready, ready_validation, log=log,
            save=lambda state: checkpoint.save(
                folder, state, network, cfg, norm, len(train.target), {"history": history}
            ),
        )  # fmt: skip
    norm = jax.jit(training.with_residual, static_argnums=1)(state.best_params, network, norm, ready_validation)
    values = np.array(history).reshape(-1, 2)
    return Network(state.best_params, network, norm), {
        f"{name}, training": values[:, 0],
        f"{name}, validation": values[:, 1],
    }


def fit_process(imagined: gp.Imagined, readings: np.ndarray, split: Split, seed: int) -> gp.GP:
    """The Gaussian process on the training touches, hyperparameters from held-out groups of them."""
    rows = np.flatnonzero(split.train)
    train = gp.Imagined(imagined.pressure[rows], imagined.load[rows])
    hyper, _ = gp.choose(train, jnp.asarray(readings[rows]), split.groups[rows], seed=seed)
    return jax.jit(gp.fit)(hyper, train, jnp.asarray(readings[rows]))


def ceiling(dataset: Dataset, imagination: Imagination, split: Split, seed: int) -> np.ndarray:
    """The same process where the camera saw what the skin met and the force was known: what the errors cost."""
    truth = dataset.touches.truth
    assert truth is not None
    exact = replace(imagination, smooth=False, tilt=0.0, pitch=dataset.window / dataset.touches.patch.shape[1])
    imagined = predicting.imagine_all(exact, truth.wide, truth.force, truth.indentation)
    process = fit_process(imagined, dataset.touches.reading, split, seed)
    rows = np.flatnonzero(split.test)
    return np.asarray(gp.predict(process, gp.Imagined(imagined.pressure[rows], imagined.load[rows]))[0])


def describe(predictor: Predictor, dataset: Dataset, split: Split) -> Predictor:
    """Fill in the middle of the training touches, which stands in for what a user does not measure."""
    touches = dataset.touches
    return replace(
        predictor,
        load=predicting.middle(touches.force[split.train], 1.0),
        depth=predicting.middle(touches.depth[split.train], 0.3e-3),
    )


def predict(predictor: Predictor, dataset: Dataset, rows: np.ndarray, imagined: gp.Imagined) -> Reading:
    """Predict rows of a data set whose touches were all imagined before."""
    touches = dataset.touches
    measured = {name: getattr(touches, name)[rows] for name in ("force", "nearest", "depth")}
    if predictor.imagination is None:
        return predictor.from_image(touches.patch[rows], measured)
    which = np.flatnonzero(rows)
    return predictor.from_imagined(gp.Imagined(imagined.pressure[which], imagined.load[which]), measured)


def scored(
    truth: np.ndarray, mean: np.ndarray, groups: np.ndarray, noise: np.ndarray | None, std: np.ndarray | None
) -> dict[str, Any]:
    """All scores of a method with the 95 % interval of R2 over groups, and how honest its spread is."""
    values: dict[str, Any] = score(truth, mean, noise)._asdict()
    values["r2_interval"] = grouped_interval(lambda rows: score(truth[rows], mean[rows]).r2, groups)
    if std is not None:
        values["coverage_90"] = float(np.mean(np.abs(truth - mean) < 1.645 * std))
    return values


def by_object(dataset: Dataset, split: Split, truth: np.ndarray, predicted: dict[str, np.ndarray]) -> dict[str, Any]:
    """R2 of every method on each test object."""
    kinds = dataset.touches.object[split.test]
    return {
        dataset.objects[kind]: {
            name: score(truth[kinds == kind], mean[kinds == kind]).r2 for name, mean in predicted.items()
        }
        for kind in np.unique(kinds)
        if (kinds == kind).sum() > 2
    }


def figures(
    out: Path, dataset: Dataset, split: Split, predicted: dict[str, np.ndarray], best: str,
    curves: dict[str, np.ndarray], noise: np.ndarray | None, metrics: dict[str, Any], simulated: bool,
) -> None:  # fmt: skip
    """All pictures of one run."""
    truth, patches = dataset.touches.reading[split.test], dataset.touches.patch[split.test]
    kinds = dataset.touches.object[split.test]
    error = np.linalg.norm(predicted[best] - truth, axis=1) / np.maximum(np.linalg.norm(truth, axis=1), 1e-9)
    order = np.argsort(error)
    middle = len(order) // 2
    shown = {
        "typical touches": order[middle - 2 : middle + 3],
        "best predicted": order[: min(5, len(order))],
        "worst predicted": order[-min(5, len(order)) :][::-1],
    }
    for title, rows in shown.items():
        labels = [f"{dataset.objects[kinds[i]]}\nerror {100 * error[i]:.0f} %" for i in rows]
        figure = plots.touches(
            patches[rows], truth[rows], predicted[best][rows], labels, dataset.board, dataset.window, dataset.reach,
            f"Unseen {'objects' if split.how == 'object' else 'touches'}, {title}", simulated,
        )  # fmt: skip
        plots.save(figure, out / f"touches_{title.split()[0]}.png")
    if any(len(values) for values in curves.values()):
        plots.save(
            plots.curves(
                {k: v for k, v in curves.items() if len(v)}, "Training", "squared error (standardised)", simulated
            ),
            out / "training.png",
        )
    drawn = {
        name: np.sqrt(((predicted[name] - truth) ** 2).mean(0))
        for name in ("mean reading", "k nearest patches", "paper's network, depth", best)
        if name in predicted
    }
    plots.save(
        plots.errors_per_axis(drawn, noise, "Error per chip and axis on the test touches", simulated),
        out / "error_per_axis.png",
    )
    intervals = {name: (values["r2"], *values["r2_interval"]) for name, values in metrics["methods"].items()}
    plots.save(
        plots.scores(intervals, "Explained variance on the test touches", "R² (95 % interval over groups)", simulated),
        out / "scores.png",
    )


def summarise(parts: list[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Means over seeds with Student's t intervals, pad by pad."""
    pads = sorted({part["pad"] or 0 for part in parts})
    names = list(parts[0]["methods"])
    numbers = [field for field in Score._fields if not field.endswith("_axis")]
    summary: dict[str, Any] = {
        "source": parts[0]["source"],
        "seeds": sorted({part["seed"] for part in parts}),
        "pads": {},
    }
    for pad in pads:
        of_pad = [part for part in parts if (part["pad"] or 0) == pad]
        summary["pads"][str(pad)] = {
            name: {field: seed_interval([part["methods"][name][field] for part in of_pad]) for field in numbers}
            for name in names
        }
    summary["best"] = {str(pad): [part["best"] for part in parts if (part["pad"] or 0) == pad] for pad in pads}
    write_json(out / "metrics.json", summary)
    first = summary["pads"][str(pads[0])]
    figure = plots.scores(
        {name: tuple(first[name]["r2"]) for name in names},
        f"Explained variance, pad {pads[0]}",
        "R² (95 % interval over seeds)",
        parts[0]["source"] != "real",
    )
    plots.save(figure, out / "scores.png")
    return summary


def report(result: dict[str, Any]) -> None:
    """The table a person reads."""
    kind = "" if result["source"] == "real" else f" ({result['source']})"
    if "pads" in result:
        for pad, methods in result["pads"].items():
            print(f"\npad {pad}{kind}: mean over seeds {result['seeds']} with 95 % interval")
            print(f"{'':48}{'R²':>22}{'RMSE µT':>10}{'/ sigma':>9}{'cosine':>8}")
            for name, values in methods.items():
                mean, low, high = values["r2"]
                rmse, sigmas, cosine = (values[field][0] for field in ("rmse", "rmse_sigma", "cosine"))
                print(f"{name:48}{_interval(mean, low, high):>22}{rmse:10.2f}{_number(sigmas):>9}{cosine:8.2f}")
        return
    print(f"\ntest touches{kind}, 95 % interval over {result['groups']} groups; kept as predictor: {result['best']}")
    print(f"{'':48}{'R²':>22}{'RMSE µT':>10}{'/ sigma':>9}{'cosine':>8}{'R² x / y / z':>22}")
    for name, values in result["methods"].items():
        low, high = values["r2_interval"]
        axes = " / ".join(f"{value:.2f}" for value in values["r2_axis"])
        r2 = _interval(values["r2"], low, high)
        sigmas = _number(values["rmse_sigma"])
        print(f"{name:48}{r2:>22}{values['rmse']:10.2f}{sigmas:>9}{values['cosine']:8.2f}{axes:>22}")
    print(f"{result['seconds']:.0f} s")


def _interval(mean: float, low: float | None, high: float | None) -> str:
    return f"{mean:.3f}" if low is None or not np.isfinite(low) else f"{mean:.3f} [{low:.3f}, {high:.3f}]"


def _number(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.2f}"


def _open(args: Args, cfg: TrainExperiment) -> None:
    """Make the folder, or refuse one that is in use; note what is run and with which versions."""
    config = {
        "args": {
            name: str(value) if isinstance(value, Path) else value
            for name, value in asdict(args).items()
            if name not in ("resume", "overwrite")
        },
        "experiment": asdict(cfg),
        "versions": {"python": sys.version.split()[0], **{name: version(name) for name in checkpoint.PACKAGES}},
    }
    path = args.out / "config.json"
    if path.exists() and args.overwrite:
        import shutil

        shutil.rmtree(args.out)
    if (args.out / "metrics.json").exists():
        raise ValueError(f"{args.out} holds a finished run; choose another --out, or pass --overwrite")
    if path.exists():
        if not args.resume:
            raise ValueError(f"{args.out} holds an unfinished run; pass --resume to go on with it, or --overwrite")
        before = json.loads(path.read_text())
        same = json.loads(json.dumps(config))
        if {**before, "versions": None} != {**same, "versions": None}:
            raise ValueError(f"{args.out} was begun with other settings ({path}); pass those, or --overwrite")
    elif args.out.exists() and any(args.out.iterdir()):
        raise ValueError(f"{args.out} is not empty and holds no run of this experiment; choose another --out")
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(path, config)


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write at once or not at all; NaN becomes null."""

    def clean(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): clean(value) for key, value in node.items()}
        if isinstance(node, list | tuple):
            return [clean(value) for value in node]
        return None if isinstance(node, float) and not np.isfinite(node) else node

    part = path.with_suffix(".part")
    part.write_text(json.dumps(clean(values), indent=1, default=str) + "\n")
    part.replace(path)


def slug(name: str) -> str:
    """A folder name."""
    return "-".join("".join(c if c.isalnum() else " " for c in name.replace("'s", "")).split())


if __name__ == "__main__":
    sys.exit(main())
