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

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from i2t.errors import require_extra
from i2t.patches.dimensions import PAD_WINDOW
from i2t.view.contents import Contents, DepthImage, Events, Field, Item, Numbers, Poses, camera_of, items, span

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
        stream.set_time("time", timestamp=span(number, record)[0])
        for item in items(contents, number, record):
            _log(rr, stream, contents, item)
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


def _log(rr: Any, stream: Any, contents: Contents, item: Item) -> None:
    """Log one item of a touch."""

    def put(time: float, place: str, what: Any) -> None:
        stream.set_time("time", timestamp=float(time))
        rr.log(place, what, recording=stream)

    match item:
        case Poses(frame, times, poses):
            for time, T in zip(times, poses, strict=True):
                if np.isfinite(T).all():
                    put(time, f"world/{frame}", rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))
        case Numbers(place, names, times, values):
            for name, column in zip(names, np.asarray(values, np.float64).T, strict=True):
                finite = np.isfinite(column)
                if finite.any():
                    line, scalars = rr.TimeColumn("time", timestamp=times[finite]), column[finite]
                    columns = rr.Scalars.columns(scalars=scalars)
                    rr.send_columns(f"{place}/{name}", [line], columns, recording=stream)
        case Field(times, vectors):
            chips = np.asarray(contents.dataset.board.chips)
            for time, field in zip(times, 1e-4 * vectors, strict=True):  # a field of 50 uT is drawn 5 mm long
                put(time, "world/tool/chips/field", rr.Arrows3D(origins=chips, vectors=field, radii=2e-4))
        case DepthImage(place, _, time, metres):
            put(time, "world/camera/image" if place == "depth" else place, rr.DepthImage(metres, meter=1.0))
        case Events(times, texts):
            for time, text in zip(times, texts, strict=True):
                put(time, "events", rr.TextLog(text))
