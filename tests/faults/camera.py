"""What breaks in the files of a camera: changed bytes, cut ends, other images, and PNGs that claim to be huge."""

import io
import json
import struct
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

from i2t.cli.pipes import ExitCode
from i2t.depth.camera import Camera
from i2t.hardware.camera_folder import DEPTH_UNIT_M, DESCRIPTION, save_views
from i2t.hardware.protocols import View
from tests.faults.table import Fault, Measure, Trial

LENS = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
CLAIMED_PIXELS = 60_000  # edge of a PNG of some kilobytes
MOST_GB = 2.0
READ = """
import json, sys
from pathlib import Path
from i2t.cli.exit_codes import exit_code_of
from i2t.hardware.camera_folder import read_view
view = []
code = exit_code_of(lambda: view.extend(read_view(sys.argv[1])[1][1:]))
peak = Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]  # kB; ru_maxrss holds the parent's, too
print(json.dumps([int(peak), *(each.tolist() for each in view)]))
sys.exit(code)
"""


def _changed(rng: np.random.Generator, data: bytes) -> bytes:
    changed = np.frombuffer(data, np.uint8).copy()
    places = rng.integers(0, len(changed), int(rng.integers(1, 20)))
    changed[places] = rng.integers(0, 256, len(places))
    return changed.tobytes()


def _cut(rng: np.random.Generator, data: bytes) -> bytes:
    return data[: rng.integers(0, len(data))]


def _huge(rng: np.random.Generator, data: bytes) -> bytes:
    """The same PNG with another size in its header."""
    header = b"IHDR" + struct.pack(">II", CLAIMED_PIXELS, CLAIMED_PIXELS) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def _grey(rng: np.random.Generator, data: bytes) -> bytes:
    """An image of one channel of 8 bits, which a depth image is not and a colour image may be."""
    file = io.BytesIO()
    Image.fromarray(rng.integers(1, 256, (LENS.height, LENS.width), np.uint8)).save(file, "PNG")
    return file.getvalue()


def _missing(rng: np.random.Generator, data: bytes) -> None:
    return None


DAMAGES: tuple[Callable[[np.random.Generator, bytes], bytes | None], ...] = (_changed, _cut, _huge, _grey, _missing)
FILES = ("depth/000000.png", "colour/000000.png", DESCRIPTION)
READABLE = {(_grey, FILES[1]), (_changed, DESCRIPTION)}  # as another image, or another lens


def damaged_file(number: int) -> Trial:
    """A folder of views of which one file is damaged or missing, read by a process of its own.

    Args:
        number: Number of the trial.

    Returns:
        Whether the process ended in anything but one sentence or the pixels that were written, and its memory in GB.
    """
    rng = np.random.default_rng((number, 17))
    name, damage = FILES[number % len(FILES)], DAMAGES[number // len(FILES) % len(DAMAGES)]
    units = rng.integers(900, 1100, (LENS.height, LENS.width))
    colour = rng.integers(0, 256, (LENS.height, LENS.width, 3), np.uint8)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "views"
        list(save_views(folder, LENS, [View(0.0, units * DEPTH_UNIT_M, colour)]))
        whole = (folder / name).read_bytes()
        (folder / name).unlink()
        if (left := damage(rng, whole)) is not None:
            (folder / name).write_bytes(left)
        child = subprocess.run([sys.executable, "-c", READ, folder], capture_output=True, text=True, check=False)
    peak, *pixels = json.loads(child.stdout or "[Infinity]")
    if child.returncode:
        right = (
            child.returncode == ExitCode.WRONG_USE
            and child.stderr.startswith("error: ")
            and child.stderr.count("\n") == 1
        )
    else:
        same = np.allclose(pixels[0], units * DEPTH_UNIT_M) and np.array_equal(pixels[1], colour)
        right = not child.stderr and (same or (damage, name) in READABLE)
    said = f"{name} {damage.__name__[1:]}: {'refused' if child.returncode else 'read'}"
    return {"wrong": not right, "memory": peak * 1024 / 1e9, "said": said}


CAMERA_FAULTS = (
    Fault("disk", "damaged camera files", damaged_file, 150, (Measure("wrong", 0), Measure("memory", MOST_GB, "GB"))),
)
