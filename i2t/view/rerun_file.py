"""A Rerun recording (`.rrd`) of touches: scene, images, time series and events on one time line.

    world/object                   the object's mesh, where it stands
    world/tool                     the skin's outline; it follows the arm where poses were recorded
    world/tool/chips/field         the reading as vectors at the chips, tool axes
    world/camera, world/cloud      the depth image as its camera took it, and its points in the world
    readings/chip0/x ...           microtesla, less the ambient
    temperature/chip0 ...          degrees Celsius
    force/x ..., torque/x ...      on the tool, tool axes
    patch, events, about, belief   what was extracted, what happened, provenance, probabilities

Time is Unix time where touches were recorded with their series; every touch also has its number on the line `touch`.
Rerun (rerun.io) shows such a file with `rerun FILE`; the package rerun-sdk is needed to write it.
"""

from pathlib import Path
from typing import Any

import numpy as np

from i2t.dataset import Record, Series
from i2t.depth.camera import Camera
from i2t.errors import DeviceError
from i2t.extras import why_missing
from i2t.types import PAD_WINDOW
from i2t.view.contents import Contents, camera_of

APPLICATION = "i2t"
VECTOR_M_PER_UT = 1e-4  # length of a field vector: 50 uT are 5 mm
VECTOR_RATE_HZ = 30.0  # at which field vectors are drawn; series have every sample
SKIN_THICKNESS_M = 2e-3
CLOUD_STRIDE = 3  # of the pixels that become points
SECONDS_A_TOUCH = 1.0  # of touches without times of their own


def why_no_recording() -> str:
    """Reason why no recording can be written here.

    Returns:
        One sentence with the remedy; empty where it can.
    """
    why = why_missing("rerun", "a Rerun recording")
    return why and f"{why}, or pass --html alone"


def write_recording(contents: Contents, path: Path) -> Path:
    """Write the recording.

    Args:
        contents: Of a session or data set.
        path: Of the file, .rrd.

    Returns:
        The file.

    Raises:
        DeviceError: rerun-sdk is missing.
    """
    if why_no_recording():
        raise DeviceError(why_no_recording())
    import rerun as rr

    stream = rr.RecordingStream(APPLICATION, recording_id=contents.path.resolve().name or APPLICATION)
    stream.save(path)
    writer = _Writer(rr, stream, contents)
    writer.once()
    for number, record in enumerate(contents.records()):
        writer.touch(number, record)
    stream.flush()
    stream.disconnect()
    return path


class _Writer:
    """Writes touches to an open recording."""

    def __init__(self, rr: Any, stream: Any, contents: Contents) -> None:
        self._rr, self._stream, self._contents = rr, stream, contents
        self._board, self._camera = contents.dataset.board, camera_of(contents.dataset)
        self._rays: np.ndarray | None = None

    def once(self) -> None:
        """Write what holds for all touches."""
        rr, dataset = self._rr, self._contents.dataset
        lines = [f"{self._contents.path}: {len(dataset)} touches, {dataset.source.upper()}"]
        self._put(
            "about", rr.TextDocument("\n\n".join([*lines, *(f"{k}: {v}" for k, v in dataset.meta.items())])), True
        )
        self._put("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, True)
        half = np.array([PAD_WINDOW / 2, PAD_WINDOW / 2, SKIN_THICKNESS_M / 2])
        self._put("world/tool/skin", rr.Boxes3D(half_sizes=[half], centers=[[0, 0, -SKIN_THICKNESS_M / 2]]), True)
        mesh = self._contents.mesh
        if mesh is not None:
            triangles = rr.Mesh3D(vertex_positions=np.asarray(mesh.vertices), triangle_indices=np.asarray(mesh.faces))
            self._put("world/object", triangles, True)

    def touch(self, number: int, record: Record) -> None:
        """One touch."""
        rr, touches = self._rr, record.touch.touches
        start = begun(number, record)
        self._at(start, number)
        self._pose("world/object", touches.T_w_o[0])
        self._pose("world/tool", touches.T_w_t[0])
        self._put("patch", rr.DepthImage(np.asarray(touches.patch[0], np.float32), meter=1.0))
        self._field(touches.reading[0])
        self._view(record)
        if self._contents.belief is not None:
            for name, p in zip(self._contents.belief.names, self._contents.belief.p[number], strict=True):
                self._put(f"belief/{name}", rr.Scalars(float(p)))
        self._series(number, record)
        for when, text in record.events:
            self._at(when, number)
            self._put("events", rr.TextLog(text))
        if not record.series:
            self._scalars("readings", touches.reading, _names(self._board.num_chips), np.array([start]))
            self._scalars("force", touches.force[:, None], ("normal",), np.array([start]))
        else:  # at the end of the press
            self._at(max(float(series.time[-1]) for series in record.series.values() if len(series.time)), number)
            self._pose("world/tool", touches.T_w_t[0])
            self._field(touches.reading[0])

    def _view(self, record: Record) -> None:
        """The depth image where its camera was, and its points."""
        image, camera, seen = record.images.get("depth"), self._camera, record.series.get("camera")
        if image is None:
            return
        rr = self._rr
        if seen is not None and len(seen.values):
            T_w_c = seen.values[0].reshape(4, 4)
            self._pose("world/camera", T_w_c)
            if camera is not None:
                self._put(
                    "world/cloud", rr.Points3D(self._points(image.values * image.scale, camera, T_w_c), radii=3e-4)
                )
        if camera is not None:
            lens = rr.Pinhole(
                focal_length=[camera.fx, camera.fy], principal_point=[camera.cx, camera.cy],
                resolution=[camera.width, camera.height],
            )  # fmt: skip
            self._put("world/camera/image", lens)
        self._put("world/camera/image", rr.DepthImage(image.values, meter=1 / image.scale))
        if "colour" in record.images:
            self._put("world/camera/colour", rr.Image(record.images["colour"].values))

    def _points(self, depth: np.ndarray, camera: Camera, T_w_c: np.ndarray) -> np.ndarray:
        if self._rays is None:
            from i2t.depth.distortion import pixel_rays

            self._rays = np.moveaxis(np.asarray(pixel_rays(camera)), 0, -1)
        some = slice(None, None, CLOUD_STRIDE), slice(None, None, CLOUD_STRIDE)
        depth, rays = depth[some], self._rays[some]
        known = depth > 0
        points = np.column_stack([rays[known] * depth[known, None], depth[known]])
        return points @ T_w_c[:3, :3].T + T_w_c[:3, 3]

    def _series(self, number: int, record: Record) -> None:
        """All values of the time series, and the tool and the field as they go."""
        chips, series = self._board.num_chips, record.series
        if "tactile" in series:
            tactile = series["tactile"]
            ambient = series["ambient"].values[0] if "ambient" in series and len(series["ambient"].values) else 0.0
            readings = tactile.values - ambient
            self._scalars("readings", readings, _names(chips), tactile.time)
            for row in thinned(tactile.time, VECTOR_RATE_HZ):
                self._at(float(tactile.time[row]), number)
                self._field(readings[row])
        if "temperature" in series:
            names = tuple(f"chip{chip}" for chip in range(chips))
            self._scalars("temperature", series["temperature"].values, names, series["temperature"].time)
        if "wrench" in series:
            self._scalars("force", series["wrench"].values[:, :3], ("x", "y", "z"), series["wrench"].time)
            self._scalars("torque", series["wrench"].values[:, 3:], ("x", "y", "z"), series["wrench"].time)
        if "pose" in series:
            self._poses(series["pose"])

    def _poses(self, series: Series) -> None:
        for row in thinned(series.time, VECTOR_RATE_HZ):
            self._stream.set_time("time", timestamp=float(series.time[row]))
            self._pose("world/tool", series.values[row].reshape(4, 4))

    def _scalars(self, place: str, values: np.ndarray, names: tuple[str, ...], time: np.ndarray) -> None:
        """Columns of numbers, whole; what is missing is left out."""
        rr = self._rr
        for name, column in zip(names, np.asarray(values, np.float64).T, strict=True):
            known = np.isfinite(column)
            if known.any():
                rr.send_columns(
                    f"{place}/{name}",
                    [rr.TimeColumn("time", timestamp=time[known])],
                    rr.Scalars.columns(scalars=column[known]),
                    recording=self._stream,
                )

    def _field(self, reading: np.ndarray) -> None:
        """A reading as vectors at the chips, in tool axes."""
        field = np.nan_to_num(np.asarray(self._board.to_tool(np.asarray(reading, np.float64))))
        self._put(
            "world/tool/chips/field",
            self._rr.Arrows3D(origins=np.asarray(self._board.chips), vectors=VECTOR_M_PER_UT * field, radii=2e-4),
        )

    def _pose(self, place: str, T: np.ndarray) -> None:
        if np.isfinite(T).all():
            self._put(place, self._rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3]))

    def _at(self, when: float, number: int) -> None:
        self._stream.set_time("time", timestamp=when)
        self._stream.set_time("touch", sequence=number)

    def _put(self, place: str, what: Any, always: bool = False) -> None:
        self._rr.log(place, what, static=always, recording=self._stream)


def _names(chips: int) -> tuple[str, ...]:
    return tuple(f"chip{chip}/{axis}" for chip in range(chips) for axis in "xyz")


def begun(number: int, record: Record) -> float:
    """Start time of a touch.

    Args:
        number: Of the touch.
        record: Of the touch.

    Returns:
        Unix time in s; from its number where nobody kept the time.
    """
    times = [float(series.time[0]) for series in record.series.values() if len(series.time)]
    times += [when for when, _ in record.events]
    return min(times) if times else SECONDS_A_TOUCH * number


def thinned(time: np.ndarray, rate: float) -> np.ndarray:
    """Rows of a series at about a rate.

    Args:
        time: s, of its rows.
        rate: Hz.

    Returns:
        Numbers of the rows.
    """
    if not len(time):
        return np.zeros(0, np.int64)
    slots = np.floor((time - time[0]) * rate).astype(np.int64)
    return np.unique(slots, return_index=True)[1]
