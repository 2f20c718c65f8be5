"""Beliefs of an environment whose pads are calibrated: touches predicted for every pad, object and pose.

The reading of a calibrated pad is predicted with its own linear response (`i2t.skin.dipoles.linear_response`) on
contacts of the nominal layer, as in the rest of `i2t.recognition`. The errors of such predictions are measured on
separate touches of the same pads. An agent that observes the posterior therefore has a calibrated pad, whereas any
other agent has only readings of pads that may be new to it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t.geometry import to_twist
from i2t.recognition.environment import (
    EnvironmentConfig,
    EnvironmentParams,
    OutcomeTable,
    TouchBeliefs,
    TouchEnvironment,
)
from i2t.recognition.outcomes import PredictedTouch, interpolate_load
from i2t.recognition.site_pool import pose_particles, predict_outcomes
from i2t.recognition.touch_table import tabulate
from i2t.rendering.ops import element
from i2t.runtime.compiling import jit_quickly
from i2t.simulation.touches import read_session
from i2t.skin.dipoles import linear_response
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.likelihood import (
    TOUCH_ERRORS,
    fit_likelihood,
    fit_position_errors,
    outlier_range,
)
from i2t.skin_models.reading_model import LOADS_N, LinearReadingModel
from i2t.types import Pad


def with_beliefs(
    key: Key[Array, ""],
    environment: TouchEnvironment,
    params: EnvironmentParams,
    particles: int = 64,
    calibration_placements: int = 3,
) -> EnvironmentParams:
    """Add to an environment the predictions from which it computes its posterior over the objects.

    Args:
        key: Random key of the touches on which errors of predictions are measured.
        environment: The rules, with their errors, limits and press law.
        params: The objects and pads of the environment.
        particles: Number of poses of each object.
        calibration_placements: Number of placements of every object on which errors of predictions are measured.

    Returns:
        Parameters with `beliefs`.
    """
    config = environment.config
    key_touch, key_sensor = jax.random.split(key)
    table = tabulate(key_touch, environment, params, calibration_placements).table
    assert table is not None
    models = [_reading_model(response) for response in np.asarray(_linear_responses(params.pads))]
    there = _predict(params, to_twist(table.T_w_o), models, config.limits.overtravel)
    errors, ends, indentation = _errors(key_sensor, config, params, table, there)
    softness = np.sum(ends * indentation) / np.sum(indentation**2)
    density = TOUCH_ERRORS.outlier_rate / outlier_range(config.limits.overtravel)
    position = fit_position_errors(
        ends - softness * indentation,
        (TOUCH_ERRORS.indentation_error * softness * indentation) ** 2,
        outlier_density=density,
    )
    likelihood = fit_likelihood(
        errors, jnp.ones(params.channels), jnp.float32(LOADS_N),
        overtravel=config.limits.overtravel, position_std=position, stiffness=config.limits.stiffness,
    )  # fmt: skip
    poses = pose_particles(config.errors, particles, 0)
    predicted = _predict(params, poses.twist, models, config.limits.overtravel)
    predicted = predicted._replace(indentation=jnp.float32(softness) * predicted.indentation)
    return params._replace(beliefs=TouchBeliefs(predicted, likelihood, poses))


@jit_quickly
def _linear_responses(pads: Pad) -> Array:
    return jax.lax.map(lambda pad: linear_response(pad, CELL_GRID), pads)


def _reading_model(response: Float[np.ndarray, "c n n"]) -> LinearReadingModel:
    """Make the reading model of a pad: its response at every load, without uncertainty."""
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
    """Predict touches, (pads, sites, objects, k)."""
    surfaces = [element(params.surfaces, i) for i in range(params.objects)]
    touches = predict_outcomes(surfaces, twist, params.T_w_site, models, overtravel=overtravel, label="pads")
    return jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *touches)


def _errors(
    key: Array, config: EnvironmentConfig, params: EnvironmentParams, table: OutcomeTable, there: PredictedTouch
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute errors of touches whose object and placement are known.

    Return the errors of the readings (uT), the distances (m) from the predicted contact to the ends of the presses
    without the compliance of the arm, and the predicted indentations (m).
    """
    read = _read_sessions(key, table, params, config)
    actual = jax.tree.map(
        lambda x: jnp.moveaxis(x, 3, 1).reshape(-1, *x.shape[4:]), (read, *table.touches[1:])
    )  # pads, sites, objects, placements
    reading, force, advance, contact = actual
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[4:]), there)
    loads = jnp.float32(LOADS_N)
    indentation, predicted, _ = jax.vmap(lambda p, f: interpolate_load(p, loads, f))(flat, force)
    ends = advance - flat.approach_distance - force / config.limits.stiffness
    both = np.asarray(contact & flat.hit)
    return np.asarray(reading - predicted)[both], np.asarray(ends)[both], np.asarray(indentation)[both]


@jit_quickly
def _read_sessions(key: Array, table: OutcomeTable, params: EnvironmentParams, config: EnvironmentConfig) -> Array:
    """Read the touches of the table by the sensor, one site after the other in each placement."""
    touches = table.touches
    pads, objects, placements = touches.force.shape[:3]
    end = jnp.broadcast_to(params.T_w_site, (*touches.advance.shape, 4, 4))
    end = end.at[..., :3, 3].add(touches.advance[..., None] * end[..., :3, 2])

    def session(key: Array, reading: Array, T_w_t: Array, pad: Array) -> Array:
        worn = element(params.pads, pad)
        return read_session(key, reading, T_w_t, worn, config.errors, presses_before=config.presses_before)

    keys = jax.random.split(key, pads * objects * placements)
    rows = [x.reshape(len(keys), *x.shape[3:]) for x in (touches.reading, end)]
    read = jax.vmap(session)(keys, rows[0], rows[1], jnp.repeat(jnp.arange(pads), objects * placements))
    return read.reshape(touches.reading.shape)
