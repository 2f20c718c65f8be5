"""Base classes of drivers: the `with` block of every device, and the features of a depth camera."""

from typing import Any, Self

from i2t.depth.camera import Camera
from i2t.errors import NotConnectedError
from i2t.hardware.protocols import CameraFeatures


class DeviceBase:
    """A device that `with` connects and closes."""

    def connect(self) -> None:
        """Start the device; raise DeviceError if that fails."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop the device and release its port; may be called repeatedly and never raises."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()


class CameraBase(DeviceBase):
    """A depth camera whose lens becomes known when it is connected: `connect` must set `_camera`.

    Args:
        features: The features that are known before the connection.
    """

    def __init__(self, features: CameraFeatures) -> None:
        self._features = features
        self._camera: Camera | None = None

    @property
    def features(self) -> CameraFeatures:
        """Features of the camera; after `connect` as the device reported them."""
        return self._features

    @property
    def camera(self) -> Camera:
        """Size and lens of the depth image; raises NotConnectedError before `connect` has read them."""
        if self._camera is None:
            raise NotConnectedError(f"{self._name} is not connected, so its lens is unknown; connect it")
        return self._camera

    @property
    def _name(self) -> str:
        return self._features.name

    def _not_connected(self) -> NotConnectedError:
        return NotConnectedError(f"{self._name} is not connected; call connect() or use with")
