"""The sketch of examples/firmware, compiled for this machine: its frames are those that the driver reads."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from i2t.hardware.reskin.frames import decode_any, decoders
from i2t.hardware.reskin.layouts import Format

SKETCH = Path(__file__).parents[2] / "examples" / "firmware" / "skin_crc" / "skin_crc.ino"
ARDUINO = Path(__file__).parents[1] / "helpers" / "arduino"
ADDRESSES = np.array([0x0C, 0x13, 0x12, 0x10, 0x11], float)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
def test_the_sketch_sends_answering_chips_and_omits_silent_ones(tmp_path):
    main = f'#include "{SKETCH}"\nint main() {{ setup(); for (int i = 0; i < 300; i++) loop(); }}'
    words = ["g++", "-std=c++11", "-Wall", "-Wextra", "-Werror", f"-I{ARDUINO}", "-x", "c++", "-", "-o", "sketch"]
    subprocess.run(words, input=main, text=True, check=True, cwd=tmp_path)
    data = subprocess.run([tmp_path / "sketch"], capture_output=True, check=True).stdout
    (decoder,), decoded = decode_any(decoders(), data)
    assert (decoder.layout.form, len(decoded), decoder.skipped, decoder.lost) == (Format.CRC, 300, 0, 0)
    field = np.column_stack([15 * ADDRESSES, -1.05 * ADDRESSES, np.full(5, 0.242 * 32767)])
    field[3] = np.nan
    celsius = np.where(ADDRESSES == 0x10, 0.0, 25 + ADDRESSES / 45.2)
    for frame in decoded:
        np.testing.assert_allclose(frame.reading.reshape(5, 3), field, rtol=1e-6)
        np.testing.assert_allclose(frame.temperature, celsius, rtol=1e-6)
