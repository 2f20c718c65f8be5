"""The offset of a camera that stays as it is mounted, from several registered sessions, and views without it.

    estimates = register_sessions(dataset, {"mug": surface})  # sessions on objects whose mesh is known
    hand_eye = pool_hand_eye(list(estimates.values()))
    dataset = with_hand_eye(dataset, hand_eye.T_t_camera)  # all sessions, those on unknown objects too

The pose of an object errs anew in each session, but the camera's does not as long as nobody takes it off. Sessions on
known objects then tell where it looks from, and views of unknown objects can be corrected. Estimates of sessions are
normal distributions with one prior in common, which counts once: the product of the likelihoods and that prior is the
posterior.
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
from i2t.patches.views import WideView, camera_view, centre
from i2t.registration.session import SessionEstimate, SessionRegistrationConfig
from i2t.runtime.batching import filled_batches
from i2t.types import Array as AnyArray

VIEWS_AT_ONCE = 36  # that are corrected by one program
FIXED_POINT_STEPS = 4  # of a pixel's origin: each divides its error by the ratio of a pixel to the slope's reach
COUNTED_INFORMATION = 1.0  # in units of the prior's: of directions that touches tell less of, sessions cannot disagree


class HandEye(NamedTuple):
    """Where the camera looks from in all sessions.

    Example:
        hand_eye = pool_hand_eye(list(estimates.values()))
        hand_eye.T_t_camera[:3, 3]  # m, by which the camera sits aside
    """

    T_t_camera: Float[np.ndarray, "4 4"]  # in tool axes, seen from where the hand-eye calibration puts it
    covariance: Float[np.ndarray, "6 6"]  # m^2, of its twist (`i2t.geometry.from_twist`)
    disagreement: float  # root mean square difference of the sessions, in standard deviations of their errors; about 1
    sessions: int  # that were pooled


def pool_hand_eye(estimates: Sequence[SessionEstimate], *, config: SessionRegistrationConfig | None = None) -> HandEye:
    """Pool what registered sessions say of a camera that was mounted alike in all of them.

    Args:
        estimates: Of sessions, by `register_session`.
        config: With which they were registered; its prior of the camera is theirs.

    Returns:
        The camera's offset. Where sessions differ by more than their covariances allow, the covariance is widened by
        the ratio (Birge, "The calculation of errors by the method of least squares", 1932).

    Raises:
        ValueError: There is no estimate.
    """
    if not estimates:
        raise ValueError("estimates: there is none; register sessions on objects whose mesh is known")
    std = np.asarray((config or SessionRegistrationConfig()).std, np.float64)[6:]
    # Twists in standard deviations of the prior, which is the unit matrix then.
    found = np.array([np.asarray(to_twist(each.T_t_camera), np.float64) / std for each in estimates])
    covariance = np.array([np.asarray(each.covariance, np.float64)[6:, 6:] / np.outer(std, std) for each in estimates])
    posterior = np.linalg.inv(covariance)
    told, size = np.linalg.eigh(posterior - np.eye(6)), np.einsum("sij,sj->si", posterior, found)
    values = np.maximum(told.eigenvalues, 0)
    information = np.einsum("sik,sk,sjk->sij", told.eigenvectors, values, told.eigenvectors)
    total = np.eye(6) + information.sum(0)
    mean = np.linalg.solve(total, size.sum(0))
    left = np.einsum("sik,si->sk", told.eigenvectors, size - information @ mean)
    counted = values > COUNTED_INFORMATION
    chi_square = float(np.sum(left[counted] ** 2 / values[counted]))
    freedom = int(counted.sum()) - 6
    disagreement = float(np.sqrt(chi_square / freedom)) if freedom > 0 else 1.0
    widened = np.linalg.inv(total) * max(1.0, disagreement) ** 2
    return HandEye(
        np.asarray(from_twist(std * mean), np.float64), np.outer(std, std) * widened, disagreement, len(estimates)
    )


def with_hand_eye(
    dataset: Dataset,
    T_t_camera: Float[AnyArray, "4 4"],
    *,
    looked_from: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Dataset:
    """Correct all views of a data set by the camera's offset, as far as they show what lies there.

    Each pixel of a corrected view takes the height that the camera saw on its line of sight, found by iterating a
    fixed point and interpolated between pixels. Beyond the edge of a view its last pixels are continued.

    Args:
        dataset: Touches with views.
        T_t_camera: Pose of the camera in tool axes, seen from where the hand-eye calibration puts it.
        looked_from: m, where the tool was when the camera looked, in its axes at the end of the press, as in
            `SessionRegistrationConfig`.

    Returns:
        The data set with corrected views; those that showed nothing stay as they were.
    """
    touches = dataset.touches
    back = np.eye(4)
    back[:3, 3] = looked_from
    offset = jnp.float32(back @ np.asarray(T_t_camera, np.float64) @ inverse(back))
    patch, wide, nearest = (np.array(part) for part in (touches.patch, touches.wide, touches.nearest))
    seen = np.flatnonzero(np.isfinite(nearest))
    pitch = dataset.window / PATCH_PIXELS
    for some in filled_batches(seen, VIEWS_AT_ONCE):
        height = nearest[some, None, None] + _continued(wide[some], patch[some])
        view = jax.device_get(_moved(jnp.float32(height), offset, pitch))
        patch[some], nearest[some] = np.minimum(view.patch.depth, dataset.reach), view.patch.nearest
        wide[some] = np.where(np.isnan(wide[some]), np.nan, np.minimum(view.wide, dataset.reach))
    return replace(dataset, touches=touches._replace(patch=patch, wide=wide, nearest=nearest))


def _continued(wide: Float[np.ndarray, "n w w"], patch: Float[np.ndarray, "n p p"]) -> Float[np.ndarray, "n w w"]:
    """Depths of views with their patches in the middle; what was cropped is the patch's edge continued."""
    margin = (wide.shape[-1] - patch.shape[-1]) // 2
    known = np.array(wide)
    middle = centre(known, patch.shape[-1])
    middle[...] = np.where(np.isnan(middle), patch, middle)
    edges = np.pad(patch, ((0, 0), (margin, margin), (margin, margin)), mode="edge")
    return np.where(np.isnan(known), edges, known)


@jax.jit
@full_precision
def _moved(height: Float[Array, "n w w"], T_t_camera: Float[Array, "4 4"], pitch: Float[Array, ""]) -> WideView:
    """Views from the tool of heights that were seen from the camera."""
    n = height.shape[-1]
    at = (jnp.arange(n) - (n - 1) / 2) * pitch
    target = jnp.stack(jnp.meshgrid(at, at), -1)  # (w, w, 2): x along columns, y along rows

    def one(seen: Float[Array, "w w"]) -> WideView:
        def point(source: Float[Array, "w w 2"]) -> Float[Array, "w w 3"]:
            column, row = jnp.moveaxis(source / pitch + (n - 1) / 2, -1, 0)
            z = map_coordinates(seen, [row, column], order=1, mode="nearest")
            return apply(T_t_camera, jnp.concatenate([source, z[..., None]], -1))

        source = target
        for _ in range(FIXED_POINT_STEPS):
            source = source + target - point(source)[..., :2]
        return camera_view(point(source)[..., 2])

    return jax.vmap(one)(height)
