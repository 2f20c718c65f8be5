"""An MCAP file of touches, which Foxglove and ROS 2 tools open: messages in JSON, with Foxglove's published schemas.

    /tf                           tool, object and camera in the world (foxglove.FrameTransforms)
    /object, /field               the object's mesh, and the reading as arrows at the chips (foxglove.SceneUpdate)
    /depth, /patch                the depth image and what was extracted (foxglove.RawImage, 32FC1, metres)
    /lens                         the depth image's lens (foxglove.CameraCalibration)
    /readings, /temperature       microtesla of each chip, less the ambient; degrees Celsius
    /force, /torque, /belief      newtons and newton metres, tool axes; the probabilities after each touch
    /events                       what happened (foxglove.Log)

Numbers are one message a sample, by name, null where one is not known. The package mcap is needed to write it.
"""

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera, Distortion
from i2t.errors import require_extra
from i2t.files import replacing
from i2t.view.contents import AXES, Contents, Events, Field, Item, Numbers, Picture, Poses, camera_of, items, span
from i2t.view.rerun_file import VECTOR_M_PER_UT

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

    camera = camera_of(contents.dataset)
    with replacing(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="i2t")
        writer.add_metadata("about", {"source": contents.dataset.source, **contents.dataset.meta})
        messages = _Messages(writer, np.asarray(contents.dataset.board.chips, float))
        for number, record in enumerate(contents.records()):
            start = span(number, record)[0]
            if number == 0 and contents.mesh is not None:
                messages.scene("object", start, "object", triangles=[_triangles(*map(np.asarray, contents.mesh))])
            if camera is not None and "depth" in record.images:
                messages.put("lens", "foxglove.CameraCalibration", start, _lens(camera))
            for item in items(contents, number, record):
                messages.item(item)
        writer.finish()
    return path


class _Messages:
    """Writes the messages of touches."""

    def __init__(self, writer: Any, chips: np.ndarray) -> None:
        self._writer, self._chips = writer, chips
        self._channels: dict[str, int] = {}

    def item(self, item: Item) -> None:
        """One thing of a touch."""
        match item:
            case Poses(frame, times, poses):
                for time, T in zip(times, poses, strict=True):
                    if np.isfinite(T).all():
                        self._pose(time, frame, T)
            case Numbers(place, names, times, values):
                for time, row in zip(times, values, strict=True):
                    numbers = {name: float(x) if np.isfinite(x) else None for name, x in zip(names, row, strict=True)}
                    self.put(place, "i2t.Numbers", time, numbers)
            case Field(times, vectors):
                for time, field in zip(times, vectors, strict=True):
                    self.scene("field", time, "tool", arrows=[*map(_arrow, self._chips, VECTOR_M_PER_UT * field)])
            case Picture(place, frame, time, metres):
                data = base64.b64encode(np.ascontiguousarray(metres, "<f4").tobytes()).decode()
                rows, columns = metres.shape
                image = {"frame_id": frame, "width": columns, "height": rows, "encoding": "32FC1", "step": 4 * columns}
                self.put(place, "foxglove.RawImage", time, {**image, "data": data}, BASE64)
            case Events(times, texts):
                for time, text in zip(times, texts, strict=True):
                    log = {"level": 2, "message": text, "name": "i2t", "file": "", "line": 0}
                    self.put("events", "foxglove.Log", time, log)

    def scene(self, topic: str, time: float, frame: str, **shapes: list[dict[str, Any]]) -> None:
        """Shapes in a frame, which stay until the next."""
        about = {"frame_id": frame, "id": topic, "lifetime": {"sec": 0, "nsec": 0}, "frame_locked": True}
        entity = {"timestamp": _stamp(time), **about, **shapes}
        self.put(topic, "foxglove.SceneUpdate", time, {"deletions": [], "entities": [entity]})

    def _pose(self, time: float, frame: str, T: np.ndarray) -> None:
        pose = _pose(T)
        moved = {"translation": pose["position"], "rotation": pose["orientation"]}
        frames = {"timestamp": _stamp(time), "parent_frame_id": "world", "child_frame_id": frame}
        self.put("tf", "foxglove.FrameTransforms", time, {"transforms": [{**frames, **moved}]})

    def put(self, topic: str, schema: str, time: float, message: dict[str, Any], about: Any = None) -> None:
        """A message, dated."""
        if topic not in self._channels:
            text = json.dumps({"title": schema, "type": "object", "properties": about or {}})
            number = self._writer.register_schema(name=schema, encoding="jsonschema", data=text.encode())
            self._channels[topic] = self._writer.register_channel(
                topic=f"/{topic}", message_encoding="json", schema_id=number
            )
        at = round(float(time) * NANOSECONDS)
        data = json.dumps({"timestamp": _stamp(time), **message}, allow_nan=False).encode()
        self._writer.add_message(channel_id=self._channels[topic], log_time=at, publish_time=at, data=data)


def _stamp(time: float) -> dict[str, int]:
    at = round(float(time) * NANOSECONDS)
    return {"sec": at // NANOSECONDS, "nsec": at % NANOSECONDS}


def _named(names: str | tuple[str, ...], values: np.ndarray) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def _pose(T: np.ndarray) -> dict[str, dict[str, float]]:
    turn = Rotation.from_matrix(np.asarray(T[:3, :3], float)).as_quat()
    return {"position": _named(AXES, T[:3, 3]), "orientation": _named("xyzw", turn)}


def _arrow(origin: np.ndarray, vector: np.ndarray) -> dict[str, Any]:
    """An arrow, which is drawn along the x axis of its pose."""
    size = float(np.linalg.norm(vector))
    T = np.eye(4)
    T[:3, 3] = origin
    if size > 0:
        T[:3, :3] = Rotation.align_vectors([vector], [[1.0, 0.0, 0.0]])[0].as_matrix()
    head = {"head_length": 2 * ARROW_M, "head_diameter": 2 * ARROW_M, "color": BLUE}
    return {"pose": _pose(T), "shaft_length": size, "shaft_diameter": ARROW_M, **head}


def _triangles(vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    points = [_named(AXES, point) for point in vertices]
    return {"pose": _pose(np.eye(4)), "points": points, "color": GREY, "colors": [], "indices": faces.ravel().tolist()}


def _lens(camera: Camera) -> dict[str, Any]:
    plumb = camera.model == Distortion.BROWN_CONRADY  # the other models have no name there
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    return {
        "frame_id": "camera", "width": camera.width, "height": camera.height,
        "distortion_model": "plumb_bob" if plumb else "", "D": [*map(float, camera.coefficients)] if plumb else [],
        "K": K.ravel().tolist(), "R": np.eye(3).ravel().tolist(), "P": np.pad(K, ((0, 0), (0, 1))).ravel().tolist(),
    }  # fmt: skip
