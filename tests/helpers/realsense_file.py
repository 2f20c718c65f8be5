"""A recording as a RealSense camera would have made it, by the SDK's own software device: what `RealSense(file=...)`
plays, so that every line that reads frames, lenses and units from the SDK can be tried without a camera.

    write("views.db3", camera, views, model="D405")

What it cannot show is what only a camera does: USB, exposure, and times on the computer's clock.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from i2t.depth.camera import Camera
from i2t.geometry import inverse
from i2t.hardware.protocols import View
from i2t.types import Array

SERIAL = "000000000000"
SENSORS = (("Stereo Module", "depth", "z16", 2), ("RGB Camera", "color", "rgb8", 3))  # stream, format, bytes a pixel


def write(
    path: str | Path,
    camera: Camera,
    views: Sequence[View],
    model: str = "D405",
    unit: float = 1e-4,
    rate: int = 30,
    T_depth_colour: Array | None = None,
) -> None:
    """Record views of one camera to a new .db3 file.

    Args:
        path: Path of the file.
        camera: Lens of depth and of colour.
        views: Depth in m, of which 0 is written where nothing was measured, and colour.
        model: Model that the recording states.
        unit: m per unit of depth.
        rate: Hz.
        T_depth_colour: (4, 4) where the colour camera stands in the depth camera.

    Raises:
        RuntimeError: The SDK cannot write the file.
    """
    import pyrealsense2 as rs

    device = rs.software_device()
    for info, text in (
        (rs.camera_info.name, f"Intel RealSense {model}"),
        (rs.camera_info.serial_number, SERIAL),
        (rs.camera_info.product_line, "D400"),
    ):
        device.register_info(info, text)
    channels = [_channel(rs, device, camera, number, rate) for number in range(len(SENSORS))]
    (depth, depth_stream), (_, colour_stream) = channels
    depth.add_read_only_option(rs.option.depth_units, unit)
    T, extrinsics = inverse(np.eye(4) if T_depth_colour is None else T_depth_colour), rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = T[:3, :3].ravel(order="F").tolist(), T[:3, 3].tolist()
    depth_stream.register_extrinsics_to(colour_stream, extrinsics)

    recorder, queue = rs.recorder(str(path), device), rs.frame_queue(4)
    recorded = recorder.query_sensors()
    for sensor in recorded:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    for number, view in enumerate(views):
        units = np.nan_to_num(np.round(view.depth / unit), nan=0.0).astype(np.uint16)
        for (sensor, stream), pixels in zip(channels, (units, view.colour), strict=True):
            frame = _frame(rs, pixels, stream, number=number, rate=rate)
            frame.depth_units = unit
            sensor.on_video_frame(frame)
        time.sleep(1 / rate)  # the file's own times are those of the writing
    for sensor in recorded:
        sensor.stop()
        sensor.close()


def _channel(rs: Any, device: Any, camera: Camera, number: int, rate: int) -> tuple[Any, Any]:
    """One of `SENSORS`, with the lens of the camera, and the stream of its images."""
    name, kind, form, size = SENSORS[number]
    lens, stream = rs.intrinsics(), rs.video_stream()
    lens.width, lens.height, lens.fx, lens.fy = camera.width, camera.height, camera.fx, camera.fy
    lens.ppx, lens.ppy, lens.coeffs = camera.cx, camera.cy, list(camera.coefficients)
    lens.model = getattr(rs.distortion, str(camera.model))
    stream.type, stream.fmt = getattr(rs.stream, kind), getattr(rs.format, form)
    stream.index, stream.uid, stream.bpp = 0, number + 1, size
    stream.width, stream.height, stream.fps, stream.intrinsics = camera.width, camera.height, rate, lens
    sensor = device.add_sensor(name)
    return sensor, sensor.add_video_stream(stream, True)


def _frame(rs: Any, pixels: np.ndarray, stream: Any, *, number: int, rate: int) -> Any:
    """An image as the SDK returns it."""
    frame = rs.software_video_frame()
    frame.pixels = np.ascontiguousarray(pixels)
    frame.bpp = pixels.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1)
    frame.stride = frame.bpp * pixels.shape[1]
    frame.timestamp, frame.domain = 1e3 * number / rate, rs.timestamp_domain.hardware_clock
    frame.frame_number, frame.profile = number + 1, stream.as_video_stream_profile()
    return frame
