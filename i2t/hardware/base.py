"""Base classes of drivers: the `with` block of every device, and the features of a depth camera."""

from typing import Any, TypeVar

from i2t.depth.camera import Camera
from i2t.errors import NotConnectedError
from i2t.hardware.protocols import CameraFeatures

D = TypeVar("D", bound="DeviceBase")


class DeviceBase:
    """A device that `with` connects and closes."""

    def connect(self) -> None:
        """Start the device; raises DeviceError."""
        raise NotImplementedError

    def close(self) -> None:
        """Stop it and give its port back, as often as one likes; raises nothing."""
        raise NotImplementedError

    def __enter__(self: D) -> D:
        self.connect()
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()


class CameraBase(DeviceBase):
    """A depth camera whose lens is known once it was connected: `connect` sets `_camera`.

    Args:
        features: What is known before that.
    """

    def __init__(self, features: CameraFeatures) -> None:
        self._features = features
        self._camera: Camera | None = None

    @property
    def features(self) -> CameraFeatures:
        """Features as known before `connect`, and after it as the device reported them."""
        return self._features

    @property
    def camera(self) -> Camera:
        """Size and lens of the depth image; raises NotConnectedError before `connect` has read them."""
        if self._camera is None:
            raise NotConnectedError(f"{self._name} is not connected, and its lens is read then; connect it")
        return self._camera

    @property
    def _name(self) -> str:
        return self._features.name

    def _not_connected(self) -> NotConnectedError:
        return NotConnectedError(f"{self._name} is not connected; call connect() or use with")
