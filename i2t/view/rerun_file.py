"""A Rerun recording (`.rrd`) of touches: scene, images, time series and events on one time line.

    world/object, world/tool       the object's mesh and the skin's outline, where they stand
    world/tool/chips/field         the reading as vectors at the chips, tool axes
    world/camera/image             the depth image from where its camera took it
    readings/chip0/x ...           microtesla, less the ambient
    temperature/chip0 ...          degrees Celsius
    force/x ..., torque/x ...      on the tool, tool axes
    patch, events, about           what was extracted, what happened, provenance

Every touch also has its number on the line `touch`. Rerun (rerun.io) shows such a file with `rerun FILE`; the package
rerun-sdk is needed to write it.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from i2t.errors import require_extra, why_missing
from i2t.patches.dimensions import PAD_WINDOW
from i2t.view.contents import Contents, Events, Field, Item, Numbers, Picture, Poses, camera_of, items, span

APPLICATION, NEEDS_RERUN = "i2t", "a Rerun recording"
VECTOR_M_PER_UT = 1e-4  # length of a field vector: 50 uT are 5 mm
SKIN_THICKNESS_M = 2e-3
PLACES = {"depth": "world/camera/image", "patch": "patch"}


def why_no_recording() -> str:
    """Reason why no recording can be written here.

    Returns:
        One sentence with the remedy; empty where it can.
    """
    why = why_missing("rerun", NEEDS_RERUN)
    return why and f"{why}, or pass --html alone"


def write_recording(contents: Contents, path: Path) -> Path:
    """Write the recording.

    Args:
        contents: Of a session or data set.
        path: Of the file, .rrd.

    Returns:
        The file.

    Raises:
        MissingExtraError: rerun-sdk is missing.
    """
    require_extra("rerun", NEEDS_RERUN)
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION, recording_id=contents.path.resolve().name or APPLICATION)
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
    """What holds for all touches."""
    dataset, mesh, camera = contents.dataset, contents.mesh, camera_of(contents.dataset)
    lines = [f"{contents.path}: {len(dataset)} touches, {dataset.source.upper()}"]
    log("about", rr.TextDocument("\n\n".join([*lines, *(f"{key}: {value}" for key, value in dataset.meta.items())])))
    log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    half = [PAD_WINDOW / 2, PAD_WINDOW / 2, SKIN_THICKNESS_M / 2]
    log("world/tool/skin", rr.Boxes3D(half_sizes=[half], centers=[[0, 0, -SKIN_THICKNESS_M / 2]]))
    if mesh is not None:
        vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
        log("world/object", rr.Mesh3D(vertex_positions=vertices, triangle_indices=faces))
    if camera is not None:
        focal, centre = [camera.fx, camera.fy], [camera.cx, camera.cy]
        size = [camera.width, camera.height]
        log("world/camera/image", rr.Pinhole(focal_length=focal, principal_point=centre, resolution=size))


def _log(rr: Any, stream: Any, contents: Contents, item: Item) -> None:
    """One thing of a touch."""

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
                known = np.isfinite(column)
                if known.any():
                    line, scalars = rr.TimeColumn("time", timestamp=times[known]), column[known]
                    columns = rr.Scalars.columns(scalars=scalars)
                    rr.send_columns(f"{place}/{name}", [line], columns, recording=stream)
        case Field(times, vectors):
            chips = np.asarray(contents.dataset.board.chips)
            for time, field in zip(times, VECTOR_M_PER_UT * vectors, strict=True):
                put(time, "world/tool/chips/field", rr.Arrows3D(origins=chips, vectors=field, radii=2e-4))
        case Picture(place, _, time, metres):
            put(time, PLACES[place], rr.DepthImage(metres, meter=1.0))
        case Events(times, texts):
            for time, text in zip(times, texts, strict=True):
                put(time, "events", rr.TextLog(text))
