"""An MCAP file of touches, which Foxglove and ROS 2 tools open: messages in JSON, with Foxglove's published schemas.

    /tf                    tool, object and camera in the world (foxglove.FrameTransforms)
    /object, /field        the object's mesh, and the reading as arrows at the chips (foxglove.SceneUpdate)
    /depth, /depth/lens    the depth image (foxglove.RawImage, 32FC1, metres) and its lens (foxglove.CameraCalibration)
    /patch                 what was extracted (foxglove.RawImage, 32FC1, metres)
    /readings              microtesla of each chip, less the ambient; temperature (degrees Celsius) where it is known
    /wrench                newtons and newton metres, tool axes
    /events, /belief       what happened (foxglove.Log), and the probabilities after each touch

Times are those of the touches, in Unix time. The package mcap is needed to write it.
"""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

from i2t.dataset import Record
from i2t.depth.camera import Camera, Distortion
from i2t.extras import require_extra
from i2t.files import replacing
from i2t.view.contents import Contents, camera_of
from i2t.view.rerun_file import VECTOR_M_PER_UT, VECTOR_RATE_HZ, begun, thinned

NEEDS_MCAP = "an MCAP file"
NANOSECONDS = 10**9
GREY, BLUE = {"r": 0.7, "g": 0.7, "b": 0.7, "a": 1.0}, {"r": 0.0, "g": 0.45, "b": 0.7, "a": 1.0}
ARROW_M = 4e-4  # diameter of an arrow's shaft
BASE64 = {"data": {"type": "string", "contentEncoding": "base64"}}


def write_mcap(contents: Contents, path: Path) -> Path:
    """Write the file.

    Args:
        contents: Of a session or data set.
        path: Of the file, .mcap.

    Returns:
        The file.

    Raises:
        MissingExtraError: mcap is missing.
    """
    require_extra("mcap", NEEDS_MCAP)
    from mcap.writer import Writer

    with replacing(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="i2t")
        messages = _Messages(writer, contents)
        writer.add_metadata("about", {"source": contents.dataset.source, **contents.dataset.meta})
        for number, record in enumerate(contents.records()):
            messages.touch(number, record)
        writer.finish()
    return path


class _Messages:
    """Writes the messages of touches."""

    def __init__(self, writer: Any, contents: Contents) -> None:
        self._writer, self._contents = writer, contents
        self._board, self._camera = contents.dataset.board, camera_of(contents.dataset)
        self._channels: dict[str, int] = {}

    def touch(self, number: int, record: Record) -> None:
        """One touch."""
        touches, start = record.touch.touches, begun(number, record)
        self._poses(start, object=touches.T_w_o[0], tool=touches.T_w_t[0])
        if number == 0:
            self._mesh(start)
        self._image("/patch", start, "tool", np.asarray(touches.patch[0], np.float32))
        self._view(start, record)
        self._readings(start, touches.reading, record)
        self._wrench(start, float(touches.force[0]), record)
        for when, text in record.events:
            log = {"timestamp": _stamp(when), "level": 2, "message": text, "name": "i2t", "file": "", "line": 0}
            self._put("/events", "foxglove.Log", when, log)
        belief = self._contents.belief
        if belief is not None:
            p = {name: float(each) for name, each in zip(belief.names, belief.p[number], strict=True)}
            self._put("/belief", "i2t.Belief", start, {"touch": number, "p": p})

    def _view(self, start: float, record: Record) -> None:
        """The depth image, its lens, and where its camera was."""
        image, seen = record.images.get("depth"), record.series.get("camera")
        if image is None:
            return
        if seen is not None and len(seen.values):
            self._poses(start, camera=seen.values[0].reshape(4, 4))
        if self._camera is not None:
            self._put("/depth/lens", "foxglove.CameraCalibration", start, _lens(self._camera, start))
        self._image("/depth", start, "camera", (image.values * image.scale).astype(np.float32))

    def _readings(self, start: float, reading: np.ndarray, record: Record) -> None:
        """Every sample with its time, or the reading of the touch where nobody kept them."""
        tactile, warm = record.series.get("tactile"), record.series.get("temperature")
        if tactile is None:
            self._reading(start, np.asarray(reading[0], float), None)
            self._field(start, np.asarray(reading[0], float))
            return
        kept = record.series.get("ambient")
        ambient = kept.values[0] if kept is not None and len(kept.values) else 0.0
        drawn = set(thinned(tactile.time, VECTOR_RATE_HZ).tolist())
        for row, when in enumerate(tactile.time):
            values = tactile.values[row] - ambient
            degrees = warm.values[row] if warm is not None and len(warm.values) == len(tactile.values) else None
            self._reading(float(when), values, degrees)
            if row in drawn:
                self._field(float(when), values)

    def _reading(self, when: float, values: np.ndarray, degrees: np.ndarray | None) -> None:
        chips: list[dict[str, float | None]] = [
            dict(zip("xyz", map(_known, chip), strict=True)) for chip in values.reshape(-1, 3)
        ]
        for chip, each in zip(chips, [] if degrees is None else degrees, strict=False):
            chip["temperature"] = _known(each)
        self._put("/readings", "i2t.Readings", when, {"timestamp": _stamp(when), "chips": chips})

    def _field(self, when: float, values: np.ndarray) -> None:
        """The reading as arrows at the chips, in the tool's frame."""
        field = np.nan_to_num(np.asarray(self._board.to_tool(values), float).reshape(-1, 3))
        arrows = [
            {"pose": _along(chip, vector), "shaft_length": VECTOR_M_PER_UT * float(np.linalg.norm(vector)),
             "shaft_diameter": ARROW_M, "head_length": 2 * ARROW_M, "head_diameter": 2 * ARROW_M, "color": BLUE}
            for chip, vector in zip(np.asarray(self._board.chips, float), field, strict=True)
        ]  # fmt: skip
        self._scene("/field", when, "tool", "field", arrows=arrows)

    def _wrench(self, start: float, force: float, record: Record) -> None:
        series = record.series.get("wrench")
        if series is None:
            self._put("/wrench", "i2t.Wrench", start, {"timestamp": _stamp(start), "normal": _known(force)})
            return
        for when, row in zip(series.time, series.values, strict=True):
            wrench = {kind: dict(zip("xyz", map(_known, part), strict=True)) for kind, part in
                      (("force", row[:3]), ("torque", row[3:]))}  # fmt: skip
            self._put("/wrench", "i2t.Wrench", float(when), {"timestamp": _stamp(float(when)), **wrench})
        poses = record.series.get("pose")
        if poses is not None:
            for row in thinned(poses.time, VECTOR_RATE_HZ):
                self._poses(float(poses.time[row]), tool=poses.values[row].reshape(4, 4))

    def _mesh(self, start: float) -> None:
        mesh = self._contents.mesh
        if mesh is None:
            return
        triangles = {
            "pose": _pose(np.eye(4)), "points": [dict(zip("xyz", map(float, point), strict=True)) for point in
            np.asarray(mesh.vertices)], "color": GREY, "colors": [], "indices": np.asarray(mesh.faces).ravel().tolist(),
        }  # fmt: skip
        self._scene("/object", start, "object", "object", triangles=[triangles])

    def _scene(self, topic: str, when: float, frame: str, name: str, **shapes: list[dict[str, Any]]) -> None:
        nothing = {"sec": 0, "nsec": 0}
        entity = {"timestamp": _stamp(when), "frame_id": frame, "id": name, "lifetime": nothing, "frame_locked": True}
        self._put(topic, "foxglove.SceneUpdate", when, {"deletions": [], "entities": [{**entity, **shapes}]})

    def _poses(self, when: float, **frames: np.ndarray) -> None:
        known = {name: T for name, T in frames.items() if np.isfinite(T).all()}
        transforms = [
            {"timestamp": _stamp(when), "parent_frame_id": "world", "child_frame_id": name,
             "translation": _pose(T)["position"], "rotation": _pose(T)["orientation"]}
            for name, T in known.items()
        ]  # fmt: skip
        if transforms:
            self._put("/tf", "foxglove.FrameTransforms", when, {"transforms": transforms})

    def _image(self, topic: str, when: float, frame: str, values: np.ndarray) -> None:
        image = {
            "timestamp": _stamp(when), "frame_id": frame, "width": values.shape[1], "height": values.shape[0],
            "encoding": "32FC1", "step": 4 * values.shape[1],
            "data": base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode(),
        }  # fmt: skip
        self._put(topic, "foxglove.RawImage", when, image, BASE64)

    def _put(self, topic: str, schema: str, when: float, message: dict[str, Any], about: Any = None) -> None:
        if topic not in self._channels:
            text = json.dumps({"title": schema, "type": "object", "properties": about or {}})
            number = self._writer.register_schema(name=schema, encoding="jsonschema", data=text.encode())
            self._channels[topic] = self._writer.register_channel(
                topic=topic, message_encoding="json", schema_id=number
            )
        at = round(when * NANOSECONDS)
        data = json.dumps(message, allow_nan=False).encode()
        self._writer.add_message(channel_id=self._channels[topic], log_time=at, publish_time=at, data=data)


def _known(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _stamp(when: float) -> dict[str, int]:
    at = round(when * NANOSECONDS)
    return {"sec": at // NANOSECONDS, "nsec": at % NANOSECONDS}


def _pose(T: np.ndarray) -> dict[str, dict[str, float]]:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_matrix(np.asarray(T[:3, :3], float)).as_quat()
    return {
        "position": dict(zip("xyz", map(float, T[:3, 3]), strict=True)),
        "orientation": dict(zip("xyzw", map(float, turn), strict=True)),
    }


def _along(origin: np.ndarray, vector: np.ndarray) -> dict[str, dict[str, float]]:
    """The pose whose x axis, along which arrows are drawn, points along a vector."""
    size = np.linalg.norm(vector)
    x = vector / size if size > 0 else np.array([1.0, 0.0, 0.0])
    aside = np.eye(3)[np.argmin(np.abs(x))]
    y = np.cross(x, aside) / np.linalg.norm(np.cross(x, aside))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, y, np.cross(x, y)]), origin
    return _pose(T)


def _lens(camera: Camera, when: float) -> dict[str, Any]:
    plumb = camera.model == Distortion.BROWN_CONRADY  # the other models have no name there
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    P = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return {
        "timestamp": _stamp(when), "frame_id": "camera", "width": camera.width, "height": camera.height,
        "distortion_model": "plumb_bob" if plumb else "",
        "D": [*map(float, camera.coefficients)] if plumb else [],
        "K": [float(each) for each in K], "R": np.eye(3).ravel().tolist(),
        "P": [float(each) for each in P],
    }  # fmt: skip
