"""A RealSense depth camera over pyrealsense2, or a file that it recorded: depth in metres, colour of the same pixels.

    i2t camera                        # the only camera that is plugged in: model, lens, range
    i2t camera --save DIR --count 5   # save views for `i2t.hardware.camera_folder`

The lens, with its distortion, is that of the depth image as the device reports it; images are not undistorted. A view
is exposed after the call if the camera's clock is the computer's (global or system time, the default on Linux and
Windows). Otherwise, and for a recording, frames that may have been under way at the call are dropped.

Stereo cameras measure nothing nearer than focal length x baseline / maximum disparity; NEAREST_MM holds the
manufacturer's values. At the paper's 104 mm only a D405 measures, at any resolution. A D435 needs 105 mm even at its
smallest image (424 x 240) and 150 mm at the paper's 640 x 360, where its lens is like the paper's; D415 and D455 need
160 mm and more, SR300 and L515 200 and 250 mm. A disparity shift, set with the manufacturer's viewer, lets a D435
measure nearer; then leave out `distance`, which would refuse the model.

Sources: RealSense D400 series data sheet (337029), "Minimum-Z depth"; data sheets of SR300 and L515.
"""

import contextlib
import itertools
import sys
import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, require_path
from i2t.depth.camera import MAX_UINT16, Camera
from i2t.errors import DeviceError, DeviceTimeoutError, MissingDriverError, NotConnectedError
from i2t.geometry import transform
from i2t.hardware import camera_folder
from i2t.hardware.base import CameraBase
from i2t.hardware.protocols import CameraFeatures, ColourImage, View
from i2t.installation import extra_advice
from i2t.types import Array

# pixels, widths and heights of depth images that RealSense cameras offer
SIZES_PX = ((424, 240), (480, 270), (640, 360), (640, 480), (848, 480), (1280, 720))
# mm, shortest depth that each RealSense model measures, at each of `SIZES_PX`
NEAREST_MM = {
    "D405": (40, 45, 55, 70, 70, 100),
    "D415": (160, 180, 240, 310, 310, 450),
    "D435": (105, 120, 150, 175, 195, 280),
    "D455": (180, 200, 260, 320, 350, 520),
    "SR300": (200,) * 6,
    "L515": (250,) * 6,
}


def nearest(model: str, width: int, height: int) -> float:
    """Look up the nearest depth that a RealSense model measures, as its maker states it, at an image size.

    Args:
        model: Model such as "D405", or the name that the device reports.
        width: Width of the image in pixels.
        height: Height of the image in pixels.

    Returns:
        The depth in m at the next larger of six image sizes; NaN if it is unknown.
    """
    for name, depths in NEAREST_MM.items():
        fitting = [depth for (w, h), depth in zip(SIZES_PX, depths, strict=True) if width <= w and height <= h]
        if name in model.upper() and fitting:
            return fitting[0] / 1000
    return float("nan")


class TooNearError(DeviceError, ValueError):
    """The requested distance is shorter than the camera can measure; the request must be changed."""


def check_distance(model: str, width: int, height: int, distance: float) -> None:
    """Refuse a RealSense camera that cannot measure depth at the requested distance; accept unknown models.

    Args:
        model: Model such as "D405".
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        distance: Distance in m from which the camera is to look.

    Raises:
        TooNearError: The camera cannot measure so near; the message states the remedy.
    """
    minimum = nearest(model, width, height)
    if distance < minimum:
        fits = [f", or take {w} x {h} pixels" for w, h in SIZES_PX if nearest(model, w, h) <= distance][-1:]
        others = [f", or mount a {name}" for name in NEAREST_MM if nearest(name, width, height) <= distance][:1]
        raise TooNearError(
            f"the {model} measures nothing nearer than {1e3 * minimum:.0f} mm at {width} x {height} pixels, so it "
            f"cannot look from {1e3 * distance:.0f} mm: look from {1e3 * minimum:.0f} mm{''.join(fits + others)}"
        )


class RealSense(CameraBase):
    """Driver of a RealSense depth camera (`i2t.hardware.protocols.DepthCamera`).

    Args:
        serial: Serial number of the camera; by default the only camera that is plugged in.
        size: (width, height) of the depth and the colour image in pixels.
        rate: Rate of the images in Hz.
        distance: Distance in m from which the camera is to look; `connect` refuses a model that cannot measure there.
        file: Recording of the SDK (.db3, or .bag of older versions) that is played in a loop instead.
    """

    def __init__(
        self,
        serial: str | None = None,
        size: tuple[int, int] = (640, 360),
        rate: int = 30,
        distance: float | None = None,
        file: str | Path | None = None,
    ) -> None:
        try:
            import pyrealsense2
        except ImportError as error:
            raise MissingDriverError(
                f"a RealSense needs pyrealsense2: {extra_advice('hardware', 'pyrealsense2')}"
            ) from error
        self._rs: Any = pyrealsense2
        self._serial, self._size, self._rate, self._distance = serial, size, rate, distance
        self._file = Path(file) if file is not None else None
        name = f"the recording {file}" if file is not None else f"the RealSense {serial or ''}".strip()
        source = "replay" if file is not None else "real"
        super().__init__(CameraFeatures(name, source, float("nan"), float(rate)))
        self.serial_number = ""  # of the camera, after `connect`
        self._lock = threading.Lock()
        self._pipe: Any = None
        self._colour: tuple[Camera, Array] | None = None

    def connect(self) -> None:
        """Start the camera's stream; raise DeviceError if that fails."""
        self.close()
        rs, (width, height) = self._rs, self._size
        config = rs.config()
        if self._file is not None:
            if not self._file.is_file():
                raise DeviceError(f"{self._file} cannot be read (the file does not exist); name a recording")
            config.enable_device_from_file(str(self._file), True)
        elif not self._plugged():
            raise self._refused("")  # the SDK would wait 15 s for one
        elif self._serial is not None:
            config.enable_device(self._serial)
        config.enable_stream(rs.stream.depth, width, height, rs.format.z16, self._rate)
        config.enable_stream(rs.stream.color, width, height, rs.format.rgb8, self._rate)
        pipe = rs.pipeline()
        try:
            profile = pipe.start(config)
        except RuntimeError as error:
            raise self._refused(str(error)) from error
        try:
            self._describe(profile)
            self._align, self._pipe = rs.align(rs.stream.depth), pipe
            end = time.monotonic() + (0.5 if self._file is None else 0.0)  # s, for the exposure to settle
            while time.monotonic() < end:
                self._wait(5.0)
        except BaseException:
            self._pipe = None
            with contextlib.suppress(RuntimeError):
                pipe.stop()
            raise

    def _describe(self, profile: Any) -> None:
        """Read model, serial number and lenses from the streaming device; refuse it if it cannot measure so near."""
        rs, device = self._rs, profile.get_device()
        model = device.get_info(rs.camera_info.name)
        if device.supports(rs.camera_info.serial_number):
            self.serial_number = device.get_info(rs.camera_info.serial_number)
        if self._distance is not None:
            check_distance(model, *self._size, self._distance)
        depth, colour = (
            profile.get_stream(stream).as_video_stream_profile() for stream in (rs.stream.depth, rs.stream.color)
        )
        self._camera, extrinsics = _camera(depth.get_intrinsics()), colour.get_extrinsics_to(depth)
        rotation = np.reshape(extrinsics.rotation, (3, 3), order="F")
        self._colour = _camera(colour.get_intrinsics()), transform(rotation, np.array(extrinsics.translation))
        name = f"{self._name.split(' (')[0]} ({model})"
        self._features = self._features._replace(name=name, nearest=nearest(model, *self._size))

    def close(self) -> None:
        """Stop the camera's stream."""
        with self._lock:
            pipe, self._pipe = self._pipe, None
        if pipe is not None:
            with contextlib.suppress(RuntimeError):
                pipe.stop()

    def capture(self, timeout: float = 2.0) -> View:
        """Take a view that is exposed after the call, as in `DepthCamera.capture`."""
        when, frames = self._fresh(timeout)
        frames = self._align.process(frames)
        depth, colour = frames.get_depth_frame(), frames.get_color_frame()
        values = np.asanyarray(depth.get_data())
        measured = (values > 0) & (values < MAX_UINT16)
        metres = np.where(measured, values * np.float64(depth.get_units()), np.nan).astype(np.float32)
        return View(when, metres, np.array(colour.get_data()) if colour else None)

    def colour(self, timeout: float = 2.0) -> ColourImage:
        """Take a complete colour image, not aligned with depth, that is exposed after the call.

        Args:
            timeout: Maximum wait in s.

        Returns:
            The image with the colour sensor's own lens.

        Raises:
            DeviceTimeoutError: No image arrived in time.
        """
        when, frames = self._fresh(timeout)
        assert self._colour is not None
        return ColourImage(when, np.array(frames.get_color_frame().get_data()), *self._colour)

    def _fresh(self, timeout: float) -> tuple[float, Any]:
        """Wait for frames that are exposed from now on; return their exposure time and the frames."""
        called = time.monotonic()
        for number in itertools.count():
            remaining = called + timeout - time.monotonic()
            frames = self._wait(remaining) if remaining > 0 else None
            if frames is None:
                break
            exposed = self._exposed(frames)
            # Without comparable times, two frames may have been exposed before the call.
            new = number >= 2 if exposed is None else exposed >= called
            if new and frames.get_depth_frame() and frames.get_color_frame():
                return time.monotonic() - 1 / self._rate if exposed is None else exposed, frames
        raise DeviceTimeoutError(f"{self._name} sent no view in {timeout:.2g} s; check its cable: it needs USB 3")

    def _wait(self, timeout: float) -> Any:
        """Wait for the next frames, or None; raise NotConnectedError, or DeviceError if the camera is gone."""
        pipe = self._pipe
        if pipe is None:
            raise self._not_connected()
        deadline = time.monotonic() + timeout
        while True:
            # Wait in pieces, to notice early that the camera is gone or closed.
            piece = min(0.25, deadline - time.monotonic())
            arrived, frames = pipe.try_wait_for_frames(max(1, round(1e3 * piece)))
            if arrived:
                return frames
            if self._pipe is not pipe:
                raise NotConnectedError(f"{self._name} was closed; connect it again")
            if self._file is None and not self._plugged():
                self.close()
                raise DeviceError(f"{self._name} is gone; plug it in and connect again")
            if time.monotonic() >= deadline:
                return None

    def _exposed(self, frames: Any) -> float | None:
        """Time of exposure of frames, on the monotonic clock; None if their clock is not this computer's."""
        domains = self._rs.timestamp_domain
        if frames.get_frame_timestamp_domain() not in (domains.global_time, domains.system_time):
            return None
        age = time.time() - 1e-3 * frames.get_timestamp()
        return time.monotonic() - age if 0 <= age < 1.0 else None  # otherwise a clock was set, or a file is played

    def _plugged(self) -> bool:
        devices = self._devices()
        return self._serial in devices if self._serial is not None else bool(devices)

    def _refused(self, reason: str) -> DeviceError:
        width, height = self._size
        if self._file is not None:
            return DeviceError(f"{self._file} cannot be played at {width} x {height}, {self._rate} Hz ({reason})")
        if not self._plugged():
            present = ", ".join(f"{name} {serial}" for serial, name in self._devices().items()) or "none"
            return DeviceError(f"{self._name} was not found (RealSense cameras here: {present}); plug it in, on USB 3")
        if "resolve" in reason:
            mode = f"{width} x {height}, {self._rate} Hz"
            return DeviceError(f"{self._name} does not stream {mode}; choose another mode, and on USB 2 a lower one")
        return DeviceError(f"{self._name} cannot be started ({reason}); close other programs that use it")

    def _devices(self) -> dict[str, str]:
        """List the names of the cameras that are plugged in, by their serial numbers."""
        info, devices = self._rs.camera_info, self._rs.context().query_devices()
        return {device.get_info(info.serial_number): device.get_info(info.name) for device in devices}


def _camera(lens: Any) -> Camera:
    pixels = lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy
    return Camera(*pixels, model=lens.model.name, coefficients=tuple(lens.coeffs))


@dataclass(frozen=True)
class RealSenseArgs:
    """Show what a depth camera sees, and save views of it."""

    serial: str | None = None  # serial number of the camera, if several are plugged in
    file: Path | None = None  # recording to play instead of reading a camera
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="WIDTH HEIGHT")] = (640, 360)  # image size in pixels
    rate: Count = 30  # frame rate (Hz)
    # working distance (m) of the camera; a camera that cannot measure so near is refused. By default, all are accepted
    distance: float | None = None
    save: Path | None = None  # new folder in which the views are saved
    count: Count = 1  # number of views to take


def _show(args: RealSenseArgs) -> None:
    require_path("--file", args.file, "recording")
    with RealSense(args.serial, args.size, args.rate, args.distance, args.file) as camera:
        print(f"{camera.features.name}: nothing nearer than {1e3 * camera.features.nearest:.0f} mm\n{camera.camera}")
        views: Iterable[View] = (camera.capture() for _ in range(args.count))
        views = camera_folder.save_views(args.save, camera.camera, views) if args.save else views
        for number, view in enumerate(views):
            middle = view.depth[args.size[1] // 2 - 10 :, args.size[0] // 2 - 10 :][:20, :20]
            at = np.nanmedian(middle) if np.isfinite(middle).any() else np.nan
            print(f"view {number}: {np.isfinite(view.depth).mean():.0%} measured, {1e3 * at:.1f} mm in the middle")


main = command(RealSenseArgs, _show, program="python -m i2t.hardware.realsense", description=__doc__)


if __name__ == "__main__":
    sys.exit(main())
