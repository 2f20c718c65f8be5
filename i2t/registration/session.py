"""Estimate the true poses of an object with a known mesh and of the camera from the touches of a session.

Within a session two errors are constant: the object is at `T_w_o from_twist(x)` instead of `T_w_o`, and the camera's
pose differs by `from_twist(h)` from the hand-eye calibration. Each touch measures both twists, twelve numbers in all:

* At first contact the skin's face meets the surface (`i2t.registration.contacts`), which depends on x alone.
* The view shows the surface from `T_o_c = (T_w_o from_twist(x))^-1 T_w_t B from_twist(h) B^-1`, where B moves the tool
  back to its pose when the camera looked.

Views are compared with renderings as in direct image alignment (Lucas and Kanade, "An iterative image registration
technique with an application to stereo vision", 1981; Kerl, Sturm and Cremers, "Robust odometry estimation for RGB-D
cameras", 2013). Heights Z(u, v) of a camera that moves by a small translation t and rotation w become

    Z + Z_u d_u + Z_v d_v - d_z,    d = t + w x (u, v, Z),

where Z_u and Z_v are differences of neighbouring pixels. These include silhouettes, which alone show where a flat face
ends. Both images and the derivatives are blurred, widely in the first search and by little more than the camera's own
blur in the last. The first search starts from several draws of the prior. The variance of a residual is the sum of the
camera's noise and of a sideways error of its pixels, which is as large as the blur until the last search. The arm's
repeatability adds a small motion to each view, which is eliminated.

Residuals are distributed as Student's t. The most probable twists are found by Levenberg-Marquardt steps while the
scale of the residuals shrinks, as in `i2t.registration.touch`. The covariance is that of Laplace's method.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from i2t.geometry import from_twist, full_precision, inverse, to_twist
from i2t.patches.dimensions import PAD_WINDOW, PATCH_PIXELS, PATCH_WINDOW, REACH, TWIST_LEVER_M
from i2t.patches.views import SAME_SURFACE_M, complete_views
from i2t.registration.contacts import (
    Contacts,
    LinearisedContacts,
    check_contacts,
    contact_poses,
    contacts_of,
    t_cost,
    t_weights,
)
from i2t.registration.contacts import cost as contact_cost
from i2t.registration.contacts import linearise as linearise_contacts
from i2t.registration.contacts import normal_equations as contact_normal_equations
from i2t.registration.levenberg_marquardt import LeastSquares, levenberg_marquardt
from i2t.rendering.render import render_heights
from i2t.runtime.batching import select_rows
from i2t.runtime.compiling import jit_quickly, traced_floats
from i2t.types import Array as AnyArray
from i2t.types import Surface, Touches, in_one_line


@traced_floats
@dataclass(frozen=True)
class SessionRegistrationConfig:
    """Expected errors of object, camera and arm, as standard deviations, and options of a session's registration.

    Example:
        config = i2t.SessionRegistrationConfig(hand_eye=3e-3, depth_noise=0.5e-3)  # a camera that was mounted by eye
        estimate = i2t.register_session(touches, surface, config=config)
    """

    placement: float = 1e-3  # m, standard deviation of the object's position along each axis
    # rad, standard deviation of the object's orientation about each axis
    placement_angle: float = float(np.radians(1.0))
    hand_eye: float = 1e-3  # m, standard deviation of the camera's position in the tool along each axis
    # rad, standard deviation of the camera's orientation about each axis
    hand_eye_angle: float = float(np.radians(0.5))
    contact: float = 0.1e-3  # m, standard deviation of the position of a first contact
    repeatability: float = 0.05e-3  # m, standard deviation of the arm's position along each axis, in each view
    # rad, standard deviation of the arm's orientation about each axis
    repeatability_angle: float = float(np.radians(0.03))
    # m, position of the tool when the camera looked, in its axes at the end of the press: hand-eye errors act there
    tool_offset_at_capture: tuple[float, float, float] = (0.0, 0.0, 0.0)
    depth_noise: float = 0.3e-3  # m, standard deviation of the depth of a pixel
    depth_bleed: float = 1.0  # pixels, standard deviation of the lateral displacement of a depth
    window: float = field(default=PATCH_WINDOW, metadata={"static": True})  # m, edge of a patch
    reach: float = field(default=REACH, metadata={"static": True})  # m, depth at which views are clipped
    num_starts: int = 8  # number of starts of the first search: the prior's mean and draws of the prior
    kept_starts: int = 2  # number of ends with the lowest cost from which the next search starts
    blurs: tuple[float, ...] = (8.0, 4.0, 1.5)  # pixels, standard deviation of the image blur in each search
    # standard deviations, scale of the residuals at first: the prior's errors relative to the noise
    first_scale: float = field(default=10.0, metadata={"static": True})
    steps: int = 12  # number of steps of each search
    half_edge: float = PAD_WINDOW / 2  # m, half the edge of the skin's face
    candidate_faces: int = 128  # number of faces that are considered for each touch
    max_touches: int = 144  # number of touches of a session that are used

    @property
    def std(self) -> Float[Array, "12"]:
        """Standard deviations (m) of the six parts of the object's twist, followed by those of the camera's."""
        turned = self.placement_angle * TWIST_LEVER_M, self.hand_eye_angle * TWIST_LEVER_M
        return jnp.repeat(jnp.stack([self.placement, turned[0], self.hand_eye, turned[1]]), 3)


@in_one_line
class SessionEstimate(NamedTuple):
    """Estimated poses of the object (in the world) and of the camera (relative to its hand-eye calibration) in one
    session, the covariance (m^2) of both twists, and the residual of each contact (m) and view (in standard
    deviations).

    Example:
        estimate = i2t.register_session(touches, surface)
        estimate.T_t_camera[:3, 3]  # m, offset of the camera
    """

    T_w_o: Float[Array, "4 4"]  # the object's estimated pose in the world
    T_t_camera: Float[Array, "4 4"]  # pose of the camera in tool axes, relative to the hand-eye calibration
    covariance: Float[Array, "12 12"]  # m^2, of the twists of the object and of the camera (`i2t.geometry.from_twist`)
    contact_residual: Float[Array, " n"]  # m, residual of each contact along the surface's normal
    view_residual: Float[Array, " n"]  # root mean square of each view's residuals, in standard deviations of the noise


class _Views(NamedTuple):
    """Heights that the camera measured, with the tool's poses."""

    T_w_t: Float[AnyArray, "*n 4 4"]
    height: Float[AnyArray, "*n w w"]  # m along tool z, clipped; 0 where not measured
    measured: Float[AnyArray, "*n w w"]  # 1 where a height was measured, else 0
    nearest: Float[AnyArray, "*n"]  # m, height of the patch's nearest surface


class _Session(NamedTuple):
    """Data of a registration."""

    surface: Surface
    T_w_o: Float[Array, "4 4"]
    contacts: Contacts
    views: _Views


class _LinearisedViews(NamedTuple):
    """Residuals of views, in standard deviations, with their derivatives by the twelve unknowns."""

    residual: Float[Array, "n k"]
    jacobian: Float[Array, "n k 12"]
    motion: Float[Array, " n"]  # half the squared norm of the arm's motion in each view, in standard deviations


class _Linearised(NamedTuple):
    contacts: LinearisedContacts
    views: _LinearisedViews


@full_precision
def register_session(
    touches: Touches, surface: Surface, *, config: SessionRegistrationConfig = SessionRegistrationConfig()
) -> SessionEstimate:
    """Estimate the true poses of the object and of the camera in one session.

    Args:
        touches: Touches of one session. Of more than `max_touches`, evenly spread ones are used. Touches that did not
            meet the object count by their views alone, cropped views by their patches, and touches without a view by
            their contacts alone.
        surface: The object, in its own frame.
        config: Errors of the lab and options of the search.

    Returns:
        The estimate. Directions that the touches do not determine keep the prior, as the covariance shows.

    Raises:
        ValueError: The touches are from several sessions, none met the object, or a pose is not rigid.
        TypeError: The touches or the surface have another type.

    Example:
        estimate = i2t.register_session(dataset.touches, i2t.prepare_surface(mesh))
    """
    if not isinstance(touches, Touches):
        raise TypeError(f"touches: {type(touches).__name__} is the wrong type; give `i2t.Touches` of one session")
    if not isinstance(surface, Surface):
        raise TypeError(f"surface: {type(surface).__name__} is the wrong type; make it with i2t.prepare_surface")
    sessions = np.unique(touches.session)
    if len(sessions) != 1:
        raise ValueError(f"touches: they are from {len(sessions)} sessions; register one session at a time")
    if len(touches.session) > config.max_touches:
        touches = select_rows(touches, np.linspace(0, len(touches.session) - 1, config.max_touches).astype(int))
    T_w_contact, met = contact_poses(touches)
    if not met.any():
        raise ValueError("touches: none met the object, so its pose cannot be estimated; give some that did")
    check_contacts(*(jnp.asarray(x, jnp.float32) for x in (touches.T_w_o[0], T_w_contact, met)))
    session = _prepare(surface, touches.T_w_o[0], *_padded(T_w_contact, met, _measured_views(touches)), config)
    draws = np.random.default_rng(0).normal(size=(config.num_starts, 12)).astype(np.float32)
    starts, searches = [draw * (number > 0) * config.std for number, draw in enumerate(draws)], len(config.blurs)
    for search, blur in enumerate(config.blurs):
        done = (search + np.minimum(2 * np.arange(config.steps) / config.steps, 1)) / searches
        blurring = _blurring(session.views.height.shape[-1], blur, config.blurs[-1])
        # Samples of a wider blur share their noise, so they hold as much information as fewer samples would.
        shared = jnp.float32(blur / config.blurs[-1])
        scales = jnp.float32(config.first_scale ** (1 - done))
        # Until the last search, edges may be displaced by as much as the images are blurred.
        bleed = config.depth_bleed if blur == config.blurs[-1] else max(config.depth_bleed, blur)
        errors = replace(config, depth_bleed=bleed)
        ends = [_search(session, start, blurring, scales, shared, errors) for start in starts]
        ends.sort(key=lambda end: float(end.cost))
        starts = [end.twist for end in ends[: config.kept_starts]]
    residual = np.sqrt(np.mean(np.square(ends[0].linearised.views.residual), axis=1))[: len(met)]
    # Views hold less information if their noise is larger than stated or shared by neighbouring pixels (McCullagh and
    # Nelder, "Generalized linear models", 1989, section 4.5).
    spread = jnp.float32(max(1.0, np.median(residual)))
    best = _search(session, starts[0], blurring, jnp.ones(config.steps), spread, config)
    return SessionEstimate(
        T_w_o=session.T_w_o @ from_twist(best.twist[:6]),
        T_t_camera=from_twist(best.twist[6:]),
        covariance=best.covariance,
        contact_residual=best.linearised.contacts.residual[: len(met)],
        view_residual=jnp.asarray(residual),
    )


def _padded(
    T_w_contact: Float[np.ndarray, "n 4 4"], met: Bool[np.ndarray, " n"], views: _Views, multiple: int = 36
) -> tuple[Float[np.ndarray, "m 4 4"], Bool[np.ndarray, " m"], _Views]:
    """Pad contacts and views to a multiple of touches, so that one compilation serves most sessions. The padding
    repeats touches without weight.
    """
    n = len(met)
    rows = np.resize(np.arange(n), multiple * -(-n // multiple))
    counts = np.arange(len(rows)) < n
    views = select_rows(views, rows)
    return T_w_contact[rows], met[rows] & counts, views._replace(measured=views.measured * counts[:, None, None])


@jit_quickly
@full_precision
def _prepare(
    surface: Surface, T_w_o: Array, T_w_contact: Array, met: Array, views: _Views, config: SessionRegistrationConfig
) -> _Session:
    T_w_o, T_w_contact, weight = (jnp.asarray(part, jnp.float32) for part in (T_w_o, T_w_contact, met))
    contacts = contacts_of(
        surface, T_w_o, T_w_contact, weight,
        translation_std=jnp.float32(config.placement), rotation_std=jnp.float32(config.placement_angle),
        half_edge=config.half_edge, candidate_faces=config.candidate_faces,
    )  # fmt: skip
    return _Session(surface, T_w_o, contacts, views)


def _measured_views(touches: Touches) -> _Views:
    """Collect the heights that the camera measured; a cropped view has those of its patch."""
    behind = complete_views(np.asarray(touches.view, np.float32), np.asarray(touches.patch, np.float32))
    seen = np.isfinite(touches.nearest)
    nearest = np.where(seen, touches.nearest, 0).astype(np.float32)
    measured = np.isfinite(behind) & seen[:, None, None]
    height = np.where(measured, nearest[:, None, None] + behind, 0)
    T_w_t = np.where(seen[:, None, None], touches.T_w_t, np.eye(4)).astype(np.float32)
    return _Views(T_w_t, height, measured.astype(np.float32), nearest)


def _blurring(pixels: int, blur: float, finest: float) -> Float[np.ndarray, "k pixels"]:
    """Compute Gaussian weights of the pixels along one axis. Samples are two standard deviations of the finest blur
    apart, so that they hardly share noise.
    """
    stride = max(round(2 * finest), 1)
    at = np.arange(pixels)[(pixels - 1) % stride // 2 :: stride]
    weights = np.exp(-((np.arange(pixels) - at[:, None]) ** 2) / (2 * blur**2))
    return (weights / weights.sum(1, keepdims=True)).astype(np.float32)


class _SearchEnd(NamedTuple):
    """The end of a search."""

    twist: Float[Array, "12"]  # m, twist of the object at the end of the search
    covariance: Float[Array, "12 12"]  # m^2, covariance of the twist
    cost: Float[Array, ""]  # cost at the last scale
    linearised: _Linearised


@jit_quickly
@full_precision
def _search(
    session: _Session,
    start: Float[Array, "12"],
    blurring: Float[Array, "k pixels"],
    scales: Float[Array, " steps"],
    shared: Float[Array, ""],
    config: SessionRegistrationConfig,
) -> _SearchEnd:
    """Search for the most probable twists from a start (m)."""
    std = config.std
    problem = _problem(session, std, blurring, shared, config)
    z, linearised = levenberg_marquardt(problem, start / std, scales)
    information, _ = problem.normal_equations(z, linearised, jnp.float32(1))
    covariance = std[:, None] * jnp.linalg.inv(information) * std[None]
    return _SearchEnd(std * z, covariance, problem.cost(z, linearised, scales[-1]), linearised)


def _problem(
    session: _Session,
    std: Float[Array, "12"],
    blurring: Float[Array, "k pixels"],
    shared: Float[Array, ""],
    config: SessionRegistrationConfig,
) -> LeastSquares:
    """State the problem of the most probable twists, in standard deviations of the prior. Scales are factors of the
    noise.
    """
    contacts = session.contacts
    back = jnp.eye(4).at[:3, 3].set(jnp.array(config.tool_offset_at_capture))

    def linearise_view(z: Float[Array, "12"], view: _Views) -> _LinearisedViews:
        def camera(z: Float[Array, "12"]) -> Float[Array, "4 4"]:
            offset = back @ from_twist(std[6:] * z[6:]) @ inverse(back)
            return inverse(session.T_w_o @ from_twist(std[:6] * z[:6])) @ view.T_w_t @ offset

        T_o_c = camera(z)
        moved = jax.jacfwd(lambda z: to_twist(inverse(T_o_c) @ camera(z)))(z)  # (6, 12)
        r, jacobian = _view_residuals(view, T_o_c, session.surface, blurring, shared, config)
        # The arm adds a motion with a normal prior to each view; the most probable one is eliminated.
        angle = config.repeatability_angle * TWIST_LEVER_M
        by_motion = jacobian * jnp.stack([config.repeatability] * 3 + [angle] * 3)[None]
        both = jnp.concatenate([r[:, None], jacobian @ moved], 1)
        motion = jnp.linalg.solve(by_motion.T @ by_motion + jnp.eye(6), by_motion.T @ both)
        rest = both - by_motion @ motion
        return _LinearisedViews(rest[:, 0], rest[:, 1:], 0.5 * motion[:, 0] @ motion[:, 0])

    def linearise(z: Float[Array, "12"]) -> _Linearised:
        seen = jax.vmap(linearise_view, (None, 0))(z, session.views)
        return _Linearised(linearise_contacts(z[:6], contacts, config.half_edge), seen)

    return LeastSquares(
        residual_and_jacobian=linearise,
        cost=partial(_cost, contacts, config.contact),
        normal_equations=partial(_normal_equations, contacts, config.contact),
        placeholder=_placeholder(len(contacts.weight), len(blurring) ** 2),
    )


def _cost(
    contacts: Contacts,
    contact_std: float | Array,
    z: Float[Array, "12"],
    linearised: _Linearised,
    scale: Float[Array, ""],
) -> Float[Array, ""]:
    """Compute minus the logarithm of the posterior density, up to a constant."""
    seen = jnp.sum(t_cost(linearised.views.residual / scale)) + jnp.sum(linearised.views.motion)
    return contact_cost(z[:6], linearised.contacts, contacts.weight, scale * contact_std) + seen + 0.5 * z[6:] @ z[6:]


def _normal_equations(
    contacts: Contacts,
    contact_std: float | Array,
    z: Float[Array, "12"],
    linearised: _Linearised,
    scale: Float[Array, ""],
) -> tuple[Float[Array, "12 12"], Float[Array, "12"]]:
    """Compute the Gauss-Newton matrix and the gradient of the posterior."""
    contact_matrix, slope = contact_normal_equations(z[:6], linearised.contacts, contacts.weight, scale * contact_std)
    residual, jacobian, _ = linearised.views
    share = t_weights(residual / scale) / scale**2
    matrix = jnp.einsum("nk,nki,nkj->ij", share, jacobian, jacobian)
    gradient = jnp.einsum("nk,nki,nk->i", share, jacobian, residual)
    matrix = matrix.at[:6, :6].add(contact_matrix).at[6:, 6:].add(jnp.eye(6))
    return matrix, gradient.at[:6].add(slope).at[6:].add(z[6:])


def _placeholder(n: int, k: int, residual: float = 1e6) -> _Linearised:
    """Make a linearisation with residuals, in standard deviations, that are worse than any real ones."""
    return _Linearised(
        LinearisedContacts(jnp.full(n, residual), jnp.zeros((n, 6)), jnp.ones(n)),
        _LinearisedViews(jnp.full((n, k), residual), jnp.zeros((n, k, 12)), jnp.zeros(n)),
    )


def _view_residuals(
    view: _Views,
    T_o_c: Float[Array, "4 4"],
    surface: Surface,
    blurring: Float[Array, "k pixels"],
    shared: Float[Array, ""],
    config: SessionRegistrationConfig,
) -> tuple[Float[Array, " kk"], Float[Array, "kk 6"]]:
    """Compute the blurred differences of a view and the rendering at a camera's pose, in standard deviations of the
    noise, and their derivatives by the twist of that pose.
    """
    pixels, pitch, limit = view.height.shape[-1], config.window / PATCH_PIXELS, view.nearest + config.reach
    height = jnp.minimum(render_heights(surface, inverse(T_o_c), pitch * pixels, pixels), limit)
    by_twist, square_slope = _by_camera_twist(height, limit, pitch)
    noise = jnp.maximum(config.depth_noise, 1e-6)  # m, for divisions
    recorded, share = _mean_recorded(height, view.nearest, noise)
    residual = jnp.minimum(view.height, limit) - recorded
    images = jnp.concatenate([residual[None], -share[None] * by_twist]) * view.measured[None]
    blurred = jnp.einsum("ai,cij,bj->cab", blurring, images, blurring).reshape(7, -1)
    variance = noise**2 + (config.depth_bleed * pitch) ** 2 * square_slope
    std = shared * jnp.sqrt(jnp.einsum("ai,ij,bj->ab", blurring**2, variance, blurring**2)).reshape(-1)
    return blurred[0] / std, (blurred[1:] / std[None]).T


def _by_camera_twist(
    height: Float[Array, "w w"], limit: Float[Array, ""], pitch: float
) -> tuple[Float[Array, "6 w w"], Float[Array, "w w"]]:
    """Compute the derivatives of clipped heights by the twist of the camera, and the squared slope of the heights."""
    n, padded = height.shape[-1], jnp.pad(height, 1, mode="edge")
    across = (padded[1:-1, 2:] - padded[1:-1, :-2]) / (2 * pitch)
    along = (padded[2:, 1:-1] - padded[:-2, 1:-1]) / (2 * pitch)
    u, v = jnp.meshgrid(*[(jnp.arange(n) - (n - 1) / 2) * pitch] * 2)
    seen = jnp.where(height < limit, 1.0, 0.0)
    turned = [-along * height - seen * v, across * height + seen * u, along * u - across * v]
    return jnp.stack([across, along, -seen, *(part / TWIST_LEVER_M for part in turned)]), across**2 + along**2


def _mean_recorded(
    height: Float[Array, "w w"], nearest: Float[Array, ""], std: float | Array
) -> tuple[Float[Array, "w w"], Float[Array, "w w"]]:
    """Compute the mean recorded height of noisy pixels, and its derivative by the true height. Protrusions before the
    nearest surface by less than `SAME_SURFACE_M` are recorded as lying on it (`i2t.patches.views`).
    """
    behind = (height - nearest) / std
    share = jax.scipy.stats.norm.cdf(behind)
    mean = nearest + std * (jax.scipy.stats.norm.pdf(behind) + behind * share)
    stands_out = height < nearest - SAME_SURFACE_M
    return jnp.where(stands_out, height, mean), jnp.where(stands_out, 1.0, share)
