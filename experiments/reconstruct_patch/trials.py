"""Touches of one part with one pad, what each method makes of them, and how that is scored.

A method gives weights of the library's patches (one gives pixels). Weights are compiled for each method; how they are
scored is the same for all and compiled once.
"""

from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.reconstruct_patch import methods, scores
from experiments.reconstruct_patch.scores import MetSurface
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PressModel
from i2t.reconstruction.press_curves import PressCurve
from i2t.types import Array, Pad

Scores = dict[str, np.ndarray]


class Trial(NamedTuple):
    """Presses of one part with one pad, and what that pad reads at the library."""

    pad: Pad
    model: PressModel
    presses: PressCurve
    truth: MetSurface

    def with_likelihood(self, likelihood: PatchLikelihood) -> "Trial":
        """The same trial, imagined with another likelihood."""
        return self._replace(model=self.model._replace(likelihood=likelihood))


class ShapeMethod(NamedTuple):
    """A method: its estimate of a press, `infer(press, fitted, library)`, and what is fitted to each pad."""

    infer: Callable[..., Any]  # weights of the library's patches; or mask, depth and deviation of coarse pixels
    fitted: Sequence[Any]
    blurs: Sequence[float | Array]  # of the weighted masks (pixels), for each pad


def by_imagination(models: Sequence[PressModel], *, first_stop_only: bool = False) -> ShapeMethod:
    """Bayes with a forward model of each pad."""
    infer = _bayes_first if first_stop_only else methods.bayes_weights
    return ShapeMethod(infer, models, [model.likelihood.blur for model in models])


def by_prior(models: Sequence[PressModel]) -> ShapeMethod:
    """Equal weights for every patch, whatever was read."""
    return ShapeMethod(_alike, models, [0.0] * len(models))


def by_neighbours(seen: Sequence[tuple[Array, Array]], count: int) -> ShapeMethod:
    """The nearest imagined presses; `seen` are their features and the features' spreads."""
    return ShapeMethod(_neighbours, [(*own, count) for own in seen], [1.0] * len(seen))


def by_network(networks: Sequence[methods.PixelNetwork]) -> ShapeMethod:
    """A network from readings to pixels."""
    return ShapeMethod(_pixels, networks, [0.0] * len(networks))


def by_tactile_image(pads: int, width: float, *, first_stop_only: bool = False) -> ShapeMethod:
    """A perfect tactile image of 1 mm."""
    return ShapeMethod(_image_first if first_stop_only else _image, [width] * pads, [0.0] * pads)


def score_touches(method: ShapeMethod, trials: Sequence[Trial], library: PatchLibrary) -> Scores:
    """Scores of the touches of all pads, one pad after the other."""
    parts = []
    for trial, fitted, blur in zip(trials, method.fitted, method.blurs, strict=True):
        presses, truth = jax.tree.map(jnp.asarray, (trial.presses, trial.truth))
        found = _infer_all(method.infer)(presses, fitted, library)
        score = (
            _score_pixels
            if method.infer is _pixels
            else partial(_score_weights, library=library, blur=jnp.float32(blur))
        )
        parts.append(jax.device_get(score(found, presses.force[:, -1], truth)))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@cache
def _infer_all(infer: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a method's estimates of all presses of one pad, one after the other."""
    return jax.jit(lambda presses, fitted, library: jax.lax.map(lambda press: infer(press, fitted, library), presses))


@jax.jit
def _score_weights(
    weight: Array, force: Array, truth: MetSurface, *, library: PatchLibrary, blur: Array
) -> dict[str, Array]:
    def score(each: tuple[Array, Array, MetSurface]) -> dict[str, Array]:
        own_weight, own_force, own_truth = each
        return scores.score_weights(own_weight, own_force, own_truth, library, blur)

    return jax.lax.map(score, (weight, force, truth))


@jax.jit
def _score_pixels(pixels: tuple[Array, Array, Array], force: Array, truth: MetSurface) -> dict[str, Array]:
    def score(each: tuple[tuple[Array, Array, Array], MetSurface]) -> dict[str, Array]:
        (mask, depth, std), own_truth = each
        return scores.score_pixels(mask, depth, std, own_truth)

    return jax.lax.map(score, (pixels, truth))


def _alike(press: PressCurve, model: PressModel, library: PatchLibrary) -> Array:
    count = len(library.patch)
    return jnp.full(count, 1 / count)


def _bayes_first(press: PressCurve, model: PressModel, library: PatchLibrary) -> Array:
    return methods.bayes_weights(methods.first_stop(press), model, library)


def _neighbours(press: PressCurve, seen: tuple[Array, Array, Array], library: PatchLibrary) -> Array:
    return methods.neighbour_weights(press, *seen)


def _pixels(press: PressCurve, network: methods.PixelNetwork, library: PatchLibrary) -> tuple[Array, Array, Array]:
    return methods.network_pixels(network, press)


def _image(press: PressCurve, width: Array, library: PatchLibrary) -> Array:
    return methods.image_weights(press, library, width)


def _image_first(press: PressCurve, width: Array, library: PatchLibrary) -> Array:
    return methods.image_weights(methods.first_stop(press), library, width)
