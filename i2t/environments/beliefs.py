"""The posterior of an environment whose pads were calibrated: touches predicted for every pad, object and pose.

What a calibrated pad would read is predicted with its own linear response (`i2t.environments.press.response_map`) on
contacts of the nominal layer, as `i2t.recognition` does; how far such predictions are off is measured on touches of the
same pads, made for that alone. An agent that is shown the posterior therefore knows its pad. One that is not sees
readings only, of pads that it may never have met.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t.environments.core import EnvironmentParams, TouchBeliefs, TouchEnvironment, sensor_noise
from i2t.environments.tables import tabulate
from i2t.geometry import to_twist
from i2t.recognition.outcomes import PredictedTouch, interpolate_load
from i2t.recognition.site_pool import pose_particles, predict_outcomes
from i2t.rendering.ops import element
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.likelihood import (
    INDENTATION_ERROR,
    OUTLIER_RATE,
    fit_likelihood,
    fit_position_errors,
    outlier_range,
)
from i2t.skin_models.reading_model import LOADS_N, LinearReadingModel

CALIBRATION_PLACEMENTS = 3  # of every object, on which errors of predictions are measured


def with_beliefs(
    key: Key[Array, ""],
    environment: TouchEnvironment,
    params: EnvironmentParams,
    particles: int = 64,
) -> EnvironmentParams:
    """Give an environment a posterior over its objects.

    Args:
        key: random key of the touches on which errors of predictions are measured.
        environment: whose task is which object it is, and whose actions are sites.
        params: what may be there.
        particles: poses in which each object may stand.

    Returns:
        The parameters with `beliefs`.
    """
    config = environment.config
    key_touch, key_noise = jax.random.split(key)
    calibration = tabulate(key_touch, environment, params, CALIBRATION_PLACEMENTS).table
    assert calibration is not None
    models = [_reading_model(response) for response in np.asarray(params.response)]
    there = _predict(params, to_twist(calibration.T_w_o), models, config.limits.overtravel)
    errors, ends, indentation = _errors(key_noise, environment, params, calibration.outcome, there)
    softness = np.sum(ends * indentation) / np.sum(indentation**2)
    density = OUTLIER_RATE / outlier_range(config.limits.overtravel)
    position = fit_position_errors(
        ends - softness * indentation, (INDENTATION_ERROR * softness * indentation) ** 2, outlier_density=density
    )
    likelihood = fit_likelihood(
        errors, jnp.ones(params.channels), jnp.float32(LOADS_N),
        overtravel=config.limits.overtravel, position_std=position, stiffness=config.limits.stiffness,
    )  # fmt: skip
    poses = pose_particles(config.errors, particles, 0)
    predicted = _predict(params, poses.twist, models, config.limits.overtravel)
    predicted = predicted._replace(indentation=jnp.float32(softness) * predicted.indentation)
    return params._replace(beliefs=TouchBeliefs(predicted, likelihood, poses))


def _reading_model(response: Float[np.ndarray, "c n n"]) -> LinearReadingModel:
    """A pad's response at every load, without an uncertainty of its own."""
    loads, cells = len(LOADS_N), CELL_GRID.cells**2
    newton = response.reshape(len(response), cells).T / CELL_GRID.spacing**2
    return LinearReadingModel(
        loads=jnp.float32(LOADS_N),
        mean=jnp.broadcast_to(jnp.float32(newton), (loads, *newton.shape)),
        root=jnp.zeros((loads, cells, 1)),
        scale=jnp.ones(len(response)),
        softness=jnp.ones(()),
    )


def _predict(
    params: EnvironmentParams, twist: Float[Array, "k 6"], models: list[LinearReadingModel], overtravel: float
) -> PredictedTouch:
    """Predicted touches, (pads, sites, objects, k)."""
    surfaces = [element(params.surfaces, i) for i in range(params.objects)]
    made = predict_outcomes(surfaces, twist, params.T_w_site, models, overtravel=overtravel)
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *made)


def _errors(
    key: Array, environment: TouchEnvironment, params: EnvironmentParams, outcome: tuple, there: PredictedTouch
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of the readings (uT) of touches whose object and placement are known; how far their presses went past the
    predicted contact, less the compliance of the arm (m), and the predicted indentations (m).
    """
    actual = jax.tree.map(lambda x: jnp.moveaxis(x, 3, 1).reshape(-1, *x.shape[4:]), outcome)  # pads, sites, ...
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[4:]), there)
    loads = jnp.float32(LOADS_N)
    indentation, reading, _ = jax.vmap(lambda p, f: interpolate_load(p, loads, f))(flat, actual.force)
    board, noise = element(params.pads.board, 0), environment.config.errors.noise
    drawn = jax.vmap(lambda k: sensor_noise(k, board, noise))(jax.random.split(key, len(reading)))
    ends = actual.advance - flat.approach_distance - actual.force / environment.config.limits.stiffness
    both = np.asarray(actual.contact & flat.hit)
    return (
        np.asarray(actual.reading + drawn - reading)[both],
        np.asarray(ends)[both],
        np.asarray(indentation)[both],
    )
