"""The harness of all studies: a finished run with its pad model, objects to tell apart, and simulated episodes."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array

from experiments.common.presets import choose_preset
from experiments.recognize import trained_run
from experiments.recognize.config import PRESETS, Recognition
from experiments.recognize.trained_run import TrainedRun, meshes_by_name
from experiments.studies.arguments import StudyArgs
from i2t.contact.press import PressLaw, PressLimits
from i2t.dataset import Dataset
from i2t.objects import Mesh
from i2t.recognition.belief import Particles
from i2t.recognition.environment import EnvironmentConfig
from i2t.recognition.episodes import Episodes
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.rollout import run_episodes
from i2t.recognition.site_pool import (
    SitePool,
    TouchPlan,
    plan_random_touches,
    pose_particles,
    precompute_outcomes,
    prepare_surfaces,
)
from i2t.simulation import touches as simulation
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import press as press_pad
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import PadModel
from i2t.skin_models.reading_model import LinearReadingModel
from i2t.types import Pad, Surface

MAX_PARTICLES = 64  # of each object: with 64 to 512 accuracies are the same within 0.01
DEBUG_EPISODES = 2  # of each object
SETS = ("validation", "test")
FIRST_SEED = 100  # of the studies' keys, apart from those of other experiments


@dataclass(frozen=True, eq=False)  # a world is that very one
class StudyWorld:
    """What is other in a simulated world than in the lab."""

    pad: Pad | None = None
    mesh: Callable[[Mesh], Mesh] | None = None
    errors: SimulationErrors | None = None
    limits: PressLimits | None = None
    law: Callable[[Pad], PressLaw] = lambda _: press_pad


@dataclass(frozen=True)
class StudyLab:
    """One pad and seed: the finished run with its pad model, and the objects to tell apart."""

    args: StudyArgs
    cfg: Recognition
    run: TrainedRun
    names: tuple[str, ...]
    surfaces: list[Surface]
    episodes: int  # of each object
    seed: int
    key: Array

    @property
    def pad_model(self) -> PadModel:
        """The pad model of the run."""
        return self.run.pad_model

    def particles(self) -> Particles:
        """Pose particles of an object under the errors of placement that the lab states."""
        return pose_particles(self.cfg.errors, self.cfg.num_particles, self.seed)

    def truth(self) -> np.ndarray:
        """Object of each episode: all in turn."""
        return np.arange(len(self.surfaces) * self.episodes) % len(self.surfaces)

    def plan(self, key: Array, episodes: int) -> TouchPlan:
        """Random sites, at which `SHARED_BY` episodes one after the other touch."""
        cfg, limits = self.cfg, self.cfg.site_limits
        return plan_random_touches(
            key, self.surfaces, self.names, episodes, cfg.touches, limits=limits, share=cfg.pool_episodes
        )

    def predict(
        self, sites: SitePool, particles: Particles, models: Sequence[LinearReadingModel], label: str
    ) -> list[PredictedTouch]:
        """Predicted touches of the lab's objects, for each reading model."""
        overtravel = self.cfg.limits.overtravel
        return precompute_outcomes(
            self.surfaces, particles.twist, sites.T_w_t, models, overtravel=overtravel, label=label
        )

    def simulate(
        self,
        key: Array,
        plan: TouchPlan,
        truth: np.ndarray,
        label: str,
        *,
        surfaces: Sequence[Surface] | None = None,
        world: StudyWorld = StudyWorld(),
    ) -> Episodes:
        """Simulated episodes; surfaces, of which `truth` says which is there, and world are the lab's unless given."""
        pad, errors, limits = (
            world.pad or self.run.pad,
            world.errors or self.cfg.errors,
            world.limits or self.cfg.limits,
        )
        config = EnvironmentConfig(errors, limits, plan.chosen.shape[1], law=world.law(pad))
        return run_episodes(
            key, surfaces or self.surfaces, truth, plan.chosen,
            sites=plan.sites, pad=pad, config=config, label=label,
        )  # fmt: skip

    def with_objects(self, names: Sequence[str]) -> "StudyLab":
        """The lab with other objects of the catalogue to tell apart."""
        if tuple(names) == self.names:
            return self
        surfaces = prepare_surfaces(list(meshes_by_name(names).values()))
        return replace(self, names=tuple(names), surfaces=surfaces)

    def touch_known_objects(self, key: Array, world: StudyWorld) -> Dataset:
        """As many touches of the training objects as the run had, with pad, errors and law of some world."""
        pad = world.pad or self.run.pad
        which, counts = np.unique(self.run.dataset.touches.object[self.run.rows], return_counts=True)
        names = tuple(self.run.dataset.objects[i] for i in which)
        made = simulation.simulate_touches(
            key, [self.run.surfaces[name] for name in names], pad, world.errors or self.cfg.errors, counts.tolist(),
            limits=self.cfg.limits, law=world.law(pad),
        )  # fmt: skip
        return Dataset.simulated(made, names, pad)

    def refit(self, key: Array, dataset: Dataset, touches: int | None = None) -> PadModel:
        """The pad model as the run fitted it, but to other touches: all, or the first so many."""
        each = None if touches is None else touches // len(dataset.objects)
        rows = np.zeros(len(dataset), bool)
        for i in range(len(dataset.objects)):
            rows[np.flatnonzero(dataset.touches.object == i)[:each]] = True
        cfg = self.cfg
        return ContactModel(cfg.errors, cfg.limits).fit(key, ObjectTouches(dataset, rows, self.run.surfaces)).model


def prepare_lab(args: StudyArgs, folder: Path, seed: int) -> StudyLab:
    """Read a finished run, fit its pad model, and prepare the objects."""
    cfg = choose_preset(PRESETS, args.preset)
    cfg = replace(cfg, num_particles=min(cfg.num_particles, MAX_PARTICLES))
    key_fit, key = jax.random.split(jax.random.key(FIRST_SEED + seed))
    run = trained_run.load_trained_run(key_fit, folder, cfg.errors, cfg.limits)
    surfaces = prepare_surfaces(list(meshes_by_name(cfg.objects).values()))
    return StudyLab(args, cfg, run, cfg.objects, surfaces, DEBUG_EPISODES if args.debug else args.episodes, seed, key)
