"""Data that several figures share."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import jax
import numpy as np
from matplotlib.figure import Figure

import i2t
from experiments.recognize.config import PRESETS, Recognition
from experiments.recognize.trained_run import TrainedRun, load_trained_run
from i2t.geometry import inverse
from i2t.models.finished import FinishedRun, finished_runs
from i2t.objects.named import read_meshes
from i2t.prediction.touch_model import Reading, TouchBatch
from i2t.recognition.recognizer import RecognizerConfig
from i2t.simulation.touches import touch_simulator
from i2t.types import ReturnCode, Touches
from i2t.viz.episode_report import EpisodeRecord

HIDDEN_OBJECT = "hammer"  # true object of the overview and of the episode
OTHER_CANDIDATES = ("star", "square", "cylinder", "screwdriver")
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])  # T_o_t of a skin over a stamp
EPISODE_CONFIG = RecognizerConfig(num_sites=24, num_particles=64, max_touches=5)


class Story:
    """A finished run, its predictions, and one episode of recognition."""

    def __init__(
        self, folder: Path, *, world: Recognition = PRESETS["paper"], config: RecognizerConfig = EPISODE_CONFIG
    ) -> None:
        self.folder, self.world, self.config = folder, world, config

    @property
    def finished(self) -> FinishedRun:
        """Finished run."""
        return finished_runs(self.folder)[0]

    @cached_property
    def run(self) -> TrainedRun:
        """Finished run with its pad model."""
        return load_trained_run(self.finished)

    @cached_property
    def unseen(self) -> Touches:
        """Touches of the hidden object, which is not in the training set."""
        dataset = self.run.dataset
        rows = dataset.touches.object == dataset.objects.index(HIDDEN_OBJECT)
        return dataset.select(rows & (dataset.touches.code != ReturnCode.AIR)).touches

    @cached_property
    def predicted(self) -> Reading:
        """Predicted readings of the unseen touches, unchecked because sensor noise may make forces negative."""
        touches = self.unseen
        pitch = self.run.predictor.window / touches.patch.shape[1]
        return self.run.predictor.predict_batch(
            TouchBatch(touches.patch, touches.view, pitch, touches.force, touches.nearest, touches.travel)
        )

    @cached_property
    def cosines(self) -> np.ndarray:
        """Cosine similarity of predicted and measured reading of each unseen touch."""
        predicted, measured = np.asarray(self.predicted.mean), self.unseen.reading
        norms = np.linalg.norm(predicted, axis=1) * np.linalg.norm(measured, axis=1)
        return np.sum(predicted * measured, axis=1) / np.where(norms > 0, norms, 1)

    @property
    def typical(self) -> int:
        """Index of the unseen touch of median cosine similarity."""
        return int(np.argsort(self.cosines)[len(self.cosines) // 2])

    @property
    def typical_pose(self) -> np.ndarray:
        """Pose (4, 4) of the tool on the hidden object where the typical touch meets its mesh."""
        T_o_t = inverse(self.unseen.T_w_o[self.typical]) @ self.unseen.T_w_t[self.typical]
        surface = i2t.prepare_surface(i2t.make_object(HIDDEN_OBJECT).mesh)
        T_o_t[:3, 3] += i2t.render_patch(surface, T_o_t).nearest * T_o_t[:3, 2]  # poses of a press have errors
        return T_o_t

    @cached_property
    def episode(self) -> EpisodeRecord:
        """Episode with the hidden object among five candidates, at the most informative sites."""
        world, meshes = self.world, read_meshes((*OTHER_CANDIDATES, HIDDEN_OBJECT))
        recognizer = i2t.ObjectRecognizer(jax.random.key(1), self.run.pad_model, meshes, config=self.config)
        hidden = i2t.prepare_surface(meshes[HIDDEN_OBJECT])
        touch = touch_simulator(jax.random.key(2), hidden, self.run.pad, errors=world.errors, limits=world.limits)
        state, poses, readings, beliefs = recognizer.init(), [], [], []
        while (site := recognizer.choose_touch(state)) is not None:
            result = touch(site.T_w_t)
            contact = int(result.code) != ReturnCode.AIR
            seen = recognizer.observe(
                site, result.reading, force=float(result.force), T_w_t=result.T_w_t, contact=contact
            )
            state, info = recognizer.update(state, seen)
            poses.append(result.T_w_t)
            readings.append(result.reading)
            beliefs.append(info.probability)
        names = list(meshes)
        return EpisodeRecord(
            list(meshes.values()), names, np.stack(poses), np.stack(readings), self.run.dataset.board,
            np.stack(beliefs), names.index(HIDDEN_OBJECT), True,
        )  # fmt: skip


Draw: TypeAlias = Callable[[Story], Figure]
