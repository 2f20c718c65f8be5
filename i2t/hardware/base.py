"""Base classes of drivers: the `with` block of every device, and the features of a depth camera."""

from typing import Any, Self

from i2t.depth.camera import Camera
from i2t.errors import NotConnectedError
from i2t.hardware.protocols import CameraFeatures


class DeviceBase:
    """Base of devices (arm, skin, camera): a `with` block connects the device and closes it."""

    def connect(self) -> None:
        """Connect and start the device; raise DeviceError if that fails."""
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
    """Base of depth cameras that report their lens once connected: a subclass's `connect` sets `_camera`.

    Args:
        features: The camera's features as far as they are known before the connection.
    """

    def __init__(self, features: CameraFeatures) -> None:
        self._features = features
        self._camera: Camera | None = None

    @property
    def features(self) -> CameraFeatures:
        """Name, source, nearest depth and rate of the camera; after `connect`, as the device reported them."""
        return self._features

    @property
    def camera(self) -> Camera:
        """Image size and lens of the depth images; raises NotConnectedError before `connect` has read them."""
        if self._camera is None:
            raise NotConnectedError(f"{self._name} is not connected, so its lens is unknown; connect it")
        return self._camera

    @property
    def _name(self) -> str:
        return self._features.name

    def _not_connected(self) -> NotConnectedError:
        return NotConnectedError(f"{self._name} is not connected; call connect() or use with")
