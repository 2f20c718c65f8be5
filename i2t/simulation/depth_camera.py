"""A simulated depth camera: a perspective view of triangles, its colours, and the errors of a real camera.

`render_view` rasterises triangles as a pinhole camera sees them (inverse depth is linear over a triangle's image),
`shade_view` colours the view, and `add_depth_noise` displaces pixels near edges, adds noise and rounds to steps (Handa
et al., ICRA 2014), as `i2t.simulation.touches.apply_camera_model` does for the orthographic views of the tool frame.

Frames: B the base in which the triangles are given, C the camera (z forwards, x right, y down). Metres. NumPy only.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8

from i2t.depth.camera import Camera, Distortion
from i2t.types import Array

NEAR_PLANE_M = 5e-3  # before a camera, nearer than which nothing is drawn
TABLE_HALF_EDGE_M, TABLE_CELL_M = 0.2, 0.05  # of the table that the camera sees, and of its squares
INSIDE_TOLERANCE = 1e-9  # of barycentric weights, so that no pixel falls between two triangles
MIN_IMAGE_AREA = 1e-12  # square pixels, below which a triangle is seen edge-on


@runtime_checkable
class DepthErrors(Protocol):
    """Sizes of a depth camera's errors; `i2t.simulation.touches.SimulationErrors` has them."""

    @property
    def depth_bleed(self) -> float:
        """Pixels by which depth is displaced sideways."""

    @property
    def depth_noise(self) -> float:
        """Standard deviation (m) of a pixel."""

    @property
    def depth_quantum(self) -> float:
        """Size (m) of the steps of depth; 0 for none."""


def render_view(
    triangles: Float[Array, "n 3 3"], T_b_c: Float[Array, "4 4"], camera: Camera
) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """View of triangles by a pinhole camera.

    Args:
        triangles: (n, 3 corners, 3) m, in the base.
        T_b_c: pose of the camera.
        camera: its intrinsics; its lens must be a pinhole.

    Returns:
        Depth (h, w) m along the camera's axis, +inf where there is nothing, and the triangle of each pixel, -1 for
        none.

    Raises:
        ValueError: the camera has a lens that bends.
    """
    if camera.model != Distortion.NONE and any(camera.coefficients):
        raise ValueError(f"camera: the simulated one has no {camera.model} lens; give one with the model 'none'")
    local = (triangles - T_b_c[:3, 3]) @ T_b_c[:3, :3]
    inverse = np.zeros((camera.height, camera.width))
    which = np.full(inverse.shape, -1)
    z = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u = camera.fx * local[..., 0] / z + camera.cx
        v = camera.fy * local[..., 1] / z + camera.cy
        twice_area = (u[:, 1] - u[:, 0]) * (v[:, 2] - v[:, 0]) - (u[:, 2] - u[:, 0]) * (v[:, 1] - v[:, 0])
    ends = [
        (np.maximum(np.ceil(side.min(1)), 0), np.minimum(np.floor(side.max(1)), last - 1))
        for side, last in ((u, camera.width), (v, camera.height))
    ]
    drawn = (z.min(1) > NEAR_PLANE_M) & (np.abs(twice_area) > MIN_IMAGE_AREA)
    for i in np.flatnonzero(drawn & (ends[0][0] <= ends[0][1]) & (ends[1][0] <= ends[1][1])):
        (left, right), (top, bottom) = ((int(low[i]), int(high[i])) for low, high in ends)
        x, y = np.arange(left, right + 1)[None, :], np.arange(top, bottom + 1)[:, None]
        weights = [
            ((u[i, k] - u[i, j]) * (y - v[i, j]) - (v[i, k] - v[i, j]) * (x - u[i, j])) / twice_area[i]
            for j, k in ((1, 2), (2, 0), (0, 1))
        ]
        close = weights[0] / z[i, 0] + weights[1] / z[i, 1] + weights[2] / z[i, 2]
        part = (slice(top, bottom + 1), slice(left, right + 1))
        front = (np.minimum.reduce(weights) >= -INSIDE_TOLERANCE) & (close > inverse[part])
        inverse[part] = np.where(front, close, inverse[part])
        which[part] = np.where(front, i, which[part])
    with np.errstate(divide="ignore"):
        return 1 / inverse, which


def shade_view(
    triangles: Float[Array, "n 3 3"], which: Int[Array, "h w"], T_b_c: Float[Array, "4 4"]
) -> UInt8[Array, "h w 3"]:
    """Colours of a view: grey, the brighter the more a face looks at the camera.

    Args:
        triangles: (n, 3 corners, 3) m, in the base.
        which: the triangle of each pixel, -1 for none, from `render_view`.
        T_b_c: pose of the camera.

    Returns:
        Red, green and blue of each pixel.
    """
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    grey = np.append(40 + 200 * np.abs(normal @ T_b_c[:3, 2]), 0.0)  # the last is that of no face
    return np.repeat(grey[which][..., None], 3, axis=-1).astype(np.uint8)


def add_depth_noise(
    depth: Float[Array, "h w"], errors: DepthErrors, random: np.random.Generator
) -> Float[Array, "h w"]:
    """Add a depth camera's errors to a view: bled sideways, noisy and in steps.

    Args:
        depth: m, +inf where there is nothing.
        errors: sizes of the errors.
        random: where they are drawn from.

    Returns:
        Depth in m, NaN where there is nothing.
    """
    rows, columns = np.indices(depth.shape)
    shift = np.rint(errors.depth_bleed * random.standard_normal((2, *depth.shape), np.float32)).astype(int)
    depth = depth[np.clip(rows + shift[0], 0, depth.shape[0] - 1), np.clip(columns + shift[1], 0, depth.shape[1] - 1)]
    depth = depth + errors.depth_noise * random.standard_normal(depth.shape, np.float32)
    if errors.depth_quantum > 0:
        depth = np.rint(depth / errors.depth_quantum) * errors.depth_quantum
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def table_triangles(T_b_o: Float[Array, "4 4"]) -> Float[Array, "n 3 3"]:
    """The table on which an object stands, in small squares, so that none is half behind a camera.

    Args:
        T_b_o: pose of the object, whose z = 0 is the table.

    Returns:
        (n, 3 corners, 3) m, in the base.
    """
    edges = np.arange(-TABLE_HALF_EDGE_M, TABLE_HALF_EDGE_M - TABLE_CELL_M / 2, TABLE_CELL_M)
    corners: Sequence[tuple[float, float]] = [
        (0, 0), (TABLE_CELL_M, 0), (TABLE_CELL_M, TABLE_CELL_M), (0, TABLE_CELL_M),
    ]  # fmt: skip
    squares = np.array([[(x + a, y + b, 0.0) for a, b in corners] for x in edges for y in edges])
    squares = squares @ T_b_o[:3, :3].T + T_b_o[:3, 3]
    return np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
