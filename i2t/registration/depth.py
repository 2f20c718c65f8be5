"""Estimate an object's pose and its covariance from a depth image. NumPy, for the host.

Points of the image that lie near the believed object and above the table are fitted to the planes of the surface's
nearest samples by iterative closest points (Besl and McKay, "A method for registration of 3-D shapes", 1992; with
planes: Chen and Medioni, "Object modelling by registration of multiple range images", 1992). Samples that face away
from the camera are excluded, and the largest distance of a pair shrinks from step to step. Tukey's biweight, with a
scale of 1.48 median absolute residuals, rejects points of other objects (Holland and Welsch, "Robust regression using
iteratively reweighted least-squares", 1977).

The object is at `T_w_o from_twist(x)` (`i2t.geometry`), where x (6,) is a twist (m) in its own frame.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float
from scipy.spatial import cKDTree

from i2t import validation
from i2t.depth.camera import Camera, check_depth, measured_mask
from i2t.depth.distortion import pixel_rays
from i2t.geometry import apply, compose, from_twist, inverse, to_twist
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.registration.estimate import PoseEstimate


@dataclass(frozen=True)
class DepthRegistrationConfig:
    """Options of the search for an object's pose in a depth image.

    Example:
        config = i2t.DepthRegistrationConfig(final_reach=5e-3)  # for a noisy camera
    """

    initial_reach: float = 15e-3  # m, largest distance of a point from the believed object at first
    final_reach: float = 3e-3  # m, largest distance of a point from the believed object at the end
    reach_factor: float = 0.8  # factor of the distance from step to step
    max_steps: int = 40
    tolerance: float = 1e-6  # m, step length at which the search ends
    max_points: int = 5000  # largest number of points drawn from the image
    table_clearance: float = 2e-3  # m, height above the table below which points are ignored
    min_points: int = 50
    min_overlap: float = 0.3  # smallest fraction of the points that must end within `final_reach` of the surface
    min_residual_scale: float = 1e-5  # m, smallest scale of the residuals, so that it exceeds their rounding
    # number of points drawn on the surface: half a millimetre apart on an object of a decimetre
    surface_samples: int = 40_000
    seed: int = 0


class _Scene(NamedTuple):
    """Points of the image and samples of the surface, which are to be matched."""

    points: Float[np.ndarray, "n 3"]  # m, points of the image in W
    samples: Float[np.ndarray, "s 3"]  # m, points of the surface in O
    normals: Float[np.ndarray, "s 3"]  # outward normals of the samples
    tree: cKDTree  # search tree of the samples
    points_per_measurement: float  # number of neighbours that share their noise


class _Pairs(NamedTuple):
    """Points and the planes of their nearest samples at one pose."""

    residual: Float[np.ndarray, " n"]  # m, distance of the point from the plane
    jacobian: Float[np.ndarray, "n 6"]  # derivative of the residual by a twist (m) of the object
    weight: Float[np.ndarray, " n"]  # Tukey's biweight of the residual
    near: Bool[np.ndarray, " n"]  # whether a point is close enough to count
    variance: float  # m^2, variance of a residual times the number of points that share their noise


def register_by_depth(
    mesh: Mesh,
    T_w_o: Float[np.ndarray | Array, "4 4"],
    depth: Float[np.ndarray | Array, "height width"],
    camera: Camera,
    T_w_c: Float[np.ndarray | Array, "4 4"],
    *,
    translation_std: float = 10e-3,
    rotation_std: float = 0.1,
    table_height: float | None = 0.0,
    points_per_measurement: float = 1.0,
    config: DepthRegistrationConfig = DepthRegistrationConfig(),
) -> PoseEstimate:
    """Estimate the most probable pose of an object in a depth image.

    The noise is estimated from the residuals. The covariance does not include errors of the camera's pose, which
    `camera_covariance` adds, or a bias of its depths.

    Args:
        mesh: The object, in its own frame (m).
        T_w_o: Believed pose of the object.
        depth: Depth image (m) along the camera's axis, with holes as described at `i2t.depth.camera.measured_mask`.
        camera: The camera.
        T_w_c: Pose of the camera.
        translation_std: Standard deviation (m) of the believed position along each axis.
        rotation_std: Standard deviation (rad) of the believed orientation about each axis.
        table_height: Height (m) in W of the plane on which the object stands; None if the image shows no plane.
        points_per_measurement: Number of neighbouring points that share their noise, as in stereo cameras. They count
            as a single point in the covariance.
        config: Options of the search.

    Returns:
        The estimate. Its covariance, residuals, weights and cost are those at the returned pose.

    Raises:
        ValueError: The size of the image differs from the camera's, a pose is not rigid, too few points lie near the
            object, or too few of these points fit its surface.
        TypeError: An argument is not real numbers.

    Example:
        estimate = i2t.register_by_depth(mesh, T_w_o, image, camera, T_w_c)
        estimate.T_w_o
    """
    validation.number("translation_std", translation_std, "metres above 0", above=0)
    validation.number("rotation_std", rotation_std, "radians above 0", above=0)
    depth = validation.numbers("depth", depth, "an image of metres")
    check_depth(depth, camera)
    start, T_w_c = validation.pose("T_w_o", T_w_o), validation.pose("T_w_c", T_w_c)
    scene = _scene(mesh, start, _points(depth, camera, T_w_c, table_height, config), T_w_c, config)
    scene = scene._replace(points_per_measurement=max(1.0, points_per_measurement * scene.points_per_measurement))
    prior_information = np.diag(np.array([translation_std] * 3 + [rotation_std * TWIST_LEVER_M] * 3) ** -2.0)

    T, reach = start, config.initial_reach
    for _ in range(config.max_steps):
        pairs = _pairs(scene, T, reach, config)
        gradient = pairs.jacobian.T @ (pairs.weight * pairs.residual) / pairs.variance
        gradient += prior_information @ to_twist(compose(inverse(start), T))
        step = -np.linalg.solve(_information(pairs, prior_information), gradient)
        T = compose(T, from_twist(step))
        if reach == config.final_reach and np.linalg.norm(step) < config.tolerance:
            break
        reach = max(reach * config.reach_factor, config.final_reach)

    pairs = _pairs(scene, T, reach, config)  # again, because the last step moved the pose
    if pairs.near.mean() < config.min_overlap:
        raise ValueError(
            f"depth: {100 * pairs.near.mean():.0f} % of {len(scene.points)} points near the object fit its surface "
            f"within {1e3 * config.final_reach:g} mm, but {100 * config.min_overlap:.0f} % are needed; check the mesh "
            "and its believed pose"
        )
    twist = to_twist(compose(inverse(start), T))
    cost = 0.5 * twist @ prior_information @ twist + 0.5 * np.sum(pairs.weight * pairs.residual**2) / pairs.variance
    covariance = np.linalg.inv(_information(pairs, prior_information))
    fields = (T, covariance, pairs.residual, pairs.weight, cost)
    return PoseEstimate(*(jnp.asarray(field, jnp.float32) for field in fields))


def camera_covariance(
    covariance: Float[np.ndarray | Array, "6 6"],
    T_c_o: Float[np.ndarray | Array, "4 4"],
    translation_std: float,
    rotation_std: float,
) -> Float[np.ndarray, "6 6"]:
    """Add the uncertainty of the camera's pose to that of an object, which moves with the camera that located it.

    Args:
        covariance: `(6, 6)` covariance (m^2) of the object's twist (translation, then rotation as arc length), such as
            from `register_by_depth`.
        T_c_o: Pose of the object in the camera's frame.
        translation_std: Standard deviation (m) of the camera's position along each axis.
        rotation_std: Standard deviation (rad) of the camera's orientation about each axis.

    Returns:
        `(6, 6)` covariance (m^2) of the object's twist that includes the camera's errors.
    """
    T = np.asarray(T_c_o, float)
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    about = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # times a small rotation: motion of the object's origin
    moved = np.block([[R.T, R.T @ about], [np.zeros((3, 3)), TWIST_LEVER_M * R.T]])
    spread = np.diag([translation_std**2] * 3 + [rotation_std**2] * 3)
    return np.asarray(covariance, float) + moved @ spread @ moved.T


def _points(
    depth: np.ndarray, camera: Camera, T_w_c: np.ndarray, table_height: float | None, config: DepthRegistrationConfig
) -> np.ndarray:
    """Compute the measured points above the table, (n, 3) m in W."""
    x, y = np.asarray(pixel_rays(camera), float)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * np.where(measured_mask(depth), depth, np.nan)[..., None]
    points = apply(T_w_c, points[np.isfinite(points).all(axis=-1)])
    return points if table_height is None else points[points[:, 2] > table_height + config.table_clearance]


def _scene(
    mesh: Mesh, start: np.ndarray, points: np.ndarray, T_w_c: np.ndarray, config: DepthRegistrationConfig
) -> _Scene:
    """Sample the surface where it faces the camera, and select at most `max_points` points near the samples."""
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    samples, faces = trimesh.sample.sample_surface(whole, config.surface_samples, seed=config.seed)
    normals = whole.face_normals[faces]
    eye = compose(inverse(start), T_w_c)[:3, 3]
    facing = np.sum((eye - samples) * normals, axis=1) > 0
    samples, normals = samples[facing], normals[facing]
    tree = cKDTree(samples)
    away, _ = tree.query(apply(inverse(start), points), distance_upper_bound=config.initial_reach)
    points = points[away < config.initial_reach]
    if len(points) < config.min_points:
        raise ValueError(
            f"depth: {len(points)} points lie within {1e3 * config.initial_reach:g} mm of the believed object, but "
            f"{config.min_points} are needed; correct T_w_o or T_w_c, or move the camera closer"
        )
    kept_fraction = min(1.0, config.max_points / len(points))
    if len(points) > config.max_points:
        points = np.random.default_rng(config.seed).choice(points, config.max_points, replace=False)
    return _Scene(points, samples, normals, tree, kept_fraction)


def _pairs(scene: _Scene, T_w_o: np.ndarray, reach: float, config: DepthRegistrationConfig) -> _Pairs:
    """Pair every point with its nearest sample."""
    points = apply(inverse(T_w_o), scene.points)
    away, index = scene.tree.query(points)
    near = away < reach
    n = scene.normals[index]
    residual = np.sum(n * (points - scene.samples[index]), axis=1)
    jacobian = -np.concatenate([n, np.cross(points, n) / TWIST_LEVER_M], axis=1)
    scale = _residual_scale(residual[near], config)
    ratio = residual / (4.685 * scale)  # the cutoff of Tukey's biweight for 95 % efficiency on normal residuals
    weight = np.where(near & (np.abs(ratio) < 1), (1 - ratio**2) ** 2, 0.0)
    return _Pairs(residual, jacobian, weight, near, scene.points_per_measurement * scale**2)


def _information(pairs: _Pairs, prior_information: np.ndarray) -> np.ndarray:
    """Compute the inverse covariance (1/m^2) of the twist, the sum of those of the points and of the prior."""
    return pairs.jacobian.T @ (pairs.weight[:, None] * pairs.jacobian) / pairs.variance + prior_information


def _residual_scale(residual: np.ndarray, config: DepthRegistrationConfig) -> float:
    """Estimate the standard deviation (m) of the residuals from their median absolute value."""
    if not len(residual):
        return config.final_reach
    # The standard deviation of a normal distribution is 1.4826 times its median absolute deviation.
    return max(1.4826 * float(np.median(np.abs(residual))), config.min_residual_scale)
