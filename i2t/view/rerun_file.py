"""Rerun recording (`.rrd`) of touches: scene, images, time series and events on one time line.

    world/object, world/tool       poses of the object's mesh and of the skin's outline
    world/tool/chips/field         the reading as vectors at the chips, in tool axes
    world/camera/image             the depth image at the pose from which the camera took it
    readings/chip0/x ...           readings in microtesla, with the ambient subtracted
    temperature/chip0 ...          temperatures in degrees Celsius
    force/x ..., torque/x ...      force and torque on the tool, in tool axes
    patch, events, about           extracted patch, events, provenance

The time line `touch` numbers the touches. Rerun (rerun.io) shows such a file with `rerun FILE`. The package rerun-sdk
is needed to write it.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from i2t.dataset import Record
from i2t.dataset.sets import AXIS_NAMES
from i2t.errors import require_extra
from i2t.patches.dimensions import PAD_WINDOW
from i2t.types import Board
from i2t.view.contents import Contents, camera_of, readings_of, span

require_rerun = partial(require_extra, "rerun", "a Rerun recording")  # raises MissingExtraError


def write_recording(contents: Contents, path: Path) -> Path:
    """Write the Rerun recording of a session or data set.

    Args:
        contents: The session or data set.
        path: Path of the recording, ending in .rrd.

    Returns:
        The path of the recording.

    Raises:
        MissingExtraError: rerun-sdk is missing.
    """
    require_rerun()
    import rerun as rr

    stream = rr.RecordingStream("i2t", recording_id=contents.path.resolve().name or "i2t")
    stream.save(path)
    _log_statics(rr, partial(rr.log, static=True, recording=stream), contents)
    for number, record in enumerate(contents.records()):
        stream.set_time("touch", sequence=number)
        _log_touch(rr, stream, contents.dataset.board, number, record)
    stream.flush()
    stream.disconnect()
    return path


def _log_statics(rr: Any, log: Any, contents: Contents) -> None:
    """Log what all touches have in common."""
    dataset, mesh, camera = contents.dataset, contents.mesh, camera_of(contents.dataset)
    lines = [f"{contents.path}: {len(dataset)} touches, {dataset.source.upper()}"]
    log("about", rr.TextDocument("\n\n".join([*lines, *(f"{key}: {value}" for key, value in dataset.meta.items())])))
    log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    half = [PAD_WINDOW / 2, PAD_WINDOW / 2, 1e-3]  # the skin is drawn 2 mm thick
    log("world/tool/skin", rr.Boxes3D(half_sizes=[half], centers=[[0, 0, -half[2]]]))
    if mesh is not None:
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        log("world/object", rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces))
    if camera is not None:
        focal, centre = [camera.fx, camera.fy], [camera.cx, camera.cy]
        size = [camera.width, camera.height]
        log("world/camera/image", rr.Pinhole(focal_length=focal, principal_point=centre, resolution=size))


def _log_touch(rr: Any, stream: Any, board: Board, number: int, record: Record) -> None:
    """Log what was recorded of a touch."""
    touches, series = record.touch.touches, record.series
    start, end = span(number, record)

    def put(time: float, place: str, what: Any) -> None:
        stream.set_time("time", timestamp=float(time))
        rr.log(place, what, recording=stream)

    def put_pose(frame: str, time: float, T: np.ndarray) -> None:
        if np.isfinite(T).all():
            put(time, f"world/{frame}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def put_numbers(place: str, names: Sequence[str], time: np.ndarray, values: np.ndarray) -> None:
        for name, column in zip(names, np.asarray(values, np.float64).T, strict=True):
            finite = np.isfinite(column)
            if finite.any():
                line = rr.TimeColumn("time", timestamp=time[finite])
                rr.send_columns(f"{place}/{name}", [line], rr.Scalars.columns(scalars=column[finite]), recording=stream)

    put_pose("object", start, np.asarray(touches.T_w_o[0], float))
    if "pose" in series:
        for row in _thinned(series["pose"].time):
            put_pose("tool", series["pose"].time[row], series["pose"].values[row].reshape(4, 4))
    put_pose("tool", end, np.asarray(touches.T_w_t[0], float))
    put(start, "patch", rr.DepthImage(np.asarray(touches.patch[0], np.float32), meter=1.0))
    if "camera" in series and len(series["camera"].values):
        put_pose("camera", start, series["camera"].values[0].reshape(4, 4))
    if "depth" in record.images:
        image = record.images["depth"]
        put(start, "world/camera/image", rr.DepthImage((image.values * image.scale).astype(np.float32), meter=1.0))
    time, readings = readings_of(number, record)
    chips = [f"chip{chip}" for chip in range(board.num_chips)]
    put_numbers("readings", [f"{chip}/{axis}" for chip in chips for axis in AXIS_NAMES], time, readings)
    shown = [(time[row], readings[row]) for row in _thinned(time)] + [(end, np.asarray(touches.reading[0], float))]
    for when, reading in shown:  # a field of 50 uT is drawn 5 mm long
        field = 1e-4 * np.nan_to_num(board.to_tool(reading))
        put(when, "world/tool/chips/field", rr.Arrows3D(origins=np.asarray(board.chips), vectors=field, radii=2e-4))
    if "temperature" in series:
        put_numbers("temperature", chips, series["temperature"].time, series["temperature"].values)
    if "wrench" in series:
        put_numbers("force", AXIS_NAMES, series["wrench"].time, series["wrench"].values[:, :3])
        put_numbers("torque", AXIS_NAMES, series["wrench"].time, series["wrench"].values[:, 3:])
    else:
        put_numbers("force", ("normal",), np.array([start]), np.asarray(touches.force[:1, None], float))
    for when, text in record.events:
        put(when, "events", rr.TextLog(text))


def _thinned(time: np.ndarray, rate: float = 30.0) -> np.ndarray:
    """Choose the rows of a series at about `rate` (Hz), fast enough for animated poses and field vectors."""
    slots = np.floor((time - time[:1]) * rate).astype(np.int64)
    return np.unique(slots, return_index=True)[1]
