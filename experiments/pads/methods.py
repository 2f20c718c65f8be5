"""The compared methods: each gives the positions of presses from their readings."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from experiments.pads.simulate import PROBE_FORCES_N, PROBE_TIP, REACH_M, SkinSession
from i2t import mlp, training
from i2t.calibration import localize
from i2t.calibration.localize import PressLibrary, WeightPosterior
from i2t.calibration.physics import LayerParameters, PadFit, layer_prior
from i2t.mlp import Layers
from i2t.prediction.metrics import nearest_neighbours
from i2t.skin.boards import reskin_board

LIBRARY_FORCES_N = np.linspace(*PROBE_FORCES_N, 3)
UNKNOWN_PAD_NOISE_UT = 4.0  # of a reading of a pad that nothing is known of: sensor, faults and layer
RIGHT_M = 1e-3  # within which a press counts as located
HIDDEN = (256, 256)
MINIBATCH_PRESSES = 128
NEIGHBOUR_COUNTS = (1, 2, 3, 5, 8)


def press_library(layer: LayerParameters, spacing: float, refinement: int = 2) -> PressLibrary:
    """Predicted readings of presses on a layer over the nominal board."""
    return localize.make_press_library(
        layer, reskin_board(), PROBE_TIP, reach=REACH_M, loads=LIBRARY_FORCES_N, spacing=spacing, refinement=refinement
    )


def by_unpressed_pad(library: PressLibrary, readings: Float[Array, "n c"]) -> Float[Array, "n 2"]:
    """Physics, on a pad that was never pressed."""
    return localize.localize(library, localize.pad_prior_weights(library, UNKNOWN_PAD_NOISE_UT), readings)[0]


def by_unlabelled_presses(
    library: PressLibrary, known: Float[Array, "m c"], readings: Float[Array, "n c"], spacing: float
) -> Float[Array, "n 2"]:
    """Physics, on a pad with presses whose positions nobody noted; weights are fitted on a coarser library."""
    coarse = press_library(nominal_layer(), spacing, refinement=1)
    weights = localize.fit_weights_without_positions(coarse, known, UNKNOWN_PAD_NOISE_UT)
    return localize.localize(library, weights, readings)[0]


def by_fitted_pad(library: PressLibrary, fitted: PadFit, readings: Float[Array, "n c"]) -> Float[Array, "n 2"]:
    """Physics, on a pad fitted to presses; the library is that of its layer."""
    weights = WeightPosterior(fitted.weights, fitted.precision_cholesky, fitted.layer.noise_std)
    amplified = library._replace(features=library.features * fitted.pad.gains[None, :, None])
    return localize.localize(amplified, weights, readings)[0]


def nominal_layer() -> LayerParameters:
    """The median of the layer's prior."""
    return layer_prior().median


def by_neighbours(known: SkinSession, readings: Float[Array, "n c"]) -> np.ndarray:
    """Mean position of the k nearest known readings; k from leave-one-out."""
    x, y = np.asarray(known.reading), np.asarray(known.position)
    distance = np.linalg.norm(x[:, None] - x[None], axis=-1)
    np.fill_diagonal(distance, np.inf)
    order = np.argsort(distance, axis=1)

    def missed(k: int) -> float:
        return float(np.mean(np.linalg.norm(y[order[:, :k]].mean(axis=1) - y, axis=1) > RIGHT_M))

    best = min((k for k in NEIGHBOUR_COUNTS if k < len(x)), key=missed)
    return nearest_neighbours(x, y, np.asarray(readings), best)


def by_network(
    key: Key[Array, ""], known: SkinSession, readings: Float[Array, "n c"], epochs: int
) -> Float[Array, "n 2"]:
    """Positions (m) by a network of two hidden layers, trained on known presses (AdamW, decayed)."""
    middle, scale = jnp.mean(known.reading, axis=0), jnp.std(known.reading, axis=0)
    x, y = (known.reading - middle[None]) / scale[None], known.position / REACH_M
    layers = _train(key, x, y, max(1, epochs * len(x) // MINIBATCH_PRESSES))
    return REACH_M * _positions(layers, (readings - middle[None]) / scale[None])


def _positions(layers: Layers, x: Float[Array, "n c"]) -> Float[Array, "n 2"]:
    return jax.vmap(lambda one: mlp.apply(layers, one, activation=jax.nn.gelu))(x)


@partial(jax.jit, static_argnums=3)
def _train(key: Key[Array, ""], x: Float[Array, "n c"], y: Float[Array, "n 2"], steps: int) -> Layers:
    key_weights, key_batches = jax.random.split(key)
    optimizer = optax.adamw(optax.cosine_decay_schedule(1e-3, steps), weight_decay=1e-3)

    def loss(layers: Layers, key: Key[Array, ""]) -> Array:
        rows = jax.random.randint(key, (MINIBATCH_PRESSES,), 0, len(x))
        return jnp.mean((_positions(layers, x[rows]) - y[rows]) ** 2)

    layers = mlp.init(key_weights, (x.shape[1], *HIDDEN, y.shape[1]))
    return training.descend(layers, loss, optimizer, jax.random.split(key_batches, steps))[0]
