"""Data sets whose sessions are registered: objects where they really stood, and views as they really were.

    estimates = register_sessions(dataset, {"mug": surface})
    dataset = with_registered_views(dataset, {"mug": surface}, estimates)

The camera's noise and its wrong place cost a predictor half of what it could explain. Where the mesh of an object is
known, its registered pose tells better than the camera what the skin met.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from i2t.dataset import Dataset
from i2t.patches.views import WideView
from i2t.registration.contacts import contact_poses
from i2t.registration.session import SessionEstimate, SessionRegistrationConfig, register_session
from i2t.rendering.render import render_view
from i2t.runtime.batching import a_few_at_a_time, filled_batches, select_rows
from i2t.types import Surface

VIEWS_AT_ONCE = 36  # that are rendered by one program
MIN_DEPTH_NOISE_M = 20e-6
MEDIAN_OF_NORMAL = 0.6745  # median of the absolute value of a standard normal number


def register_sessions(
    dataset: Dataset,
    surfaces: Mapping[str, Surface],
    *,
    config: SessionRegistrationConfig | None = None,
) -> dict[int, SessionEstimate]:
    """Register every session whose object has a known surface and was met.

    Args:
        dataset: Recorded or simulated touches.
        surfaces: Of objects, by name, in one size class (`i2t.rendering.render.stack_surfaces`) for speed.
        config: What is known before, and how to search; left out, the defaults with the noise that the views show. Its
            window and reach are the data set's.

    Returns:
        The estimates by the number of the session.
    """
    touches = dataset.touches
    config = config or SessionRegistrationConfig(depth_noise=depth_noise(touches.patch))
    config = replace(config, window=dataset.window, reach=dataset.reach)
    met = contact_poses(touches)[1]
    calls = {}
    for session in np.unique(touches.session[met]):
        rows = np.flatnonzero(touches.session == session)
        surface = surfaces.get(dataset.objects[int(touches.object[rows[0]])])
        if surface is not None:
            calls[int(session)] = select_rows(touches, rows), surface
    found = a_few_at_a_time(partial(register_session, config=config), calls.values())
    return dict(zip(calls, found, strict=True))


def depth_noise(patches: Float[np.ndarray, "n p p"]) -> float:
    """Measure the noise of a camera's pixels by the second differences of its views, most of which surfaces leave near
    zero (Immerkaer, "Fast noise variance estimation", 1996, with a median in place of the mean).

    Args:
        patches: m, as the camera saw them.

    Returns:
        Standard deviation (m) of a pixel, at least `MIN_DEPTH_NOISE_M`.
    """
    second = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    inside = np.isfinite(second) & (patches[:, 1:-1] > 0) & (patches[:, 1:-1] < np.nanmax(patches))
    if not inside.any():
        return MIN_DEPTH_NOISE_M
    return max(float(np.median(np.abs(second[inside]))) / (MEDIAN_OF_NORMAL * np.sqrt(6)), MIN_DEPTH_NOISE_M)


def with_registered_views(
    dataset: Dataset, surfaces: Mapping[str, Surface], estimates: Mapping[int, SessionEstimate]
) -> Dataset:
    """Replace the views of registered sessions by renderings of their objects from where the tool really was.

    Args:
        dataset: The touches that were registered.
        surfaces: Of objects, by name.
        estimates: Of sessions, by number.

    Returns:
        The data set; poses of objects are the registered ones. Sessions without an estimate stay as they were.
    """
    touches = dataset.touches
    fields: dict[str, Any] = {name: np.array(getattr(touches, name)) for name in ("patch", "wide", "nearest", "T_w_o")}
    for session, estimate in estimates.items():
        rows = np.flatnonzero(touches.session == session)
        surface = surfaces[dataset.objects[int(touches.object[rows[0]])]]
        T_o_t = np.linalg.inv(np.asarray(estimate.T_w_o, np.float64)) @ touches.T_w_t[rows]
        fields["T_w_o"][rows] = estimate.T_w_o
        for some in filled_batches(np.arange(len(rows)), VIEWS_AT_ONCE):
            view = jax.device_get(_render(surface, jnp.float32(T_o_t[some]), dataset.window, dataset.reach))
            fields["patch"][rows[some]], fields["nearest"][rows[some]] = view.patch.depth, view.patch.nearest
            fields["wide"][rows[some]] = view.wide
    return replace(dataset, touches=touches._replace(**fields))


@partial(jax.jit, static_argnames=("window", "reach"))
def _render(surface: Surface, T_o_t: Float[Array, "n 4 4"], window: float, reach: float) -> WideView:
    return jax.vmap(partial(render_view, surface, window=window, reach=reach))(T_o_t)
