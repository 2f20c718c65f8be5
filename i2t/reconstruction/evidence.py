"""What one touch or one view says of an unknown object's surface.

  points   where the signed distance is known: zero on the surface, less behind it
  pad      its points, of which one lies on the surface, wherever the pad met it
  free     space that is known to be free, with a lower bound of the signed distance: what a pad swept on its way, or
           what a camera looked through

A touch whose reading is not used knows only that its pad met the surface somewhere; a reading says where. Metres; all
is in the frame of the object, as the lab believes it to stand.
"""

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

PAD_EDGE = 7  # points along each edge of the pad, among which the one that met the surface is sought
SWEPT_EDGE = 5  # points along each edge of the pad, of the space behind it
SWEPT_DEPTHS_M = (0.5e-3, 3e-3, 8e-3, 16e-3, 28e-3)  # behind the pad's plane
CENTRE_STD_M = 0.6e-3  # of the surface about a centre of pressure
PATCH_EDGE = 8  # points along each edge of the patch's window
FREE_QUANTILE, FREE_SHARE, LEAST_FREE_M = 0.05, 0.8, 0.4e-3  # of the posterior's depths, a part of which counts as free
INSIDE_DEPTH_M, INSIDE_STD_M = 3e-3, 2e-3  # behind a contact, where the object is expected to be solid
VIEW_POINTS, VIEW_FREE_POINTS, VIEW_FREE_M = 150, 300, 40e-3  # of a view; free ones lie so far before the others
VIEW_OBSERVATIONS = 15.0  # independent ones that a view counts as
VIEW_STD_M, VIEW_MARGIN_M = 1.5e-3, 3e-3  # of its points; before them space counts as free
TABLE_MARGIN_M = 2e-3
MAX_SWEPT_M = 10.0
OUTLINE_PIXELS = 3  # across: what is seen past the edge of a surface counts from so far beside it


class Sweep(NamedTuple):
    """Space that a pad swept on a straight way to a pose."""

    T_o_t: Float[np.ndarray, "4 4"]  # pose of the tool at first contact, or where the way through air ended
    length: float  # m of the way behind that pose

    def lower_bound(self, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """Lower bound of the signed distance of points: their depth in the swept space.

        Args:
            points: m.

        Returns:
            m; -inf for points that were not swept.
        """
        x, y, z = ((points - self.T_o_t[:3, 3]) @ self.T_o_t[:3, :3]).T
        half = PAD_WINDOW / 2
        depth = np.minimum(np.minimum(half - np.abs(x), half - np.abs(y)), np.minimum(-z, z + self.length))
        return np.where(depth > 0, depth, -np.inf)


class SeenThrough(NamedTuple):
    """Space between a camera and what it saw."""

    depth: Float[np.ndarray, "h w"]  # m, +inf where nothing was there, NaN where nothing is known
    camera: Camera
    T_o_c: Float[np.ndarray, "4 4"]

    def lower_bound(self, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """Lower bound of the signed distance of points: zero before what was seen.

        Args:
            points: m.

        Returns:
            m; -inf for points that the camera did not look through.
        """
        local = (points - self.T_o_c[:3, 3]) @ self.T_o_c[:3, :3]
        before = local[:, 2] > 0
        at = np.rint(distortion.project(self.camera, jnp.asarray(np.where(before[:, None], local, 1.0))))
        inside = before & (at >= 0).all(1) & (at < [self.camera.width, self.camera.height]).all(1)
        column, row = np.where(inside, at.T, 0).astype(int)
        nearest = minimum_filter(np.nan_to_num(self.depth, nan=0.0, posinf=np.inf), OUTLINE_PIXELS, mode="nearest")
        return np.where(inside & (local[:, 2] < nearest[row, column] - VIEW_MARGIN_M), 0.0, -np.inf)


class SurfaceEvidence(NamedTuple):
    """Evidence of one touch or one view."""

    region: Sweep | SeenThrough  # carved out of the surface exactly
    free: Float[np.ndarray, "f 3"]  # m, points of free space
    free_bound: Float[np.ndarray, " f"]  # m, lower bounds of the signed distance at them
    points: Float[np.ndarray, "n 3"] = np.zeros((0, 3))  # m
    values: Float[np.ndarray, " n"] = np.zeros(0)  # m, signed distances at them
    std: Float[np.ndarray, " n"] = np.zeros(0)  # m, of the values
    pad_points: Float[np.ndarray, "s 3"] = np.zeros((0, 3))  # m, of which one lies on the surface; none after air
    observations: float = 1.0  # independent ones that the points count as

    @property
    def is_contact(self) -> bool:
        """Whether a pad met a surface."""
        return len(self.pad_points) > 0


def contact_evidence(T_o_t: Float[Array, "4 4"], *, hit: bool = True, swept: float = STANDOFF) -> SurfaceEvidence:
    """Evidence of a touch of which nothing is known but the pose of contact.

    Args:
        T_o_t: Pose of the tool at first contact, or where the way through air ended.
        hit: Whether there was a contact.
        swept: m of the straight way behind that pose.

    Returns:
        The evidence: the surface lies somewhere on the pad's square, and what was swept is free.

    Raises:
        ValueError: The pose is not rigid and finite, or the way no way.
    """
    T_o_t = validation.pose("T_o_t", T_o_t)
    if not 0 < swept < MAX_SWEPT_M:
        raise ValueError(f"swept: is {swept}; give a way in metres, above 0 and below {MAX_SWEPT_M:g}")
    sweep = Sweep(T_o_t, float(swept))
    edge = 0.9 * PAD_WINDOW * (np.arange(SWEPT_EDGE) / (SWEPT_EDGE - 1) - 0.5)
    free = _to_object(T_o_t, _grid(edge, edge, -np.array(SWEPT_DEPTHS_M)))
    bound = sweep.lower_bound(free)
    touch = SurfaceEvidence(sweep, free[bound > 0], bound[bound > 0])
    along = PAD_WINDOW * (np.arange(PAD_EDGE) / (PAD_EDGE - 1) - 0.5)
    return touch._replace(pad_points=_to_object(T_o_t, _grid(along, along, np.zeros(1)))) if hit else touch


def reading_evidence(
    T_o_t: Float[Array, "4 4"], posterior: PatchPosterior, *, swept: float = STANDOFF
) -> SurfaceEvidence:
    """Evidence of a touch whose reading says where in its square the pad met the surface.

    Args:
        T_o_t: Pose of the tool at first contact.
        posterior: Of the patch that the pad met, by `infer_patch`.
        swept: m of the straight way behind that pose.

    Returns:
        The evidence: the centre of pressure lies on the surface, and what nearly all patches leave free is free.

    Raises:
        ValueError: The pose is not rigid and finite, or the way no way.
    """
    touch = contact_evidence(T_o_t, swept=swept)
    centre = np.append(np.asarray(posterior.centre, float), 0.0)
    found = with_surface_points(touch, centre[None], np.array([CENTRE_STD_M]))
    patches = np.asarray(posterior.patch)
    place = ((np.arange(PATCH_EDGE) + 0.5) / PATCH_EDGE * patches.shape[-1]).astype(int)
    return with_free_patch(found, np.quantile(patches[:, place][:, :, place].astype(np.float32), FREE_QUANTILE, axis=0))


def with_surface_points(
    touch: SurfaceEvidence, local: Float[np.ndarray, "n 3"], std: Float[np.ndarray, " n"]
) -> SurfaceEvidence:
    """A touch with points of the surface that it felt, and one behind the surest of them, where the object is solid.

    Args:
        touch: By `contact_evidence`.
        local: m, in the frame of the tool.
        std: m, of their distances to the surface.

    Returns:
        The evidence.
    """
    assert isinstance(touch.region, Sweep)
    if not (len(local) and np.isfinite(local).all() and (std > 0).all()):
        raise ValueError("points of a touch must be finite, one or more, with standard deviations above 0")
    behind = local[[int(std.argmin())]] + [0, 0, INSIDE_DEPTH_M]
    return touch._replace(
        points=_to_object(touch.region.T_o_t, np.concatenate([local, behind])),
        values=np.append(np.zeros(len(local)), -INSIDE_DEPTH_M),
        std=np.append(std, INSIDE_STD_M),
    )


def with_free_patch(touch: SurfaceEvidence, depth: Float[np.ndarray, "e e"]) -> SurfaceEvidence:
    """A touch that leaves the space before its pad free.

    Args:
        touch: By `contact_evidence`.
        depth: m beyond the pad's plane that are free, over the patch's window; row i along tool y. Only a part of it is
            believed.

    Returns:
        The evidence.
    """
    assert isinstance(touch.region, Sweep)
    at = ((np.arange(len(depth)) + 0.5) / len(depth) - 0.5) * PATCH_WINDOW
    y, x = np.meshgrid(at, at, indexing="ij")
    local = np.stack([x, y, FREE_SHARE * depth], -1)[FREE_SHARE * depth > LEAST_FREE_M]
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
    """Evidence of a view of the object by a depth camera.

    Args:
        depth: m along the camera's axis, +inf where nothing was there, NaN or 0 where nothing is known.
        camera: Its intrinsics.
        T_o_c: Pose of the camera (z forwards).
        table: m, height of what the object stands on; what is no more than 2 mm above it is not the object.
        box: (3,) m each, lowest and highest corner of the box that the object is known to be in; what is seen outside
            of it is not the object.

    Returns:
        The evidence: points of the surface, and space that the camera looked through.

    Raises:
        ValueError: The view shows nothing above the table and in the box, its size is not the camera's, or the
            camera's pose is not rigid and finite.
    """
    depth, T_o_c = validation.numbers("depth", depth, "an image of metres"), validation.pose("T_o_c", T_o_c)
    check_image(depth, camera)
    depth = depth.astype(np.float64)
    rng = np.random.default_rng(0)
    depth = np.where(measured_mask(depth) | np.isposinf(depth), depth, np.nan)  # infinite: nothing was there
    row, column = np.nonzero(np.isfinite(depth))
    pixels = jnp.stack([column, row], -1).astype(jnp.float32)
    points = _to_object(T_o_c, np.asarray(distortion.deproject(camera, pixels, jnp.asarray(depth[row, column]))))
    low, high = (-np.inf, np.inf) if box is None else map(np.asarray, box)
    of_object = (points[:, 2] > table + TABLE_MARGIN_M) & ((points > low) & (points < high)).all(1)
    points = points[of_object].astype(np.float64)
    if not len(points):
        raise ValueError(
            "the depth image shows nothing above the table and in the box; check its unit, the camera's pose, `table` "
            "and `box`"
        )
    points = points[rng.permutation(len(points))[:VIEW_POINTS]]
    # Free space is looked at on the way to the points, most of it near them.
    ends = points[rng.integers(len(points), size=VIEW_FREE_POINTS)]
    way = T_o_c[:3, 3] - ends
    before = VIEW_MARGIN_M + VIEW_FREE_M * rng.uniform(0, 1, (VIEW_FREE_POINTS, 1)) ** 2
    free = ends + before * way / np.linalg.norm(way, axis=1, keepdims=True)
    return SurfaceEvidence(
        SeenThrough(depth, camera, T_o_c),
        free,
        np.zeros(len(free)),
        points,
        np.zeros(len(points)),
        np.full(len(points), VIEW_STD_M),
        observations=VIEW_OBSERVATIONS,
    )


def _grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)


def _to_object(T_o_t: np.ndarray, local: np.ndarray) -> np.ndarray:
    return local @ T_o_t[:3, :3].T + T_o_t[:3, 3]
