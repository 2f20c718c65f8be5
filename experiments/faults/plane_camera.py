"""A camera that sees a horizontal plane, and its patch: closed forms that need neither mesh nor JAX."""

from collections.abc import Callable
from typing import Any

import numpy as np

from i2t.collect.touch import SeenPatch
from i2t.depth.camera import Camera
from i2t.errors import DeviceError, NotConnectedError
from i2t.hardware.clock import Clock
from i2t.hardware.protocols import CameraFeatures, View
from i2t.types import PATCH_PIXELS, WIDE_PIXELS, Array

NOISE_M = 0.3e-3  # of a pixel


class PlaneCamera:
    """A pinhole camera over a plane; while `trouble` is set, that is what it raises.

    Args:
        camera: Its size and lens.
        height: m, of the plane in the base.
        pose: Gives T_b_c (4, 4) now.
        clock: That dates its views.
    """

    def __init__(self, camera: Camera, height: float, pose: Callable[[], Array], clock: Clock) -> None:
        self.camera, self.height, self._pose, self._clock = camera, height, pose, clock
        self.trouble: DeviceError | None = None
        self.connects = 0
        self._open = False
        self._random = np.random.default_rng(0)
        u, v = np.arange(camera.width) - camera.cx, np.arange(camera.height) - camera.cy
        x, y = np.meshgrid(u / camera.fx, v / camera.fy)
        self._rays = np.stack([x, y, np.ones_like(x)], -1)

    @property
    def features(self) -> CameraFeatures:
        """Features of the camera, known before `connect`."""
        return CameraFeatures("the camera over a plane", "simulated", 0.0, 30.0)

    def connect(self) -> None:
        """Switch the camera on."""
        self.connects += 1
        self._open = True

    def close(self) -> None:
        """Switch the camera off."""
        self._open = False

    def __enter__(self) -> "PlaneCamera":
        self.connect()
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def capture(self, timeout: float = 2.0) -> View:
        """A view from where the camera is now."""
        if self.trouble is not None:
            raise self.trouble
        if not self._open:
            raise NotConnectedError("the camera over a plane is not connected; call connect() or use with")
        T_b_c = self._pose()
        down = self._rays @ T_b_c[2, :3]
        depth = np.where(down < -1e-6, (self.height - T_b_c[2, 3]) / np.where(down < -1e-6, down, -1.0), np.nan)
        noisy = depth + NOISE_M * self._random.standard_normal(depth.shape)
        return View(self._clock.now(), noisy.astype(np.float32), None)


def plane_patch(view: View, camera: Camera, T_w_c: Array, T_w_t: Array) -> SeenPatch:
    """The patch of a plane that the tool faces: flat, and as far away as the middle of the view says.

    Args:
        view: Of the plane.
        camera: That took it.
        T_w_c: (4, 4) from where.
        T_w_t: (4, 4) the tool.

    Returns:
        The patch.
    """
    row, column = round(camera.cy), round(camera.cx)
    middle = view.depth[max(0, row - 8) : row + 9, max(0, column - 8) : column + 9]
    point = T_w_c[:3, 3] + float(np.nanmean(middle)) * T_w_c[:3, 2]
    nearest = float((point - T_w_t[:3, 3]) @ T_w_t[:3, 2])
    flat = np.zeros((WIDE_PIXELS, WIDE_PIXELS), np.float32)
    return SeenPatch(flat[:PATCH_PIXELS, :PATCH_PIXELS], flat, nearest, float(np.isfinite(middle).mean()))
