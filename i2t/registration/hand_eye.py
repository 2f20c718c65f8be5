"""Estimate the offset of a camera that stays mounted, from several registered sessions, and correct its views.

    estimates = register_sessions(dataset, {"mug": surface})  # sessions on objects whose mesh is known
    hand_eye = pool_hand_eye(list(estimates.values()))
    dataset = with_hand_eye(dataset, hand_eye.T_t_camera)  # all sessions, including those on unknown objects

The error of an object's pose is new in each session, but that of the camera's pose stays as long as the camera is not
removed. Sessions on known objects therefore determine the camera's pose, with which views of unknown objects can be
corrected. The estimates of the sessions are normal distributions with a common prior, which counts once: the posterior
is the product of all likelihoods and this prior.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from jaxtyping import Array, Float

from i2t.dataset import Dataset
from i2t.geometry import apply, from_twist, full_precision, inverse, to_twist
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.patches.views import PatchView, complete_views, view_of_noisy_heights
from i2t.registration.session import SessionEstimate, SessionRegistrationConfig
from i2t.runtime.batching import filled_batches
from i2t.types import Array as AnyArray


class HandEye(NamedTuple):
    """Offset of the camera from its hand-eye calibration, common to several sessions: a pose in tool axes, the
    covariance (m^2) of its twist, the disagreement of the sessions (in standard deviations) and their number.

    Example:
        hand_eye = pool_hand_eye(list(estimates.values()))
        hand_eye.T_t_camera[:3, 3]  # m, offset of the camera
    """

    T_t_camera: Float[np.ndarray, "4 4"]  # pose of the camera in tool axes, relative to the hand-eye calibration
    covariance: Float[np.ndarray, "6 6"]  # m^2, covariance of the twist (`i2t.geometry.from_twist`) of `T_t_camera`
    disagreement: float  # root mean square difference of the sessions, in standard deviations of their errors; about 1
    num_sessions: int  # number of pooled sessions


def pool_hand_eye(estimates: Sequence[SessionEstimate], *, config: SessionRegistrationConfig | None = None) -> HandEye:
    """Pool the sessions' estimates of the offset of a camera that stayed mounted from session to session.

    Args:
        estimates: Estimates of sessions by `register_session`.
        config: The configuration with which they were registered, for its prior of the camera.

    Returns:
        The camera's offset with its covariance. Where sessions differ by more than their covariances allow, the
        covariance is widened by the ratio (Birge, "The calculation of errors by the method of least squares", 1932).

    Raises:
        ValueError: There is no estimate.
    """
    if not estimates:
        raise ValueError("estimates: the list is empty; register sessions on objects whose mesh is known")
    std = np.asarray((config or SessionRegistrationConfig()).std, np.float64)[6:]
    # In standard deviations of the prior, whose covariance is then the unit matrix.
    twists = np.array([np.asarray(to_twist(session.T_t_camera), np.float64) / std for session in estimates])
    scale = np.outer(std, std)
    covariance = np.array([np.asarray(session.covariance, np.float64)[6:, 6:] / scale for session in estimates])
    posterior = np.linalg.inv(covariance)
    likelihood, weighted = np.linalg.eigh(posterior - np.eye(6)), np.einsum("sij,sj->si", posterior, twists)
    values = np.maximum(likelihood.eigenvalues, 0)
    information = np.einsum("sik,sk,sjk->sij", likelihood.eigenvectors, values, likelihood.eigenvectors)
    total = np.eye(6) + information.sum(0)
    mean = np.linalg.solve(total, weighted.sum(0))
    residual = np.einsum("sik,si->sk", likelihood.eigenvectors, weighted - information @ mean)
    counted = values > 1  # directions in which the touches hold more information than the prior
    chi_square = float(np.sum(residual[counted] ** 2 / values[counted]))
    freedom = int(counted.sum()) - 6
    disagreement = float(np.sqrt(chi_square / freedom)) if freedom > 0 else 1.0
    widened = np.linalg.inv(total) * max(1.0, disagreement) ** 2
    return HandEye(np.asarray(from_twist(std * mean), np.float64), scale * widened, disagreement, len(estimates))


def with_hand_eye(
    dataset: Dataset,
    T_t_camera: Float[AnyArray, "4 4"],
    *,
    tool_offset_at_capture: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Dataset:
    """Correct all views of a data set for the camera's offset, as far as the view covers the corrected pixels.

    Each pixel of a corrected view takes the height that the camera measured on its line of sight, found by fixed-point
    iteration and interpolated between pixels. Pixels at the edge of a view are repeated beyond it.

    Args:
        dataset: Touches with views.
        T_t_camera: Pose of the camera in tool axes, relative to the hand-eye calibration.
        tool_offset_at_capture: Position (m) of the tool when the image was captured, in its axes at the end of the
            press, as in `SessionRegistrationConfig`.

    Returns:
        The data set with corrected views. Empty views stay unchanged.
    """
    touches = dataset.touches
    back = np.eye(4)
    back[:3, 3] = tool_offset_at_capture
    offset = jnp.float32(back @ np.asarray(T_t_camera, np.float64) @ inverse(back))
    patch, view, nearest = (np.array(part) for part in (touches.patch, touches.view, touches.nearest))
    seen = np.flatnonzero(np.isfinite(nearest))
    pitch = dataset.window / PATCH_PIXELS
    for rows in filled_batches(seen, 36):  # a single size, so that the program is compiled once
        height = nearest[rows, None, None] + _continued(view[rows], patch[rows])
        moved = jax.device_get(_moved(jnp.float32(height), offset, pitch))
        patch[rows], nearest[rows] = np.minimum(moved.patch.depth, dataset.reach), moved.patch.nearest
        view[rows] = np.where(np.isnan(view[rows]), np.nan, np.minimum(moved.depth, dataset.reach))
    return replace(dataset, touches=touches._replace(patch=patch, view=view, nearest=nearest))


def _continued(view: Float[np.ndarray, "n w w"], patch: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, "n w w"]:
    """Complete views by their patches in the middle, and by the repeated edge of the patch where they were cropped."""
    margin = (view.shape[-1] - patch.shape[-1]) // 2
    view = complete_views(view, patch)
    edges = np.pad(patch, ((0, 0), (margin, margin), (margin, margin)), mode="edge")
    return np.where(np.isnan(view), edges, view)


@jax.jit
@full_precision
def _moved(height: Float[Array, "n w w"], T_t_camera: Float[Array, "4 4"], pitch: Float[Array, ""]) -> PatchView:
    """Compute views from the tool of heights that were measured from the camera."""
    n = height.shape[-1]
    centres = (jnp.arange(n) - (n - 1) / 2) * pitch
    target = jnp.stack(jnp.meshgrid(centres, centres), -1)  # (w, w, 2): x along columns, y along rows

    def move(seen: Float[Array, "w w"]) -> PatchView:
        def point(source: Float[Array, "w w 2"]) -> Float[Array, "w w 3"]:
            column, row = jnp.moveaxis(source / pitch + (n - 1) / 2, -1, 0)
            z = map_coordinates(seen, [row, column], order=1, mode="nearest")
            return apply(T_t_camera, jnp.concatenate([source, z[..., None]], -1))

        source = target
        # Each step divides the error by the ratio of a pixel to the distance over which the slope changes.
        for _ in range(4):
            source = source + target - point(source)[..., :2]
        return view_of_noisy_heights(point(source)[..., 2])

    return jax.vmap(move)(height)
