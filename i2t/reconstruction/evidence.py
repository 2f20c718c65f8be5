"""Evidence about an unknown object's surface from one touch or one view.

  points   points whose signed distance is given: zero on the surface, negative behind it
  pad      points of the pad, at least one of them on the surface, because the pad met it there
  free     points of free space with a lower bound of the signed distance: space that a pad swept on its path, or that a
           camera looked through

A touch without its reading only shows that its pad met the surface somewhere; the reading shows where. Lengths are in
metres, and everything is in the frame of the object, at its assumed pose.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import minimum_filter

from i2t import validation
from i2t.depth import distortion
from i2t.depth.camera import Camera, check_image, measured_mask
from i2t.patches.dimensions import PAD_WINDOW, PATCH_WINDOW, STANDOFF
from i2t.reconstruction.local_shape import PatchPosterior
from i2t.types import Array


@dataclass(frozen=True)
class EvidenceConfig:
    """Sampling and uncertainties of the evidence that touches and views give about a surface."""

    pad_edge: int = 7  # number of points along each edge of the pad, one of which met the surface
    swept_edge: int = 5  # number of points along each edge of the pad in the swept space behind it
    # m, depths of the swept points behind the pad's plane
    swept_depths: tuple[float, ...] = (0.5e-3, 3e-3, 8e-3, 16e-3, 28e-3)
    max_swept: float = 10.0  # m, longest accepted length of a sweep
    centre_std: float = 0.6e-3  # m, standard deviation of the surface's distance from a centre of pressure
    patch_edge: int = 8  # number of free points along each edge of the patch's window
    free_quantile: float = 0.05  # quantile of the posterior's depths down to which space is free
    free_fraction: float = 0.8  # fraction of the `free_quantile` depth that counts as free
    min_free: float = 0.4e-3  # m, smaller free depths are ignored
    inside_depth: float = 3e-3  # m, depth behind a contact at which the object is expected to be solid
    inside_std: float = 2e-3  # m, standard deviation of the signed distance at `inside_depth`
    view_points: int = 150  # number of points of the surface in a view
    view_free_points: int = 300
    view_free_range: float = 40e-3  # m, range before the surface of a view within which free points are placed
    view_observations: float = 15.0  # number of independent observations that a view is worth
    view_std: float = 1.5e-3  # m, standard deviation of the points of a view
    view_margin: float = 3e-3  # m, distance before the seen surface at which free space starts
    table_margin: float = 2e-3  # m, height above the table below which a point does not belong to the object
    outline_pixels: int = 3  # width of the filter that keeps free space away from the edge of a surface


_EVIDENCE = EvidenceConfig()  # default sampling and uncertainties of the evidence of touches and views on the surface


class Sweep(NamedTuple):
    """Free space that the pad swept on a straight path along the tool's z axis: the tool's pose at its end, and its
    length (m).
    """

    T_o_t: Float[np.ndarray, "4 4"]  # (4, 4) pose of the tool at first contact, or at the end of a sweep through air
    length: float  # m, length of the path to `T_o_t`

    def lower_bound(self, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """Bound the signed distance of points to the object's surface from below by their depth in the swept space.

        Args:
            points: `(q, 3)` points (m) in the object's frame.

        Returns:
            `(q,)` lower bounds (m), -inf for points that were not swept.
        """
        x, y, z = ((points - self.T_o_t[:3, 3]) @ self.T_o_t[:3, :3]).T
        half = PAD_WINDOW / 2
        depth = np.minimum(np.minimum(half - np.abs(x), half - np.abs(y)), np.minimum(-z, z + self.length))
        return np.where(depth > 0, depth, -np.inf)


class SeenThrough(NamedTuple):
    """Free space between a depth camera and the surfaces that it saw: depth image (m), camera, and its pose."""

    # m, depth image: +inf where there is no surface, NaN where the camera measured nothing
    depth: Float[np.ndarray, "h w"]
    camera: Camera
    T_o_c: Float[np.ndarray, "4 4"]

    def lower_bound(self, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """Bound the signed distance of points to the object's surface from below by 0 in front of the seen surfaces.

        Args:
            points: `(q, 3)` points (m) in the object's frame.

        Returns:
            `(q,)` lower bounds (m), -inf for points that the camera did not look through.
        """
        local = (points - self.T_o_c[:3, 3]) @ self.T_o_c[:3, :3]
        before = local[:, 2] > 0
        at = np.rint(distortion.project(self.camera, jnp.asarray(np.where(before[:, None], local, 1.0))))
        inside = before & (at >= 0).all(1) & (at < [self.camera.width, self.camera.height]).all(1)
        column, row = np.where(inside, at.T, 0).astype(int)
        depth = np.nan_to_num(self.depth, nan=0.0, posinf=np.inf)
        nearest = minimum_filter(depth, _EVIDENCE.outline_pixels, mode="nearest")
        return np.where(inside & (local[:, 2] < nearest[row, column] - _EVIDENCE.view_margin), 0.0, -np.inf)


class SurfaceEvidence(NamedTuple):
    """Evidence of one touch or view about a surface: the region of free space, points (m) in it with lower bounds of
    the signed distance, points (m) with signed distances (m, inside < 0) and their standard deviations, and points of
    the pad, one of which is on the surface (none without contact).
    """

    region: Sweep | SeenThrough  # free space, which is carved out of the surface exactly
    free: Float[np.ndarray, "f 3"]  # m, points in free space
    free_bound: Float[np.ndarray, " f"]  # m, lower bounds of the signed distance at `free`
    points: Float[np.ndarray, "n 3"] = np.zeros((0, 3))  # m, points with known signed distances
    values: Float[np.ndarray, " n"] = np.zeros(0)  # m, signed distances at `points`
    std: Float[np.ndarray, " n"] = np.zeros(0)  # m, standard deviations of `values`
    # m, points of the pad, one of which is on the surface; empty without contact
    pad_points: Float[np.ndarray, "s 3"] = np.zeros((0, 3))
    observations: float = 1.0  # number of independent observations that `points` are worth

    @property
    def is_contact(self) -> bool:
        """Whether a pad met a surface."""
        return len(self.pad_points) > 0


def contact_evidence(T_o_t: Float[Array, "4 4"], *, hit: bool = True, swept: float = STANDOFF) -> SurfaceEvidence:
    """Build the evidence of a touch from its pose alone.

    Args:
        T_o_t: Pose of the tool at first contact, or at the end of the path through air.
        hit: Whether there was a contact.
        swept: Length (m) of the straight path to that pose.

    Returns:
        Evidence that the surface lies somewhere on the pad's square and that the swept space is free.

    Raises:
        ValueError: The pose is not rigid and finite, or the path is not between 0 and 10 m long.
    """
    T_o_t = validation.pose("T_o_t", T_o_t)
    if not 0 < swept < _EVIDENCE.max_swept:
        raise ValueError(f"swept: is {swept}; give a distance in metres, above 0 and below {_EVIDENCE.max_swept:g}")
    sweep = Sweep(T_o_t, float(swept))
    edge = 0.9 * PAD_WINDOW * (np.arange(_EVIDENCE.swept_edge) / (_EVIDENCE.swept_edge - 1) - 0.5)
    free = _to_object(T_o_t, _grid(edge, edge, -np.array(_EVIDENCE.swept_depths)))
    bound = sweep.lower_bound(free)
    touch = SurfaceEvidence(sweep, free[bound > 0], bound[bound > 0])
    along = PAD_WINDOW * (np.arange(_EVIDENCE.pad_edge) / (_EVIDENCE.pad_edge - 1) - 0.5)
    return touch._replace(pad_points=_to_object(T_o_t, _grid(along, along, np.zeros(1)))) if hit else touch


def reading_evidence(
    T_o_t: Float[Array, "4 4"], posterior: PatchPosterior, *, swept: float = STANDOFF
) -> SurfaceEvidence:
    """Build the evidence of a touch whose reading shows where in its square the pad met the surface.

    Args:
        T_o_t: Pose of the tool at first contact.
        posterior: Posterior of the patch that the pad met, from `infer_patch`.
        swept: Length (m) of the straight path to that pose.

    Returns:
        Evidence that the centre of pressure lies on the surface and that the space which nearly all patches leave free
        is free.

    Raises:
        ValueError: The pose is not rigid and finite, or the path is not between 0 and 10 m long.
    """
    touch = contact_evidence(T_o_t, swept=swept)
    centre = np.append(np.asarray(posterior.centre, float), 0.0)
    felt = with_surface_points(touch, centre[None], np.array([_EVIDENCE.centre_std]))
    patches = np.asarray(posterior.patch)
    pixels = ((np.arange(_EVIDENCE.patch_edge) + 0.5) / _EVIDENCE.patch_edge * patches.shape[-1]).astype(int)
    depths = patches[:, pixels][:, :, pixels].astype(np.float32)
    return with_free_patch(felt, np.quantile(depths, _EVIDENCE.free_quantile, axis=0))


def with_surface_points(
    touch: SurfaceEvidence, local: Float[np.ndarray, "n 3"], std: Float[np.ndarray, " n"]
) -> SurfaceEvidence:
    """Add the points of the surface that a touch felt, and a solid point behind the most certain of them.

    Args:
        touch: Evidence of the touch from `contact_evidence`.
        local: Points (m) of the surface in the tool frame.
        std: Standard deviations (m) of their distances to the surface.

    Returns:
        Evidence of the touch with these points in the object's frame.
    """
    assert isinstance(touch.region, Sweep)
    if not (len(local) and np.isfinite(local).all() and (std > 0).all()):
        raise ValueError("give one or more surface points of a touch, all finite, with standard deviations above 0")
    behind = local[[int(std.argmin())]] + [0, 0, _EVIDENCE.inside_depth]
    return touch._replace(
        points=_to_object(touch.region.T_o_t, np.concatenate([local, behind])),
        values=np.append(np.zeros(len(local)), -_EVIDENCE.inside_depth),
        std=np.append(std, _EVIDENCE.inside_std),
    )


def with_free_patch(touch: SurfaceEvidence, depth: Float[np.ndarray, "e e"]) -> SurfaceEvidence:
    """Add the space that a touch leaves free in front of its pad.

    Args:
        touch: Evidence of the touch from `contact_evidence`.
        depth: Square image of free depths (m) beyond the pad's plane over the patch's window; row i along tool y. Only
            four fifths of each count as free, and depths of less than 0.4 mm are ignored.

    Returns:
        Evidence of the touch with these free points.
    """
    assert isinstance(touch.region, Sweep)
    at = ((np.arange(len(depth)) + 0.5) / len(depth) - 0.5) * PATCH_WINDOW
    y, x = np.meshgrid(at, at, indexing="ij")
    local = np.stack([x, y, _EVIDENCE.free_fraction * depth], -1)[_EVIDENCE.free_fraction * depth > _EVIDENCE.min_free]
    free = _to_object(touch.region.T_o_t, local)
    return touch._replace(
        free=np.concatenate([touch.free, free]), free_bound=np.append(touch.free_bound, np.zeros(len(free)))
    )


def view_evidence(
    depth: Float[np.ndarray, "h w"],
    camera: Camera,
    T_o_c: Float[np.ndarray, "4 4"],
    *,
    table: float = -np.inf,
    box: tuple[Array, Array] | None = None,
) -> SurfaceEvidence:
    """Build the evidence of a depth camera's view of the object.

    Args:
        depth: Depth (m) along the camera's axis, +inf where there is no surface, NaN or 0 where nothing was measured.
        camera: Intrinsics of the camera.
        T_o_c: Pose of the camera, whose z points forwards.
        table: Height (m) of the surface on which the object stands. Points up to 2 mm above it are not the object's.
        box: Lowest and highest corner, (3,) m each, of the box that holds the object. Points outside of it are not the
            object's.

    Returns:
        Evidence with randomly chosen points of the surface and the space that the camera looked through.

    Raises:
        ValueError: The view shows nothing above the table and in the box, its size is not the camera's, or the
            camera's pose is not rigid and finite.
    """
    depth, T_o_c = validation.numbers("depth", depth, "an image of metres"), validation.pose("T_o_c", T_o_c)
    check_image(depth, camera)
    depth = depth.astype(np.float64)
    rng = np.random.default_rng(0)
    depth = np.where(measured_mask(depth) | np.isposinf(depth), depth, np.nan)
    row, column = np.nonzero(np.isfinite(depth))
    pixels = jnp.stack([column, row], -1).astype(jnp.float32)
    points = _to_object(T_o_c, np.asarray(distortion.deproject(camera, pixels, jnp.asarray(depth[row, column]))))
    low, high = (-np.inf, np.inf) if box is None else map(np.asarray, box)
    of_object = (points[:, 2] > table + _EVIDENCE.table_margin) & ((points > low) & (points < high)).all(1)
    points = points[of_object].astype(np.float64)
    if not len(points):
        raise ValueError(
            "the depth image shows nothing above the table and in the box; check its unit, the camera's pose, `table` "
            "and `box`"
        )
    points = points[rng.permutation(len(points))[: _EVIDENCE.view_points]]
    # Free space is sampled on the rays to the points, most densely near them.
    ends = points[rng.integers(len(points), size=_EVIDENCE.view_free_points)]
    way = T_o_c[:3, 3] - ends
    before = _EVIDENCE.view_margin + _EVIDENCE.view_free_range * rng.uniform(0, 1, (_EVIDENCE.view_free_points, 1)) ** 2
    free = ends + before * way / np.linalg.norm(way, axis=1, keepdims=True)
    return SurfaceEvidence(
        SeenThrough(depth, camera, T_o_c),
        free,
        np.zeros(len(free)),
        points,
        np.zeros(len(points)),
        np.full(len(points), _EVIDENCE.view_std),
        observations=_EVIDENCE.view_observations,
    )


def _grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)


def _to_object(T_o_t: np.ndarray, local: np.ndarray) -> np.ndarray:
    return local @ T_o_t[:3, :3].T + T_o_t[:3, 3]
