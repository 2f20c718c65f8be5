"""Sessions of eFlesh as they were recorded: the contents of their tables, and which rows belong together.

`states.csv` holds Unix time (s), x, y, z of the probe (mm) and, in some sessions, the load in grams (-1: not read).
`sensor_post_baselines.csv` holds Unix time (s) and 15 values for each board, minus the reading before that touch.
`sensor.csv`, which some sessions have, holds the raw values.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from i2t.errors import DataError
from i2t.recordings.columns import NEWTONS_PER_GRAM
from i2t.recordings.files import data_error, read_numbers
from i2t.skin.boards import silent_chips

EFLESH_READINGS = 15  # number of values in a reading of eFlesh's AnySkin board
# s, largest time between sensor and state in one row; sensor rows without a state so near are left out. The two are
# within 8 ms, and rows are at least 34 ms apart.
MAX_ROW_OFFSET_S = 15e-3


def match_rows(
    states: Float[np.ndarray, " n"], values: Float[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Match each sensor row with the state of the probe that is nearest in time, within 15 ms.

    Args:
        states: `(n,)` increasing times of the states, in s.
        values: `(m,)` times of the sensor rows, in s.

    Returns:
        Row numbers of the k sensor rows that have a state, and row numbers of these states. Other rows are dropped.
    """
    after = np.clip(np.searchsorted(states, values), 0, len(states) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(states[before] - values) < np.abs(states[after] - values), before, after)
    rows = np.flatnonzero(np.abs(states[nearest] - values) <= MAX_ROW_OFFSET_S)
    return rows, nearest[rows]


def baselines(folder: Path, values: Float[np.ndarray, "n columns"]) -> Float[np.ndarray, "n c"] | None:
    """Compute the baseline that was subtracted from each row, from the raw values (`sensor.csv`) in the same folder.

    Args:
        folder: Folder of the session.
        values: `(n, columns)` rows as recorded: time in s, and differences in uT.

    Returns:
        `(n, c)` baselines in uT, or None if the raw values are missing, damaged or of other rows.
    """
    try:
        raw = read_numbers(table_path(folder, "sensor"), (values.shape[1],))
    except DataError:
        return None
    raw = raw[np.isfinite(raw[:, 0])]
    raw = raw[np.argsort(raw[:, 0], kind="stable")]
    if not len(raw):
        return None
    rows, partner = match_rows(raw[:, 0], values[:, 0])
    return raw[partner, 1:] - values[:, 1:] if len(rows) == len(values) else None


def silent_chips_of(folder: Path, values: Float[np.ndarray, "n columns"]) -> Bool[np.ndarray, "n chips"]:
    """Find chips that did not answer in an eFlesh session, from raw values if the folder has them, or differences.

    Args:
        folder: Folder of the session.
        values: `(n, columns)` rows as recorded: time in s, and differences in uT.

    Returns:
        `(n, chips)` mask that is True where a chip did not answer.
    """
    subtracted = baselines(folder, values)
    if subtracted is None:
        return silent_chips(values[:, 1:], differences=True)
    # Rounding removes the error of the sum: a silent chip sends exact zeros.
    return silent_chips(np.round(values[:, 1:] + subtracted, 6))


def stroke_numbers(
    time: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"], *, min_pause_s: float = 0.5
) -> Int[np.ndarray, " n"]:
    """Number the strokes of the probe in a `normal` or `shear` session of eFlesh; each begins at the top after a pause.

    Args:
        time: `(n,)` times in s.
        z: `(n,)` heights of the probe in any unit; NaN where unknown.
        min_pause_s: Time between rows above which the probe paused; rows are 0.03 to 0.14 s apart within a stroke.

    Returns:
        `(n,)` number of each row's stroke, from 0.
    """
    at_top = z > np.nanmax(z) - 0.1 * (np.nanmax(z) - np.nanmin(z))
    begins = np.concatenate([[False], (np.diff(time) > min_pause_s) & at_top[1:] & at_top[:-1]])
    return np.cumsum(begins)


def load_of_states(states: Float[np.ndarray, "n columns"]) -> Float[np.ndarray, " n"]:
    """Convert the loads in the states of an eFlesh session, read by a scale in grams, to newtons.

    Args:
        states: `(n, columns)` states as recorded. The fifth column, if there is one, is the load in grams, -1 if it was
            not read.

    Returns:
        `(n,)` loads in N; NaN where the scale was not read.
    """
    if states.shape[1] < 5:
        return np.full(len(states), np.nan)
    return np.where(states[:, 4] == -1, np.nan, NEWTONS_PER_GRAM * states[:, 4])


def table_path(folder: Path, name: str) -> Path:
    """Find the file of a session's table, plain or gzipped.

    Args:
        folder: Folder of the session.
        name: Name of the table without suffix.

    Returns:
        The path of the file.

    Raises:
        DataError: There is no such file.
    """
    path = next((p for p in (folder / f"{name}.csv", folder / f"{name}.csv.gz") if p.is_file()), None)
    if path is None:
        raise data_error(folder, f"{name}.csv or {name}.csv.gz is missing")
    return path
