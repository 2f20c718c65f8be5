"""Sources of touches to train on: a simulated pad, or a recording; and what the pad model of each is fitted to."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple, TypeAlias

import jax
import numpy as np
from jaxtyping import Array

from experiments.train.configs import Simulation
from experiments.train.finished import PAD, TOUCHES
from experiments.train.simulate import simulated_dataset
from i2t import dataset as data
from i2t.contact.press import PressLimits
from i2t.dataset import Dataset
from i2t.hardware.rig import Rig
from i2t.objects import Mesh, catalogue
from i2t.objects.named import read_object
from i2t.recognition.recorded import named_surfaces, recorded_touches, with_placement
from i2t.simulation.touches import SimulationErrors
from i2t.skin.files import PadAbout, load_pad, load_pad_about, save_pad
from i2t.skin.pad import pad_from_seed
from i2t.skin_models.pad_fit import ContactModel, ObjectTouches
from i2t.skin_models.pad_model import KnownPad, add_press_errors
from i2t.types import Pad

MIN_PAD_R2 = 0.5  # at places left out: below it the fitted layer is not what was pressed


class ObjectsKnown(NamedTuple):
    """What is known of the objects that were touched."""

    meshes: dict[str, Mesh]  # of those that the catalogue does not have, by name
    errors: SimulationErrors  # how far they may be from where they are believed


@dataclass(frozen=True)
class SimulatedSource:
    """Touches that are simulated with one pad."""

    pad: int | str  # its number, or its file
    plan: Simulation

    recording: ClassVar[None] = None

    def read_pad(self) -> tuple[Pad, PadAbout]:
        """The pad and its description."""
        if isinstance(self.pad, int):
            return pad_from_seed(self.pad), PadAbout(f"simulated pad {self.pad}", "", 0.0)
        about = load_pad_about(self.pad)
        if about.r2_places is not None and not about.r2_places >= MIN_PAD_R2:
            raise ValueError(
                f"{self.pad} explains {about.r2_places:.2f} of the variance of its own skin's readings at places left "
                f"out, less than {MIN_PAD_R2:g}, so that what is trained on it says nothing about that skin; train on "
                "recorded touches (--dataset)"
            )
        return load_pad(self.pad), about

    def objects_known(self) -> ObjectsKnown:
        """Objects of the catalogue, as far off as the simulation puts them."""
        return ObjectsKnown({}, self.plan.errors)

    def dataset(self, seed: int, out: Path) -> Dataset:
        """The touches, which are kept in the run's folder with their pad."""
        pad, about = self.read_pad()
        camera = self.pad if isinstance(self.pad, int) else 0
        dataset = simulated_dataset(self.plan, pad, out / TOUCHES, seed=seed, name=about.name, camera=camera)
        save_pad(out / PAD, pad, about={"pad": about.name})
        return dataset

    def pad_model(self, seed: int, dataset: Dataset, train: np.ndarray, known: ObjectsKnown) -> KnownPad:
        """Fit a pad model to all touches of the training objects (ValueError: none can be)."""
        about = self.read_pad()[1]
        made_from = f"experiments.train, pad {self.pad}{about.made_from}, seed {seed}"
        touches = simulated_touches(dataset, self.plan.train, made_from)
        fitted = ContactModel(known.errors, self.plan.limits).fit(fit_key(seed), touches)
        return fitted._replace(model=add_press_errors(fitted.model, about.error_std)) if about.error_std else fitted


@dataclass(frozen=True)
class RecordedSource:
    """Touches that were recorded."""

    recording: Path
    skin: str | None  # of several in each touch, the one that is meant
    objects: tuple[Path, ...]  # mesh files of objects that the catalogue does not have
    unit: str | None  # of these files
    rig: Path | None  # of the lab: how far its objects may be off
    all_touches: bool  # whether the pad model is fitted to all touches, and not to those that methods train on

    pad: ClassVar[None] = None

    def objects_known(self) -> ObjectsKnown:
        """Objects of the files, as far off as the rig says (ValueError: a file cannot be read)."""
        errors = SimulationErrors()
        meshes = {path.stem: read_object(str(path), self.unit).mesh for path in self.objects}
        return ObjectsKnown(
            meshes, with_placement(errors, Rig.read(self.rig).object_covariance) if self.rig else errors
        )

    def dataset(self, seed: int, out: Path) -> Dataset:
        """The recorded touches, which stay where they are."""
        return data.load_dataset(self.recording, skin=self.skin)

    def pad_model(self, seed: int, dataset: Dataset, train: np.ndarray, known: ObjectsKnown) -> KnownPad:
        """Fit a pad model to touches of objects whose mesh is known (ValueError: none can be)."""
        rows = np.ones(len(dataset), bool) if self.all_touches else train
        made_from = f"experiments.train --dataset {self.recording}, seed {seed}"
        touches = recorded_touches(dataset, rows, known.meshes, made_from)
        return ContactModel(known.errors, PressLimits()).fit(fit_key(seed), touches)


TouchSource: TypeAlias = SimulatedSource | RecordedSource


def fit_key(seed: int) -> Array:
    """Key of a pad model's fit."""
    return jax.random.split(jax.random.key(seed))[0]


def simulated_touches(dataset: Dataset, names: tuple[str, ...], made_from: str) -> ObjectTouches:
    """The simulated touches that a pad model is fitted to: all of the catalogue's objects that are trained on."""
    rows = np.isin(dataset.touches.object, [dataset.objects.index(name) for name in names])
    touched = [dataset.objects[i] for i in np.unique(dataset.touches.object[rows])]
    meshes = {name: catalogue.make_object(name).mesh for name in touched}
    return ObjectTouches(dataset, rows, named_surfaces(meshes), made_from)
