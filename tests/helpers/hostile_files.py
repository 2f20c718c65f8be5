"""Small files made to mislead a reader, for every reader; and a process in which one is read within limits.

`HOSTILE` names them: the reader that is to be tried, the file's name and what it holds. Run as a script, this reads
lines of `reader TAB path`, reads each in a process of its own and prints what came of it as JSON.
"""

import contextlib
import gzip
import hashlib
import io
import json
import os
import resource
import signal
import struct
import sys
import time
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from helpers import random_touches

from i2t.collect.arguments import CollectArgs
from i2t.collect.folder_notes import resume
from i2t.collect.recorder import RAW_FILE_HEADER, read_raw
from i2t.convert import eflesh, imagine2touch, presses
from i2t.dataset import load_dataset, read_touch, save_dataset
from i2t.depth.camera import read_depth
from i2t.errors import I2TError
from i2t.files.serialization import _digest
from i2t.hardware.camera_folder import read_view
from i2t.hardware.hand_eye import CharucoBoard, estimate
from i2t.hardware.rig import Rig
from i2t.heads.heads import load_head
from i2t.objects import load_mesh, make_object
from i2t.prediction.predictor import load_predictor
from i2t.recordings.read import read_recordings
from i2t.skin.boards import reskin_board
from i2t.skin.files import load_pad
from i2t.skin_models.calibration import load_calibration
from i2t.skin_models.pad_model import load_pad_model

GIB = 2**30
PATIENCE_S = 60
DEEP = "[" * 200_000
PIPE = object()
# Bytes, a text, a path to link to, a pipe, the files of a folder, or what makes one of these where it is told the path.
Content = Any


def make(path: Path, content: Content) -> Path:
    """Make a hostile file or folder."""
    if isinstance(content, dict):
        for name, each in content.items():
            make(path / name, each)
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    if callable(content):
        return make(path, content(path))
    if isinstance(content, Path):
        path.symlink_to(content)
    elif content is PIPE:
        os.mkfifo(path)
    elif content is not None:
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


# Meshes

CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], "<f4").tobytes()
TRIANGLE = np.array([0, 1, 2], "<u4").tobytes()
POSITIONS = {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}
INDICES = {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"}
SCENE = {
    "asset": {"version": "2.0"},
    "scene": 0,
    "scenes": [{"nodes": [0]}],
    "nodes": [{"mesh": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
    "accessors": [POSITIONS, INDICES],
    "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
    "buffers": [{"byteLength": 48}],
}


def glb(scene: str = "", blob: bytes = CORNERS + TRIANGLE, **changes: Any) -> bytes:
    text = (scene or json.dumps(SCENE | changes)).encode()
    text, blob = text + b" " * (-len(text) % 4), blob + b"\0" * (-len(blob) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


XYZ = "property float x\nproperty float y\nproperty float z\n"


def ply(corners: int, faces: int = 0, form: str = "binary_little_endian", body: bytes = CORNERS) -> bytes:
    """A PLY whose faces have four bytes for the number of their corners."""
    elements = f"element vertex {corners}\n{XYZ}"
    elements += f"element face {faces}\nproperty list uint int vertex_indices\n" if faces else ""
    return f"ply\nformat {form} 1.0\n{elements}end_header\n".encode() + body


# Data sets and recorded touches in HDF5


FORCE = "touches/force"


def h5(change: Callable[[h5py.File], Any]) -> Content:
    """A file of the schema with the correct checksum, as any program can write it."""

    def write(path: Path) -> None:
        save_dataset(path, random_touches.make(3))
        with h5py.File(path, "r+") as file:
            change(file)
        body = path.read_bytes()[512:]
        line = f"i2t-touches 3 sha256 {hashlib.sha256(body).hexdigest()}\n".encode()
        path.write_bytes(line.ljust(512, b"\0") + body)

    return write


def put(name: str, value: Any = None, **options: Any) -> Content:
    """Replace the array or group of this name in the file."""

    def change(file: h5py.File) -> None:
        if name in file:
            del file[name]
        if options:
            file.create_dataset(name, **options)
        else:
            file[name] = value(file) if callable(value) else value

    return h5(change)


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((3,), "f4")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (3,))
    file.create_virtual_dataset("touches/more", layout)


def bomb(file: h5py.File) -> None:
    rows = 2**22
    array = file.create_dataset("touches/more", (rows * 64,), "f8", chunks=(rows,), compression="gzip")
    chunk = zlib.compress(bytes(8 * rows))
    for i in range(64):
        array.id.write_direct_chunk((i * rows,), chunk)


def tower(file: h5py.File) -> None:
    group: Any = file
    for _ in range(3000):
        group = group.create_group("a")


# Pads, pad models, calibrations and heads in npz


def npy(values: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, values, allow_pickle=True)
    return out.getvalue()


def npy_header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": descr, "fortran_order": False, "shape": shape})
    return out.getvalue()


def npz(entries: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, data in entries.items():
            file.writestr(name, data)
    return out.getvalue()


def kept(kind: str, arrays: dict[str, Any]) -> bytes:
    """A file of arbitrary arrays as `i2t.files.serialization.save` writes it, with the correct checksum."""
    arrays = {name: np.asarray(values) for name, values in arrays.items()}
    header = {"format": kind, "version": 1, "sha256": _digest(arrays), "about": {}}
    entries = {"about": np.array(json.dumps(header)), **arrays}
    return npz({f"{name}.npy": npy(values) for name, values in entries.items()})


class Runs:
    """An object whose pickle is a program that leaves a mark."""

    def __reduce__(self) -> Any:
        return os.system, ("touch i2t-was-here",)


# Checkpoints and predictors


def about(whole: dict[str, Any], **changes: Any) -> str:
    return json.dumps({"custom_metadata": whole | changes})


PREDICTOR = {
    "format": "i2t predictor", "version": 5, "model": {"class": "i2t.prediction.gp_method:GPModel", "settings": {}},
    "window": 0.017, "reach": 0.004, "default_force": 1.0, "default_travel": None, "std_scale": 1.0, "metadata": {},
    "shapes": {"params": ["float32", 3]},
}  # fmt: skip

# Images


def png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, extra: bytes = b"", rows: bytes = b"") -> bytes:
    head = png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + extra + png_chunk(b"IDAT", zlib.compress(rows)) + png_chunk(b"IEND", b"")


def tif(width: int, height: int, packing: int = 1, strip: bytes = b"\1\0\2\0", following: int = 0) -> bytes:
    entries = [(256, 4, width), (257, 4, height), (258, 3, 16), (259, 3, packing), (262, 3, 1), (273, 4, 200),
               (277, 3, 1), (278, 4, height), (279, 4, len(strip))]  # fmt: skip
    table = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    whole = b"II*\0" + struct.pack("<IH", 8, len(entries)) + table + struct.pack("<I", following)
    return whole.ljust(200, b"\0") + strip


# Folders of cameras, converters and the recorder

LENS = "width = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 31.5\ncy = 23.5\n"
NOTES = {"object": "cube", "session": "a", "seed": 0, "devices": ["s", "s", "s"], "unreachable": {}, "sites": {}}


def hand_eye(poses: str, **images: Path) -> Content:
    return {"camera.toml": LENS, "poses.csv": poses, "images": {"0.png": Path("/etc/passwd")}} | images


def reskin_run(tactile: Content) -> Content:
    """A run of an object with the name of its folder."""
    return {"theirs/theirs_tactile/experiment_1_reskin": tactile}


def eflesh_session(states: Callable[[Path], bytes]) -> Content:
    return {"states.csv.gz": states, "sensor_post_baselines.csv": "0," + ",".join("1" * 15) + "\n"}


def raw(entry: str) -> str:
    return f"{RAW_FILE_HEADER.decode()}\n{entry}\n"


BY_READER: dict[tuple[str, str], dict[str, Content]] = {
    ("mesh", "a.glb"): {
        "300_000 nodes": lambda _: glb(nodes=[{"mesh": 0}] * 300_000, scenes=[{"nodes": [*range(300_000)]}]),
        "a trillion corners": glb(accessors=[POSITIONS | {"count": 10**12}, INDICES]),
        "an index out of range": glb(blob=CORNERS + np.array([0, 1, 9_999_999], "<u4").tobytes()),
        "geometry elsewhere": glb(buffers=[{"byteLength": 48, "uri": "../../../etc/passwd"}]),
        "nodes that go round": glb(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}]),
        "nested deep": glb(DEEP),
    },
    ("mesh", "a.gltf"): {
        "data elsewhere": json.dumps(SCENE | {"buffers": [{"byteLength": 48, "uri": "../../../etc/passwd"}]}),
        "data on the network": json.dumps(SCENE | {"buffers": [{"byteLength": 48, "uri": "http://[::1]/a"}]}),
        "nested deep": DEEP,
    },
    ("mesh", "b.glb"): {
        "a mesh 10_000 times": lambda _: glb(
            blob=CORNERS + np.tile([0, 1, 2], 100_000).astype("<u4").tobytes(),
            accessors=[POSITIONS, INDICES | {"count": 300_000}],
            bufferViews=[SCENE["bufferViews"][0], {"buffer": 0, "byteOffset": 36, "byteLength": 1_200_000}],
            buffers=[{"byteLength": 1_200_036}],
            nodes=[{"mesh": 0}] * 10_000,
            scenes=[{"nodes": [*range(10_000)]}],
        ),
        "views that overlap": glb(bufferViews=[{"buffer": 0, "byteLength": 2**40, "byteStride": 252}] * 2),
    },
    ("mesh", "a.obj"): {
        "an index out of range": "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n",
        "a face of 200_000 corners": lambda _: (
            "".join(f"v {i} {i * 7919 % 100_003} 0\n" for i in range(200_000))
            + "f "
            + " ".join(map(str, range(1, 200_001)))
        ),
        "lines that go on without end": "v 0 0 0 \\\n" * 200_000,
    },
    ("mesh", "a.off"): {
        "a trillion corners": "OFF\n1000000000000 1 0\n0 0 0\n",
        "a face of two billion corners": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n2000000000 0 1 2\n",
    },
    ("mesh", "a.stl"): {
        "four billion faces": bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50),
        "a device": Path("/dev/zero"),
    },
    ("mesh", "a.ply"): {
        "a trillion corners": ply(10**12, 1),
        "a face of two billion corners": ply(3, 1, body=CORNERS + b"\xff\xff\xff\x7f" + TRIANGLE),
        "a trillion rows of nothing": "ply\nformat binary_little_endian 1.0\nelement no 1000000000000\nend_header\n",
        "faces of no corners": ply(3, 5_000_000, body=CORNERS + bytes(20_000_000 - 5_200_000)),
    },
    ("dataset", "a.h5"): {
        "an external link": put(FORCE, h5py.ExternalLink("/etc/hostname", "/x")),
        "values in another file": put(FORCE, shape=(3,), dtype="f4", external="/etc/hostname"),
        "a virtual array": h5(virtual),
        "a trillion touches": put(FORCE, shape=(10**12,), dtype="f4", chunks=(1000,)),
        "a chunk of two gigabytes": put(
            FORCE, shape=(3,), dtype="f8", chunks=(2**28,), maxshape=(None,), compression="gzip"
        ),
        "two gigabytes unpacked": h5(bomb),
        "3000 levels": h5(tower),
        "20_000 groups": h5(lambda file: [file.create_group(f"meta/{i}") for i in range(20_000)]),
        "a group that holds itself": h5(lambda file: file.__setitem__("touches/again", file["touches"])),
        "a million names": h5(lambda file: file["names"].create_dataset("more", (1000, 1000), h5py.string_dtype())),
        "a device": Path("/dev/zero"),
    },
    ("touch", "a.h5"): {
        "a series that is none": put("series/tactile", [1]),
        "a counter of many": put("counters/site", [1, 2, 3]),
    },
    ("pad", "a.npz"): {
        "300 megabytes unpacked": lambda _: npz({"about.npy": npy(0), "gains.npy": bytes(300 * 2**20)}),
        "6000 entries": lambda _: npz({f"{i}.npy": b"" for i in range(6000)}, zipfile.ZIP_STORED),
        "a program": npz({"about.npy": npy(np.array([Runs()], object))}),
        "ten trillion numbers": npz({"about.npy": npy_header((10**13,)) + bytes(400)}),
    },
    **{
        (reader, "b.npz"): {"texts for numbers": kept(f"i2t {kind}", {"young": "soft", "a": "b"})}
        for reader, kind in (
            ("pad", "pad"),
            ("pad_model", "pad model"),
            ("calibration", "calibration"),
            ("head", "head"),
        )
    },
    ("predictor", "theirs/_CHECKPOINT_METADATA"): {
        "nested deep": DEEP,
        "a trillion numbers": about(PREDICTOR, shapes={"gp": {"a": ["float32", 10**6, 10**6]}}),
    },
    ("depth", "a.png"): {
        "ten billion pixels": png(100_000, 100_000),
        "a comment of 200 megabytes": lambda _: png(
            2, 2, png_chunk(b"zTXt", b"Comment\0\0" + zlib.compress(bytes(200 * 2**20))), bytes([0, 1, 1, 1, 1] * 2)
        ),
    },
    ("depth", "a.tif"): {
        "four billion pixels": tif(65_536, 65_536),
        "400 megabytes unpacked": lambda _: tif(8, 8, 8, zlib.compress(bytes(400 * 2**20))),
        "images without end": tif(2, 1, following=8),
    },
    ("rig", "rig.toml"): {
        "nested deep": "x = " + "[" * 4000,
        "a key of many parts": "a." * 50_000 + "b = 1",
        "two million letters": lambda _: "# " + "x" * 2**21,
        "a number of 10_000 digits": "[tool]\nmass = " + "1" * 4000 + "\n" + "y = 0x" + "f" * 4000,
        "a device": Path("/dev/zero"),
    },
    ("views", "theirs"): {
        "a camera of absurd size": {"camera.toml": LENS.replace("64", "1" + "0" * 30) + 'scale = "mm"\n'},
        "a huge colour image": {
            "camera.toml": LENS + 'scale = "mm"\n',
            "depth/0.png": png(64, 48, rows=(b"\0" + b"\1\1" * 64) * 48),
            "colour/0.png": png(30_000, 30_000),
        },
    },
    ("hand_eye", "theirs"): {
        "images that are links elsewhere": hand_eye("0.png,0,0,0,0,0,0\n"),
        "a cell of half a megabyte": hand_eye("0" * 500_000 + ",0,0,0,0,0,0\n"),
    },
    ("imagine2touch", "theirs"): {
        "a program": reskin_run(npy(np.array([Runs()], object))),
        "a trillion samples": reskin_run(npy_header((10**12, 4)) + bytes(400)),
    },
    ("eflesh", "theirs"): {
        "500 megabytes unpacked": eflesh_session(lambda _: gzip.compress(b"1,2,3,4\n" * 2**20, 1) * 64),
    },
    ("presses", "a.csv"): {
        "a cell of a million letters": lambda _: 'x_mm,y_mm,"' + "z" * 10**6,
        "many columns": lambda _: ",".join(f"c{i}" for i in range(200_000)),
    },
    ("presses", "a.csv.gz"): {"500 megabytes unpacked": lambda _: gzip.compress(b"x_mm\n" * 10**6, 1) * 100},
    ("readings", "a.csv"): {"a cell of a million letters": lambda _: 'b0x_uT,"' + "z" * 10**6},
    ("session", "theirs/.collection.json"): {
        "nested deep": DEEP,
        "a number": "3",
        "no session": json.dumps({"object": "cube"}),
    },
    ("raw", "a.raw"): {
        "a broken event": raw('["event", [1.0'),
        "samples of two sizes": raw('["skin", [[0.0, 0.0], [0.0]]]'),
        "no pair": raw('["skin"]'),
    },
}
EVERY_FILE = {"a pipe": PIPE, "rubbish": bytes(range(256)) * 80}
HOSTILE: dict[str, tuple[str, str, Content]] = {
    f"{reader} {name}: {label}": (reader, name, content)
    for (reader, name), contents in BY_READER.items()
    for label, content in (contents if name == "theirs" else contents | EVERY_FILE).items()
}


# What reads them


def _session(path: Path) -> None:
    resume(CollectArgs(out=path.parent), "star", Rig(), make_object("star").mesh)


READERS: dict[str, Callable[[Path], Any]] = {
    "mesh": lambda path: load_mesh(path, "m"),
    "dataset": load_dataset,
    "touch": read_touch,
    "pad": load_pad,
    "pad_model": load_pad_model,
    "calibration": load_calibration,
    "head": load_head,
    "predictor": lambda path: load_predictor(path.parent),
    "depth": lambda path: read_depth(path, "mm"),
    "rig": Rig.read,
    "views": read_view,
    "hand_eye": lambda path: estimate(path, CharucoBoard()),
    "imagine2touch": lambda path: imagine2touch.convert(path, board=reskin_board()),
    "eflesh": eflesh.convert,
    "presses": lambda path: presses.convert(path, board=reskin_board(), indenter="sphere:4"),
    "readings": read_recordings,
    "session": _session,
    "raw": lambda path: list(read_raw(path)),
}


def read_within_limits(reader: str, path: Path, most: int) -> dict[str, Any]:
    """Read a file with so many bytes more than this process has now, and say what came of it. The limit is a loose one,
    as libraries reserve addresses that they never use; what was really used is said.
    """
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + most, used + most))
    signal.alarm(PATIENCE_S)  # whoever waits for ever is ended
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.process_time()
    found: dict[str, Any] = {"kind": "read", "said": "", "user": False}
    try:
        READERS[reader](path)
    except BaseException as error:
        mine = isinstance(error, I2TError | ValueError | FileNotFoundError)
        found = {"kind": type(error).__name__, "said": str(error), "user": mine}
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {**found, "seconds": time.process_time() - begun, "grown": 1024 * grown}


def main() -> None:
    """Read what standard input names, one process for each file."""
    for line in sys.stdin:
        reader, path = line.rstrip("\n").split("\t")
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            with contextlib.suppress(BaseException), open(write, "w") as answer:
                json.dump(read_within_limits(reader, Path(path), 4 * GIB), answer)
            os._exit(0)
        os.close(write)
        with open(read) as answer:
            killed = {"kind": "killed", "said": "", "user": False, "seconds": 0, "grown": 0}
            print(answer.read() or json.dumps(killed), flush=True)
        os.waitpid(child, 0)


if __name__ == "__main__":
    main()
