"""Readers of recordings: readings and their targets, from several file formats.

    from i2t.recordings.read import read_recordings

    (recording,) = read_recordings("eflesh/spatial/20250316_155729_probe")
    recording.readings                # (n, c) uT
    recording.targets["position"]     # (n, 2) m

Three formats are read: a data set of i2t (a file or a folder), sessions of eFlesh as they were recorded (a folder with
`states.csv`), and a table with one row for each reading (a `.csv` file with the columns of `i2t.recordings.columns`).
The converters of `i2t.convert` refuse damage; this reader keeps what it can. Non-finite rows are left out, missing
values are NaN, and a note describes each such change. `corrected_recording` applies the findings of
`i2t.recordings.diagnose`.
"""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from i2t.dataset import Dataset, load_dataset
from i2t.dataset.sets import times_of
from i2t.errors import DataError
from i2t.files.kinds import TABLE_SUFFIXES
from i2t.recordings.cells import parse_number
from i2t.recordings.columns import (
    FIELD_COLUMN,
    HEIGHT_COLUMNS,
    NAME_COLUMNS,
    TARGET_COLUMNS,
    TIME_COLUMN,
    ambient_columns,
    describe_header,
    library_factor,
    value_columns,
)
from i2t.recordings.diagnose import Finding, correction_of, lag_rows, rotate_board
from i2t.recordings.eflesh import (
    EFLESH_READINGS,
    MAX_ROW_OFFSET_S,
    baselines,
    load_of_states,
    match_rows,
    silent_chips_of,
    stroke_numbers,
    table_path,
)
from i2t.recordings.files import read_text
from i2t.recordings.presses import Presses, dataset_presses
from i2t.recordings.tables import MAX_TABLE_VALUE, TextTable, read_text_table
from i2t.skin.boards import AXES_OF_CHIP, without_silent_chips
from i2t.types import Board, ReturnCode

MAX_STREAM_STEP_S = 0.5  # s, largest time between successive rows of a recording that counts as a stream


class TargetKind(NamedTuple):
    """Description of a target that a head predicts from readings: unit, factor from the library's unit to it, whether
    it is binary, and the range below which it counts as constant.
    """

    unit: str
    scale: float  # factor from the library's unit to `unit`
    binary: bool = False
    min_range: float = 0.5  # range in the library's unit below which the target is constant


# Targets that a recording may hold, such as the position of the tip: unit in messages, factor from the library's unit
# (m, N) to it, smallest range (in the library's unit) of a target that is not constant, and whether it is binary.
TARGETS: Mapping[str, TargetKind] = {
    "position": TargetKind("mm", 1e3, min_range=0.2e-3),
    "travel": TargetKind("mm", 1e3, min_range=0.1e-3),
    "force": TargetKind("N", 1.0, min_range=0.05),
    "shear": TargetKind("N", 1.0, min_range=0.05),
    "contact": TargetKind("", 1.0, binary=True),
    "slip": TargetKind("", 1.0, binary=True),
}


@dataclass(frozen=True)
class SkinRecording:
    """n readings of one skin in the order of time, with their targets; unknown values are NaN.

    Attributes:
        name: Name of the recording.
        readings: `(n, c)` finite readings in uT, three channels for each chip.
        targets: `(n, d)` values of each target in `TARGETS` that is known in some row, by its name.
        session: `(n,)` number of the stroke, run or session within which rows follow each other.
        time: `(n,)` times in s; NaN where unknown.
        board: Board of the skin, or None if unknown.
        source: "real", "simulated" or "mixed".
        baseline: `(n, c)` baselines in uT that were subtracted from the readings, or None if unknown.
        notes: What was assumed and left out, a sentence each.
        labels: `(n,)` index of the object that was touched, or None if unknown.
    """

    name: str
    readings: Float[np.ndarray, "n c"]
    targets: Mapping[str, Float[np.ndarray, "n d"]]
    session: Int[np.ndarray, " n"]
    time: Float[np.ndarray, " n"]
    board: Board | None = None
    source: str = "real"
    baseline: Float[np.ndarray, "n c"] | None = None
    notes: tuple[str, ...] = ()
    labels: Int[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return len(self.readings)

    def known_rows(self, target: str) -> np.ndarray:
        """Find the rows in which a target is known.

        Args:
            target: Name of the target.

        Returns:
            `(n,)` mask of these rows; False throughout if the recording lacks the target.
        """
        values = self.targets.get(target)
        return np.zeros(len(self), bool) if values is None else np.isfinite(values).all(1)

    def presses(self) -> Presses:
        """Convert the recording's rows to presses.

        Returns:
            A press for each row, whose height is minus its travel.
        """
        travel, force = self.targets.get("travel"), self.targets.get("force")
        return Presses(
            self.targets.get("position", np.full((len(self), 2), np.nan)),
            self.readings,
            height=None if travel is None else -travel[:, 0],
            force=None if force is None else force[:, 0],
        )

    def varies(self, target: str) -> bool:
        """Test whether a target varies, so that a head can be fitted to it.

        Args:
            target: Name of the target.

        Returns:
            True if the known values range over more than the target's `min_range` (from their 1st to their 99th
        percentile), or if both values of a yes-no target occur.
        """
        known_rows = self.known_rows(target)
        if known_rows.sum() < 2:
            return False
        values, kind = self.targets[target][known_rows], TARGETS[target]
        spread = np.subtract(*np.percentile(values, [99, 1], axis=0)).max()
        return bool(spread > kind.min_range or (kind.binary and len(np.unique(values)) > 1))

    def rows(self, chosen: np.ndarray | slice) -> "SkinRecording":
        """Select some rows of the recording.

        Args:
            chosen: `(n,)` mask, row numbers or a slice.

        Returns:
            A recording of the selected rows.
        """
        numbers = np.arange(len(self))[chosen]

        def select(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values[numbers]

        return replace(
            self,
            readings=self.readings[numbers],
            targets={name: values[numbers] for name, values in self.targets.items()},
            session=self.session[numbers],
            time=self.time[numbers],
            baseline=select(self.baseline),
            labels=select(self.labels),
        )


def read_recordings(path: Path | str) -> list[SkinRecording]:
    """Read the recordings at a path: a data set, sessions of eFlesh, or a table.

    Args:
        path: Path of a file or a folder.

    Returns:
        A recording for each skin and, in eFlesh, for each session.

    Raises:
        DataError: The path holds nothing that can be read.
    """
    path = Path(path)
    if is_dataset(path):
        return from_dataset(load_dataset(path), path.name)
    if path.is_file():
        return read_tables(path)
    if folders := sorted({file.parent for file in path.rglob("states.csv*")}):
        return [read_eflesh_session(folder) for folder in folders]
    return [recording for table in sorted(path.glob("*.csv*")) for recording in read_tables(table)]


def is_dataset(path: Path) -> bool:
    """Test whether a path is read as a data set of i2t.

    Args:
        path: Path of a file or a folder.

    Returns:
        False for tables, and for folders of tables or sessions of eFlesh.
    """
    if path.is_file() and path.name.removesuffix(".gz").endswith(TABLE_SUFFIXES):
        return False
    if not path.is_dir():
        return True
    tables = any(path.glob("*.csv*")) and not any(path.rglob("*.h5"))
    return not (tables or any(path.rglob("states.csv*")))


def from_dataset(dataset: Dataset, name: str = "data set") -> list[SkinRecording]:
    """Convert the touches of a data set to recordings.

    Args:
        dataset: Recorded or simulated touches.
        name: Name of the recordings; the name of the skin is added if there are several.

    Returns:
        A recording for each skin that has a touch with a finite reading.

    Raises:
        DataError: No touch has a finite reading.
    """
    touches, has_several_pads = dataset.touches, len(np.unique(dataset.touches.pad)) > 1
    presses, free = dataset_presses(dataset), np.isin(touches.code, [ReturnCode.FREE, ReturnCode.AIR])
    contact = np.where(free, 0.0, 1.0) if free.any() else np.full(len(dataset), np.nan)
    targets = {
        "position": presses.position,
        "travel": np.where(free, np.nan, touches.travel.astype(np.float64))[:, None],
        "force": touches.force.astype(np.float64)[:, None],
        "contact": contact[:, None],
    }
    usable = (touches.code != ReturnCode.FAILED) & np.isfinite(touches.reading).all(1)
    recordings = []
    for pad in np.unique(touches.pad[usable]):
        rows = usable & (touches.pad == pad)
        unusable = int(np.sum((touches.pad == pad) & ~usable))
        notes = [f"left out: {unusable} touches that failed or whose reading is not finite"] if unusable else []
        notes += [note for note in dataset.meta.get("notes", "").split(" | ") if note]
        recordings.append(
            SkinRecording(
                f"{name} ({dataset.pads[pad]})" if has_several_pads else name,
                touches.reading[rows].astype(np.float64),
                {key: values[rows] for key, values in targets.items()},
                session=touches.session[rows].astype(int),
                time=times_of(dataset)[rows],
                board=dataset.board,
                source=dataset.source,
                notes=tuple(notes),
                labels=touches.object[rows],
            )
        )
    if not recordings:
        raise DataError(f"{name}: no touch has a finite reading; record it again")
    return [_cleaned(recording) for recording in recordings]


def is_stream(recording: SkinRecording) -> bool:
    """Test whether a recording's rows follow each other quickly, as samples of one contact do.

    Args:
        recording: Recording of one skin.

    Returns:
        True if the median time between rows is below 0.5 s; False if the times are unknown.
    """
    steps = np.diff(recording.time)
    return bool(np.isfinite(steps).any() and np.nanmedian(steps) < MAX_STREAM_STEP_S)


def corrected_recording(recording: SkinRecording, findings: Sequence[Finding]) -> SkinRecording:
    """Correct the units, signs, lag and board of a recording.

    Height zero is kept. If travel changes sign and becomes negative, it counts from the smallest one.

    Args:
        recording: Recording as it was read.
        findings: Findings about the recording.

    Returns:
        The corrected recording. A lag leaves fewer rows.
    """
    if not any(finding.correction for finding in findings):
        return recording
    correction = correction_of(findings)
    factors = {"position": correction.length, "travel": correction.height, "force": correction.force}
    factors["shear"] = abs(correction.force)
    targets = {name: factors.get(name, 1.0) * values for name, values in recording.targets.items()}
    if correction.height < 0 and "travel" in targets:
        targets["travel"] = targets["travel"] - min(np.nanmin(targets["travel"]), 0.0)
    board, baseline, board_from_stage = recording.board, recording.baseline, correction.board_from_stage
    recording = replace(
        recording,
        targets=targets,
        readings=correction.field * recording.readings,
        baseline=None if baseline is None else correction.field * baseline,
        board=board if board is None or board_from_stage is None else rotate_board(board, board_from_stage),
    )
    if correction.lag:
        # The lag was estimated over rows with a known position.
        recording = recording.rows(recording.known_rows("position"))
        label_rows, reading_rows = lag_rows(len(recording), correction.lag)
        labels = {name: values[label_rows] for name, values in recording.targets.items()}
        recording = replace(recording.rows(reading_rows), targets=labels)
    return recording


def read_tables(path: Path) -> list[SkinRecording]:
    """Read a table with a line of column names and one row for each reading.

    The columns b0x_uT, b0y_uT, b0z_uT, b1x_uT ... (of any number of chips) are required. Optional are those of
    `TARGET_COLUMNS`, the ambient field a0x_uT ..., which is subtracted, time_s, session, pad, and z_mm or height_mm of
    the tip instead of its travel. `i2t.recordings.tables` lists other delimiters and units. Empty or unreadable cells
    are unknown.

    Args:
        path: Path of the table, plain or gzipped.

    Returns:
        A recording for each pad.

    Raises:
        DataError: The file is not a table of readings, or no row has a finite reading.
    """
    table = _LooseTable.read(path)
    names, notes = _reading_columns(table, path), list(table.text.notes)
    ambient = ambient_columns(names)
    readings = table.select(names)
    if all(name in table.columns for name in ambient) and (table.select(ambient) != 0).any():
        readings = without_silent_chips(readings) - without_silent_chips(table.select(ambient))
    else:
        readings, ambient = without_silent_chips(readings, differences=True), []
    targets = {
        target: np.column_stack([library_factor(name) * table.column(name) for name in columns])
        for target, required in TARGET_COLUMNS.items()
        if (columns := [name for name in required if name in table.columns])
    }
    height = next((name for name in HEIGHT_COLUMNS if name in table.columns), None)
    if height is not None and "travel" not in targets and np.isfinite(z := table.column(height)).any():
        targets["travel"] = 1e-3 * (np.nanmax(z) - z)[:, None]
        notes.append(
            f"assumed: {height} points out of the skin, and travel counts from its highest value, {np.nanmax(z):g} mm"
        )
    session, _ = table.named("session")
    pad, pads = table.named("pad")
    name, notes = path.name.split(".")[0], notes + _unused_columns(table, {*names, *ambient})
    recording = _cleaned(SkinRecording(name, readings, targets, session, table.column(TIME_COLUMN), notes=tuple(notes)))
    if len(pads) < 2:
        return [_finite(recording, path)]
    return [
        _finite(replace(recording.rows(pad == i), name=f"{name} ({pad_name})"), path) for i, pad_name in enumerate(pads)
    ]


class _LooseTable(NamedTuple):
    """A table whose cells may be missing or unreadable."""

    text: TextTable
    columns: dict[str, int]  # index of the first column of each name
    values: np.ndarray  # (rows, columns); NaN for cells that are not numbers

    @classmethod
    def read(cls, path: Path) -> "_LooseTable":
        text = read_text_table(path)
        width = len(text.header)
        columns = {name: i for i, name in reversed(list(enumerate(text.header)))}
        values = np.array([_numbers(cells, width) for _, cells in text.rows])
        return cls(text, columns, values.reshape(-1, width))

    def column(self, name: str) -> np.ndarray:
        """Return the numbers of a column, or NaN throughout if there is no such column."""
        return self.values[:, self.columns[name]] if name in self.columns else np.full(len(self.values), np.nan)

    def select(self, names: list[str]) -> np.ndarray:
        """Return the numbers of existing columns."""
        return self.values[:, [self.columns[name] for name in names]]

    def named(self, name: str) -> tuple[np.ndarray, list[str]]:
        """Number the names in a column: the number of each row's name, and the names; "" if there is no column."""
        if name not in self.columns:
            return np.zeros(len(self.text.rows), int), [""]
        at = self.columns[name]
        cells = [cells[at].strip() if at < len(cells) else "" for _, cells in self.text.rows]
        names, numbers = np.unique(cells, return_inverse=True)
        return numbers, names.tolist()


def _reading_columns(table: _LooseTable, path: Path) -> list[str]:
    """Name the columns that hold readings, chip by chip."""
    chips = sorted({int(match[1]) for name in table.columns if (match := FIELD_COLUMN.fullmatch(name))})
    names = value_columns(chips)
    if not chips or any(name not in table.columns for name in names):
        line = describe_header(list(table.text.stated))
        raise DataError(f"{path}: lacks the columns b0x_uT, b0y_uT, b0z_uT, ... ({line}); name them as in docs/data.md")
    return names


def _unused_columns(table: _LooseTable, readings: set[str]) -> list[str]:
    """Describe columns that are left out, a sentence each."""
    used = readings | {TIME_COLUMN, *NAME_COLUMNS, *HEIGHT_COLUMNS}.union(*TARGET_COLUMNS.values())
    notes = []
    if unknown := [name for name in table.columns if name not in used]:
        notes.append(f"left out: columns {', '.join(unknown)}, which are not used")
    if twice := sorted(name for name, count in Counter(table.text.header).items() if count > 1):
        notes.append(f"columns {', '.join(twice)} appear twice: the first of each is read")
    return notes


def read_eflesh_session(folder: Path) -> SkinRecording:
    """Read a session of eFlesh as it was recorded: `states.csv` and `sensor_post_baselines.csv`, plain or gzip-ed.

    In a session with two boards the probe shears two skins along z, and the load is the shear force. In any other
    session it presses one skin along z, and travel counts from the highest z. `i2t.convert.eflesh` assumes the same.

    Args:
        folder: Folder of the session.

    Returns:
        The recording, with the channels of all boards.

    Raises:
        DataError: A table is missing, or no row has a finite reading.
    """
    states, values = _loose_table(folder, "states"), _loose_table(folder, "sensor_post_baselines")
    if states.shape[1] < 4 or values.shape[1] < 1 + AXES_OF_CHIP or (values.shape[1] - 1) % AXES_OF_CHIP:
        raise DataError(
            f"{folder}: has {states.shape[1]} columns of states and {values.shape[1]} of values; give time, x, y, z "
            "and time with three values for each chip"
        )
    rows, partner = match_rows(states[:, 0], values[:, 0])
    if not len(rows):
        raise DataError(f"{folder}: no state was recorded within {1e3 * MAX_ROW_OFFSET_S:g} ms of a sensor row")
    unmatched = len(values) - len(rows)
    notes = [f"left out: {unmatched} rows without a state at their time"] if unmatched else []
    states, values = states[partner], values[rows]
    silent = np.repeat(silent_chips_of(folder, values), AXES_OF_CHIP, axis=1)
    readings, place = np.where(silent, np.nan, values[:, 1:]), 1e-3 * states[:, 1:4]
    has_two_boards = readings.shape[1] > EFLESH_READINGS
    middle = (np.nanmin(place, 0) + np.nanmax(place, 0)) / 2
    load = load_of_states(states)
    targets = {"position": place[:, :2] - middle[:2]}
    if has_two_boards:
        notes += ["assumed: the stroke (robot z) shears along tool x, and the load is the shear force"]
        targets["position"] = targets["position"] + np.column_stack([place[:, 2] - middle[2], np.zeros(len(place))])
        targets["shear"] = load[:, None]
    else:
        notes += [f"assumed: travel counts from the highest z, {1e3 * np.nanmax(place[:, 2]):.3f} mm"]
        targets |= {"travel": (np.nanmax(place[:, 2]) - place[:, 2])[:, None], "force": load[:, None]}
    session = stroke_numbers(states[:, 0], place[:, 2]) if states.shape[1] > 4 else np.zeros(len(states), int)
    recording = SkinRecording(
        folder.name, readings, targets, session, states[:, 0], notes=tuple(notes), baseline=baselines(folder, values)
    )
    return _finite(_cleaned(recording), folder)


def _finite(recording: SkinRecording, where: Path) -> SkinRecording:
    """Remove damaged rows; values that no sensor sends are damage too."""
    readings, notes = recording.readings, recording.notes
    with np.errstate(invalid="ignore"):
        plausible = np.abs(readings) < MAX_TABLE_VALUE
    dead = ~plausible.any(0)
    if dead.any() and not dead.all():
        readings = np.where(dead[None], 0.0, readings)
        plausible = plausible | dead[None]
        notes = (*notes, f"channels {', '.join(map(str, np.flatnonzero(dead)))} hold no number: they are read as zero")
    good = plausible.all(1)
    if not good.any():
        raise DataError(f"{where}: no row has a finite reading; record it again")
    if not good.all():
        notes = (*notes, f"left out: {np.sum(~good)} rows whose reading is not finite, first row {np.argmin(good) + 1}")
    finite = replace(recording, readings=readings, notes=notes).rows(good)
    targets = {name: values for name, values in finite.targets.items() if finite.known_rows(name).any()}
    return replace(finite, targets=targets)


def _cleaned(recording: SkinRecording, *, min_contact_n: float = 0.1, max_air_n: float = 0.02) -> SkinRecording:
    """Remove implausible values and unknown targets, and infer contact from the force.

    Contact is unknown if the force is between the two limits.
    """
    bound = MAX_TABLE_VALUE
    clean = {name: np.where(np.abs(values) < bound, values, np.nan) for name, values in recording.targets.items()}
    if "contact" not in clean or not np.isfinite(clean["contact"]).any():
        loads = [np.abs(clean[name]).max(1) for name in ("force", "shear") if name in clean]
        if loads:
            load = np.fmax.reduce(loads)
            in_contact = np.where(load >= min_contact_n, 1.0, np.nan)
            clean["contact"] = np.where(load <= max_air_n, 0.0, in_contact)[:, None]
    targets = {name: values for name, values in clean.items() if np.isfinite(values).all(1).any()}
    return replace(recording, targets=targets)


def _numbers(cells: list[str], count: int) -> list[float]:
    """Read the numbers of a line; other texts and missing cells are NaN."""
    numbers = [parse_number(cell) for cell in [*cells, *[""] * count][:count]]
    return [np.nan if number is None else number for number in numbers]


def _loose_table(folder: Path, name: str) -> np.ndarray:
    """Read one table of a session without its damage: rows in the order of time, unreadable cells as NaN."""
    path = table_path(folder, name)
    try:
        lines = [line for line in csv.reader(read_text(path).splitlines()) if line]
    except csv.Error as error:
        raise DataError(f"{path}: is not a comma-separated table ({error}); save it as CSV") from error
    if not lines:
        raise DataError(f"{path}: holds no row; restore it from the source")
    width = Counter(map(len, lines)).most_common(1)[0][0]
    missing = [np.nan] * width
    table = np.array([_numbers(line, width) if len(line) == width else missing for line in lines])
    table = table[np.isfinite(table[:, 0])]
    if not len(table):
        raise DataError(f"{path}: holds no row that begins with a time; restore it from the source")
    return table[np.argsort(table[:, 0], kind="stable")]
