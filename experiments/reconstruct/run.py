"""Question: how much of an unknown object's shape do a few touches tell, and where should they be?

    python -m experiments.reconstruct --out runs/reconstruct          random objects of the catalogue
    python -m experiments.reconstruct --meshes DIR --unit cm          any folder: those ending in 0 are unseen
    python -m experiments.reconstruct --preset debug                  once through everything, too small to mean much
    python -m experiments.reconstruct --dataset DATA --object NAME    one object from recorded touches, as a mesh
    python -m experiments.reconstruct --arm emulated --true-object spanner      an arm explores an object, as a mesh

Unseen objects are touched by a simulated arm with a simulated skin: placement errs by 1 mm and 1 degree per axis, the
approach tilts, readings are noisy. Before the first touch the estimate is the mean of a library of other objects
(`i2t.reconstruction.surface`). Compared are policies (random, even, greatest uncertainty, expected reduction of the
surface's error, and a greedy oracle that knows the truth), what a touch says besides its pose (nothing, the posterior
of the reading, a perfect tactile image), a prior of smoothness alone, and a start from one depth view. The width of the
bands is chosen on validation objects; test objects are judged once. Everything is simulated.

Ten minutes on two cores that do other work too, half of them for libraries and compilation. Expect half to two thirds
of the start's distance to the true surface after 20 touches; four objects are too few to tell policies apart.
"""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from experiments.common.runs import begin, write_json
from experiments.reconstruct import recorded
from experiments.reconstruct.arguments import CONDITIONS, ExplorationCondition, ReconstructArgs
from experiments.reconstruct.episodes import Explorer, explore, site_limits
from experiments.reconstruct.figures import draw_all
from experiments.reconstruct.report import Episodes, summarize, table
from experiments.reconstruct.scores import SurfaceErrors, true_shape
from experiments.reconstruct.world import ObjectSplit, make_reality, make_skins, split_objects
from i2t.progress import progress
from i2t.reconstruction.surface import Z_90, SurfaceModel, surface_model

BAND = 0.9  # that a band should hold of the surface
BAND_FLOORS_M = tuple(np.arange(9) * 0.25e-3)  # what is chosen among


def run(args: ReconstructArgs) -> dict:
    """Run every condition on the same objects; print the table, write metrics.json, config.json and figures."""
    if args.dataset is not None or args.arm is not None:
        return recorded.run(args)
    sizes = args.sizes
    begin(args.out, args, sizes, None, args.overwrite)
    started = time.monotonic()
    split = split_objects(args, sizes)
    models = make_models(split)
    skins = make_skins(jax.random.key(args.seed), split.train, sizes)
    prepared = time.monotonic() - started

    explorer = Explorer(
        models=models,
        shapes=[true_shape(item.mesh, models[True].grid, sizes.samples) for item in split.validation + split.test],
        reality=make_reality(split.validation + split.test, skins),
        sizes=sizes,
        seed=args.seed,
        limits=site_limits(args),
    )
    unseen = range(len(split.validation), len(explorer.shapes))
    chosen = {name: CONDITIONS[name] for name in args.conditions or CONDITIONS}
    libraries = {condition.library for condition in chosen.values()}
    bands = {known: choose_band(explorer, range(len(split.validation)), known) for known in libraries}
    test = replace(explorer, models={known: with_band(models[known], bands[known]) for known in libraries})
    episodes = explore_all(test, chosen, unseen)
    report = summarize(episodes, test, sizes) | {
        "preset": args.preset,
        "reach": args.reach,
        "objects": {part: [item.name for item in getattr(split, part)] for part in ("validation", "test")},
        "library": {"shapes": len(split.train), "patches": len(skins.library.object)},
        "band": {"library" if known else "smoothness alone": band._asdict() for known, band in bands.items()},
        "grid_points": list(models[True].grid.shape),
        "grid_spacing_mm": 1e3 * models[True].grid.spacing,
        "seconds": {"preparing": prepared, "all": time.monotonic() - started},
        "seed": args.seed,
    }
    write_json(args.out / "metrics.json", report)
    text = table(report)
    (args.out / "table.md").write_text(text + "\n")
    draw_all(args.out, report, episodes, test)
    print(text)
    return report


def make_models(split: ObjectSplit) -> dict[bool, SurfaceModel]:
    """The library of the training objects, and a prior of smoothness alone on the same grid."""
    with progress(total=len(split.train), desc="library of shapes") as bar:
        meshes = [item.mesh for item in split.train]
        known = surface_model(meshes, progress=lambda done: bar.update(1) and None)
    return {True: known, False: known._replace(library=known.library[:, :0])}


class Band(NamedTuple):
    """Width of the bands."""

    scale: float  # of all standard deviations
    floor: float  # m, standard deviation that no touch takes away


def with_band(model: SurfaceModel, band: Band) -> SurfaceModel:
    """A model whose bands are wider or narrower."""
    return model._replace(config=replace(model.config, band_scale=band.scale, band_floor=band.floor))


def choose_band(explorer: Explorer, numbers: Sequence[int], known: bool) -> Band:
    """The band that holds 90 % of validation objects' surfaces, after few touches and after many alike."""
    bare = replace(explorer, models={known: with_band(explorer.models[known], Band(1.0, 0.0))})
    found = [explore(bare, number, ExplorationCondition(library=known), seed=0) for number in numbers]
    counts = sorted({count for each in found for count in each.errors if count > 0})
    errors = [
        SurfaceErrors(
            *map(np.concatenate, zip(*(each.errors[count] for each in found if count in each.errors), strict=True))
        )
        for count in counts
    ]

    def fitting(floor: float) -> Band:
        """The scale with which a band of this floor holds as much as it should, over all numbers of touches."""
        needed = [np.sqrt(np.maximum((each.distance / Z_90) ** 2 - floor**2, 0)) / each.std for each in errors]
        counted_alike = np.concatenate([np.full(len(each), 1 / len(each)) for each in needed])
        scale = np.quantile(np.concatenate(needed), BAND, weights=counted_alike, method="inverted_cdf")
        return Band(float(scale), floor)

    def unevenness(band: Band) -> float:
        return float(np.mean([(_held(each, band) - BAND) ** 2 for each in errors]))

    return min(map(fitting, BAND_FLOORS_M), key=unevenness)


def _held(errors: SurfaceErrors, band: Band) -> float:
    """Share of the surface in a band of 90 %."""
    return float(np.mean(errors.distance <= Z_90 * np.hypot(band.scale * errors.std, band.floor)))


def explore_all(explorer: Explorer, conditions: dict[str, ExplorationCondition], numbers: Sequence[int]) -> Episodes:
    """Every condition on every object and seed."""
    places = [(number, seed) for number in numbers for seed in range(explorer.sizes.seeds)]
    found: Episodes = {}
    with progress(total=len(conditions) * len(places), desc="episodes") as bar:
        for name, condition in conditions.items():
            found[name] = {}
            for number, seed in places:
                found[name][number, seed] = explore(explorer, number, condition, seed=seed)
                bar.update(1)
    return found
