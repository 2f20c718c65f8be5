"""Question: how much of an unknown object's shape can a few touches determine, and where should they be made?

    python -m experiments.reconstruct                                 random objects of the catalogue
    python -m experiments.reconstruct --objects FOLDER --unit mm      your meshes: eight tenths for the library
    python -m experiments.reconstruct --preset debug                  everything once, too small for a result
    python -m experiments.reconstruct --dataset DATA --object NAME    mesh of one object from recorded touches
    python -m experiments.reconstruct patch --help                    the patch below one press

A simulated arm with a simulated skin touches unknown objects, which are mounted so that the tool can reach them from
all sides. The object is displaced by 1 mm and 1 degree per axis, the arm repeats to 0.05 mm, approaches are tilted by
0.3 degrees, and readings are noisy; each press stops twice, at 25 and at 100 uT. Surfaces are scored at the object's
true pose. Before the first touch the estimate is the mean of a library of other objects
(`i2t.reconstruction.surface`).

The default conditions compare what a touch measures (its reading, its pose alone, or the whole patch in front of the
pad), and touches after one view of a depth camera. `--conditions` adds poses with the likeliest shapes of the library,
a fitted pad with the object's pose known to 3 mm and 5 degrees only, and policies for the next site, one of which uses
the true object. The width of the bands is chosen on validation objects with readings. Everything is simulated.

Time: the first object is drawn within a minute on two cores, and all are done after ten minutes. Expect a third of the
initial distance to the true surface after 5 touches.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.common.runs import begin, write_json
from experiments.reconstruct import recorded
from experiments.reconstruct.arguments import (
    CONDITIONS,
    DEFAULT_CONDITIONS,
    ExplorationCondition,
    ReconstructArgs,
    ReconstructSizes,
)
from experiments.reconstruct.episodes import (
    REPORTED_TOUCHES,
    START,
    Episode,
    SurfaceErrors,
    TrueShape,
    chamfer_mm,
    true_shape,
)
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

BAND_COVERAGE = 0.9  # fraction of the surface that the band should contain


class Band(NamedTuple):
    """Width of the bands."""

    scale: float = 1.0  # factor of all standard deviations
    floor: float = 0.0  # m, standard deviation that touches do not reduce


@dataclass(frozen=True)
class Explorer:
    """Model, objects and settings that the episodes of a run share."""

    model: SurfaceModel
    truth: Callable[..., TrueShape]  # by object number and whether the object is loosely placed
    names: list[str]  # by object number
    reality: Reality
    sizes: ReconstructSizes
    seed: int
    band: Band = field(default_factory=Band)

    def holds(self, number: int) -> bool:
        """Check that the grid can represent an object; print the name and fault of an object that is left out."""
        vertices, grid = self.reality.meshes[number].vertices, self.model.grid
        low, high = self.model.points.min(0), self.model.points.max(0)
        across, most = MM_PER_M * np.ptp(vertices, axis=0).max(), MM_PER_M * 0.5 * grid.spacing
        if not ((vertices > low) & (vertices < high)).all():
            fault = f"{across:.0f} mm across, larger than all library objects; pass --across-mm"
        elif not self.truth(number).floor_mm <= most:
            fault = f"open, or too thin for a grid of {MM_PER_M * grid.spacing:.1f} mm"
        else:
            return True
        print(printable(f"left out: {self.names[number]}: {fault}"), flush=True)
        return False

    def explore(self, number: int, condition: ExplorationCondition) -> Episode:
        """Touch one object under one condition.

        The simulated errors depend on object and seed only, so conditions differ in their size but not in their draws.
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
            # If the episode stops early, its last estimate counts for all later touches.
            for count in {count for count in REPORTED_TOUCHES if count < touches} | {touches}:
                if count == done or (episode.stopped and count > done):
                    episode.judge(count, self.estimate(model, episode), truth)
            if site is None:
                break
            episode.state, _ = update(model, episode.state, session.touch(site, condition.sensing))
        return episode

    def model_of(self, condition: ExplorationCondition) -> SurfaceModel:
        """Model with the condition's choice of library shapes."""
        return self.model._replace(config=replace(self.model.config, likeliest=condition.likeliest))

    def estimate(self, model: SurfaceModel, episode: Episode) -> SurfaceEstimate:
        """Estimate the surface with the chosen bands, which the choice of sites does not use."""
        config = replace(model.config, band_scale=self.band.scale, band_floor=self.band.floor)
        return estimate_surface(model._replace(config=config), episode.state)

    def choose(
        self, number: int, done: int, condition: ExplorationCondition, session: Session, episode: Episode
    ) -> Float[np.ndarray, "4 4"] | None:
        """Choose the next site, or None if none is safe. The oracle foresees twelve sites, on a coarser grid."""
        step = int(np.random.SeedSequence([self.seed, 0, number, done]).generate_state(1)[0])
        if condition.policy != "oracle":
            config = ExplorationConfig(condition.policy, limits=AROUND_LIMITS, overtravel=EXPLORING_OVERTRAVEL_M)
            return choose_touch(self.model, episode.state, config=config, seed=step).T_o_t
        config = ExplorationConfig("random", limits=AROUND_LIMITS, overtravel=EXPLORING_OVERTRAVEL_M)
        proposals = choose_touch(self.model, episode.state, config=config, seed=step).proposals
        sites = proposals.T_o_t[proposals.safe][:12]
        if not len(sites):
            return None
        after = (update(self.model, episode.state, evidence)[0] for evidence in session.foresee(sites))
        foreseen = (estimate_surface(self.model, evidence, stride=2) for evidence in after)
        left = [chamfer_mm(evidence.mesh, self.truth(number), 8000) for evidence in foreseen]
        return sites[int(np.argmin(left))]


def run(args: ReconstructArgs) -> dict[str, Any]:
    """Run all conditions on the same objects; print the table, write metrics.json, config.json and figures."""
    if args.dataset is not None:
        return recorded.run(args)
    sizes, started = args.sizes, time.monotonic()
    split = split_objects(args)
    begin(args, sizes)
    print(f"preparing a library of {len(split.train)} shapes and the readings of {sizes.pads} skins", flush=True)
    config, box = SurfaceConfig(on_table=False), np.full(3, 30e-3)  # larger library objects enlarge the box
    model = surface_model(list(split.train.values()), config=config, low=-box, high=box)
    reality = make_reality(args.seed, split, sizes)

    @cache
    def truth(number: int, loose: bool = False) -> TrueShape:
        return true_shape(Session(reality, number, args.seed, loose), model.grid, sizes.samples)

    names, first_test = [*split.validation, *split.test], len(split.validation)
    explorer = Explorer(model, truth, names, reality, sizes, args.seed)
    prepared = time.monotonic() - started

    chosen = {name: CONDITIONS[name] for name in args.conditions or DEFAULT_CONDITIONS}
    unseen = filter(explorer.holds, range(first_test, len(names)))
    first = require_one(unseen, "test")
    episode = explorer.explore(first, next(iter(chosen.values())))
    draw_episode(args.out, episode, names[first], reality.meshes[first], time.monotonic() - started)
    validation = filter(explorer.holds, range(first_test))
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
        "grid_points": list(model.grid.shape),
        "grid_spacing_mm": MM_PER_M * model.grid.spacing,
        "seconds": {"preparing": prepared, "all": time.monotonic() - started},
        "seed": args.seed,
    }
    write_json(args.out / "metrics.json", report)
    viz.save_figure(draw_errors(report), args.out / "errors.png")
    print(f"{reconstructions(report)}\n\ngrid floor: {report['grid_floor_mm']:.2f} mm")
    return report


def require_one(numbers: Iterator[int], part: str) -> int:
    """Return the first object of a part that the grid can represent."""
    for number in numbers:
        return number
    raise ValueError(f"no {part} object is left; give objects similar to those of the library, and their --unit")


def choose_band(explorer: Explorer, numbers: Sequence[int]) -> Band:
    """Choose the band that contains 90 % of validation objects' surfaces, after few touches as after many."""
    shown = progress(numbers, desc="validation", unit="episodes")
    episodes = [explorer.explore(number, ExplorationCondition()) for number in shown]
    counts = sorted({count for errors_after in episodes for count in errors_after.errors if count > START})
    parts = (
        [errors_after.errors[count] for errors_after in episodes if count in errors_after.errors] for count in counts
    )
    errors = [SurfaceErrors(*map(np.concatenate, zip(*some, strict=True))) for some in parts]

    def fitting(floor: float) -> Band:
        """Scale at which a band of this floor has the wanted coverage, over all numbers of touches together."""
        needed = [
            np.sqrt(np.maximum((errors_after.distance / STDS_WITHIN_90) ** 2 - floor**2, 0)) / errors_after.std
            for errors_after in errors
        ]
        weights = np.concatenate([np.full(len(errors_after), 1 / len(errors_after)) for errors_after in needed])
        scale = np.quantile(np.concatenate(needed), BAND_COVERAGE, weights=weights, method="inverted_cdf")
        return Band(float(scale), floor)

    def unevenness(band: Band) -> float:
        held = [
            np.mean(errors_after.distance <= STDS_WITHIN_90 * np.hypot(band.scale * errors_after.std, band.floor))
            for errors_after in errors
        ]
        return float(np.mean((np.array(held) - BAND_COVERAGE) ** 2))

    return min(map(fitting, np.arange(9) * 0.25e-3), key=unevenness)


def explore_all(explorer: Explorer, conditions: dict[str, ExplorationCondition], numbers: Sequence[int]) -> Episodes:
    """Explore every object under every condition."""
    episodes: Episodes = {name: {} for name in conditions}
    pairs = [(name, number) for name in conditions for number in numbers]
    for name, number in progress(pairs, desc="exploring", unit="episodes"):
        episodes[name][number] = explorer.explore(number, conditions[name])
        episodes[name][number].estimates.clear()  # megabytes each, and only the first episode is drawn
    return episodes
