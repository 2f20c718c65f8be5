"""Sources of touches, simulated or recorded, with the pad model that is fitted to each."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Array

from experiments.train.configs import Simulation
from experiments.train.simulate import simulated_dataset
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.hardware.rig import Rig
from i2t.models.finished import PAD, TOUCHES
from i2t.objects import Mesh, catalogue
from i2t.objects.named import read_meshes
from i2t.recognition.recorded import fit_pad_model, named_surfaces, with_placement
from i2t.simulation.touches import SimulationErrors
from i2t.skin.files import PadAbout, load_pad, load_pad_about, save_pad
from i2t.skin.pad import pad_from_seed
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import KnownPad, add_press_errors
from i2t.types import Pad

MIN_PAD_R2 = 0.5  # minimum R2 of a fitted pad at places left out


class KnownObjects(NamedTuple):
    """Meshes and placement errors of the touched objects."""

    meshes: dict[str, Mesh]  # of objects that are not in the catalogue, by name
    errors: SimulationErrors  # expected errors of their placement


@dataclass(frozen=True)
class SimulatedSource:
    """Touches that are simulated with one pad."""

    pad: int | str  # number or file of the pad
    plan: Simulation

    recording: ClassVar[None] = None

    def read_pad(self) -> tuple[Pad, PadAbout]:
        """Load the pad and its description (ValueError: the pad does not fit its own skin well enough)."""
        if isinstance(self.pad, int):
            return pad_from_seed(self.pad), PadAbout(f"simulated pad {self.pad}", "", 0.0)
        about = load_pad_about(self.pad)
        if about.r2_places is not None and not about.r2_places >= MIN_PAD_R2:
            raise ValueError(
                f"{self.pad} explains {about.r2_places:.2f} of the variance of its own skin's readings at places left "
                f"out, less than {MIN_PAD_R2:g}, so a model trained on it is not valid for that skin; train on "
                "recorded touches (--dataset)"
            )
        return load_pad(self.pad), about

    def known_objects(self) -> KnownObjects:
        """Return objects of the catalogue with the simulation's placement errors."""
        return KnownObjects({}, self.plan.errors)

    def dataset(self, seed: int, out: Path) -> Dataset:
        """Simulate the touches, and save them with their pad in the run's folder."""
        pad, about = self.read_pad()
        camera = self.pad if isinstance(self.pad, int) else 0
        dataset = simulated_dataset(self.plan, pad, out / TOUCHES, seed=seed, name=about.name, camera=camera)
        save_pad(out / PAD, pad, about={"pad": about.name})
        return dataset

    def pad_model(self, seed: int, dataset: Dataset, train: np.ndarray, objects: KnownObjects) -> KnownPad:
        """Fit a pad model to all touches of the training objects (ValueError: it cannot be fitted)."""
        about = self.read_pad()[1]
        made_from = f"experiments.train, pad {self.pad}{about.made_from}, seed {seed}"
        touches = simulated_touches(dataset, self.plan.train, made_from)
        fitted = ContactModel(objects.errors, self.plan.limits).fit(fit_key(seed), touches)
        return fitted._replace(model=add_press_errors(fitted.model, about.error_std)) if about.error_std else fitted


@dataclass(frozen=True)
class RecordedSource:
    """Recorded touches."""

    recording: Path
    skin: str | None  # name of the skin, if each touch has readings of several
    objects: tuple[Path, ...]  # mesh files of objects that are not in the catalogue
    unit: str | None  # unit of the mesh files whose names have none
    rig: Path | None  # description of the lab, with the covariance of object poses
    all_touches: bool  # whether the pad model is fitted to all touches instead of the training touches

    pad: ClassVar[None] = None

    def known_objects(self) -> KnownObjects:
        """Read the objects of the mesh files and the rig's placement errors (ValueError: a file cannot be read)."""
        errors = SimulationErrors()
        meshes = read_meshes(self.objects, self.unit)
        if self.rig:
            errors = with_placement(errors, Rig.read(self.rig).object_covariance)
        return KnownObjects(meshes, errors)

    def dataset(self, seed: int, out: Path) -> Dataset:
        """Load the recorded touches."""
        return data.load_dataset(self.recording, skin=self.skin)

    def pad_model(self, seed: int, dataset: Dataset, train: np.ndarray, objects: KnownObjects) -> KnownPad:
        """Fit a pad model to touches of objects whose mesh is known (ValueError: it cannot be fitted)."""
        rows = np.ones(len(dataset), bool) if self.all_touches else train
        made_from = f"experiments.train --dataset {self.recording}, seed {seed}"
        return fit_pad_model(
            dataset, objects.meshes, rows=rows, key=fit_key(seed), errors=objects.errors, made_from=made_from
        )


TouchSource: TypeAlias = SimulatedSource | RecordedSource


def fit_key(seed: int) -> Array:
    """Derive the random key for fitting a pad model."""
    return jax.random.split(jax.random.key(seed))[0]


def simulated_touches(dataset: Dataset, names: tuple[str, ...], made_from: str) -> ObjectTouches:
    """Select the simulated touches that a pad model is fitted to: those of the named objects of the catalogue."""
    rows = np.isin(dataset.touches.object, [dataset.objects.index(name) for name in names])
    touched = [dataset.objects[i] for i in np.unique(dataset.touches.object[rows])]
    meshes = {name: catalogue.make_object(name).mesh for name in touched}
    return ObjectTouches(dataset, rows, named_surfaces(meshes), made_from)
