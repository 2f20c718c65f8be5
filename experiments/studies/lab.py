"""Common setup of the studies: a finished run with its pad model, objects to distinguish, and simulated episodes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from experiments.recognize.config import Recognition
from experiments.recognize.trained_run import TrainedRun, load_trained_run
from i2t.contact.press import PressLaw, PressLimits
from i2t.dataset import Dataset
from i2t.models.finished import FinishedRun
from i2t.objects import Mesh
from i2t.objects.named import read_meshes
from i2t.recognition.belief import Particles
from i2t.recognition.environment import EnvironmentConfig
from i2t.recognition.episodes import Episodes
from i2t.recognition.outcomes import PredictedTouch
from i2t.recognition.recorded import named_surfaces
from i2t.recognition.rollout import run_episodes
from i2t.recognition.site_pool import (
    SitePool,
    TouchPlan,
    plan_random_touches,
    pose_particles,
    predict_outcomes,
    prepare_surfaces,
)
from i2t.simulation import touches as simulation
from i2t.simulation.touches import SimulationErrors
from i2t.skin.pad import press as press_pad
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import PadModel
from i2t.skin_models.reading_model import READING_PRIOR, LinearReadingModel, ReadingPrior
from i2t.types import Pad, Surface

SETS = ("validation", "test")


@dataclass(frozen=True, eq=False)  # compared by identity
class StudyWorld:
    """A simulated world's differences from the assumptions of the pad model; None means no difference."""

    pad: Pad | None = None
    mesh: Callable[[Mesh], Mesh] | None = None
    errors: SimulationErrors | None = None
    limits: PressLimits | None = None
    law: Callable[[Pad], PressLaw] = lambda _: press_pad


class StudySize(NamedTuple):
    """Size of a study."""

    episodes: int  # per object and setting, for each pad and seed
    debug: bool  # whether the study is reduced to a few settings, too small for a result


@dataclass(frozen=True)
class StudyLab:
    """One pad and seed: the finished run with its pad model, and the objects to distinguish."""

    cfg: Recognition
    size: StudySize
    run: TrainedRun
    names: tuple[str, ...]
    surfaces: list[Surface]
    seed: int
    key: Array

    @property
    def pad_model(self) -> PadModel:
        """The pad model of the run."""
        return self.run.pad_model

    def particles(self) -> Particles:
        """Pose particles of an object under the stated errors of placement."""
        return pose_particles(self.cfg.errors, self.cfg.num_particles, self.seed)

    def truth(self) -> np.ndarray:
        """Object index `(e,)` of each episode, with all objects in turn."""
        return np.arange(len(self.surfaces) * self.size.episodes) % len(self.surfaces)

    def plan(self, key: Array, episodes: int) -> TouchPlan:
        """Plan random sites; `cfg.pool_episodes` consecutive episodes share their sites."""
        cfg, limits = self.cfg, self.cfg.site_limits
        return plan_random_touches(
            key, self.surfaces, self.names, episodes, cfg.touches, limits=limits, share=cfg.pool_episodes
        )

    def predict(
        self, sites: SitePool, particles: Particles, models: Sequence[LinearReadingModel], label: str
    ) -> list[PredictedTouch]:
        """Predict touches of the lab's objects with each reading model."""
        overtravel = self.cfg.limits.overtravel
        return predict_outcomes(self.surfaces, particles.twist, sites.T_w_t, models, overtravel=overtravel, label=label)

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
        """Simulate episodes, with the lab's surfaces and world unless given.

        Args:
            key: Random key of the episodes.
            plan: Sites of each episode.
            truth: (e,) index into `surfaces` of each episode's object.
            label: Title of the progress bar.
            surfaces: Objects of the simulation.
            world: Differences from the lab.

        Returns:
            The episodes, with the observations of every touch.
        """
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
        """Copy of the lab with other catalogue objects to distinguish."""
        if tuple(names) == self.names:
            return self
        surfaces = prepare_surfaces(list(read_meshes(names).values()))
        return replace(self, names=tuple(names), surfaces=surfaces)

    def trained_surfaces(self) -> dict[str, Surface]:
        """Surfaces of the training objects by name."""
        return named_surfaces(read_meshes(self.run.trained_objects))

    def touch_known_objects(self, key: Array, surfaces: Mapping[str, Surface], world: StudyWorld) -> Dataset:
        """Simulate as many touches of the training objects as the run had, in a given world."""
        pad = world.pad or self.run.pad
        _, counts = np.unique(self.run.dataset.touches.object[self.run.rows], return_counts=True)
        touches = simulation.simulate_touches(
            key, list(surfaces.values()), pad, world.errors or self.cfg.errors, counts.tolist(),
            limits=self.cfg.limits, law=world.law(pad),
        )  # fmt: skip
        return Dataset.simulated(touches, tuple(surfaces), pad)

    def refit(
        self,
        key: Array,
        dataset: Dataset,
        surfaces: dict[str, Surface],
        touches: int | None = None,
        prior: ReadingPrior = READING_PRIOR,
    ) -> PadModel:
        """Fit a pad model as the run did, to other touches and with another prior; `touches` limits their number."""
        per_object = None if touches is None else touches // len(dataset.objects)
        rows = np.zeros(len(dataset), bool)
        for i in range(len(dataset.objects)):
            rows[np.flatnonzero(dataset.touches.object == i)[:per_object]] = True
        cfg = self.cfg
        return ContactModel(cfg.errors, cfg.limits, prior).fit(key, ObjectTouches(dataset, rows, surfaces)).model


def prepare_lab(cfg: Recognition, size: StudySize, run: FinishedRun, seed: int) -> StudyLab:
    """Load a finished run with its pad model, and prepare the objects."""
    # 64 pose particles per object suffice: with 64 to 512, accuracies are the same within 0.01.
    cfg = replace(cfg, num_particles=min(cfg.num_particles, 64))
    _, key = jax.random.split(jax.random.key(100 + seed))  # distinct from the seeds of other experiments
    surfaces = prepare_surfaces(list(read_meshes(cfg.objects).values()))
    return StudyLab(cfg, size, load_trained_run(run), cfg.objects, surfaces, seed, key)
