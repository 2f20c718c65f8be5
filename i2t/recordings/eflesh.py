"""Sessions of eFlesh as they were recorded: what their tables hold, and which rows belong together.

`states.csv` has Unix time (s), x, y, z of the probe (mm) and, where it was read, the load in grams (-1: not read);
`sensor_post_baselines.csv` has Unix time (s) and 15 values for each board, each less the reading before that touch;
`sensor.csv`, where it was kept, has the raw values.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.errors import DataError
from i2t.recordings.columns import NEWTONS_PER_GRAM
from i2t.recordings.files import data_error, read_numbers
from i2t.skin.boards import silent_chips

EFLESH_READINGS = 15  # of one board, AnySkin's
RAW_DECIMALS = 6  # of raw values, which are sums here
SAME_ROW = 15e-3  # s: sensor and state of a row are at most 8 ms apart, and rows at least 34 ms
STROKE_PAUSE_S = 0.5  # without rows between the strokes of a `normal` or `shear` session; rows are 0.03 to 0.14 s apart


def rows_together(
    states: Float[np.ndarray, " n"], values: Float[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Sensor rows that have a state at their time.

    Args:
        states: s, increasing.
        values: s, of the sensor's rows.

    Returns:
        These rows, and the states that are theirs.
    """
    after = np.clip(np.searchsorted(states, values), 0, len(states) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(states[before] - values) < np.abs(states[after] - values), before, after)
    rows = np.flatnonzero(np.abs(states[nearest] - values) <= SAME_ROW)
    return rows, nearest[rows]


def baselines(folder: Path, values: Float[np.ndarray, "n columns"]) -> Float[np.ndarray, "n c"] | None:
    """What was subtracted from each row, by the raw values (`sensor.csv`) in the same folder.

    Args:
        folder: Of the session.
        values: As recorded: time (s), and differences (uT).

    Returns:
        uT; None where the raw values are missing, damaged or of other rows.
    """
    try:
        raw = read_numbers(table_path(folder, "sensor"), (values.shape[1],))
    except DataError:
        return None
    raw = raw[np.isfinite(raw[:, 0])]
    raw = raw[np.argsort(raw[:, 0], kind="stable")]
    if not len(raw):
        return None
    rows, partner = rows_together(raw[:, 0], values[:, 0])
    return raw[partner, 1:] - values[:, 1:] if len(rows) == len(values) else None


def silent_chips_of(folder: Path, values: Float[np.ndarray, "n columns"]) -> Bool[np.ndarray, "n chips"]:
    """Chips that did not answer, by the raw values where these are in the folder, else by the differences.

    Args:
        folder: Of the session.
        values: As recorded: time (s), and differences (uT).

    Returns:
        Where a chip did not answer.
    """
    subtracted = baselines(folder, values)
    if subtracted is None:
        return silent_chips(values[:, 1:], differences=True)
    return silent_chips(np.round(values[:, 1:] + subtracted, RAW_DECIMALS))


def stroke_numbers(time: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """The stroke, down and up, that each row belongs to: strokes begin at the top, after a pause.

    Args:
        time: s.
        z: Height of the probe, in any unit; NaN where it is not known.

    Returns:
        Numbers from 0.
    """
    at_top = z > np.nanmax(z) - 0.1 * (np.nanmax(z) - np.nanmin(z))
    begins = np.concatenate([[False], (np.diff(time) > STROKE_PAUSE_S) & at_top[1:] & at_top[:-1]])
    return np.cumsum(begins)


def load_of_states(states: Float[np.ndarray, "n columns"]) -> Float[np.ndarray, " n"]:
    """What the scale read.

    Args:
        states: As recorded, the load (grams, -1 where it was not read) in the fifth column if there is one.

    Returns:
        N; NaN where it was not read.
    """
    if states.shape[1] < 5:
        return np.full(len(states), np.nan)
    return np.where(states[:, 4] == -1, np.nan, NEWTONS_PER_GRAM * states[:, 4])


def table_path(folder: Path, name: str) -> Path:
    """The file of a session's table, plain or gzip-ed.

    Args:
        folder: Of the session.
        name: Of the table.

    Returns:
        The file.

    Raises:
        DataError: There is none.
    """
    path = next((p for p in (folder / f"{name}.csv", folder / f"{name}.csv.gz") if p.is_file()), None)
    if path is None:
        raise data_error(folder, f"{name}.csv or {name}.csv.gz is missing")
    return path
