"""What one touch or one view says of an unknown object's surface.

  points   where the signed distance is known: zero on the surface, less behind it
  square   points of the pad, of which some lie on the surface, wherever the pad met it
  free     space that is known to be free, with a lower bound of the signed distance: what a pad swept on its way, or
           what a camera looked through

A touch whose reading is not used knows only that its pad met the surface somewhere; a reading says where. Metres; all
is in the frame of the object, as the lab believes it to stand.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from i2t.depth import distortion
from i2t.depth.camera import Camera
from i2t.reconstruction.local_shape import PatchPosterior
from i2t.types import Array
from i2t.windows import PAD_WINDOW, PATCH_WINDOW, STANDOFF

SQUARE_EDGE = 7  # points along each edge of the pad
SWEPT_EDGE = 5  # points along each edge of the pad, of the space behind it
SWEPT_DEPTHS_M = (0.5e-3, 3e-3, 8e-3, 16e-3, 28e-3)  # behind the pad's plane
CENTRE_STD_M = 0.6e-3  # of the surface about a centre of pressure
PATCH_EDGE = 8  # points along each edge of the patch's window
FREE_QUANTILE, FREE_SHARE, LEAST_FREE_M = 0.05, 0.8, 0.4e-3  # of the posterior's depths, a part of which counts as free
INSIDE_DEPTH_M, INSIDE_STD_M = 3e-3, 2e-3  # behind a contact, where the object is expected to be solid
VIEW_POINTS, VIEW_FREE_POINTS = 150, 300  # of a view
VIEW_OBSERVATIONS = 15.0  # independent ones that a view counts as
VIEW_STD_M, VIEW_MARGIN_M = 1e-3, 2e-3  # of its points; before them space counts as free
TABLE_MARGIN_M = 2e-3


class Sweep(NamedTuple):
    """Space that a pad swept on a straight way to a pose."""

    T_o_t: Float[np.ndarray, "4 4"]  # pose of the tool at first contact, or where the way through air ended
    length: float  # m of the way behind that pose

    @property
    def inwards(self) -> Float[np.ndarray, "3"]:
        """Unit vector along which the pad moved."""
        return self.T_o_t[:3, 2]

    def bound(self, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """Depth of points in the swept space: no surface is nearer to them."""
        x, y, z = ((points - self.T_o_t[:3, 3]) @ self.T_o_t[:3, :3]).T
        half = PAD_WINDOW / 2
        depth = np.minimum(np.minimum(half - np.abs(x), half - np.abs(y)), np.minimum(-z, z + self.length))
        return np.where(depth > 0, depth, -np.inf)


class SeenThrough(NamedTuple):
    """Space between a camera and what it saw."""

    depth: Float[np.ndarray, "h w"]  # m, +inf where nothing was there, NaN where nothing is known
    camera: Camera
    T_o_c: Float[np.ndarray, "4 4"]

    @property
    def inwards(self) -> Float[np.ndarray, "3"]:
        """Unit vector along which the camera looked."""
        return self.T_o_c[:3, 2]

    def bound(self, points: Float[np.ndarray, "q 3"]) -> Float[np.ndarray, " q"]:
        """Zero for points that lie before what was seen."""
        local = (points - self.T_o_c[:3, 3]) @ self.T_o_c[:3, :3]
        before = local[:, 2] > 0
        at = np.rint(distortion.project(self.camera, jnp.asarray(np.where(before[:, None], local, 1.0))))
        inside = before & (at >= 0).all(1) & (at < [self.camera.width, self.camera.height]).all(1)
        column, row = np.where(inside, at.T, 0).astype(int)
        free = inside & (local[:, 2] < self.depth[row, column] - VIEW_MARGIN_M)
        return np.where(free, 0.0, -np.inf)


class SurfaceEvidence(NamedTuple):
    """Evidence of one touch or one view."""

    region: Sweep | SeenThrough  # carved out of the surface exactly
    points: Float[np.ndarray, "n 3"]  # m
    values: Float[np.ndarray, " n"]  # m, signed distances at them
    std: Float[np.ndarray, " n"]  # m, of the values
    square: Float[np.ndarray, "s 3"]  # m, points of which the nearest to the surface lies on it; none after air
    free: Float[np.ndarray, "f 3"]  # m, points of free space
    bound: Float[np.ndarray, " f"]  # m, lower bounds of the signed distance at them
    observations: float = 1.0  # independent ones that the points count as

    @property
    def hit(self) -> bool:
        """Whether a surface was met."""
        return len(self.square) > 0 or len(self.points) > 0


def contact_evidence(T_o_t: Float[Array, "4 4"], *, hit: bool = True, swept: float = STANDOFF) -> SurfaceEvidence:
    """Evidence of a touch of which nothing is known but the pose of contact.

    Args:
        T_o_t: Pose of the tool at first contact, or where the way through air ended.
        hit: Whether there was a contact.
        swept: m of the straight way behind that pose.

    Returns:
        The evidence: the surface lies somewhere on the pad's square, and what was swept is free.
    """
    T_o_t = np.asarray(T_o_t, np.float64)
    along = PAD_WINDOW * (np.arange(SQUARE_EDGE) / (SQUARE_EDGE - 1) - 0.5)
    square = _grid(along, along, np.zeros(1)) if hit else np.zeros((0, 3))
    edge = 0.9 * PAD_WINDOW * (np.arange(SWEPT_EDGE) / (SWEPT_EDGE - 1) - 0.5)
    free = _grid(edge, edge, -np.array(SWEPT_DEPTHS_M))
    sweep = Sweep(T_o_t, float(swept))
    inner = _to_object(T_o_t, free)
    nothing = np.zeros(0)
    return SurfaceEvidence(
        sweep, np.zeros((0, 3)), nothing, nothing, _to_object(T_o_t, square), inner, np.maximum(sweep.bound(inner), 0)
    )


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
    """
    T_o_t = np.asarray(T_o_t, np.float64)
    touch = contact_evidence(T_o_t, swept=swept)
    centre = np.append(np.asarray(posterior.centre, float), 0.0)
    found = with_surface_points(touch, _to_object(T_o_t, centre[None]), np.array([CENTRE_STD_M]))
    # What nearly all samples leave free before the pad.
    patches = np.asarray(posterior.patch)
    place = ((np.arange(PATCH_EDGE) + 0.5) / PATCH_EDGE * patches.shape[-1]).astype(int)
    low = FREE_SHARE * np.quantile(patches[:, place][:, :, place].astype(np.float32), FREE_QUANTILE, axis=0).ravel()
    at = ((np.arange(PATCH_EDGE) + 0.5) / PATCH_EDGE - 0.5) * PATCH_WINDOW
    y, x = (each.ravel() for each in np.meshgrid(at, at, indexing="ij"))
    free = _to_object(T_o_t, np.stack([x, y, low], -1)[low > LEAST_FREE_M])
    return found._replace(free=np.concatenate([found.free, free]), bound=np.append(found.bound, np.zeros(len(free))))


def with_surface_points(
    touch: SurfaceEvidence, points: Float[np.ndarray, "n 3"], std: Float[np.ndarray, " n"]
) -> SurfaceEvidence:
    """A touch with points of the surface that it felt, and one behind the surest of them, where the object is solid.

    Args:
        touch: By `contact_evidence`.
        points: m, in the object's frame.
        std: m, of their distances to the surface.

    Returns:
        The evidence.
    """
    behind = points[[int(std.argmin())]] + INSIDE_DEPTH_M * touch.region.inwards
    return touch._replace(
        points=np.concatenate([points, behind]),
        values=np.append(np.zeros(len(points)), -INSIDE_DEPTH_M),
        std=np.append(std, INSIDE_STD_M),
    )


def view_evidence(
    depth: Float[np.ndarray, "h w"],
    camera: Camera,
    T_o_c: Float[np.ndarray, "4 4"],
    *,
    table: float = -np.inf,
    seed: int = 0,
) -> SurfaceEvidence:
    """Evidence of a view of the object by a depth camera.

    Args:
        depth: m along the camera's axis, +inf where nothing was there, NaN where nothing is known.
        camera: Its intrinsics.
        T_o_c: Pose of the camera (z forwards).
        table: m, height of what the object stands on; what is no more than 2 mm above it is not the object.
        seed: Of the choice of points.

    Returns:
        The evidence: points of the surface, and space that the camera looked through.
    """
    rng = np.random.default_rng(seed)
    row, column = np.nonzero(np.isfinite(depth))
    seen = distortion.deproject(
        camera, jnp.stack([column, row], -1).astype(jnp.float32), jnp.asarray(depth[row, column])
    )
    points = _to_object(T_o_c, np.asarray(seen, np.float64))
    points = points[points[:, 2] > table + TABLE_MARGIN_M]
    points = points[rng.permutation(len(points))[:VIEW_POINTS]]
    # Free space is looked at on the way to the points, near which it says most.
    part = rng.uniform(0, 1, (VIEW_FREE_POINTS, 1)) ** 2 * 40e-3
    ends = points[rng.integers(len(points), size=VIEW_FREE_POINTS)] if len(points) else np.zeros((0, 3))
    way = T_o_c[:3, 3] - ends
    free = ends + (VIEW_MARGIN_M + part[: len(ends)]) * way / np.linalg.norm(way, axis=1, keepdims=True)
    return SurfaceEvidence(
        SeenThrough(depth, camera, T_o_c),
        points,
        np.zeros(len(points)),
        np.full(len(points), VIEW_STD_M),
        np.zeros((0, 3)),
        free,
        np.zeros(len(free)),
        VIEW_OBSERVATIONS,
    )


def _grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)


def _to_object(T_o_t: np.ndarray, local: np.ndarray) -> np.ndarray:
    return local @ T_o_t[:3, :3].T + T_o_t[:3, 3]
