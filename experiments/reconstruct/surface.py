"""Question: how much of an unknown object's shape do a few touches tell, and where should they be?

    python -m experiments.reconstruct                                 random objects of the catalogue
    python -m experiments.reconstruct --preset debug                  once through everything, too small to mean much
    python -m experiments.reconstruct --dataset DATA --object NAME    one object from recorded touches, as a mesh
    python -m experiments.reconstruct patch --help                    what one press met
    python -m experiments.reconstruct tip --help                      where a tip pressed, on recorded presses

Unseen objects are touched by a simulated arm with a simulated skin: placement errs by 1 mm and 1 degree per axis, the
approach tilts, readings are noisy. Before the first touch the estimate is the mean of a library of other objects
(`i2t.reconstruction.surface`). Compared are policies (random, greatest uncertainty, expected reduction of the surface's
error), and touches that say nothing besides their pose. The width of the bands is chosen on validation objects; test
objects are judged once. Everything is simulated.

Ten minutes on two cores that do other work too, half of them for libraries and compilation. Expect about half
of the start's distance to the true surface after 20 touches; four objects are too few to tell policies apart.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import begin, write_json
from experiments.reconstruct import recorded
from experiments.reconstruct.arguments import CONDITIONS, ExplorationCondition, ReconstructArgs, ReconstructSizes
from experiments.reconstruct.episodes import REPORTED, Episode, SurfaceErrors, TrueShape, true_shape
from experiments.reconstruct.report import Episodes, draw_errors, draw_growing, summarize
from experiments.reconstruct.world import EXPLORING_OVERTRAVEL_M, Reality, Session, make_reality, split_objects
from experiments.reproduce.shape_tables import reconstructions
from i2t import viz
from i2t.progress import progress
from i2t.reconstruction.exploration import AROUND_LIMITS, ExplorationConfig, choose_touch
from i2t.reconstruction.surface import Z_90, SurfaceModel, estimate_surface, init, surface_model, update

BAND = 0.9  # that a band should hold of the surface
BAND_FLOORS_M = tuple(np.arange(9) * 0.25e-3)  # what is chosen among


class Band(NamedTuple):
    """Width of the bands."""

    scale: float  # of all standard deviations
    floor: float  # m, standard deviation that no touch takes away


@dataclass(frozen=True)
class Explorer:
    """What all episodes of a run share."""

    model: SurfaceModel
    shapes: list[TrueShape]  # of the reality's objects
    reality: Reality
    sizes: ReconstructSizes
    seed: int

    def explore(self, number: int, condition: ExplorationCondition) -> Episode:
        """Touch one object, whose errors of the lab depend on object and seed only: conditions share them."""
        model, truth, touches = self.model, self.shapes[number], self.sizes.touches
        session = Session(self.reality, number, 1000 * self.seed)
        episode = Episode(init(model)[0])
        config = ExplorationConfig(condition.policy, limits=AROUND_LIMITS, overtravel=EXPLORING_OVERTRAVEL_M)
        for done in range(touches + 1):
            if done in (*REPORTED, touches):
                episode.judge(done, estimate_surface(model, episode.state), truth)
            if done == touches:
                break
            step = int(np.random.SeedSequence([self.seed, 0, number, done]).generate_state(1)[0])
            site = choose_touch(model, episode.state, config=config, seed=step).T_o_t
            if site is None:
                episode.stopped = True
                break
            episode.state, _ = update(model, episode.state, session.touch(site, condition.reading))
        return episode

    def with_band(self, band: Band) -> "Explorer":
        """The same with wider or narrower bands."""
        config = replace(self.model.config, band_scale=band.scale, band_floor=band.floor)
        return replace(self, model=self.model._replace(config=config))


def run(args: ReconstructArgs) -> dict[str, Any]:
    """Run every condition on the same objects; print the table, write metrics.json, config.json and figures."""
    if args.dataset is not None:
        return recorded.run(args)
    sizes, started = args.sizes, time.monotonic()
    begin(args.out, args, sizes, None, args.overwrite)
    split = split_objects(sizes, args.seed)
    print(f"a library of {len(split.train)} shapes, and what {sizes.pads} skins read", flush=True)
    known = surface_model([item.mesh for item in split.train])
    reality = make_reality(jax.random.key(args.seed), split, sizes)
    shapes = [true_shape(item.mesh, known.grid, sizes.samples) for item in reality.objects]
    explorer = Explorer(known, shapes, reality, sizes, args.seed)
    prepared = time.monotonic() - started

    chosen = {name: CONDITIONS[name] for name in args.conditions or CONDITIONS}
    band = choose_band(explorer, range(len(split.validation)))
    unseen = range(len(split.validation), len(shapes))
    episodes = explore_all(explorer.with_band(band), chosen, unseen)
    report = {
        "source": "simulated",
        **summarize(episodes, sizes.pads),
        "grid_floor_mm": float(np.mean([shapes[number].floor_mm for number in unseen])),
        "preset": args.preset,
        "objects": {part: [item.name for item in getattr(split, part)] for part in ("validation", "test")},
        "library": {"shapes": len(split.train), "patches": len(reality.library.object)},
        "band": band._asdict(),
        "grid_points": list(known.grid.shape),
        "grid_spacing_mm": 1e3 * known.grid.spacing,
        "seconds": {"preparing": prepared, "all": time.monotonic() - started},
        "seed": args.seed,
    }
    write_json(args.out / "metrics.json", report)
    viz.save_figure(draw_errors(report), args.out / "errors.png")
    shown = episodes.get("reduction", next(iter(episodes.values())))[unseen[0]]
    viz.save_figure(draw_growing(shown, reality.objects[unseen[0]]), args.out / "growing.png")
    print(f"{reconstructions(report)}\n\ngrid floor: {report['grid_floor_mm']:.2f} mm")
    return report


def choose_band(explorer: Explorer, numbers: Sequence[int]) -> Band:
    """The band that holds 90 % of validation objects' surfaces, after few touches and after many alike."""
    bare = explorer.with_band(Band(1.0, 0.0))
    found = [bare.explore(number, ExplorationCondition()) for number in numbers]
    counts = sorted({count for each in found for count in each.errors if count > 0})
    parts = ([each.errors[count] for each in found if count in each.errors] for count in counts)
    errors = [SurfaceErrors(*map(np.concatenate, zip(*some, strict=True))) for some in parts]

    def fitting(floor: float) -> Band:
        """The scale with which a band of this floor holds as much as it should, over all numbers of touches."""
        needed = [np.sqrt(np.maximum((each.distance / Z_90) ** 2 - floor**2, 0)) / each.std for each in errors]
        counted_alike = np.concatenate([np.full(len(each), 1 / len(each)) for each in needed])
        scale = np.quantile(np.concatenate(needed), BAND, weights=counted_alike, method="inverted_cdf")
        return Band(float(scale), floor)

    def unevenness(band: Band) -> float:
        held = [np.mean(each.distance <= Z_90 * np.hypot(band.scale * each.std, band.floor)) for each in errors]
        return float(np.mean((np.array(held) - BAND) ** 2))

    return min(map(fitting, BAND_FLOORS_M), key=unevenness)


def explore_all(explorer: Explorer, conditions: dict[str, ExplorationCondition], numbers: Sequence[int]) -> Episodes:
    """Every condition on every object."""
    found: Episodes = {name: {} for name in conditions}
    for name, number in progress([(name, number) for name in conditions for number in numbers], desc="episodes"):
        found[name][number] = explorer.explore(number, conditions[name])
    return found
