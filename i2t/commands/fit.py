"""Fit a predictor and a pad model to a data set: `i2t fit` scores them on touches that it holds out.

    i2t fit nominal                                        the simulated touches that come with i2t
    i2t fit DATA --out runs/mine                           recorded or converted touches of your own
    i2t fit DATA --objects mug.stl bowl.stl --unit mm      objects outside the catalogue, for the pad model
    i2t fit DATA --method ridge --split session            another method, and whole sessions held out

The predictor computes readings from a depth patch and a force (`i2t.load_predictor`, `i2t imagine --model`). The pad
model computes the reading of any contact on a mesh (`i2t.load_pad_model`, `i2t recognize --pad-model`). It needs tool
poses, forces, travels and the meshes of the touched objects; without them, only the predictor is fitted. --out then
holds both, with config.json, metrics.json and a picture of measured and predicted values (`i2t.models.finished` lists
the files). In a checkout, `python -m experiments.train` compares all methods on the same touches.
"""

import platform
import shutil
import sys
import time
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Seed, docstring_of, require_writable
from i2t.errors import printable
from i2t.files.writing import write_json
from i2t.installation import checkout
from i2t.models.checks import require_dataset
from i2t.models.finished import CHECKPOINTS, CONFIG, KEPT, METRICS, FinishedRun, kind_of_config, write_training
from i2t.objects.named import read_meshes, require_objects

if TYPE_CHECKING:
    from i2t.dataset import Dataset, Split
    from i2t.prediction.metrics import PredictorScore
    from i2t.skin_models.pad_model import KnownPad


@dataclass(frozen=True)
class FitArgs:
    """Fit a predictor and a pad model to a data set, and score the predictor on touches that are held out."""

    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder or file of touches, or nominal, the simulated touches that come with i2t."""
    method: str = "gp"
    """Method of the predictor, by its name (docs/prediction.md) or as my_package.module:Method."""
    split: Literal["auto", "object", "session", "block", "time"] = "auto"
    """What is held out for validation and test."""
    objects: tuple[Path, ...] = ()
    """Mesh files of touched objects that are not in the catalogue, for the pad model."""
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    """Unit of the mesh files."""
    skin_name: str | None = None
    """Skin to fit, if each touch has readings of several."""
    epochs: Count | None = None
    """Epochs of a network."""
    out: Path = Path("runs/fit")
    """Folder for the results."""
    seed: Seed = 0
    """Seed of the split and of the fits."""
    overwrite: bool = False
    """Replace the results of an earlier fit in --out."""


def _fit(args: FitArgs) -> None:
    _check(args)
    started = time.perf_counter()
    import jax

    from i2t.dataset import load_dataset, source_phrase
    from i2t.prediction import choose_split, find_method, fit_predictor
    from i2t.prediction.fit import correct_touches
    from i2t.recognition.recorded import describe
    from i2t.recognition.recorded import to_json as pad_model_to_json
    from i2t.training import TrainConfig

    find_method(args.method)  # before the data are read
    dataset = load_dataset(args.dataset, skin=args.skin_name)
    split = choose_split(dataset, args.split, seed=args.seed, rows=correct_touches(dataset).rows)
    print(f"{len(dataset)} touches ({source_phrase(dataset.source)}). {split}")
    training = TrainConfig() if args.epochs is None else replace(TrainConfig(), epochs=args.epochs)
    predictor = fit_predictor(dataset, split, method=args.method, key=jax.random.key(args.seed), training=training)
    by_session = bool((split.groups == dataset.touches.session).all())
    score = predictor.score(dataset, split.test, groups=None if by_session else split.groups)
    print(f"\n{predictor}\n\nScore on held-out touches:\n{score}\n")
    pad_model = _pad_model(args, dataset, split)
    reason = pad_model if isinstance(pad_model, str) else None
    about = predictor.metadata or {}
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "pad": None,
        "notes": about["notes"],
        "split": split.description,
        "counts": {part: int(getattr(split, part).sum()) for part in ("train", "validation", "test")},
        "best": about["method"],
        "methods": {about["method"]: score.to_json()},
        "pad_model": pad_model if isinstance(pad_model, str) else pad_model_to_json(pad_model),
    }
    if args.out.exists():
        shutil.rmtree(args.out)  # `_check` has refused any other folder
    args.out.mkdir(parents=True)
    run = FinishedRun(args.out, None, {KEPT: about["method"]}, reason)
    write_json(args.out / CONFIG, _config(args))
    predictor.save(args.out / CHECKPOINTS / KEPT)
    if not isinstance(pad_model, str):
        print(printable(describe(pad_model)))
        pad_model.save(run.pad_model)
    write_training(run)
    picture = _draw(args, score)
    write_json(args.out / METRICS, metrics | {"seconds": round(time.perf_counter() - started, 1)})
    print(f"\nwrote {args.out}: the predictor{'' if reason else ', the pad model'}, {METRICS} and {picture.name}")
    print("\n".join(_next_steps(args, dataset, pad_model=reason is None)))


def _next_steps(args: FitArgs, dataset: "Dataset", *, pad_model: bool) -> list[str]:
    """Name the commands that use the results. Presses of one tip suit a calibration, but no other shapes."""
    from i2t.recordings.loads import presses_one_tip

    if presses_one_tip(dataset):
        skin = "" if args.skin_name is None else f" --skin-name {args.skin_name}"
        calibrate = f"python -m experiments.calibrate --dataset {args.dataset}{skin}" if checkout() else "i2t.calibrate"
        return [
            f"note: all touches are presses of one tip, {dataset.objects[int(dataset.touches.object[0])]}, so the "
            "predictor suits no other shape",
            f"next: calibrate the skin for this tip: {calibrate}",
        ]
    recognize = [f"      i2t recognize {args.dataset} --pad-model {args.out}"] if pad_model else []
    return [f"next: i2t imagine star --model {args.out}", *recognize]


def _check(args: FitArgs) -> None:
    """Refuse wrong options before JAX is imported."""
    require_dataset("DATASET", args.dataset)
    require_objects(args.objects, args.unit, minimum=1, catalogue=False)
    require_writable("--out", args.out)
    if not args.out.exists():
        return
    if args.out.is_file():
        raise ValueError(f"--out {args.out}: is a file; name a folder")
    if not any(args.out.iterdir()):
        return
    if kind_of_config(args.out / CONFIG) != FitArgs.__name__:
        raise ValueError(f"--out {args.out}: is not empty and holds no earlier fit; name another folder")
    if not args.overwrite:
        raise ValueError(f"--out {args.out}: holds an earlier fit; pass --overwrite, or name another folder")
    if Path.cwd().is_relative_to(args.out.resolve()):
        raise ValueError(f"--out {args.out}: is the folder in which this command runs; name another folder")


def _pad_model(args: FitArgs, dataset: "Dataset", split: "Split") -> "KnownPad | str":
    """Fit a pad model to the training touches, or return the reason why they do not suffice for it."""
    import jax

    from i2t.recognition.recorded import fit_pad_model

    print("fitting a pad model, which takes a minute or more", flush=True)
    meshes = read_meshes(args.objects, args.unit)
    try:
        return fit_pad_model(
            dataset, meshes, rows=split.train, key=jax.random.key(args.seed),
            made_from=f"i2t fit {args.dataset}, seed {args.seed}",
        )  # fmt: skip
    except ValueError as error:
        print(printable(f"note: no pad model, so these results cannot be used for recognition: {error}"))
        return str(error)


def _draw(args: FitArgs, score: "PredictorScore") -> Path:
    from i2t import viz
    from i2t.dataset import holds_simulated

    figure = viz.plot_predictions(
        score.measured.ravel(), score.predicted.mean.ravel(), score.predicted.std.ravel(),
        f"{score.touches} held-out touches, R² {score.r2.mean:.2f}", holds_simulated(score.source),
    )  # fmt: skip
    return viz.save_figure(figure, args.out / "agreement.png")


def _config(args: FitArgs) -> dict[str, Any]:
    """Collect the options and the versions of packages."""
    options = {name: value for name, value in asdict(args).items() if name not in ("out", "overwrite")}
    packages = {name: version(name) for name in ("jax", "flax", "optax", "numpy")}
    return {"kind": FitArgs.__name__, "args": options, "versions": {"python": platform.python_version(), **packages}}


main = command(FitArgs, _fit, program="i2t fit", description=docstring_of("i2t.commands.fit"))


if __name__ == "__main__":
    sys.exit(main())
