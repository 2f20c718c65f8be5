"""The paper's network and others as methods: fitted to patches, or to predicted contact pressure."""

import warnings
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import ClassVar, TypeAlias

import jax
import numpy as np
from jaxtyping import Array, Key

from i2t import training
from i2t.contact.pressure import PressureModelConfig
from i2t.dataset import Split
from i2t.paper.config import ImageKind, PaperConfig
from i2t.paper.network import Params
from i2t.prediction import model
from i2t.prediction.methods import Method, TrainingTouches
from i2t.prediction.model import Inputs, ModelConfig, Normalisation
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel, stacked
from i2t.runtime.compiling import jit_quickly
from i2t.runtime.progress import progress
from i2t.training import Batch, TrainConfig
from i2t.types import Touches

EPOCHS_BETWEEN_CHECKS = 10


@dataclass(frozen=True)
class PatchNetwork(TouchModel):
    """A network on depth patches.

    Attributes:
        params: Members as axis 0.
        cfg: The paper's configuration, or a `ModelConfig`.
        normalisation: What turns physical units into the network's and back.
    """

    params: Params
    cfg: PaperConfig
    normalisation: Normalisation

    @property
    def channels(self) -> int:
        """Values of a reading."""
        return self.normalisation.reading.mean.shape[-1]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        return self._readings(touches.patch, touches)

    def _readings(self, images: np.ndarray, touches: TouchBatch) -> Reading:
        """Readings from images (n, p, p): patches (m), or contact pressures (N)."""
        if images.shape[1] != self.cfg.pixels:
            raise ValueError(f"patch has {images.shape[1]} pixels an edge; this model sees {self.cfg.pixels}")
        conditions = touches.conditions(model.conditions_of(self.cfg))
        inputs = Inputs(*jax.device_put((np.float32(images), np.float32(conditions))))
        mean, std = _predict(self.cfg, self.params, self.normalisation, inputs)
        return Reading(np.asarray(mean), np.asarray(std))


@dataclass(frozen=True)
class PressureNetwork(PatchNetwork):
    """A network on predicted contact pressure.

    Attributes:
        pressure: How contact pressure is predicted.
    """

    pressure: PressureModelConfig  # type: ignore[misc]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        return self._readings(np.asarray(touches.pressures(self.pressure).pressure), touches)


Made: TypeAlias = Callable[[Params, PaperConfig, Normalisation], PatchNetwork]


class NetworkMethod(Method):
    """A network, trained to the best epoch on the validation touches."""

    @abstractmethod
    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, Made] | None:
        """Configure the network.

        Args:
            touches: All touches.

        Returns:
            The configuration, what it sees of all touches (n, p, p), and what makes the model of parameters,
            configuration and normalisation; None where touches lack what it sees.
        """

    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit the network that the touches allow.

        Args:
            key: A JAX key, of initial weights and minibatches.
            touches: To fit to, and to choose the best epoch by.
            split: Which of them are for what.

        Returns:
            The predictor; None where touches lack what the network sees.

        Raises:
            ValueError: Touches cannot be learned from, or no epoch had a finite loss.
        """
        found = self.network(touches)
        if found is None:
            return None
        cfg, images, made = found
        how, learner, n = touches.training, model.learner(cfg), int(split.train.sum())
        train, validation = (
            _batch(cfg, images, touches.dataset.touches, rows) for rows in (split.train, split.validation)
        )
        model.check(train, cfg, "training")
        model.check(validation, cfg, "validation")
        norm = _normalisation(train)
        train, validation = (_prepared(cfg, norm, batch) for batch in (train, validation))

        state, epoch = _start(key, learner, how, n), training.compiled(learner, how)
        history: list[list[float]] = []
        with progress(total=how.epochs, desc=f"training {self.title}", unit="epoch") as bar:
            while not training.finished(state, how):
                state, info = epoch(state, train, validation)
                history.append([float(np.asarray(losses.squared).mean()) for losses in info])
                bar.update(1)
                if len(history) % EPOCHS_BETWEEN_CHECKS == 0:
                    _check_finite(state, how)
        _check_finite(state, how)
        _warn_of_lost_epochs(history, self.title, how)
        norm = _with_residual(state.best_params, cfg, norm, validation)
        predictor = touches.predictor(made(state.best_params, cfg, norm), split)
        return replace(predictor, metadata={**(predictor.metadata or {}), "curve": history, "epochs": how.epochs})


class PaperDepth(NetworkMethod):
    """The paper's network on depths, as in its text."""

    title = "paper's network, depth"
    input: ClassVar[ImageKind] = "depth"

    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, Made] | None:
        """Configure the network, as in `NetworkMethod.network`."""
        seen, reach = touches.dataset.touches, touches.dataset.reach
        sizes = {"pixels": seen.patch.shape[1], "readings": seen.reading.shape[-1]}
        return PaperConfig(**asdict(touches.paper), input=self.input, reach=reach, **sizes), seen.patch, PatchNetwork


class PaperMask(PaperDepth):
    """The paper's network on contact masks, as in its published code."""

    title = "paper's network, mask"
    input = "mask"


class PaperDepthForce(PaperDepth):
    """The paper's network on depths and, which the paper does not have, the measured force of each touch."""

    title = "paper's network and measured force, depth"

    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, Made] | None:
        """Configure the network, as in `NetworkMethod.network`; it needs measured forces."""
        if "force" not in touches.measured or (plain := super().network(touches)) is None:
            return None
        cfg, images, made = plain
        return ModelConfig(**asdict(cfg), conditions=("force",)), images, made


class PaperMaskForce(PaperDepthForce):
    """The same on contact masks."""

    title = "paper's network and measured force, mask"
    input = "mask"


class OnPressure(NetworkMethod):
    """Networks on predicted contact pressure and measured conditions, each with a variance of its own."""

    title = "network on predicted contact pressure"
    cfg = ModelConfig(
        input="pressure", bottleneck=30, auxiliary=False, heteroscedastic=True, members=5, conditions=("force", "depth")
    )

    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, Made] | None:
        """Configure the network, as in `NetworkMethod.network`; it needs predicted pressures."""
        if touches.pressure is None or touches.pressure_model is None:
            return None
        images = np.asarray(touches.pressure.pressure)
        sizes = {"pixels": images.shape[1], "readings": touches.dataset.touches.reading.shape[-1]}
        known = tuple(name for name in self.cfg.conditions if name in touches.measured)
        made = partial(PressureNetwork, pressure=touches.pressure_model)
        return replace(self.cfg, conditions=known, **sizes), images, made


# Each runs once for a network.
_normalisation = jit_quickly(model.normalisation)
_start = jit_quickly(training.init, static_argnames=("learner", "cfg", "touches"))
_prepared = jit_quickly(model.prepared, static_argnames="cfg")
_with_residual = jit_quickly(model.with_residual, static_argnames="cfg")


def _check_finite(state: training.TrainState, how: TrainConfig) -> None:
    """Stop a training without any finite loss: it kept no parameters, and later ones will be no better."""
    if not np.isfinite(state.best_loss).all():
        raise ValueError(
            f"the loss on the validation touches was not finite in any of the first {int(state.epoch.max())} epochs; "
            f"lower the learning rate ({how.learning_rate:g}, of TrainConfig), or look for extreme readings or images"
        )


def _warn_of_lost_epochs(history: list[list[float]], title: str, how: TrainConfig) -> None:
    """Warn of epochs without a finite loss, after which a network was kept from another."""
    if lost := int(np.sum(~np.isfinite(history).all(1))):
        warnings.warn(
            f"{title}: the loss was not finite in {lost} of {len(history)} epochs, and the best of the others is kept; "
            f"lower the learning rate ({how.learning_rate:g}, of TrainConfig)",
            stacklevel=3,
        )


def _batch(cfg: PaperConfig, images: np.ndarray, touches: Touches, rows: np.ndarray) -> Batch:
    """The touches in `rows` as a network is trained on them."""
    conditions = np.float32(stacked(touches, model.conditions_of(cfg))[rows])
    seen, given, readings = jax.device_put((images[rows], conditions, touches.reading[rows]))
    return Batch(Inputs(seen, given), readings)


@partial(jax.jit, static_argnums=0)
def _predict(cfg: PaperConfig, params: Params, norm: Normalisation, inputs: Inputs) -> tuple[Array, Array]:
    return jax.vmap(partial(model.predict, params, cfg, norm))(inputs)
