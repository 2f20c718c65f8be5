"""Register the sessions of a data set and replace their views by renderings at the registered poses.

    estimates = register_sessions(dataset, {"mug": surface})
    dataset = with_registered_views(dataset, {"mug": surface}, estimates)

The camera's noise and the error of its pose halve what a predictor could explain. Where the mesh of an object is known,
its registered pose describes the touched surface better than the camera does.
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
from i2t.patches.views import PatchView
from i2t.registration.contacts import contact_poses
from i2t.registration.session import SessionEstimate, SessionRegistrationConfig, register_session
from i2t.rendering.render import render_view
from i2t.runtime.batching import filled_batches, map_in_threads, select_rows
from i2t.types import Surface


def register_sessions(
    dataset: Dataset,
    surfaces: Mapping[str, Surface],
    *,
    config: SessionRegistrationConfig | None = None,
) -> dict[int, SessionEstimate]:
    """Estimate the poses of object and camera in every session that touched an object with a known surface.

    Args:
        dataset: Recorded or simulated touches.
        surfaces: Surfaces of objects by name, in one size class (`i2t.rendering.render.stack_surfaces`) for speed.
        config: Errors of the lab and options of the search, by default with the noise estimated from the views. Window
            and reach are taken from the data set.

    Returns:
        The estimates by session number. Sessions without contact or without a surface of their object are left out.
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
    estimates = map_in_threads(partial(register_session, config=config), calls.values())
    return dict(zip(calls, estimates, strict=True))


def depth_noise(patches: Float[np.ndarray, "n p p"], *, minimum: float = 20e-6) -> float:
    """Estimate the noise of a camera's pixels from the second differences of its views, most of which are near zero on
    surfaces (Immerkaer, "Fast noise variance estimation", 1996, with a median in place of the mean).

    Args:
        patches: `(n, p, p)` depths (m) of n patches of p x p pixels, as the camera measured them.
        minimum: Smallest standard deviation (m) to return.

    Returns:
        Standard deviation (m) of a pixel.
    """
    second = patches[:, 2:] - 2 * patches[:, 1:-1] + patches[:, :-2]
    inside = np.isfinite(second) & (patches[:, 1:-1] > 0) & (patches[:, 1:-1] < np.nanmax(patches))
    if not inside.any():
        return minimum
    # The median of the absolute value of a standard normal number is 0.6745.
    return max(float(np.median(np.abs(second[inside]))) / (0.6745 * np.sqrt(6)), minimum)


def with_registered_views(
    dataset: Dataset, surfaces: Mapping[str, Surface], estimates: Mapping[int, SessionEstimate]
) -> Dataset:
    """Replace the camera views of registered sessions by renderings of their objects at the estimated poses.

    Args:
        dataset: The touches that were registered.
        surfaces: Surfaces of the objects by name.
        estimates: Estimates of the sessions by session number.

    Returns:
        The data set with registered poses of objects. Sessions without an estimate stay unchanged.
    """
    touches = dataset.touches
    fields: dict[str, Any] = {name: np.array(getattr(touches, name)) for name in ("patch", "view", "nearest", "T_w_o")}
    for session, estimate in estimates.items():
        rows = np.flatnonzero(touches.session == session)
        surface = surfaces[dataset.objects[int(touches.object[rows[0]])]]
        T_o_t = np.linalg.inv(np.asarray(estimate.T_w_o, np.float64)) @ touches.T_w_t[rows]
        fields["T_w_o"][rows] = estimate.T_w_o
        for some in filled_batches(np.arange(len(rows)), 36):  # a single size, so that it is compiled once
            view = jax.device_get(_render(surface, jnp.float32(T_o_t[some]), dataset.window, dataset.reach))
            fields["patch"][rows[some]], fields["nearest"][rows[some]] = view.patch.depth, view.patch.nearest
            fields["view"][rows[some]] = view.depth
    return replace(dataset, touches=touches._replace(**fields))


@partial(jax.jit, static_argnames=("window", "reach"))
def _render(surface: Surface, T_o_t: Float[Array, "n 4 4"], window: float, reach: float) -> PatchView:
    return jax.vmap(partial(render_view, surface, window=window, reach=reach))(T_o_t)
