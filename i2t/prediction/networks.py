"""Networks as methods, on patches or on predicted contact pressure: the paper's network and others."""

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


@dataclass(frozen=True)
class PatchNetwork(TouchModel):
    """Model that predicts readings by an ensemble of networks on depth patches.

    Attributes:
        params: Parameters with members as axis 0.
        cfg: The paper's configuration, or a `ModelConfig`.
        normalisation: Scales between physical units and the network's.
    """

    params: Params
    cfg: PaperConfig
    normalisation: Normalisation

    @property
    def channels(self) -> int:
        """Number of values in a reading."""
        return self.normalisation.reading.mean.shape[-1]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        return self._readings(touches.patch, touches)

    def _readings(self, images: np.ndarray, touches: TouchBatch) -> Reading:
        """Predict readings from images (n, p, p): patches (m), or contact pressures (N)."""
        if images.shape[1] != self.cfg.pixels:
            raise ValueError(f"patch has {images.shape[1]} pixels an edge; this model takes {self.cfg.pixels}")
        conditions = touches.conditions(model.conditions_of(self.cfg))
        inputs = Inputs(*jax.device_put((np.float32(images), np.float32(conditions))))
        mean, std = _predict(self.cfg, self.params, self.normalisation, inputs)
        return Reading(np.asarray(mean), np.asarray(std))


@dataclass(frozen=True)
class PressureNetwork(PatchNetwork):
    """Model that predicts readings by an ensemble of networks on predicted contact pressure.

    Attributes:
        pressure: Configuration of the predicted contact pressure.
    """

    pressure: PressureModelConfig  # type: ignore[misc]

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict, as in `TouchModel.predict_batch`."""
        return self._readings(np.asarray(touches.pressures(self.pressure).pressure), touches)


ModelFactory: TypeAlias = Callable[[Params, PaperConfig, Normalisation], PatchNetwork]


class NetworkMethod(Method):
    """Method that trains networks to predict readings and keeps the epoch that is best on the validation touches."""

    @abstractmethod
    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, ModelFactory] | None:
        """Configure the network for a data set.

        Args:
            touches: All n touches.

        Returns:
            Configuration, `(n, p, p)` input images of all touches (p pixels along an edge), and the function that makes
            the model from parameters, configuration and normalisation; None if the touches lack an input of the
            network.
        """

    def fit(self, key: Key[Array, ""], touches: TrainingTouches, split: Split) -> Predictor | None:
        """Fit the network to the training touches.

        Args:
            key: Random key of the initial weights and minibatches.
            touches: All touches, for training and for the choice of the epoch.
            split: Split into training and validation touches.

        Returns:
            Fitted predictor, or None if the touches lack an input of the network.

        Raises:
            ValueError: The touches are unsuitable for training, or no epoch had a finite loss.
        """
        setup = self.network(touches)
        if setup is None:
            return None
        cfg, images, make_model = setup
        options, learner, n = touches.training, model.learner(cfg), int(split.train.sum())
        train, validation = (
            _batch(cfg, images, touches.dataset.touches, rows) for rows in (split.train, split.validation)
        )
        model.check(train, cfg, "training")
        model.check(validation, cfg, "validation")
        norm = _normalisation(train)
        train, validation = (_prepared(cfg, norm, batch) for batch in (train, validation))

        state, epoch = _start(key, learner, options, n), training.compiled(learner, options)
        history: list[list[float]] = []
        with progress(total=options.epochs, desc=f"training {self.title}", unit="epochs", at_most=True) as bar:
            while not training.finished(state, options):
                state, info = epoch(state, train, validation)
                history.append([float(np.asarray(losses.squared).mean()) for losses in info])
                bar.update(1)
                if len(history) % 10 == 0:
                    _check_finite(state, options)
        _check_finite(state, options)
        _warn_of_lost_epochs(history, self.title, options)
        norm = _with_residual(state.best_params, cfg, norm, validation)
        predictor = touches.predictor(make_model(state.best_params, cfg, norm), split)
        return replace(predictor, metadata={**(predictor.metadata or {}), "curve": history, "epochs": options.epochs})


class PaperDepth(NetworkMethod):
    """Method that trains the paper's network on depth patches, as in the paper's text."""

    title = "paper's network, depth"
    input: ClassVar[ImageKind] = "depth"

    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, ModelFactory] | None:
        """Configure the network, as in `NetworkMethod.network`."""
        seen, reach = touches.dataset.touches, touches.dataset.reach
        sizes = {"pixels": seen.patch.shape[1], "readings": seen.reading.shape[-1]}
        return PaperConfig(**asdict(touches.paper), input=self.input, reach=reach, **sizes), seen.patch, PatchNetwork


class PaperMask(PaperDepth):
    """Method that trains the paper's network on contact masks, as in the paper's published code."""

    title = "paper's network, mask"
    input = "mask"


class PaperDepthForce(PaperDepth):
    """Method that trains the paper's network on depth patches and measured forces, which the paper does not use."""

    title = "paper's network and measured force, depth"

    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, ModelFactory] | None:
        """Configure the network, as in `NetworkMethod.network`; return None without measured forces."""
        if "force" not in touches.measured or (plain := super().network(touches)) is None:
            return None
        cfg, images, make_model = plain
        return ModelConfig(**asdict(cfg), conditions=("force",)), images, make_model


class PaperMaskForce(PaperDepthForce):
    """Method that trains the paper's network on contact masks and measured forces, which the paper does not use."""

    title = "paper's network and measured force, mask"
    input = "mask"


class OnPressure(NetworkMethod):
    """Method that trains five networks on predicted contact pressure, and on force and travel if they were measured.

    Each network also predicts the variance of its reading.
    """

    title = "network on predicted contact pressure"
    cfg = ModelConfig(
        input="pressure", bottleneck=30, auxiliary=False, heteroscedastic=True, members=5,
        conditions=("force", "travel"),
    )  # fmt: skip

    def network(self, touches: TrainingTouches) -> tuple[PaperConfig, np.ndarray, ModelFactory] | None:
        """Configure the network, as in `NetworkMethod.network`; return None without predicted contact pressures."""
        if touches.pressure is None or touches.pressure_model is None:
            return None
        images = np.asarray(touches.pressure.pressure)
        sizes = {"pixels": images.shape[1], "readings": touches.dataset.touches.reading.shape[-1]}
        conditions = tuple(name for name in self.cfg.conditions if name in touches.measured)
        make_model = partial(PressureNetwork, pressure=touches.pressure_model)
        return replace(self.cfg, conditions=conditions, **sizes), images, make_model


# Each of these runs once for a network.
_normalisation = jit_quickly(model.normalisation)
_start = jit_quickly(training.init, static_argnames=("learner", "cfg", "touches"))
_prepared = jit_quickly(model.prepared, static_argnames="cfg")
_with_residual = jit_quickly(model.with_residual, static_argnames="cfg")


def _check_finite(state: training.TrainState, options: TrainConfig) -> None:
    """Stop a training without any finite loss: it has no parameters to keep, and later ones will be no better."""
    if not np.isfinite(state.best_loss).all():
        raise ValueError(
            f"the loss on the validation touches was not finite in any of the first {int(state.epoch.max())} epochs; "
            f"lower TrainConfig.learning_rate ({options.learning_rate:g}), or look for extreme readings or images"
        )


def _warn_of_lost_epochs(history: list[list[float]], title: str, options: TrainConfig) -> None:
    """Warn of epochs without a finite loss, from which no network is kept."""
    if lost := int(np.sum(~np.isfinite(history).all(1))):
        warnings.warn(
            f"{title}: the loss was not finite in {lost} of {len(history)} epochs, and the best of the others is kept; "
            f"lower TrainConfig.learning_rate ({options.learning_rate:g})",
            stacklevel=3,
        )


def _batch(cfg: PaperConfig, images: np.ndarray, touches: Touches, rows: np.ndarray) -> Batch:
    """Collect the training batch of the touches in `rows`."""
    conditions = np.float32(stacked(touches, model.conditions_of(cfg))[rows])
    seen, given, readings = jax.device_put((images[rows], conditions, touches.reading[rows]))
    return Batch(Inputs(seen, given), readings)


@partial(jax.jit, static_argnums=0)
def _predict(cfg: PaperConfig, params: Params, norm: Normalisation, inputs: Inputs) -> tuple[Array, Array]:
    return jax.vmap(partial(model.predict, params, cfg, norm))(inputs)
