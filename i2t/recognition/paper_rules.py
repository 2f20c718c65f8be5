"""The paper's rules (`i2t.recognition.ensemble`) over whole episodes: readings predicted at the believed pose, and the
proprioception baseline, which knows only where contacts were.
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.geometry import inverse
from i2t.prediction.predictor import Predictor
from i2t.recognition import ensemble
from i2t.recognition.episodes import Episodes
from i2t.recognition.outcomes import MIN_LOAD_N, PRESSURE_GRID
from i2t.rendering.render import render_heights
from i2t.types import PATCH_PIXELS, REACH, WIDE_PIXELS, WIDE_WINDOW, Surface

BASELINE_LENGTH_M = 1e-3  # by which distances of contacts are divided before exp(-d)
RULES = {"votes": ensemble.votes, "average": ensemble.average, "product": ensemble.product}
MARGIN_PIXELS = (WIDE_PIXELS - PATCH_PIXELS) // 2  # of a wide view about its patch


def paper_rules(
    predictor: Predictor,
    reading_std: Float[np.ndarray, " c"],
    surfaces: Sequence[Surface],
    episodes: Episodes,
    view_noise: float = 0.0,
) -> dict[str, Float[np.ndarray, "e t objects"]]:
    """Beliefs by the paper's rules, from readings ("I2T") and from contact positions ("proprioception").

    Objects are taken to stand at the world's origin; each is rendered where the press ended and pressed with the
    measured force.

    Args:
        predictor: Of readings.
        reading_std: Standard deviation (uT) of each channel in the training data.
        surfaces: Of the objects.
        episodes: As they went.
        view_noise: Noise (m) of every pixel of objects that are known from a depth camera only.

    Returns:
        Beliefs after each touch, by source and rule, such as "I2T, votes".
    """
    T = jnp.asarray(episodes.T_w_t.reshape(-1, 4, 4))
    force = np.maximum(episodes.observations.force.reshape(-1), MIN_LOAD_N)
    # Rendered views have no noise to be smoothed away.
    predictor = predictor.with_pressure(smooth=view_noise > 0, cell=PRESSURE_GRID.spacing)
    rng = np.random.default_rng(0)
    predicted = [
        _predict_at_contacts(predictor, surface, T, force, view_noise=view_noise, rng=rng) for surface in surfaces
    ]
    distance = [np.asarray(_nearest_distances(T[:, :3, 3], surface)) for surface in surfaces]
    measured = jnp.asarray(np.asarray(episodes.observations.reading).reshape(len(T), -1))
    tau = ensemble.distances(measured, jnp.float32(np.stack(predicted, 1)), jnp.asarray(reading_std, jnp.float32))
    shape = (*episodes.site.shape, len(surfaces))
    sources = {
        "I2T": tau.reshape(shape),
        "proprioception": jnp.stack(distance, -1).reshape(shape) / BASELINE_LENGTH_M,
    }
    return {
        f"{source}, {name}": np.asarray(jax.jit(jax.vmap(rule))(values))
        for source, values in sources.items()
        for name, rule in RULES.items()
    }


def _predict_at_contacts(
    predictor: Predictor,
    surface: Surface,
    T_w_t: Float[Array, "n 4 4"],
    force: Float[np.ndarray, " n"],
    *,
    view_noise: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "n c"]:
    """Readings (uT) that a predictor expects where presses ended; zero where nothing is seen."""
    wide, seen = jax.device_get(_views(surface, T_w_t))
    inner = np.s_[:, MARGIN_PIXELS:-MARGIN_PIXELS, MARGIN_PIXELS:-MARGIN_PIXELS]
    if view_noise > 0:
        wide = wide + view_noise * rng.standard_normal(wide.shape, dtype=np.float32)
        wide = np.clip(wide - wide[inner].min((1, 2), keepdims=True), 0, REACH)
    blank = np.zeros(len(wide), np.float32)
    reading = predictor.predict(wide[inner], force=force, nearest=blank, wide=wide).mean
    return np.where(seen[:, None], reading, 0.0)


_nearest_distances = jax.jit(jax.vmap(ensemble.nearest_distance, (0, None)))


@jax.jit
def _views(surface: Surface, T_w_t: Array) -> tuple[Array, Array]:
    return jax.lax.map(partial(_view, surface), T_w_t, batch_size=64)


def _view(surface: Surface, T_w_t: Array) -> tuple[Array, Array]:
    """A wide view behind the patch's nearest point, as the camera's are (`i2t.simulation.touches`), and whether it
    shows any.
    """
    z = render_heights(surface, inverse(T_w_t), WIDE_WINDOW, WIDE_PIXELS)
    nearest = jnp.min(z[MARGIN_PIXELS:-MARGIN_PIXELS, MARGIN_PIXELS:-MARGIN_PIXELS])
    seen = jnp.isfinite(nearest)
    return jnp.clip(z - jnp.where(seen, nearest, 0.0), 0, REACH), seen
