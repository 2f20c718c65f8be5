"""Small files made to mislead a reader, for every reader; and a process in which one is read within limits.

`HOSTILE` names them: each makes its files in a folder and says which reader is to be tried on which path. Run as a
script, this reads lines of `reader TAB path`, reads each in a process of its own and prints what came of it as JSON.
"""

import contextlib
import gzip
import hashlib
import io
import json
import lzma
import os
import pickle
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

GIB = 2**30
PATIENCE_S = 60
HEADER_BYTES = 512
CORNERS = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], "<f4").tobytes()
TRIANGLE = np.array([0, 1, 2], "<u4").tobytes()
DEEP = "[" * 200_000
Made = tuple[str, Path]
HOSTILE: dict[str, Callable[[Path], Made]] = {}


def hostile(reader: str, name: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register what writes a file of this name for a reader."""

    def register(write: Callable[[Path], None]) -> Callable[[Path], None]:
        def make(folder: Path) -> Made:
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write(path)
            return reader, path

        HOSTILE[write.__name__.strip("_")] = make
        return write

    return register


def add(reader: str, name: str, label: str, content: bytes | str | Callable[[], bytes]) -> None:
    """Register a file by its contents."""

    def write(path: Path) -> None:
        data = content() if callable(content) else content
        path.write_bytes(data.encode() if isinstance(data, str) else data)

    write.__name__ = label
    hostile(reader, name)(write)


# Meshes and point clouds


def glb(scene: dict[str, Any] | str, blob: bytes = CORNERS + TRIANGLE) -> bytes:
    text = (scene if isinstance(scene, str) else json.dumps(scene)).encode()
    text, blob = text + b" " * (-len(text) % 4), blob + b"\0" * (-len(blob) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def scene(**changes: Any) -> dict[str, Any]:
    whole: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 12},
        ],
        "buffers": [{"byteLength": 48}],
    }
    return whole | changes


def _many(accessor: dict[str, Any]) -> list[dict[str, Any]]:
    return [accessor, scene()["accessors"][1]]


def _ply(elements: str, form: str = "binary_little_endian", body: bytes = CORNERS) -> bytes:
    return f"ply\nformat {form} 1.0\n{elements}end_header\n".encode() + body


XYZ = "property float x\nproperty float y\nproperty float z\n"
FACES = "property list uchar int vertex_indices\n"

for label, content in {
    "glb_of_300_000_nodes": lambda: glb(scene(nodes=[{"mesh": 0}] * 300_000, scenes=[{"nodes": [*range(300_000)]}])),
    "glb_that_announces_a_trillion_corners": lambda: glb(
        scene(accessors=_many({"bufferView": 0, "componentType": 5126, "count": 10**12, "type": "VEC3"}))
    ),
    "glb_of_corners_without_bytes": lambda: glb(
        scene(accessors=_many({"componentType": 5126, "count": 10**10, "type": "VEC3"}))
    ),
    "glb_with_an_index_out_of_range": lambda: glb(scene(), CORNERS + np.array([0, 1, 9_999_999], "<u4").tobytes()),
    "glb_with_geometry_elsewhere": lambda: glb(scene(buffers=[{"byteLength": 48, "uri": "../../../etc/passwd"}])),
    "glb_whose_nodes_go_round": lambda: glb(scene(nodes=[{"children": [1]}, {"children": [0], "mesh": 0}])),
    "glb_nested_deep": lambda: glb(DEEP),
    "glb_of_one_mesh_a_thousand_times": lambda: glb(
        scene(
            nodes=[{"mesh": 0}] * 1000,
            scenes=[{"nodes": [*range(1000)]}],
            accessors=[
                scene()["accessors"][0],
                {"bufferView": 1, "componentType": 5121, "count": 50_000, "type": "SCALAR"},
            ],
            bufferViews=[
                {"buffer": 0, "byteOffset": 0, "byteLength": 36},
                {"buffer": 0, "byteOffset": 36, "byteLength": 50_000},
            ],
            buffers=[{"byteLength": 50_036}],
        ),
        CORNERS + bytes([0, 1, 2] * 16_667),
    ),
    "glb_with_a_mesh_that_is_not_there": lambda: glb(scene(nodes=[{"mesh": 7}])),
    "glb_of_meshes_that_are_numbers": lambda: glb(scene(meshes=[1, 2, 3])),
    "glb_cut_off_in_its_scene": lambda: glb(scene())[:12] + struct.pack("<I4s", 2**32 - 4, b"JSON") + b"{}",
}.items():
    add("mesh", "a.glb", label, content)
for label, content in {
    "obj_with_an_index_out_of_range": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 999999999\n",
    "obj_with_an_index_before_its_first": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -999999999\n",
    "obj_of_rubbish": b"\xff\xfe\x00\x01" * 5000,
    "obj_of_a_face_of_five_million_corners": lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf " + b"1 2 3 " * 1_700_000 + b"\n",
}.items():
    add("mesh", "a.obj", label, content)
add("mesh", "a.stl", "stl_that_announces_four_billion_faces", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50))
add("mesh", "b.stl", "stl_text_cut_off", b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\n")
for label, elements in {
    "ply_that_announces_a_trillion_corners": f"element vertex 1000000000000\n{XYZ}element face 1\n{FACES}",
    "ply_with_a_face_of_two_billion_corners": f"element vertex 3\n{XYZ}element face 1\n"
    "property list uint int vertex_indices\n",
    "ply_that_announces_a_billion_faces": f"element vertex 3\n{XYZ}element face 1000000000\n{FACES}",
}.items():
    add("mesh", "a.ply", label, _ply(elements, body=CORNERS + b"\xff\xff\xff\x7f" + TRIANGLE))
add("mesh", "b.ply", "ply_text_cut_off", _ply(f"element vertex 1000000000000\n{XYZ}", "ascii", b"0 0 0\n1 0 0\n"))
add("cloud", "c.ply", "cloud_of_a_quadrillion_points", _ply(f"element vertex {10**15}\n{XYZ}"))
add("cloud", "d.ply", "cloud_of_minus_a_point", _ply(f"element vertex -1\n{XYZ}"))
add("cloud", "e.ply", "cloud_without_a_format", b"ply\nelement vertex 3\n" + XYZ.encode() + b"end_header\n" + CORNERS)
PCD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT {count}\nPOINTS {points}\nDATA binary\n"
add("cloud", "a.pcd", "pcd_of_a_quadrillion_points", PCD.format(count="1 1 1", points=10**15))
add("cloud", "b.pcd", "pcd_of_points_of_a_billion_values", PCD.format(count=f"{10**9} 1 1", points=1))
add("cloud", "c.pcd", "pcd_whose_header_never_ends", b"# " + b"x" * 2_000_000)


@hostile("mesh", "pipe.stl")
def _pipe_for_a_mesh(path: Path) -> None:
    os.mkfifo(path)


@hostile("mesh", "zero.ply")
def _device_for_a_mesh(path: Path) -> None:
    path.symlink_to("/dev/zero")


# Data sets and recorded touches in HDF5, with the right checksum


def sealed(path: Path, fill: Callable[[h5py.File], None]) -> None:
    """A file of our schema, as anybody can write it."""
    from helpers.random_touches import make

    from i2t.dataset import save_dataset

    save_dataset(path, make(3))
    with h5py.File(path, "r+") as file:
        fill(file)
    body = path.read_bytes()[HEADER_BYTES:]
    line = f"i2t-touches 2 sha256 {hashlib.sha256(body).hexdigest()}\n".encode()
    path.write_bytes(line.ljust(HEADER_BYTES, b"\0") + body)


def replace_force(file: h5py.File, **options: Any) -> None:
    del file["touches/force"]
    file.create_dataset("touches/force", **options)


def h5(label: str, fill: Callable[[h5py.File], Any], reader: str = "dataset") -> None:
    def write(path: Path) -> None:
        sealed(path, fill)

    write.__name__ = label
    hostile(reader, f"{label}.h5")(write)


def _linked(file: h5py.File, link: Any) -> None:
    del file["touches/force"]
    file["touches/force"] = link


def _virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((3,), "f4")
    layout[:] = h5py.VirtualSource("/etc/hostname", "x", (3,))
    del file["touches/force"]
    file.create_virtual_dataset("touches/force", layout)


def _bomb(file: h5py.File) -> None:
    del file["touches/force"]
    rows = 2**22
    array = file.create_dataset("touches/force", (rows * 64,), "f8", chunks=(rows,), compression="gzip")
    chunk = zlib.compress(bytes(8 * rows))
    for i in range(64):
        array.id.write_direct_chunk((i * rows,), chunk)


def _towers(file: h5py.File) -> None:
    group = file
    for _ in range(3000):
        group = group.create_group("a")


def _crowd(file: h5py.File) -> None:
    for i in range(20_000):
        file.create_group(f"meta/{i}")


def _round(file: h5py.File) -> None:
    file["touches/again"] = file["touches"]


def _references(file: h5py.File) -> None:
    values = np.array([file["touches"].ref] * 3, h5py.ref_dtype)
    replace_force(file, data=values, dtype=h5py.ref_dtype)


def _type_for_an_array(file: h5py.File) -> None:
    del file["touches/force"]
    file["touches/force"] = np.dtype("f4")


def _array_for_a_group(file: h5py.File) -> None:
    del file["touches"]
    file["touches"] = np.zeros(3)


def _texts_for_numbers(file: h5py.File) -> None:
    replace_force(file, data=np.array(["one", "two", "three"], object), dtype=h5py.string_dtype())


def _table_of_names(file: h5py.File) -> None:
    del file["names/objects"]
    file.create_dataset("names/objects", (1000, 1000), h5py.string_dtype())


h5("h5_with_an_external_link", lambda file: _linked(file, h5py.ExternalLink("/etc/hostname", "/x")))
h5("h5_with_a_soft_link", lambda file: _linked(file, h5py.SoftLink("/touches/depth")))
h5("h5_with_a_link_to_nothing", lambda file: _linked(file, h5py.SoftLink("/../../x")))
h5("h5_with_values_in_another_file", lambda file: replace_force(file, shape=(3,), dtype="f4", external="/etc/hostname"))
h5("h5_with_a_virtual_array", _virtual)
h5("h5_of_a_trillion_touches", lambda file: replace_force(file, shape=(10**12,), dtype="f4", chunks=(1000,)))
h5("h5_with_a_chunk_of_two_gigabytes", lambda f: replace_force(
    f, shape=(3,), dtype="f8", chunks=(2**28,), maxshape=(None,), compression="gzip"))  # fmt: skip
h5("h5_that_unpacks_to_two_gigabytes", _bomb)
h5("h5_of_3000_levels", _towers)
h5("h5_of_20_000_groups", _crowd)
h5("h5_that_holds_itself", _round)
h5("h5_of_references", _references)
h5("h5_with_a_type_for_an_array", _type_for_an_array)
h5("h5_with_an_array_for_a_group", _array_for_a_group)
h5("h5_with_texts_for_numbers", _texts_for_numbers)
h5("h5_with_a_million_names", _table_of_names)
h5("h5_packed_otherwise", lambda file: replace_force(file, data=np.zeros(3, "f4"), chunks=(3,), compression="lzf"))
h5("h5_with_an_image_without_a_scale", lambda file: file.create_dataset("images/depth", data=[[1]]), "touch")
h5("h5_with_a_series_that_is_none", lambda file: file.create_dataset("series/tactile", data=[1]), "touch")
h5("h5_with_a_counter_of_many", lambda file: file.create_dataset("counters/site", data=[1, 2, 3]), "touch")
add("dataset", "other.h5", "h5_that_is_none", b"\x89HDF\r\n\x1a\n" + bytes(4000))
add("dataset", "short.h5", "h5_of_a_header_alone", b"i2t-touches 2 sha256 " + b"0" * 64 + b"\n")


@hostile("dataset", "pipe.h5")
def _pipe_for_touches(path: Path) -> None:
    os.mkfifo(path)


@hostile("dataset", "zero.h5")
def _device_for_touches(path: Path) -> None:
    path.symlink_to("/dev/zero")


# Pads, pad models, calibrations, ambient fields and heads in npz


def npy(values: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, values, allow_pickle=True)
    return out.getvalue()


def npy_header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": descr, "fortran_order": False, "shape": shape})
    return out.getvalue()


def npz(entries: list[tuple[str, bytes]], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", method) as file:
        for name, data in entries:
            file.writestr(name, data)
    return out.getvalue()


def kept(kind: str, arrays: dict[str, Any], about: Any) -> bytes:
    """A file as `i2t.serialization.save` writes it, with the right checksum, of whatever arrays."""
    from i2t.serialization import _digest

    arrays = {name: np.asarray(values) for name, values in arrays.items()}
    header = {"format": kind, "version": 1, "sha256": _digest(arrays), "about": about}
    entries = {"about": np.array(json.dumps(header)), **arrays}
    return npz([(f"{name}.npy", npy(values)) for name, values in entries.items()])


class Runs:
    """Pickled, this is a program that leaves a mark."""

    def __reduce__(self) -> Any:
        return os.system, ("touch i2t-was-here",)


PAD = {
    "thickness": 2e-3, "young": 1e5, "poisson": 0.48, "magnetization": np.zeros((4, 4, 3)), "gains": np.ones(15),
    "board.chips": np.zeros((5, 3)), "board.rotations": np.tile(np.eye(3), (5, 1, 1)), "friction": 0.1,
    "mount_compliance": 0.0,
}  # fmt: skip
for label, content in {
    "npz_that_unpacks_to_300_megabytes": lambda: npz([("about.npy", npy(0)), ("gains.npy", bytes(300 * 2**20))]),
    "npz_of_6000_entries": lambda: npz([(f"{i}.npy", b"") for i in range(6000)], zipfile.ZIP_STORED),
    "npz_packed_otherwise": lambda: npz([("about.npy", npy(0))], zipfile.ZIP_LZMA),
    "npz_with_a_program": lambda: npz([("about.npy", npy(np.array([Runs()], object)))]),
    "npz_that_announces_ten_trillion_numbers": lambda: npz([("about.npy", npy_header((10**13,)) + bytes(400))]),
    "npz_cut_off": lambda: kept("i2t pad", PAD, {})[:-300],
    "npz_nested_deep": lambda: npz([("about.npy", npy(np.array(DEEP)))]),
    "pad_of_texts": lambda: kept("i2t pad", PAD | {"young": "soft"}, {}),
    "pad_without_a_board": lambda: kept("i2t pad", PAD | {"board.chips": 3.0}, {}),
    "pad_of_imaginary_stiffness": lambda: kept("i2t pad", PAD | {"young": 1e5 + 1j}, {}),
    "pad_without_about": lambda: npz([("about.npy", npy(np.array("{}")))]),
}.items():
    add("pad", f"{label}.npz", label, content)
MODEL = {"reading_model.mean": np.zeros(3), "reading_model.scale": 1.0, "reading_std": 1.0, "r2": 1.0}
add("pad_model", "m.npz", "pad_model_of_single_numbers", lambda: kept("i2t pad model", MODEL | PAD, {}))
add("pad_model", "n.npz", "pad_model_of_another_kind", lambda: kept("i2t pad", PAD, {}))
add("calibration", "c.npz", "calibration_without_parts", lambda: kept("i2t calibration", {"a": 1.0}, []))
add("calibration", "d.npz", "calibration_of_nothing", lambda: npz([("about.npy", npy(np.array('{"format": 7}')))]))
AMBIENT = {
    "earth": 1.0, "offset": 2.0, "gradient": 0.0, "centre": 0.0, "response": 0.0, "terms": True, "covariance": 0.0,
    "left_out": 0.0, **{f"{kind}.{name}": 0.0 for kind in ("noise", "burst")
                        for name in ("samples", "common", "chip", "dof_common", "dof_chip")},
}  # fmt: skip
add("ambient", "e.npz", "ambient_field_of_single_numbers", lambda: kept("i2t ambient field", AMBIENT, {}))
add("head", "h.npz", "head_of_a_list", lambda: kept("i2t head", {"a": 1.0}, ["position"]))


@hostile("pad", "pipe.npz")
def _pipe_for_a_pad(path: Path) -> None:
    os.mkfifo(path)


# Checkpoints and predictors


def checkpoint(label: str, reader: str, about: str | Callable[[], dict[str, Any]], step: str = "") -> None:
    def write(path: Path) -> None:
        folder = path / step
        folder.mkdir(parents=True)
        text = about if isinstance(about, str) else json.dumps({"custom_metadata": about()})
        (folder / "_CHECKPOINT_METADATA").write_text(text)

    write.__name__ = label
    hostile(reader, label)(write)


def _predictor(**changes: Any) -> Callable[[], dict[str, Any]]:
    whole = {
        "format": "i2t predictor", "version": 2, "pressure": None, "network": None, "baseline": None,
        "window": 0.017, "reach": 0.004, "default_force": 1.0, "default_depth": None, "std_scale": 1.0, "metadata": {},
        "shapes": {"params": [3]},
    }  # fmt: skip
    return lambda: whole | changes


def _training(**changes: Any) -> Callable[[], dict[str, Any]]:
    whole = {"format": "i2t checkpoint", "version": 1, "model": {}, "train": {}, "touches": 100,
             "packages": {"i2t": "0"}, "extra": {}}  # fmt: skip
    return lambda: whole | changes


checkpoint("predictor_nested_deep", "predictor", DEEP)
checkpoint("predictor_of_a_trillion_numbers", "predictor", _predictor(shapes={"gp": {"a": [10**6, 10**6]}}))
checkpoint("predictor_of_shapes_that_are_texts", "predictor", _predictor(shapes="large"))
checkpoint("predictor_of_a_baseline_that_is_a_list", "predictor", _predictor(baseline=[1], shapes={}))
checkpoint("predictor_that_is_a_list", "predictor", '{"custom_metadata": [1, 2]}')
checkpoint("training_nested_deep", "checkpoint", DEEP, "7")
checkpoint("training_of_100_000_layers", "checkpoint", _training(model={"channels": [8] * 100_000}), "7")
checkpoint("training_of_layers_of_a_trillion", "checkpoint", _training(model={"encoder_width": 10**12}), "7")
checkpoint("training_without_packages", "checkpoint", _training(packages=3, version=9), "7")
checkpoint("training_of_touches_that_are_none", "checkpoint", _training(touches="many"), "7")


# Images


def png(width: int, height: int, extra: bytes = b"", rows: bytes = b"") -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + extra + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def _ztxt() -> bytes:
    data = b"Comment\0\0" + zlib.compress(bytes(200 * 2**20))
    return struct.pack(">I", len(data)) + b"zTXt" + data + struct.pack(">I", zlib.crc32(b"zTXt" + data))


def tif(width: int, height: int, packing: int = 1, strip: bytes = b"\1\0\2\0", following: int = 0) -> bytes:
    entries = [(256, 4, width), (257, 4, height), (258, 3, 16), (259, 3, packing), (262, 3, 1), (273, 4, 200),
               (277, 3, 1), (278, 4, height), (279, 4, len(strip))]  # fmt: skip
    table = b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    whole = b"II*\0" + struct.pack("<IH", 8, len(entries)) + table + struct.pack("<I", following)
    return whole.ljust(200, b"\0") + strip


for label, content in {
    "png_of_ten_billion_pixels": png(100_000, 100_000),
    "png_of_268_million_pixels": png(16_384, 16_384),
    "png_cut_off": png(64, 64, rows=bytes(400))[:-30],
    "png_with_a_comment_of_200_megabytes": lambda: png(2, 2, _ztxt(), bytes([0, 1, 1, 1, 1] * 2)),
    "png_of_nothing": b"\x89PNG\r\n\x1a\n",
}.items():
    add("depth", "a.png", label, content)
for label, content in {
    "tif_of_four_billion_pixels": tif(65_536, 65_536),
    "tif_that_unpacks_to_400_megabytes": lambda: tif(8, 8, 8, zlib.compress(bytes(400 * 2**20))),
    "tif_of_images_without_end": tif(2, 1, following=8),
    "tif_packed_otherwise": lambda: tif(8, 8, 34_925, lzma.compress(bytes(128))),
    "tif_of_rubbish": b"II*\0" + bytes(range(256)) * 4,
}.items():
    add("depth", "a.tif", label, content)


@hostile("depth", "pipe.png")
def _pipe_for_an_image(path: Path) -> None:
    os.mkfifo(path)


# Rigs, cameras and hand-eye views in TOML and CSV

for label, content in {
    "rig_nested_deep": lambda: "x = " + "[" * 4000,
    "rig_nested_deep_in_many_lines": lambda: "x = " + "[\n" * 100_000,
    "rig_with_a_key_of_many_parts": lambda: "a." * 50_000 + "b = 1",
    "rig_of_two_megabytes": lambda: "# " + "x" * 2**21,
    "rig_that_is_no_text": b"\xff\xfe\x00" * 100,
    "rig_with_a_number_of_10_000_digits": lambda: "[tool]\nmass = " + "1" * 4000 + "\n" + "y = 0x" + "f" * 4000,
    "rig_of_tables_in_tables": lambda: "".join(f"[{'.'.join('a' * (i % 90 + 1))}.t{i}]\n" for i in range(5000)),
    "rig_whose_mass_is_a_table": b"[tool]\nmass = {}\n[camera]\n[world]\n[limits]\n",
}.items():
    add("rig", "rig.toml", label, content)


@hostile("rig", "pipe.toml")
def _pipe_for_a_rig(path: Path) -> None:
    os.mkfifo(path)


@hostile("rig", "zero.toml")
def _device_for_a_rig(path: Path) -> None:
    path.symlink_to("/dev/zero")


LENS = "width = 64\nheight = 48\nfx = 60.0\nfy = 60.0\ncx = 31.5\ncy = 23.5\n"


@hostile("views", "nested")
def _views_nested_deep(path: Path) -> None:
    path.mkdir()
    (path / "camera.toml").write_text("x = " + "[" * 4000)


@hostile("views", "wide")
def _views_of_a_camera_of_absurd_size(path: Path) -> None:
    path.mkdir()
    (path / "camera.toml").write_text(LENS.replace("64", "1" + "0" * 30) + 'scale = "mm"\n')


@hostile("views", "bomb")
def _views_with_a_huge_colour_image(path: Path) -> None:
    (path / "depth").mkdir(parents=True)
    (path / "colour").mkdir()
    (path / "camera.toml").write_text(LENS + 'scale = "mm"\n')
    (path / "depth" / "0.png").write_bytes(png(64, 48, rows=(b"\0" + b"\1\1" * 64) * 48))
    (path / "colour" / "0.png").write_bytes(png(30_000, 30_000))


def hand_eye(label: str, poses: str | Callable[[], str], link: str = "") -> None:
    def write(path: Path) -> None:
        (path / "images").mkdir(parents=True)
        (path / "camera.toml").write_text(LENS)
        (path / "poses.csv").write_text(poses if isinstance(poses, str) else poses())
        if link:
            (path / "images" / "000.png").symlink_to(link)

    write.__name__ = label
    hostile("hand_eye", label)(write)


hand_eye("images_that_lead_out_of_the_folder", "../../../../etc/passwd,0,0,0,0,0,0\n")
hand_eye("images_at_the_root", "/etc/passwd,0,0,0,0,0,0\n")
hand_eye("images_that_are_links_elsewhere", "000.png,0,0,0,0,0,0\n", link="/etc/passwd")
hand_eye("poses_with_a_cell_of_a_megabyte", lambda: "0" * 500_000 + ",0,0,0,0,0,0\n")


# Converters


def _reskin_run(path: Path, tactile: bytes) -> None:
    folder = path / path.name
    (folder / f"{path.name}_tactile").mkdir(parents=True)
    (folder / f"{path.name}_tactile" / "experiment_1_reskin").write_bytes(tactile)


@hostile("imagine2touch", "program")
def _tactile_samples_with_a_program(path: Path) -> None:
    _reskin_run(path, npy(np.array([Runs()], object)))


@hostile("imagine2touch", "header")
def _tactile_samples_of_a_trillion(path: Path) -> None:
    _reskin_run(path, npy_header((10**12, 4)) + bytes(400))


@hostile("imagine2touch", "bomb")
def _tactile_samples_that_multiply(path: Path) -> None:
    values: Any = [1.0] * 10
    for _ in range(30):
        values = [values] * 10
    body = pickle.dumps(values, 2)
    _reskin_run(path, npy_header((1,), "|O") + body)


def eflesh(label: str, states: Callable[[], bytes]) -> None:
    def write(path: Path) -> None:
        path.mkdir()
        (path / "states.csv.gz").write_bytes(states())
        (path / "sensor_post_baselines.csv").write_text("0," + ",".join("1" * 15) + "\n")

    write.__name__ = label
    hostile("eflesh", label)(write)


eflesh("table_that_unpacks_to_500_megabytes", lambda: gzip.compress(b"1,2,3,4\n" * 2**26, 1))
eflesh("table_cut_off", lambda: gzip.compress(b"1,2,3,4\n" * 1000)[:-20])
eflesh("table_of_zeros", lambda: gzip.compress(bytes(10**6)))
add("presses", "a.csv", "table_with_a_cell_of_a_megabyte", lambda: b'x_mm,y_mm,"' + b"z" * 10**6)
add("presses", "b.csv", "table_of_bytes_that_are_no_text", b"\xff\xfe" * 1000)
add("presses", "c.csv", "table_of_many_columns", lambda: ",".join(f"c{i}" for i in range(200_000)))
add("readings", "d.csv", "readings_with_a_cell_of_a_megabyte", lambda: b'b0x_uT,"' + b"z" * 10**6)
add("presses", "e.csv.gz", "presses_that_unpack_to_500_megabytes", lambda: gzip.compress(b"x_mm\n" * 10**8, 1))


# Folders of the recorder, and recorded streams

NOTES = {"object": "cube", "session": "a", "seed": 0, "devices": ["s", "s", "s"], "unreachable": {}, "sites": {}}
for label, content in {
    "notes_nested_deep": DEEP,
    "notes_that_are_a_list": '[["session", "a"], ["unreachable", {}]]',
    "notes_of_other_kinds": json.dumps(NOTES | {"unreachable": ["3"]}),
    "notes_of_sites_without_numbers": json.dumps(NOTES | {"unreachable": {"three": "far"}}),
    "notes_with_a_session_of_numbers": json.dumps(NOTES | {"session": 3}),
    "notes_without_a_session": json.dumps({"unreachable": {}}),
    "notes_cut_off": json.dumps(NOTES)[:-9],
    "notes_that_are_no_text": b"\xff" * 100,
}.items():
    add("session", f"{label}/.collection.json", label, content)


@hostile("session", "pipe/.collection.json")
def _pipe_for_notes(path: Path) -> None:
    os.mkfifo(path)


for label, content in {
    "raw_touch_with_a_broken_event": lambda: _raw(b"e", b"[1.0"),
    "raw_touch_with_an_event_nested_deep": lambda: _raw(b"e", DEEP.encode()),
    "raw_touch_with_half_a_sample": lambda: _raw(b"s", bytes(13)),
    "raw_touch_of_an_unknown_entry": lambda: _raw(b"z", bytes(8)),
    "raw_touch_of_a_billion_chips": lambda: _raw_header(chips=10**9) + b"x",
}.items():
    add("raw", f"{label}.raw", label, content)


def _raw_header(chips: int = 5) -> bytes:
    from i2t.collect.event_log import RAW_FILE_KIND

    return json.dumps({"touch": RAW_FILE_KIND, "version": 2, "chips": chips}).encode() + b"\n"


def _raw(kind: bytes, payload: bytes) -> bytes:
    from i2t.collect.event_log import ENTRY_HEADER

    return _raw_header() + ENTRY_HEADER.pack(kind, len(payload)) + payload


def _stream(*chunks: tuple[float, bytes]) -> bytes:
    from i2t.hardware.reskin.recording import CHUNK, RECORDING_HEADER

    return RECORDING_HEADER + b"".join(CHUNK.pack(when, len(data)) + data for when, data in chunks)


add("replay", "nan.raw", "stream_without_times", lambda: _stream((0.0, b"abc"), (float("nan"), b"abc")))
add("replay", "far.raw", "stream_of_a_thousand_years", lambda: _stream((0.0, b"abc"), (3e10, b"abc")))
add("replay", "none.raw", "stream_of_rubbish", lambda: bytes(range(256)) * 20)


@hostile("replay", "pipe.raw")
def _pipe_for_a_stream(path: Path) -> None:
    os.mkfifo(path)


# What reads them


def _session(path: Path) -> None:
    from i2t.collect.arguments import CollectArgs
    from i2t.collect.session import _resume
    from i2t.hardware.rig import Rig
    from i2t.objects.catalogue import make_object

    _resume(CollectArgs(out=path.parent), "star", Rig(), make_object("star").mesh)


def _views(path: Path) -> None:
    from i2t.hardware.camera_folder import RecordedDepthCamera

    camera = RecordedDepthCamera(path)
    camera.connect()
    camera.capture()


def _hand_eye(path: Path) -> None:
    from i2t.hardware.hand_eye import CharucoBoard, estimate

    estimate(path, CharucoBoard())


def _converter(name: str) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        from importlib import import_module

        from i2t.skin.boards import reskin_board

        convert = import_module(f"i2t.convert.{name}").convert
        options = {"eflesh": {}, "imagine2touch": {"board": reskin_board()}}
        return convert(path, **options.get(name, {"board": reskin_board(), "indenter": "sphere:4"}))

    return read


def _replay(path: Path) -> None:
    from i2t.hardware.reskin.driver import Replay

    Replay(path).connect()


def _named(module: str, name: str, *more: Any) -> Callable[[Path], Any]:
    def read(path: Path) -> Any:
        from importlib import import_module

        found: Any = import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
        return found(path, *more)

    return read


READERS: dict[str, Callable[[Path], Any]] = {
    "mesh": _named("i2t.objects", "load_mesh", "m"),
    "cloud": _named("i2t.objects", "load_point_cloud", "m"),
    "dataset": _named("i2t.dataset", "load_dataset"),
    "touch": _named("i2t.dataset", "read_touch"),
    "pad": _named("i2t.skin.files", "load_pad"),
    "pad_model": _named("i2t.recognition.pad_model_files", "load_pad_model"),
    "calibration": _named("i2t.calibration.model", "load_calibration"),
    "ambient": _named("i2t.skin.ambient", "load_ambient"),
    "head": _named("i2t.calibration.heads.head", "load_head"),
    "predictor": _named("i2t.prediction.predictor", "load_predictor"),
    "checkpoint": _named("i2t.prediction.checkpoint", "restore"),
    "depth": _named("i2t.depth.camera", "read_depth", "mm"),
    "rig": _named("i2t.hardware.rig", "Rig.read"),
    "views": _views,
    "hand_eye": _hand_eye,
    "imagine2touch": _converter("imagine2touch"),
    "eflesh": _converter("eflesh"),
    "presses": _converter("presses"),
    "readings": _named("i2t.calibration.heads.recording", "read_recordings"),
    "session": _session,
    "raw": lambda path: list(_named("i2t.collect.event_log", "read_raw")(path)),
    "replay": _replay,
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
        from i2t.errors import I2TError

        mine = isinstance(error, I2TError | ValueError | FileNotFoundError)
        found = {"kind": type(error).__name__, "said": str(error), "user": mine}
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return {**found, "seconds": time.process_time() - begun, "grown": 1024 * grown}


def warm_up() -> None:
    """Import what the readers need, so that this is not counted."""
    for module in (
        "i2t.objects", "i2t.dataset", "i2t.skin.files", "i2t.recognition.pad_model_files", "i2t.calibration.model",
        "i2t.calibration.heads.head", "i2t.calibration.heads.recording", "i2t.prediction.predictor",
        "i2t.hardware.hand_eye", "i2t.hardware.camera_folder", "i2t.convert.eflesh", "i2t.convert.presses",
        "i2t.convert.imagine2touch", "i2t.collect.session", "i2t.hardware.reskin.driver",
    ):  # fmt: skip
        __import__(module)


def main() -> None:
    """Read what standard input names, one process for each file."""
    warm_up()
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
            print(
                answer.read() or '{"kind": "killed", "said": "", "user": false, "seconds": 0, "grown": 0}', flush=True
            )
        os.waitpid(child, 0)


if __name__ == "__main__":
    main()
