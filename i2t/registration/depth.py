"""An object's pose from a depth image, with its covariance. NumPy, for the host.

Points of the image that lie near the believed object, and not on the table, are drawn to the planes of the surface's
nearest samples, over and over (iterative closest points; Besl and McKay, "A method for registration of 3-D shapes",
1992; to planes: Chen and Medioni, "Object modelling by registration of multiple range images", 1992). Samples that face
away from the camera are no candidates, the distance at which a pair counts shrinks, and Tukey's biweight with a scale
of 1.48 median absolute residuals leaves out what is still something else (Holland and Welsch, "Robust regression using
iteratively reweighted least-squares", 1977).

The object stands at `T_w_o from_twist(x)` (`i2t.geometry`): x (6,) m in its own frame.
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

SURFACE_SAMPLES = 40_000  # half a millimetre apart on an object of a decimetre
BIWEIGHT_CUTOFF = 4.685  # scales beyond which Tukey's weight is zero (95 % efficient where all is normal)
STD_PER_MAD = 1.4826  # of a normal distribution: standard deviation over median absolute deviation


@dataclass(frozen=True)
class DepthRegistrationConfig:
    """Options of pose search by depth image."""

    initial_reach: float = 15e-3  # m from the believed object within which a point counts, at first
    final_reach: float = 3e-3  # m, and at the end
    reach_factor: float = 0.8  # from step to step
    max_steps: int = 40
    tolerance: float = 1e-6  # m, ends when a step is shorter
    max_points: int = 5000  # drawn from the image
    table_clearance: float = 2e-3  # m above the table below which a point may be the table's
    min_points: int = 50
    min_overlap: float = 0.3  # share of the points that must end close to the surface
    min_residual_scale: float = 1e-5  # m, below it residuals are rounding
    seed: int = 0


class _Scene(NamedTuple):
    """Data to be matched."""

    points: Float[np.ndarray, "n 3"]  # m, in W, from the image
    samples: Float[np.ndarray, "s 3"]  # m, in O, of the surface
    normals: Float[np.ndarray, "s 3"]  # of the samples, outward
    tree: cKDTree  # of the samples
    points_per_measurement: float  # neighbours that share their noise


class _Pairs(NamedTuple):
    """Points and the planes of their nearest samples at one pose."""

    residual: Float[np.ndarray, " n"]  # m, from the plane
    jacobian: Float[np.ndarray, "n 6"]  # by a twist of the object
    weight: Float[np.ndarray, " n"]  # Tukey's
    near: Bool[np.ndarray, " n"]  # close enough to count
    variance: float  # m^2, of a residual, times the points that share one measurement's noise


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
    """The most probable pose of an object in a depth image.

    Noise is measured, from the residuals; the covariance knows nothing of a bias of the camera (`camera_covariance`
    adds that of its pose).

    Args:
        mesh: The object, in its own frame (m).
        T_w_o: Where it is believed to be.
        depth: Depth (m) along the camera's axis, with holes as `i2t.depth.camera.measured_mask` knows them.
        camera: The camera.
        T_w_c: Where it stands.
        translation_std: Standard deviation (m) of the belief along each axis.
        rotation_std: Standard deviation (rad) of the belief about each axis.
        table_height: Height (m) in W of the plane the object stands on; None where the image shows none.
        points_per_measurement: How many neighbouring points share their noise, as in stereo cameras; they count as one
            in the covariance.
        config: How to search.

    Returns:
        The estimate; covariance, residuals, weights and cost are those of the pose returned.

    Raises:
        ValueError: The image is not the camera's, a pose is not rigid, too few points lie near the object, or too few
            of those fit its surface.
        TypeError: An argument holds no real numbers.

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

    pairs = _pairs(scene, T, reach, config)  # at the pose returned, which the last step has moved
    if pairs.near.mean() < config.min_overlap:
        raise ValueError(
            f"depth: {100 * pairs.near.mean():.0f} % of {len(scene.points)} points near the object fit its surface "
            f"within {1e3 * config.final_reach:g} mm, of {100 * config.min_overlap:.0f} % needed; check the mesh and "
            "its believed pose"
        )
    off = to_twist(compose(inverse(start), T))
    cost = 0.5 * off @ prior_information @ off + 0.5 * np.sum(pairs.weight * pairs.residual**2) / pairs.variance
    covariance = np.linalg.inv(_information(pairs, prior_information))
    fields = (T, covariance, pairs.residual, pairs.weight, cost)
    return PoseEstimate(*(jnp.asarray(field, jnp.float32) for field in fields))


def camera_covariance(
    covariance: Float[np.ndarray | Array, "6 6"],
    T_c_o: Float[np.ndarray | Array, "4 4"],
    translation_std: float,
    rotation_std: float,
) -> Float[np.ndarray, "6 6"]:
    """Add the uncertainty of the camera's pose to an object's: the object moves with the camera that found it.

    Args:
        covariance: Of the object's twist (m^2), as of `register_by_depth`.
        T_c_o: Where the camera found the object.
        translation_std: Standard deviation (m) of the camera along each axis.
        rotation_std: Standard deviation (rad) of the camera about each axis.

    Returns:
        The covariance (m^2) of the object's twist with both.
    """
    T = np.asarray(T_c_o, float)
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    about = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # times a small turn: how the object's origin moves
    moved = np.block([[R.T, R.T @ about], [np.zeros((3, 3)), TWIST_LEVER_M * R.T]])
    spread = np.diag([translation_std**2] * 3 + [rotation_std**2] * 3)
    return np.asarray(covariance, float) + moved @ spread @ moved.T


def _points(
    depth: np.ndarray, camera: Camera, T_w_c: np.ndarray, table_height: float | None, config: DepthRegistrationConfig
) -> np.ndarray:
    """Points measured above the table, in W (n, 3)."""
    x, y = np.asarray(pixel_rays(camera), float)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * np.where(measured_mask(depth), depth, np.nan)[..., None]
    points = apply(T_w_c, points[np.isfinite(points).all(axis=-1)])
    return points if table_height is None else points[points[:, 2] > table_height + config.table_clearance]


def _scene(
    mesh: Mesh, start: np.ndarray, points: np.ndarray, T_w_c: np.ndarray, config: DepthRegistrationConfig
) -> _Scene:
    """Samples of the surface that face the camera, and the points near them, thinned to `max_points`."""
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    samples, faces = trimesh.sample.sample_surface(whole, SURFACE_SAMPLES, seed=config.seed)
    normals = whole.face_normals[faces]
    eye = compose(inverse(start), T_w_c)[:3, 3]
    facing = np.sum((eye - samples) * normals, axis=1) > 0
    samples, normals = samples[facing], normals[facing]
    tree = cKDTree(samples)
    away, _ = tree.query(apply(inverse(start), points), distance_upper_bound=config.initial_reach)
    points = points[away < config.initial_reach]
    if len(points) < config.min_points:
        raise ValueError(
            f"depth: {len(points)} points lie within {1e3 * config.initial_reach:g} mm of the believed object, of "
            f"{config.min_points} needed; correct T_w_o or T_w_c, or look from nearer"
        )
    thinned = min(1.0, config.max_points / len(points))  # those that are drawn lie further apart
    if len(points) > config.max_points:
        points = np.random.default_rng(config.seed).choice(points, config.max_points, replace=False)
    return _Scene(points, samples, normals, tree, thinned)


def _pairs(scene: _Scene, T_w_o: np.ndarray, reach: float, config: DepthRegistrationConfig) -> _Pairs:
    """Pair every point with its nearest sample."""
    points = apply(inverse(T_w_o), scene.points)
    away, index = scene.tree.query(points)
    near = away < reach
    n = scene.normals[index]
    residual = np.sum(n * (points - scene.samples[index]), axis=1)
    jacobian = -np.concatenate([n, np.cross(points, n) / TWIST_LEVER_M], axis=1)
    scale = _residual_scale(residual[near], config)
    ratio = residual / (BIWEIGHT_CUTOFF * scale)
    weight = np.where(near & (np.abs(ratio) < 1), (1 - ratio**2) ** 2, 0.0)
    return _Pairs(residual, jacobian, weight, near, scene.points_per_measurement * scale**2)


def _information(pairs: _Pairs, prior_information: np.ndarray) -> np.ndarray:
    """The inverse covariance (1/m^2) of the twist: that of the points plus that of the prior."""
    return pairs.jacobian.T @ (pairs.weight[:, None] * pairs.jacobian) / pairs.variance + prior_information


def _residual_scale(residual: np.ndarray, config: DepthRegistrationConfig) -> float:
    """Standard deviation (m) of the residuals, were they normal."""
    if not len(residual):
        return config.final_reach
    return max(STD_PER_MAD * float(np.median(np.abs(residual))), config.min_residual_scale)
