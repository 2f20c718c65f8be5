"""Question: how much of an unknown object's shape do a few touches tell, and where should they be?

    python -m experiments.reconstruct                                 random objects of the catalogue
    python -m experiments.reconstruct --objects FOLDER --unit mm      your meshes: nine tenths to learn from
    python -m experiments.reconstruct --preset debug                  once through everything, too small to mean much
    python -m experiments.reconstruct --dataset DATA --object NAME    one object from recorded touches, as a mesh
    python -m experiments.reconstruct patch --help                    what one press met

Unseen objects, held so that the tool reaches them from everywhere, are touched by a simulated arm with a simulated
skin: the object is displaced by 1 mm and 1 degree per axis, the arm repeats to .05 mm, approaches err by .3 degrees,
readings are noisy; each press stops twice, at 25 and at 100 uT. An object is judged where it was. Before the first
touch the estimate is the mean of a library of other objects (`i2t.reconstruction.surface`). Compared are touches by
what they tell: what their reading says, their pose alone, or all of the patch before the pad; touches after one view of
a depth camera; and, by `--conditions`, poses with another choice of shapes that stand for the library, a pad that is
fitted to presses where an object's middle is known to 3 mm and 5 degrees only, and policies of where to touch next,
with one that knows the true object. The width of the bands is chosen on validation objects, whose touches are read.
Everything is simulated.

The first object is drawn after less than a minute on two cores, all of them after ten minutes. Expect a third of the
start's distance to the true surface after 5 touches.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.common.runs import begin, write_json
from experiments.reconstruct import recorded
from experiments.reconstruct.arguments import (
    CONDITIONS,
    USUAL,
    ExplorationCondition,
    ReconstructArgs,
    ReconstructSizes,
)
from experiments.reconstruct.episodes import REPORTED, START, Episode, SurfaceErrors, TrueShape, chamfer_mm, true_shape
from experiments.reconstruct.report import Episodes, draw_episode, draw_errors, summarize
from experiments.reconstruct.tables import reconstructions
from experiments.reconstruct.world import (
    EXPLORING_OVERTRAVEL_M,
    MM_PER_M,
    Reality,
    Session,
    make_reality,
    split_objects,
)
from i2t import viz
from i2t.errors import printable
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.reconstruction.exploration import AROUND_LIMITS, ExplorationConfig, choose_touch
from i2t.reconstruction.surface import (
    SurfaceConfig,
    SurfaceEstimate,
    SurfaceModel,
    estimate_surface,
    init,
    surface_model,
    update,
)
from i2t.runtime.progress import progress

LOW_M, HIGH_M = (-30e-3,) * 3, (30e-3,) * 3  # of the box that holds any object; larger ones of the library enlarge it
FORESEEN = 12  # sites among which the oracle chooses
FORESEEN_STRIDE, FORESEEN_SAMPLES = 2, 8000  # of what it foresees: coarser, as only differences count
MAX_FLOOR = 0.5  # of the grid's spacing: what the grid holds less well is left out
BAND = 0.9  # that a band should hold of the surface
BAND_FLOORS_M = tuple(np.arange(9) * 0.25e-3)  # what is chosen among


class Band(NamedTuple):
    """Width of the bands."""

    scale: float  # of all standard deviations
    floor: float  # m, standard deviation that no touch takes away


UNSCALED = Band(1.0, 0.0)


@dataclass(frozen=True)
class Explorer:
    """What all episodes of a run share."""

    model: SurfaceModel
    truth: Callable[..., TrueShape]  # of an object by its number, and whether it is placed loosely
    names: list[str]  # of the same objects
    reality: Reality
    sizes: ReconstructSizes
    seed: int
    band: Band = UNSCALED

    def holds(self, number: int) -> bool:
        """Whether the grid can hold an object; one that it cannot is named, and left out of all conditions."""
        vertices, grid = self.reality.meshes[number].vertices, self.model.grid
        low, high = self.model.points.min(0), self.model.points.max(0)
        across, most = MM_PER_M * np.ptp(vertices, axis=0).max(), MM_PER_M * MAX_FLOOR * grid.spacing
        if not ((vertices > low) & (vertices < high)).all():
            fault = f"{across:.0f} mm across, larger than all that is learnt from; pass --across-mm"
        elif not self.truth(number).floor_mm <= most:
            fault = f"open, or too thin for a grid of {MM_PER_M * grid.spacing:.1f} mm"
        else:
            return True
        print(printable(f"left out: {self.names[number]}: {fault}"), flush=True)
        return False

    def explore(self, number: int, condition: ExplorationCondition) -> Episode:
        """Touch one object, whose errors of the lab depend on object and seed only: conditions share them, but for
        their size.
        """
        model, touches = self.model_of(condition), self.sizes.touches
        truth = self.truth(number, condition.loose)
        session = Session(self.reality, number, self.seed, condition.loose, condition.fitted)
        episode = Episode(init(model)[0])
        episode.judge(START, self.estimate(model, episode), truth)
        if condition.view:
            episode.state, _ = update(model, episode.state, session.view())
        for done in range(touches + 1):
            site = self.choose(number, done, condition, session, episode) if done < touches else None
            episode.stopped = site is None and done < touches
            # Of one that stopped, what is known then counts for all touches to come.
            for count in {each for each in REPORTED if each < touches} | {touches}:
                if count == done or (episode.stopped and count > done):
                    episode.judge(count, self.estimate(model, episode), truth)
            if site is None:
                break
            episode.state, _ = update(model, episode.state, session.touch(site, condition.felt))
        return episode

    def model_of(self, condition: ExplorationCondition) -> SurfaceModel:
        """The model with the shapes that stand for the library in a condition."""
        return self.model._replace(config=replace(self.model.config, likeliest=condition.likeliest))

    def estimate(self, model: SurfaceModel, episode: Episode) -> SurfaceEstimate:
        """What is known, with the chosen bands; where to touch is chosen without them."""
        config = replace(model.config, band_scale=self.band.scale, band_floor=self.band.floor)
        return estimate_surface(model._replace(config=config), episode.state)

    def choose(
        self, number: int, done: int, condition: ExplorationCondition, session: Session, episode: Episode
    ) -> Float[np.ndarray, "4 4"] | None:
        """The next site; None where none is safe."""
        step = int(np.random.SeedSequence([self.seed, 0, number, done]).generate_state(1)[0])
        if condition.policy != "oracle":
            config = ExplorationConfig(condition.policy, limits=AROUND_LIMITS, overtravel=EXPLORING_OVERTRAVEL_M)
            return choose_touch(self.model, episode.state, config=config, seed=step).T_o_t
        config = ExplorationConfig("random", limits=AROUND_LIMITS, overtravel=EXPLORING_OVERTRAVEL_M)
        proposals = choose_touch(self.model, episode.state, config=config, seed=step).proposals
        sites = proposals.T_o_t[proposals.safe][:FORESEEN]
        if not len(sites):
            return None
        after = (update(self.model, episode.state, each)[0] for each in session.foresee(sites))
        foreseen = (estimate_surface(self.model, each, stride=FORESEEN_STRIDE) for each in after)
        left = [chamfer_mm(each.mesh, self.truth(number), FORESEEN_SAMPLES) for each in foreseen]
        return sites[int(np.argmin(left))]


def run(args: ReconstructArgs) -> dict[str, Any]:
    """Run every condition on the same objects; print the table, write metrics.json, config.json and figures."""
    if args.dataset is not None:
        return recorded.run(args)
    sizes, started = args.sizes, time.monotonic()
    split = split_objects(args)
    begin(args, sizes)
    print(f"a library of {len(split.train)} shapes, and what {sizes.pads} skins read", flush=True)
    known = surface_model(list(split.train.values()), config=SurfaceConfig(on_table=False), low=LOW_M, high=HIGH_M)
    reality = make_reality(args.seed, split, sizes)

    @cache
    def truth(number: int, loose: bool = False) -> TrueShape:
        return true_shape(Session(reality, number, args.seed, loose), known.grid, sizes.samples)

    names, seen = [*split.validation, *split.test], len(split.validation)
    explorer = Explorer(known, truth, names, reality, sizes, args.seed)
    prepared = time.monotonic() - started

    chosen = {name: CONDITIONS[name] for name in args.conditions or USUAL}
    unseen = filter(explorer.holds, range(seen, len(names)))
    first = require_one(unseen, "test")
    episode = explorer.explore(first, next(iter(chosen.values())))
    draw_episode(args.out, episode, names[first], reality.meshes[first], time.monotonic() - started)
    validation = filter(explorer.holds, range(seen))
    numbers = {"validation": [require_one(validation, "validation"), *validation], "test": [first, *unseen]}
    band = choose_band(explorer, numbers["validation"])
    episodes = explore_all(replace(explorer, band=band), chosen, numbers["test"])
    report = {
        "source": "simulated",
        **summarize(episodes, sizes.pads),
        "grid_floor_mm": float(np.mean([truth(number).floor_mm for number in numbers["test"]])),
        "preset": args.preset,
        "objects": {part: [names[number] for number in some] for part, some in numbers.items()},
        "library": {"shapes": len(split.train), "patches": len(reality.library.object)},
        "band": band._asdict(),
        "grid_points": list(known.grid.shape),
        "grid_spacing_mm": MM_PER_M * known.grid.spacing,
        "seconds": {"preparing": prepared, "all": time.monotonic() - started},
        "seed": args.seed,
    }
    write_json(args.out / "metrics.json", report)
    viz.save_figure(draw_errors(report), args.out / "errors.png")
    print(f"{reconstructions(report)}\n\ngrid floor: {report['grid_floor_mm']:.2f} mm")
    return report


def require_one(numbers: Iterator[int], part: str) -> int:
    """The first of the objects of a part that the grid can hold."""
    for number in numbers:
        return number
    raise ValueError(f"no object of {part} is left; give objects like those that are learnt from, and their --unit")


def choose_band(explorer: Explorer, numbers: Sequence[int]) -> Band:
    """The band that holds 90 % of validation objects' surfaces, after few touches and after many alike."""
    found = [explorer.explore(number, ExplorationCondition()) for number in progress(numbers, desc="validation")]
    counts = sorted({count for each in found for count in each.errors if count > START})
    parts = ([each.errors[count] for each in found if count in each.errors] for count in counts)
    errors = [SurfaceErrors(*map(np.concatenate, zip(*some, strict=True))) for some in parts]

    def fitting(floor: float) -> Band:
        """The scale with which a band of this floor holds as much as it should, over all numbers of touches."""
        needed = [
            np.sqrt(np.maximum((each.distance / STDS_WITHIN_90) ** 2 - floor**2, 0)) / each.std for each in errors
        ]
        counted_alike = np.concatenate([np.full(len(each), 1 / len(each)) for each in needed])
        scale = np.quantile(np.concatenate(needed), BAND, weights=counted_alike, method="inverted_cdf")
        return Band(float(scale), floor)

    def unevenness(band: Band) -> float:
        held = [
            np.mean(each.distance <= STDS_WITHIN_90 * np.hypot(band.scale * each.std, band.floor)) for each in errors
        ]
        return float(np.mean((np.array(held) - BAND) ** 2))

    return min(map(fitting, BAND_FLOORS_M), key=unevenness)


def explore_all(explorer: Explorer, conditions: dict[str, ExplorationCondition], numbers: Sequence[int]) -> Episodes:
    """Every condition on every object."""
    found: Episodes = {name: {} for name in conditions}
    for name, number in progress([(name, number) for name in conditions for number in numbers], desc="episodes"):
        found[name][number] = explorer.explore(number, conditions[name])
        found[name][number].estimates.clear()  # megabytes each, and only those of the first are drawn
    return found
