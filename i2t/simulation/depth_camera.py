"""Simulate a depth camera: a perspective view of triangles, its colours, and the errors of a real camera.

`render_view` rasterises triangles as a pinhole camera sees them (inverse depth is linear over a triangle's image).
`shade_view` colours the view. `add_depth_noise` displaces pixels near edges, adds noise and rounds to steps (Handa et
al., ICRA 2014), as `i2t.simulation.touches.apply_camera_model` does for the orthographic views of the tool frame.

Frames: B is the base in which the triangles are given, C the camera (z forwards, x right, y down). Metres. NumPy only.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int, UInt8

from i2t.depth.camera import Camera, Distortion
from i2t.types import Array


@runtime_checkable
class DepthErrors(Protocol):
    """Sizes of a depth camera's errors: sideways displacement (pixels), noise (m) and rounding step (m);
    `i2t.simulation.touches.SimulationErrors` is an example.
    """

    @property
    def depth_bleed(self) -> float:
        """Sideways displacement of depths in pixels, a standard deviation."""

    @property
    def depth_noise(self) -> float:
        """Standard deviation (m) of a pixel's depth."""

    @property
    def depth_quantum(self) -> float:
        """Step (m) to which depths are rounded; 0 for no rounding."""


def render_view(
    triangles: Float[Array, "n 3 3"], T_b_c: Float[Array, "4 4"], camera: Camera, *, near_plane: float = 5e-3
) -> tuple[Float[Array, "h w"], Int[Array, "h w"]]:
    """Render the view of triangles by a pinhole camera.

    Args:
        triangles: `(n, 3 corners, 3)` coordinates (m) in the base.
        T_b_c: Pose of the camera.
        camera: The camera, whose lens must be a pinhole.
        near_plane: Depth (m); a triangle with a corner nearer than this is not drawn at all.

    Returns:
        `(h, w)` depths (m) along the camera's axis, +inf where nothing is seen, and `(h, w)` index of the triangle that
        each pixel shows, -1 where nothing is seen; h and w are the image's height and width in pixels.

    Raises:
        ValueError: The camera's lens has distortion.
    """
    if camera.model != Distortion.NONE and any(camera.coefficients):
        raise ValueError(f"camera: the simulated one cannot have a {camera.model} lens; give the model 'none'")
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
    drawn = (z.min(1) > near_plane) & (np.abs(twice_area) > 1e-12)  # square pixels; smaller triangles are edge-on
    for i in np.flatnonzero(drawn & (ends[0][0] <= ends[0][1]) & (ends[1][0] <= ends[1][1])):
        (left, right), (top, bottom) = ((int(low[i]), int(high[i])) for low, high in ends)
        x, y = np.arange(left, right + 1)[None, :], np.arange(top, bottom + 1)[:, None]
        weights = [
            ((u[i, k] - u[i, j]) * (y - v[i, j]) - (v[i, k] - v[i, j]) * (x - u[i, j])) / twice_area[i]
            for j, k in ((1, 2), (2, 0), (0, 1))
        ]
        close = weights[0] / z[i, 0] + weights[1] / z[i, 1] + weights[2] / z[i, 2]
        part = (slice(top, bottom + 1), slice(left, right + 1))
        # A tolerance of the weights, so that no pixel falls between two triangles.
        front = (np.minimum.reduce(weights) >= -1e-9) & (close > inverse[part])
        inverse[part] = np.where(front, close, inverse[part])
        which[part] = np.where(front, i, which[part])
    with np.errstate(divide="ignore"):
        return 1 / inverse, which


def shade_view(
    triangles: Float[Array, "n 3 3"], which: Int[Array, "h w"], T_b_c: Float[Array, "4 4"]
) -> UInt8[Array, "h w 3"]:
    """Colour a view in grey; faces are brighter the more directly the camera looks at them, from either side.

    Args:
        triangles: `(n, 3 corners, 3)` coordinates (m) in the base.
        which: `(h, w)` triangles of the pixels from `render_view`, -1 where nothing is seen.
        T_b_c: Pose of the camera.

    Returns:
        `(h, w, 3)` red, green and blue of the pixels, from 0 to 255; black where nothing is seen.
    """
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    grey = np.append(40 + 200 * np.abs(normal @ T_b_c[:3, 2]), 0.0)  # the last is for pixels without a face
    return np.repeat(grey[which][..., None], 3, axis=-1).astype(np.uint8)


def add_depth_noise(
    depth: Float[Array, "h w"], errors: DepthErrors, random: np.random.Generator
) -> Float[Array, "h w"]:
    """Add the errors of a depth camera to a view: sideways displacement, noise and rounding to steps.

    Args:
        depth: `(h, w)` depths (m), +inf where nothing is seen.
        errors: Sizes of the errors.
        random: Random number generator.

    Returns:
        `(h, w)` depths (m), NaN where nothing is seen.
    """
    rows, columns = np.indices(depth.shape)
    shift = np.rint(errors.depth_bleed * random.standard_normal((2, *depth.shape), np.float32)).astype(int)
    depth = depth[np.clip(rows + shift[0], 0, depth.shape[0] - 1), np.clip(columns + shift[1], 0, depth.shape[1] - 1)]
    depth = depth + errors.depth_noise * random.standard_normal(depth.shape, np.float32)
    if errors.depth_quantum > 0:
        depth = np.rint(depth / errors.depth_quantum) * errors.depth_quantum
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32)


def table_triangles(T_b_o: Float[Array, "4 4"], *, half_edge: float = 0.2, cell: float = 0.05) -> Float[Array, "n 3 3"]:
    """Make the table on which an object stands, of small squares, so that no square is partly behind a camera.

    Args:
        T_b_o: Pose of the object, whose z = 0 is the table.
        half_edge: Half the edge (m) of the table.
        cell: Edge (m) of a square.

    Returns:
        `(n, 3 corners, 3)` coordinates (m) in the base.
    """
    edges = np.arange(-half_edge, half_edge - cell / 2, cell)
    corners: Sequence[tuple[float, float]] = [(0, 0), (cell, 0), (cell, cell), (0, cell)]
    squares = np.array([[(x + a, y + b, 0.0) for a, b in corners] for x in edges for y in edges])
    squares = squares @ T_b_o[:3, :3].T + T_b_o[:3, 3]
    return np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
