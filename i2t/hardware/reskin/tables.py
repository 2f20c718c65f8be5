"""A recorded byte stream as a table for other programs: CSV, or NumPy arrays (npz).

time_s       from the first byte; began_unix in the npz says when that was
b0x_uT ...   three columns for each chip, in the board's order and the chips' own axes, nothing subtracted
t0_C ...     temperatures; both are empty (NaN) for a chip that is missing
"""

import csv
from pathlib import Path

import numpy as np

from i2t.errors import DataError, DeviceError
from i2t.files import replacing
from i2t.hardware.protocols import Samples
from i2t.hardware.reskin import frames, recording
from i2t.hardware.reskin.layouts import FrameLayout

TABLE_ENDINGS = (".csv", ".npz")
HEARD_BYTES = 4000  # of bytes that are no frames, to say why
TABLE_DECIMALS = 6  # of times and values in a CSV file: more than the converter has


def is_table(path: Path) -> bool:
    """Test whether a file of this name is a table, and not a recording of bytes.

    Args:
        path: Of the file.

    Returns:
        By its ending.
    """
    return path.suffix.lower() in TABLE_ENDINGS


def samples_of(path: str | Path, chips: int, rate: float) -> Samples:
    """Samples of a recording of bytes.

    Args:
        path: Of the recording.
        chips: How many magnetometers the board has.
        rate: Hz, at which bare bytes are taken to have come.

    Returns:
        All samples; times in s from the first byte.

    Raises:
        DeviceError: It holds no frames of such a board.
        DataError: It cannot be a recording.
        OSError: It cannot be read.
    """
    decoders, found, heard = frames.decoders(None, chips), list[tuple[float, frames.Frame]](), b""
    for when, chunk in recording.chunks(path, rate * FrameLayout(chips=chips).binary.size):
        heard = (heard + chunk)[-HEARD_BYTES:]
        decoders, more = frames.decode_any(decoders, chunk)
        found += [(when, frame) for frame in more]
    if not found:
        raise DeviceError(f"no skin in {path}: {frames.diagnose(heard, None, chips)}")
    return Samples(
        np.arange(len(found)),
        np.array([when for when, _ in found]),
        np.array([frame.reading for _, frame in found]),
        np.array([frame.temperature for _, frame in found]),
    )


def write_table(path: Path, samples: Samples, began: float | None = None) -> Path:
    """Write samples as a table, whole or not at all.

    Args:
        path: Of the new file, .csv or .npz.
        samples: Of one board.
        began: Unix time in s of their first byte, if it is known.

    Returns:
        The file.

    Raises:
        DataError: There is such a file already, or it cannot be written.
    """
    chips = samples.temperature.shape[1]
    names = ["time_s", *(f"b{chip}{axis}_uT" for chip in range(chips) for axis in "xyz")]
    names += [f"t{chip}_C" for chip in range(chips)]
    columns = np.column_stack([samples.time, samples.reading, samples.temperature])
    if path.exists():
        raise DataError(f"{path}: exists already; give the table a new name")
    with replacing(path) as temporary:
        if path.suffix.lower() == ".csv":
            with temporary.open("w", newline="") as file:
                rows = csv.writer(file)
                rows.writerow(names)
                rows.writerows([f"{x:.{TABLE_DECIMALS}f}" if np.isfinite(x) else "" for x in row] for row in columns)
        else:
            arrays = {"time_s": samples.time, "reading_uT": samples.reading, "temperature_C": samples.temperature}
            unix = np.float64(np.nan if began is None else began)
            with temporary.open("wb") as file:  # by its name NumPy would add an ending to one in capitals
                np.savez_compressed(file, allow_pickle=False, began_unix=unix, **arrays)
    return path
