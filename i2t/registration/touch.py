"""Where an object really is: its pose from touches that probe it, or from a depth image, and how well either tells it.

The object is believed at `T_w_o` and stands at `T_w_o exp(x)`, where x (6,) is a twist in its own frame as in
`i2t.registration.patch`: three translations (m), then three rotations times `LEVER`, all in metres.

Touches. At first contact the skin's flat square face just meets the surface: the gap to the lowest surface point inside
the square (`i2t.simulation.sites.nearest_in_square`) is zero up to noise. On a steep facet a sideways error changes the
gap more than itself, so a residual is the gap over the length of its derivative by translations, the distance along the
normal (Sampson, "Fitting conic sections to very scattered data", 1982). With x normal before and residuals distributed
as Student's t (Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989), the most
probable x is sought by Levenberg-Marquardt steps on the reweighted squares, while the noise shrinks from the size of
the prior's own errors to what it is (deterministic annealing; Rose, "Deterministic annealing for clustering,
compression, classification, regression, and related optimization problems", 1998). The contact of edges and corners is
not smooth, so the search starts from several draws of the prior and keeps the most probable end. Nor are posteriors
normal there: from the mode and the inverse of the Gauss-Newton matrix (Laplace's method) on, mean and covariance are
corrected by rounds of importance sampling, each from what the one before found (population Monte Carlo; Cappé, Guillin,
Marin and Robert, J. Comput. Graph. Stat. 13, 2004). What no touch tells keeps the prior's.

Depth. Points of the image that lie near the believed object, and not on the table, are drawn to the planes of the
surface's nearest samples, over and over (iterative closest points; Besl and McKay, "A method for registration of 3-D
shapes", 1992; to planes: Chen and Medioni, "Object modelling by registration of multiple range images", 1992). Samples
that face away from the camera are no candidates, the distance at which a pair counts shrinks, and Tukey's biweight
with a scale of 1.48 median absolute residuals leaves out what is still something else (Holland and Welsch, "Robust
regression using iteratively reweighted least-squares", 1977). This part is NumPy, for the host.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Array, Bool, Float, Key
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera, check_image
from i2t.depth.distortion import pixel_rays
from i2t.geometry import full_precision, inverse, is_rigid
from i2t.objects.solids import Mesh
from i2t.registration.patch import EASE, STIFFEN, motion
from i2t.simulation.sites import nearest_in_square
from i2t.types import PAD_WINDOW, STANDOFF, TWIST_LEVER_M, ReturnCode, Surface, Touches

STUDENT_T_DOF = 4.0  # degrees of freedom of Student's t: the usual compromise of Lange et al.
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e6  # of the Gauss-Newton matrix's diagonal
UNSEEN = 1e3  # m, residual of a motion that was not looked at yet: worse than any
TAIL = 5  # degrees of freedom of what is drawn: heavier tails than any posterior's
LEAST_SPREAD = 1e-3  # of draws, in standard deviations of the prior, for float32's sake
SAMPLES = 40_000  # of a surface: half a millimetre apart on an object of a decimetre
BIWEIGHT = 4.685  # scales beyond which Tukey's weight is zero (95 % efficient where all is normal)


@dataclass(frozen=True)
class TouchRegistrationConfig:
    """How a pose is sought from touches."""

    starts: int = 12  # draws of the prior; the first is its mean
    cooling: int = 10  # steps while the noise shrinks
    steps: int = 10  # and at its true size
    draws: int = 256  # for the moments of the posterior
    rounds: int = 4  # of drawing; 0 leaves mode and curvature
    half: float = PAD_WINDOW / 2  # m, half edge of the face
    faces: int = 128  # of the surface at each touch: those that could come nearest


@dataclass(frozen=True)
class DepthRegistrationConfig:
    """How a pose is sought from a depth image."""

    reach: float = 15e-3  # m from the believed object within which a point counts, at first
    close: float = 3e-3  # m, and at the end
    shrink: float = 0.8  # from step to step
    steps: int = 40  # at most
    settled: float = 1e-6  # m, ends when a step is shorter
    points: int = 5000  # at most, drawn from the image
    clearance: float = 2e-3  # m above the table below which a point may be the table's
    enough: int = 50  # points
    overlap: float = 0.3  # least share of the points that must end close to the surface
    least: float = 1e-5  # m, scale of residuals: below it they are rounding
    seed: int = 0


class PoseEstimate(NamedTuple):
    """A pose, how well it is known, and how well it explains what was measured."""

    T_w_o: Float[Array, "4 4"]
    covariance: Float[Array, "6 6"]  # m^2, of the twist x in T_w_o exp(x)
    residual: Float[Array, " n"]  # m, of each touch or point
    weight: Float[Array, " n"]  # of each, from 0 for an outlier to about 1
    cost: Float[Array, ""]  # minus the logarithm of the posterior density, up to a constant


class _Seen(NamedTuple):
    """What a motion leaves, with derivatives by the motion in standard deviations of the prior."""

    residual: Float[Array, " n"]  # m, along the surface's normal
    slopes: Float[Array, "n 6"]
    stretch: Float[Array, " n"]  # of the gap along tool z against that


class _Probe(NamedTuple):
    """The best motion so far, in standard deviations of the prior, what it leaves, and what to try next."""

    z: Float[Array, "6"]
    seen: _Seen
    trial: Float[Array, "6"]
    damping: Float[Array, ""]


def contact_poses(touches: Touches) -> tuple[Float[Array, "n 4 4"], Bool[Array, " n"]]:
    """Poses of first contact of recorded touches, and which of them met the object: each is the pose at the end of the
    press, taken back along tool z by the measured travel past contact.
    """
    met = jnp.isfinite(touches.depth)
    met &= (touches.code == ReturnCode.SKIN) | (touches.code == ReturnCode.WRENCH)
    back = jnp.where(met, touches.depth, 0.0)
    return touches.T_w_t.at[:, :3, 3].add(-back[:, None] * touches.T_w_t[:, :3, 2]), met


@full_precision
def register_by_touch(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_contact: Float[Array, "n 4 4"],
    weight: Float[Array, " n"] | Bool[Array, " n"],
    distance: float | Float[Array, ""],
    angle: float | Float[Array, ""],
    noise: float | Float[Array, ""] = 0.1e-3,
    how: TouchRegistrationConfig = TouchRegistrationConfig(),
) -> PoseEstimate:
    """The mean pose of an object believed at `T_w_o` that was met at the tool poses `T_w_contact`.

    Before, each axis is normal with standard deviation `distance` (m) and `angle` (rad); contact is known to `noise`
    (m), which counts the arm, the skin's tilt times its half edge, and the object's shape. `weight` 0 (or false) leaves
    a touch out, whatever its pose holds: one in air. Residuals, weights and cost are those of the most probable pose.
    Iterations and starts are static.
    """
    spread = jnp.stack([jnp.asarray(distance, jnp.float32)] * 3 + [jnp.asarray(angle * TWIST_LEVER_M, jnp.float32)] * 3)
    weight = jnp.asarray(weight, jnp.float32)
    T_w_t = jnp.where((weight > 0)[:, None, None], T_w_contact, jnp.eye(4)[None])
    T_t_o = jax.vmap(lambda T: inverse(T) @ T_w_o)(T_w_t)
    triangles = jax.vmap(lambda T: _candidates(surface, T, how, 3 * distance, 3 * angle))(T_t_o)

    def look_once(x, T, triangles):
        face = triangles[jnp.argmin(_gaps(triangles, T @ motion(x), how.half))]
        gap, slope = jax.value_and_grad(lambda x: _gap(face, T @ motion(x), how.half))(x)
        stretch = jnp.maximum(jnp.linalg.norm(slope[:3]), 1.0)
        return _Seen(gap / stretch, slope / stretch, stretch)

    def look(z):
        seen = jax.vmap(look_once, (None, 0, 0))(spread * z, T_t_o, triangles)
        told = (weight > 0) & jnp.isfinite(seen.slopes).all(axis=1)
        return _Seen(
            jnp.where(weight > 0, seen.residual, 0.0),
            jnp.where(told[:, None], seen.slopes * spread[None], 0.0),
            jnp.where(told, seen.stretch, 1.0),
        )

    def cost(z, seen, scale):
        """Minus the logarithm of the posterior."""
        surprise = (STUDENT_T_DOF + 1) / 2 * jnp.log1p((seen.residual / scale) ** 2 / STUDENT_T_DOF) + jnp.log(
            seen.stretch
        )
        return 0.5 * z @ z + weight @ surprise

    def normal(seen, scale):
        """Weights of the squares that have the t distribution's slope, and the Gauss-Newton matrix."""
        share = weight * (STUDENT_T_DOF + 1) / (STUDENT_T_DOF + (seen.residual / scale) ** 2)
        return share, seen.slopes.T @ (share[:, None] * seen.slopes) / scale**2 + jnp.eye(6)

    def step(probe, scale):
        """Look where the last step led, keep it if it is better, and lead on from what was kept."""
        seen = probe._replace(z=probe.trial, seen=look(probe.trial), damping=probe.damping * EASE)
        back = probe._replace(damping=probe.damping * STIFFEN)
        better = cost(seen.z, seen.seen, scale) <= cost(back.z, back.seen, scale)
        probe = jax.tree.map(lambda new, old: jnp.where(better, new, old), seen, back)
        share, matrix = normal(probe.seen, scale)
        gradient = probe.seen.slopes.T @ (share * probe.seen.residual) / scale**2 + probe.z
        damping = jnp.clip(probe.damping, LEAST_DAMPING, MOST_DAMPING)
        damped = matrix + damping * jnp.diag(jnp.diagonal(matrix))
        trial = probe.z - jax.scipy.linalg.solve(damped, gradient, assume_a="pos")
        return probe._replace(trial=trial, damping=damping), None

    noise = jnp.asarray(noise, jnp.float32)
    wide = jnp.maximum(noise, jnp.hypot(spread[0], spread[3]))  # how far the prior may be off at the face
    fraction = jnp.minimum(jnp.arange(how.cooling + how.steps) / how.cooling, 1.0)
    scales = wide ** (1 - fraction) * noise**fraction

    def search(z):
        blind = _Seen(jnp.full(len(weight), UNSEEN), jnp.zeros((len(weight), 6)), jnp.ones(len(weight)))
        end, _ = jax.lax.scan(step, _Probe(z, blind, z, jnp.float32(LEAST_DAMPING)), scales)
        return end, cost(end.z, end.seen, noise)

    def adapt(belief, drawn):
        """Correct mean and covariance by draws of Student's t about them, weighted as the posterior's and, to take off
        the noise of drawing, as those of the normal distribution that was believed; a few draws change little.
        """
        mean, covariance = belief
        factor = jnp.linalg.cholesky(covariance + LEAST_SPREAD**2 * jnp.eye(6))
        u = drawn[:, :6] / jnp.sqrt(jnp.mean(drawn[:, 6:] ** 2, axis=1, keepdims=True))
        z = mean[None] + u @ factor.T
        square = jnp.sum(u**2, axis=1)
        heavy = (TAIL + 6) / 2 * jnp.log1p(square / TAIL)  # minus the logarithm of the density that was drawn from
        posterior = jax.nn.softmax(jax.lax.map(lambda z: -cost(z, look(z), noise), z) + heavy)
        change = posterior - jax.nn.softmax(heavy - square / 2)
        count = 1 / jnp.sum(posterior**2)  # effective number of draws
        trust = count / (count + 6)
        shift = trust * (change @ u)
        values, axes = jnp.linalg.eigh(jnp.eye(6) + trust * (u.T @ (change[:, None] * u)) - jnp.outer(shift, shift))
        root = factor @ axes * jnp.sqrt(jnp.maximum(values, 0.1))[None]
        return (mean + factor @ shift, root @ root.T), None

    key_starts, key_draws = jax.random.split(key)
    begins = jax.random.normal(key_starts, (how.starts, 6)).at[0].set(0.0)
    ends, costs = jax.lax.map(search, begins)
    best = jnp.argmin(costs)
    end = jax.tree.map(lambda leaf: leaf[best], ends)
    share, matrix = normal(end.seen, noise)
    belief = end.z, jnp.linalg.inv(matrix)
    (z, covariance), _ = jax.lax.scan(adapt, belief, jax.random.normal(key_draws, (how.rounds, how.draws, 6 + TAIL)))
    covariance = spread[:, None] * covariance * spread[None]
    return PoseEstimate(T_w_o @ motion(spread * z), covariance, end.seen.residual, share, costs[best])


def _gap(triangle: Float[Array, "3 3"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, ""]:
    """Gap (m) between the square face and a triangle, negative where they overlap; one beside the face is far off."""
    gap = nearest_in_square(Surface(triangle[None]), T_t_o, half)
    return jnp.where(gap < jnp.inf, gap, STANDOFF)


def _gaps(triangles: Float[Array, "k 3 3"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, " k"]:
    return jax.vmap(_gap, (0, None, None))(triangles, T_t_o, half)


def _candidates(
    surface: Surface,
    T_t_o: Float[Array, "4 4"],
    how: TouchRegistrationConfig,
    distance: float | Array,
    angle: float | Array,
) -> Float[Array, "k 3 3"]:
    """The faces that come nearest when the object moves sideways by up to `distance` (m) and turns by `angle` (rad)."""
    triangles = jnp.asarray(surface.triangles)
    arm = jnp.linalg.norm(T_t_o[:3, 3])
    gaps = _gaps(triangles, T_t_o, how.half + distance + angle * arm)
    _, nearest = jax.lax.top_k(-gaps, min(how.faces, len(triangles)))
    return triangles[nearest]


def register_by_depth(
    mesh: Mesh,
    T_w_o: Float[np.ndarray | Array, "4 4"],
    depth: Float[np.ndarray | Array, "height width"],
    camera: Camera,
    T_w_c: Float[np.ndarray | Array, "4 4"],
    distance: float = 10e-3,
    angle: float = 0.1,
    *,
    table: float | None = 0.0,
    alike: float = 1.0,
    how: DepthRegistrationConfig = DepthRegistrationConfig(),
) -> PoseEstimate:
    """The pose of an object believed at `T_w_o`, from a depth image (m, holes not positive or not finite) of a camera
    at `T_w_c`; host code.

    Before, each axis is normal with standard deviation `distance` (m) and `angle` (rad). `table` is the height (m) in W
    of the plane the object stands on, or None where the image shows none. Noise is measured, from the residuals; where
    about `alike` neighbouring points share theirs, as in stereo cameras, they count as one in the covariance, which
    knows nothing of a bias of the camera. Raises ValueError where the image is not the camera's, a pose is not rigid,
    too few points lie near the object, or too few of those fit its surface.
    """
    depth, T_w_c, start = np.asarray(depth), np.asarray(T_w_c, float), np.asarray(T_w_o, float)
    check_image(depth, camera)
    for name, pose in (("T_w_o", start), ("T_w_c", T_w_c)):
        if not bool(is_rigid(jnp.asarray(pose, jnp.float32))):
            raise ValueError(f"{name}: is not a rigid motion; correct it")
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    samples, faces = trimesh.sample.sample_surface(whole, SAMPLES, seed=how.seed)
    normals = whole.face_normals[faces]
    eye = (np.linalg.inv(start) @ T_w_c)[:3, 3]
    facing = np.sum((eye - samples) * normals, axis=1) > 0
    samples, normals = samples[facing], normals[facing]
    tree = cKDTree(samples)

    points = _points(depth, camera, T_w_c)
    if table is not None:
        points = points[points[:, 2] > table + how.clearance]
    apart, _ = tree.query(_moved(np.linalg.inv(start), points), distance_upper_bound=how.reach)
    points = points[apart < how.reach]
    if len(points) < how.enough:
        raise ValueError(
            f"depth: {len(points)} points lie within {1e3 * how.reach:g} mm of the believed object, of {how.enough} "
            "needed; correct T_w_o or T_w_c, or look from nearer"
        )
    alike = max(1.0, alike * min(1.0, how.points / len(points)))  # those that are drawn lie further apart
    if len(points) > how.points:
        points = np.random.default_rng(how.seed).choice(points, how.points, replace=False)

    prior = np.diag([distance] * 3 + [angle * TWIST_LEVER_M] * 3) ** 2
    inverse = np.linalg.inv(prior)
    T, limit = start, how.reach
    for _ in range(how.steps):
        residual, slopes, weight, near = _pairs(_moved(np.linalg.inv(T), points), tree, samples, normals, limit, how)
        scale = _scale(residual[near], how)
        information = slopes.T @ (weight[:, None] * slopes) / (alike * scale**2) + inverse
        gradient = slopes.T @ (weight * residual) / (alike * scale**2) + inverse @ _twist(np.linalg.inv(start) @ T)
        step = -np.linalg.solve(information, gradient)
        turn = Rotation.from_rotvec(step[3:] / TWIST_LEVER_M).as_matrix()
        T = T @ np.block([[turn, step[:3, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        if limit == how.close and np.linalg.norm(step) < how.settled:
            break
        limit = max(limit * how.shrink, how.close)
    if near.mean() < how.overlap:
        raise ValueError(
            f"depth: {100 * near.mean():.0f} % of {len(points)} points near the object fit its surface within "
            f"{1e3 * how.close:g} mm, of {100 * how.overlap:.0f} % needed; check the mesh and its believed pose"
        )
    off = _twist(np.linalg.inv(start) @ T)
    cost = 0.5 * off @ inverse @ off + 0.5 * np.sum(weight * residual**2) / (alike * scale**2)
    fields = (T, np.linalg.inv(information), residual, weight, cost)
    return PoseEstimate(*(jnp.asarray(field, jnp.float32) for field in fields))


def camera_covariance(
    covariance: Float[np.ndarray | Array, "6 6"],
    T_c_o: Float[np.ndarray | Array, "4 4"],
    distance: float,
    angle: float,
) -> Float[np.ndarray, "6 6"]:
    """The covariance (m^2) of an object's twist with that of the camera that found it at `T_c_o` added: the camera
    stands on each axis `distance` (m) and `angle` (rad) off (one sigma), and the object moves with it.
    """
    T = np.asarray(T_c_o, float)
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    about = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])  # times a small turn: how the object's origin moves
    moved = np.block([[R.T, R.T @ about], [np.zeros((3, 3)), TWIST_LEVER_M * R.T]])
    return np.asarray(covariance, float) + moved @ np.diag([distance**2] * 3 + [angle**2] * 3) @ moved.T


def _points(depth: np.ndarray, camera: Camera, T_w_c: np.ndarray) -> np.ndarray:
    """What the camera measured, in W (n, 3)."""
    x, y = np.asarray(pixel_rays(camera), float)
    points = np.stack([x, y, np.ones_like(x)], axis=-1) * np.where(depth > 0, depth, np.nan)[..., None]
    return _moved(T_w_c, points[np.isfinite(points).all(axis=-1)])


def _moved(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ T[:3, :3].T + T[:3, 3]


def _twist(T: np.ndarray) -> np.ndarray:
    return np.concatenate([T[:3, 3], TWIST_LEVER_M * Rotation.from_matrix(T[:3, :3]).as_rotvec()])


def _scale(residual: np.ndarray, how: DepthRegistrationConfig) -> float:
    """Their standard deviation, were they normal."""
    return max(1.4826 * float(np.median(np.abs(residual))), how.least) if len(residual) else how.close


def _pairs(
    points: np.ndarray,
    tree: cKDTree,
    samples: np.ndarray,
    normals: np.ndarray,
    limit: float,
    how: DepthRegistrationConfig,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Distances of points in O to the planes of their nearest samples, their derivatives by a twist of the object, the
    biweights, and which points are near enough to count.
    """
    apart, index = tree.query(points)
    near = apart < limit
    n = normals[index]
    residual = np.sum(n * (points - samples[index]), axis=1)
    slopes = -np.concatenate([n, np.cross(points, n) / TWIST_LEVER_M], axis=1)
    ratio = residual / (BIWEIGHT * _scale(residual[near], how))
    return residual, slopes, np.where(near & (np.abs(ratio) < 1), (1 - ratio**2) ** 2, 0.0), near
