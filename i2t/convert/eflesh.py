"""eFlesh recordings (github notvenky/eFlesh, characterization/datasets): a probe that presses one skin, or shears two.

A session is a folder of comma-separated tables, plain or gzip-ed, without headers: `states.csv` (Unix time in s; x, y,
z of the probe in mm of its robot; in some sessions the load in grams, -1 = not read) and `sensor_post_baselines.csv`
(Unix time in s, 15 values per board, each minus the reading before that touch; the steps of the values are those of the
chip in uT, so the unit is very likely uT). Rows of the two tables are matched by their times.

Frames: the skin is fixed, and its tool frame T is the world's: x and y are the robot's from the centre of the session's
range, z is up, zero where the press begins. The object O is the probe: origin at the lowest point of its tip, axes as
T. The source states neither the shape of the tip (a sphere is assumed), nor the height of first contact, the
orientation of the board, or the centre of the skin. They are estimated from the readings as far as possible
(`i2t.recordings.diagnose`): if presses lie on both sides of first contact, travel counts from where readings begin; if
all go to one height, travel is unknown.
"""

import json
from pathlib import Path

import numpy as np

from i2t.convert import EFLESH_TIP_RADIUS_M, EFLESH_WINDOW_M
from i2t.convert.common import Converted, converted
from i2t.convert.press_table import (
    SessionCheck,
    check_session,
    presses_dataset,
    round_tip,
    sphere,
)
from i2t.errors import DataError
from i2t.patches.dimensions import REACH
from i2t.recordings.clocks import check_stamps, require_order
from i2t.recordings.diagnose import corrected_presses, find_units, findings_to_meta, first_contact, rotate_board
from i2t.recordings.eflesh import (
    EFLESH_READINGS,
    MAX_ROW_OFFSET_S,
    load_of_states,
    match_rows,
    silent_chips_of,
    stroke_numbers,
    table_path,
)
from i2t.recordings.files import data_error, read_numbers
from i2t.recordings.log import ReadingLog
from i2t.recordings.presses import Presses, join_presses
from i2t.skin import boards
from i2t.types import Board


def convert(
    source: Path,
    *,
    radius: float = EFLESH_TIP_RADIUS_M,
    window: float = EFLESH_WINDOW_M,
    reach: float = REACH,
    zero: float | None = None,
    pad: str | None = None,
    stated_source: str | None = None,
    as_stated: bool = False,
    skip_bad: bool = False,
) -> Converted:
    """Convert recordings of the eFlesh project, a session or a folder of sessions, to a data set.

    Args:
        source: Folder of a session, or of sessions.
        radius: Radius (m) of the probe's spherical tip, which the recordings do not state.
        window: Edge (m) of the square that a patch shows; presses whose tip it does not show are left out.
        reach: Depth (m) behind the tip's lowest point to which patches are clipped.
        zero: The robot's z (m) at first contact. By default it is where readings begin. If no press is above that, it
            is the session's highest z, so that no travel is negative; if all presses go to one height, travels are
            unknown.
        pad: One name for all pads; by default, each board of each session is a pad of its own.
        stated_source: "real" (by default) or "simulated".
        as_stated: Whether to skip the search for mistakes; travel then counts from the session's highest z.
        skip_bad: Whether to leave out damaged rows and sessions, with notes.

    Returns:
        The data set, with notes on assumptions and omissions.

    Raises:
        DataError: If a recording cannot be used.
    """
    if not 0 < radius < np.inf:
        raise DataError(f"--tip-radius-mm {1e3 * radius:g}: is not a radius; give a positive length in mm")
    notes = ReadingLog(skip_bad)
    sessions = sorted({file.parent for file in source.rglob("states.csv*")}) if source.is_dir() else []
    if not sessions:
        raise DataError(f"{source}: holds no states.csv or states.csv.gz; give a session or a folder of sessions")
    notes.doubt(
        "radius of the tip", f"assumed: the tip is a sphere of radius {1e3 * radius:g} mm (not stated in the source)"
    )
    notes.info(
        "assumed: values are in microtesla (their steps are those of the chip); chips are in AnySkin's order and "
        "aligned, and the board is turned by a quarter turn on the stage, as the readings of the `spatial` session show"
    )
    parts: list[Presses] = []
    checks: list[SessionCheck] = []
    for session in sessions:
        try:
            tables, check = _session(session, notes, zero=zero, pad=pad, as_stated=as_stated)
            parts, checks = [*parts, *tables], [*checks, check]
        except DataError as error:
            notes.skip(error)
    if not parts:
        raise DataError(
            f"{source}: no press is left to convert ({' | '.join(notes.lines)}); restore it from the source"
        )
    dataset = presses_dataset(
        join_presses(parts), round_tip("probe", sphere(radius)), _common_board(checks, notes), notes, whose=source,
        window=window, reach=reach, source=stated_source or "real",
        meta={"converter": "eflesh", "tip_radius_m": f"{radius:g}"} | {k: v for c in checks for k, v in c.meta.items()},
    )  # fmt: skip
    return converted(dataset, notes)


def _common_board(checks: list[SessionCheck], notes: ReadingLog) -> Board:
    """Return the board of all sessions: the described one if they disagree on its orientation."""
    first = checks[0].board
    if all(np.allclose(a, b) for check in checks for a, b in zip(check.board, first, strict=True)):
        return first
    notes.doubt(
        "orientation of the board",
        "left out: the orientation of the board, which differs between sessions; the described one is assumed",
    )
    return _board()


def _board() -> Board:
    """Return eFlesh's board as it is mounted on the stage of these recordings."""
    # By what the five chips read together in the `spatial` session.
    return rotate_board(boards.eflesh_board(), np.array([[0.0, -1.0], [1.0, 0.0]]))


def _session(
    folder: Path, notes: ReadingLog, *, zero: float | None, pad: str | None, as_stated: bool
) -> tuple[list[Presses], SessionCheck]:
    """Read the presses of a session, a table for each board, and its findings."""
    states = _table(folder, "states", (4, 5), notes)
    values = _table(folder, "sensor_post_baselines", (1 + EFLESH_READINGS, 1 + 2 * EFLESH_READINGS), notes)
    states, values = _matched(folder, states, values, notes)
    answered = notes.select_answered(silent_chips_of(folder, values))
    notes.require_answers(source=folder)
    states, values = states[answered], values[answered]
    n, name, position = len(states), folder.name, 1e-3 * states[:, 1:4]
    table = Presses(
        position[:, :2], values[:, 1:], height=position[:, 2], force=load_of_states(states), time=states[:, 0],
        pad=np.full(n, pad or name), session=_strokes(name, states),
    )  # fmt: skip
    if values.shape[1] == 1 + EFLESH_READINGS:
        table, check = _pressed(name, table, notes, stated_zero=zero, as_stated=as_stated)
        return [table], check
    table, check = _sheared(name, table, notes, as_stated=as_stated)
    both = [
        table._replace(readings=readings, pad=np.full(n, pad or f"{name}/board {i}"))
        for i, readings in enumerate(np.split(table.readings, 2, axis=1))
    ]
    return both, check


def _pressed(
    name: str, table: Presses, notes: ReadingLog, *, stated_zero: float | None, as_stated: bool
) -> tuple[Presses, SessionCheck]:
    """Correct a session in which the probe presses one skin from above."""
    middle, check = _middle(table.position), SessionCheck(_board())
    if not as_stated:
        centred = table._replace(position=table.position - middle)
        check = check_session(name, centred, _board(), notes, stated_zero=stated_zero, keep_zero=True)
    assert table.height is not None
    heights = table.height * check.correction.height
    zero = _zero(name, heights, check, notes, stated=stated_zero)
    centre = check.correction.length * middle
    reference = {
        "centre_m": centre.tolist(),
        "zero_m": zero if np.isfinite(zero) else None,
        "lowest_z_m": float(heights.min()),
    }
    table = corrected_presses(table, check.findings)
    assert table.height is not None
    table = table._replace(position=table.position - centre, height=table.height - zero)
    return table, check._replace(meta={**check.meta, f"reference of {name}": json.dumps(reference)})


def _zero(name: str, heights: np.ndarray, check: SessionCheck, notes: ReadingLog, *, stated: float | None) -> float:
    """Return the height of first contact (m): as given, as found or as assumed; NaN if unknown."""
    if stated is not None:
        notes.info(f"as given for {name}: first contact at the robot's z = {1e3 * stated:.3f} mm")
        return stated
    zero = first_contact(heights, check.zero)
    if check.zero is not None and check.zero.identifiable:
        notes.info(f"travel in {name} counts from z = {1e3 * zero:.3f} mm, where readings begin")
    elif np.isnan(zero):
        notes.change(
            "travel", f"left out of {name}: travel, as all presses go to one height; give --z0-mm if it is known"
        )
    else:
        notes.doubt(
            "height zero",
            f"assumed in {name}: first contact at the highest z = {1e3 * zero:.3f} mm; travel counts from there, so "
            "that all travels may be too small by the same amount",
        )
    return zero


def _sheared(name: str, table: Presses, notes: ReadingLog, *, as_stated: bool) -> tuple[Presses, SessionCheck]:
    """Correct a session in which the probe moves along two skins.

    The robot's z is the direction of shear, and the travel of the press is not recorded. Only the units are checked.
    """
    check = SessionCheck(_board())
    if not as_stated:
        units = find_units(table.position, table.readings)
        if units.wrong:
            notes.change(units.name, f"corrected in {name}: {units.sentence}")
        check = SessionCheck(_board(), (units,), findings_to_meta(name, [units]))
    table = corrected_presses(table, check.findings)
    assert table.height is not None
    x, y = (table.position - _middle(table.position)).T
    notes.info(f"assumed in {name}: the probe's stroke (robot z) shears along tool x, from the middle of the stroke")
    notes.change("load", f"left out of {name}: the load, which is the shear force; travel and normal force are unknown")
    unknown = np.full(len(x), np.nan)
    along = np.column_stack([x + table.height - _middle(table.height), y])
    return table._replace(position=along, height=unknown, force=unknown), check


def _middle(values: np.ndarray) -> np.ndarray:
    """Compute the middle of the range of values."""
    return (values.min(0) + values.max(0)) / 2


def _table(folder: Path, name: str, columns: tuple[int, int], notes: ReadingLog) -> np.ndarray:
    """Read one table of a session, with ascending times and without rows that are not finite."""
    path = table_path(folder, name)
    table = read_numbers(path, columns)
    finite = (np.abs(table) < 1e10).all(1)  # Unix times are 1.7e9 s
    if not finite.all():
        row = np.flatnonzero(~finite)[0] + 1
        notes.skip(data_error(path, f"{np.sum(~finite)} rows are not finite, first row {row}"))
    table = table[finite]
    require_order(table[:, 0], f"{path}: time, its first column,", remedy="sort them by it")
    verdict = check_stamps(table[:, 0])
    back = np.flatnonzero(np.diff(table[:, 0]) < 0) + 2
    if verdict.damaged.any():
        rows = np.flatnonzero(verdict.damaged) + 1
        others = f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        wrong = f"the time in row {rows[0]}{others} contradicts the rows around"
        notes.skip(data_error(path, f"time does not increase at row {back[0]}, as {wrong}"))
    if len(verdict.restarts):
        row = verdict.restarts[0] + 1
        raise DataError(f"{path}: time goes back at row {row}; make a session of each part")
    return table[~verdict.damaged]


def _matched(folder: Path, states: np.ndarray, values: np.ndarray, notes: ReadingLog) -> tuple[np.ndarray, np.ndarray]:
    """Match the rows of both tables by time."""
    if not len(states) or not len(values):
        raise data_error(folder, "has no rows")
    rows, partner = match_rows(states[:, 0], values[:, 0])
    if not len(rows):
        raise DataError(
            f"{folder}: no state was recorded within {1e3 * MAX_ROW_OFFSET_S:g} ms of a sensor row; check both tables"
        )
    if not len(states) == len(values) == len(rows):
        lost = max(len(states), len(values)) - len(rows)
        notes.skip(
            DataError(f"{folder}: {lost} rows have no partner at their time; restore both tables from the source")
        )
    return states[partner], values[rows]


def _strokes(name: str, states: np.ndarray) -> np.ndarray:
    """Name the session of each row: one for a session of single presses. If the probe was recorded throughout, each
    stroke down and up is one.
    """
    if states.shape[1] == 4:
        return np.full(len(states), name)
    return np.array([f"{name}/stroke {1 + number:02d}" for number in stroke_numbers(states[:, 0], states[:, 3])])
