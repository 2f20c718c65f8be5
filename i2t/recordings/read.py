"""Recordings of a skin: readings and their known targets, from several file formats.

    from i2t.recordings.read import read_recordings

    (recording,) = read_recordings("eflesh/spatial/20250316_155729_probe")
    recording.readings                # (n, c) uT
    recording.targets["position"]     # (n, 2) m

Three forms are read: a data set of i2t (a file or a folder), sessions of eFlesh as they were recorded (a folder with
`states.csv`), and a table with one row for each reading (a `.csv` file with the columns of `i2t.recordings.columns`).
Unlike the converters of `i2t.convert`, which refuse what is damaged, this reader keeps what can be kept: a row that is
not finite is left out, what was not measured is NaN, and each such thing is said in a note. `corrected_recording`
applies what `i2t.recordings.diagnose` finds wrong. NumPy only.
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
    TIME,
    ambient_columns,
    beginning_of,
    library_factor,
    value_columns,
)
from i2t.recordings.diagnose import Finding, correction_of, lag_rows, turn_board
from i2t.recordings.eflesh import (
    EFLESH_READINGS,
    SAME_ROW,
    baselines,
    load_of_states,
    rows_together,
    silent_chips_of,
    stroke_numbers,
    table_path,
)
from i2t.recordings.files import read_text
from i2t.recordings.presses import Presses, dataset_presses
from i2t.recordings.tables import TextTable, read_text_table
from i2t.skin.boards import AXES_OF_CHIP, without_silent_chips
from i2t.types import Board, ReturnCode

MAX_VALUE = 1e9  # of any number of a table, in its unit; beyond it is damage
TOUCHING_FORCE_N = 0.1  # from which a reading counts as one in contact
AIR_FORCE_N = 0.02  # up to which it counts as one in air; what lies between is neither
STREAM_GAP_S = 0.5  # rows farther apart are no stream
MIN_CHANGE = {"position": 0.2e-3, "depth": 0.1e-3, "force": 0.05, "shear": 0.05}  # m, m, N, N: less is no range


class TargetKind(NamedTuple):
    """Kind of target of a head."""

    unit: str
    scale: float  # from the library's unit to the unit
    yes_no: bool = False


TARGETS: Mapping[str, TargetKind] = {
    "position": TargetKind("mm", 1e3),
    "depth": TargetKind("mm", 1e3),
    "force": TargetKind("N", 1.0),
    "shear": TargetKind("N", 1.0),
    "contact": TargetKind("", 1.0, yes_no=True),
    "slip": TargetKind("", 1.0, yes_no=True),
}


@dataclass(frozen=True)
class SkinRecording:
    """Readings of one skin in the order of time, with their known targets; NaN where one is unknown.

    Attributes:
        name: of the recording.
        readings: (n, c) uT, finite; three channels for each chip.
        targets: by its name in `TARGETS` (n, d); only those that are known somewhere.
        session: (n,) number of the stroke, run or session, in which rows follow each other.
        time: (n,) s; NaN where it is not known.
        board: positions of the chips, where they are known.
        source: real, simulated or mixed.
        baseline: (n, c) uT that was subtracted from each reading, where it is known.
        notes: what was assumed and left out, a sentence each.
        labels: (n,) index of the object that was touched, where it is known.
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

    def known(self, target: str) -> np.ndarray:
        """Rows of which a target is known.

        Args:
            target: its name.

        Returns:
            (n,) mask; False throughout where the recording does not have it.
        """
        values = self.targets.get(target)
        return np.zeros(len(self), bool) if values is None else np.isfinite(values).all(1)

    def presses(self) -> Presses:
        """The rows as presses.

        Returns:
            A press for each row; its height is minus its depth.
        """
        depth, force = self.targets.get("depth"), self.targets.get("force")
        return Presses(
            self.targets.get("position", np.full((len(self), 2), np.nan)),
            self.readings,
            height=None if depth is None else -depth[:, 0],
            force=None if force is None else force[:, 0],
        )

    def varies(self, target: str) -> bool:
        """Test that a target varies, so that a head can be fitted to it.

        Args:
            target: its name.

        Returns:
            Whether it is known and differs from row to row; of a question with yes or no, whether both occur.
        """
        known = self.known(target)
        if known.sum() < 2:
            return False
        spread = np.subtract(*np.percentile(self.targets[target][known], [99, 1], axis=0)).max()
        return bool(spread > MIN_CHANGE.get(target, 0.5) or (TARGETS[target].yes_no and self._both(target)))

    def rows(self, chosen: np.ndarray | slice) -> "SkinRecording":
        """Some rows.

        Args:
            chosen: a mask (n,), row numbers or a slice.

        Returns:
            The recording of these rows.
        """
        pick = np.arange(len(self))[chosen]

        def some(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values[pick]

        return replace(
            self,
            readings=self.readings[pick],
            targets={name: values[pick] for name, values in self.targets.items()},
            session=self.session[pick],
            time=self.time[pick],
            baseline=some(self.baseline),
            labels=some(self.labels),
        )

    def _both(self, target: str) -> bool:
        return len(np.unique(self.targets[target][self.known(target)])) > 1


def read_recordings(path: Path | str) -> list[SkinRecording]:
    """Read the recordings of a path: a data set, sessions of eFlesh, or a table.

    Args:
        path: a file or a folder.

    Returns:
        A recording for each skin and, of eFlesh, for each session.

    Raises:
        DataError: there is nothing that can be read, in one sentence.
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
        path: a file or a folder.

    Returns:
        False for tables, and folders of tables or sessions of eFlesh.
    """
    if path.is_file() and path.name.removesuffix(".gz").endswith(TABLE_SUFFIXES):
        return False
    if not path.is_dir():
        return True
    tables = any(path.glob("*.csv*")) and not any(path.rglob("*.h5"))
    return not (tables or any(path.rglob("states.csv*")))


def from_dataset(dataset: Dataset, name: str = "data set") -> list[SkinRecording]:
    """A data set's touches as recordings, one for each skin.

    Args:
        dataset: of touches.
        name: of the recordings; where there are several skins, each adds its own.

    Returns:
        A recording for each skin that has a touch with a finite reading.

    Raises:
        DataError: no touch has a finite reading.
    """
    touches, several = dataset.touches, len(np.unique(dataset.touches.pad)) > 1
    presses, free = dataset_presses(dataset), np.isin(touches.code, [ReturnCode.FREE, ReturnCode.AIR])
    contact = np.where(free, 0.0, 1.0) if free.any() else np.full(len(dataset), np.nan)
    targets = {
        "position": presses.position,
        "depth": np.where(free, np.nan, touches.depth.astype(np.float64))[:, None],
        "force": touches.force.astype(np.float64)[:, None],
        "contact": contact[:, None],
    }
    usable = (touches.code != ReturnCode.FAILED) & np.isfinite(touches.reading).all(1)
    found = []
    for pad in np.unique(touches.pad[usable]):
        rows = usable & (touches.pad == pad)
        left = int(np.sum((touches.pad == pad) & ~usable))
        notes = [f"left out: {left} touches that failed or whose reading is not finite"] if left else []
        notes += [note for note in dataset.meta.get("notes", "").split(" | ") if note]
        found.append(
            SkinRecording(
                f"{name} ({dataset.pads[pad]})" if several else name,
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
    if not found:
        raise DataError(f"{name}: no touch has a finite reading; record it again")
    return [_cleaned(one) for one in found]


def is_stream(recording: SkinRecording) -> bool:
    """Test for rows in quick sequence, as samples of one contact are.

    Args:
        recording: of one skin.

    Returns:
        False where times are not known.
    """
    gap = np.diff(recording.time)
    return bool(np.isfinite(gap).any() and np.nanmedian(gap) < STREAM_GAP_S)


def corrected_recording(recording: SkinRecording, findings: Sequence[Finding]) -> SkinRecording:
    """Apply the corrections of findings: units, signs, a lag, the board's turn.

    A height zero stays where it is. Depths that are turned and fall below zero count from the least of them.

    Args:
        recording: As it was read.
        findings: About it.

    Returns:
        The recording put right; with a lag it has fewer rows.
    """
    if not any(finding.correction for finding in findings):
        return recording
    todo = correction_of(findings)
    factors = {"position": todo.length, "depth": todo.height, "force": todo.force, "shear": abs(todo.force)}
    targets = {name: factors.get(name, 1.0) * values for name, values in recording.targets.items()}
    if todo.height < 0 and "depth" in targets:
        targets["depth"] = targets["depth"] - min(np.nanmin(targets["depth"]), 0.0)
    board, baseline, turn = recording.board, recording.baseline, todo.board_from_stage
    recording = replace(
        recording,
        targets=targets,
        readings=todo.field * recording.readings,
        baseline=None if baseline is None else todo.field * baseline,
        board=board if board is None or turn is None else turn_board(board, turn),
    )
    if todo.lag:
        # The lag counts rows whose position is known, as the estimate did.
        recording = recording.rows(recording.known("position"))
        label_rows, reading_rows = lag_rows(len(recording), todo.lag)
        labels = {name: values[label_rows] for name, values in recording.targets.items()}
        recording = replace(recording.rows(reading_rows), targets=labels)
    return recording


def read_tables(path: Path) -> list[SkinRecording]:
    """Read a table with a line of names and one row for each reading.

    Columns by name: b0x_uT, b0y_uT, b0z_uT, b1x_uT ... (any number of chips), and of `TARGET_COLUMNS`, a0x_uT ...
    (ambient, subtracted), time_s, session and pad what there is; z_mm or height_mm of the tip in place of a depth.
    Separators and units may be those of `i2t.recordings.tables`. Empty or unreadable cells are unknown.

    Args:
        path: of the table, plain or gzip-ed.

    Returns:
        A recording for each pad.

    Raises:
        DataError: it is no such table, or no row has a finite reading.
    """
    table = _LooseTable.read(path)
    names, notes = _reading_columns(table, path), list(table.text.notes)
    ambient = ambient_columns(names)
    readings = table.some(names)
    if all(name in table.columns for name in ambient) and (table.some(ambient) != 0).any():
        readings = without_silent_chips(readings) - without_silent_chips(table.some(ambient))
    else:
        readings, ambient = without_silent_chips(readings, differences=True), []
    targets = {
        target: np.column_stack([library_factor(name) * table.column(name) for name in columns])
        for target, every in TARGET_COLUMNS.items()
        if (columns := [name for name in every if name in table.columns])
    }
    height = next((name for name in HEIGHT_COLUMNS if name in table.columns), None)
    if height is not None and "depth" not in targets and np.isfinite(z := table.column(height)).any():
        targets["depth"] = 1e-3 * (np.nanmax(z) - z)[:, None]
        notes.append(
            f"assumed: {height} grows out of the skin, and depth counts from its highest value, {np.nanmax(z):g} mm"
        )
    session, _ = table.named("session")
    pad, pads = table.named("pad")
    name, notes = path.name.split(".")[0], notes + _unused_columns(table, {*names, *ambient})
    whole = _cleaned(SkinRecording(name, readings, targets, session, table.column(TIME), notes=tuple(notes)))
    if len(pads) < 2:
        return [_finite(whole, path)]
    return [_finite(replace(whole.rows(pad == i), name=f"{whole.name} ({one})"), path) for i, one in enumerate(pads)]


class _LooseTable(NamedTuple):
    """A table whose cells may be missing or unreadable."""

    text: TextTable
    columns: dict[str, int]  # the first of each name
    values: np.ndarray  # (rows, columns); NaN for what is no number

    @classmethod
    def read(cls, path: Path) -> "_LooseTable":
        text = read_text_table(path)
        width = len(text.header)
        columns = {name: i for i, name in reversed(list(enumerate(text.header)))}
        values = np.array([_numbers(cells, width) for _, cells in text.rows])
        return cls(text, columns, values.reshape(-1, width))

    def column(self, name: str) -> np.ndarray:
        """The numbers of a column; NaN throughout where there is none."""
        return self.values[:, self.columns[name]] if name in self.columns else np.full(len(self.values), np.nan)

    def some(self, names: list[str]) -> np.ndarray:
        """Numbers of existing columns."""
        return self.values[:, [self.columns[name] for name in names]]

    def named(self, name: str) -> tuple[np.ndarray, list[str]]:
        """Number of each row's name in a column, and the names; one name where there is no column."""
        if name not in self.columns:
            return np.zeros(len(self.text.rows), int), [""]
        at = self.columns[name]
        cells = [cells[at].strip() if at < len(cells) else "" for _, cells in self.text.rows]
        names, which = np.unique(cells, return_inverse=True)
        return which, names.tolist()


def _reading_columns(table: _LooseTable, path: Path) -> list[str]:
    """The names of the columns that hold readings, chip by chip."""
    chips = sorted({int(match[1]) for name in table.columns if (match := FIELD_COLUMN.fullmatch(name))})
    names = value_columns(chips)
    if not chips or any(name not in table.columns for name in names):
        raise DataError(
            f"{path}: has not the columns b0x_uT, b0y_uT, b0z_uT, ... ({beginning_of(table.text.header)}); name them "
            "as in docs/data.md"
        )
    return names


def _unused_columns(table: _LooseTable, readings: set[str]) -> list[str]:
    """Sentences on columns that were left out."""
    used = readings | {TIME, *NAME_COLUMNS, *HEIGHT_COLUMNS}.union(*TARGET_COLUMNS.values())
    notes = []
    if unknown := [name for name in table.columns if name not in used]:
        notes.append(f"left out: columns {', '.join(unknown)}, which have no meaning here")
    if twice := sorted(name for name, count in Counter(table.text.header).items() if count > 1):
        notes.append(f"columns {', '.join(twice)} stand twice: the first of each is taken")
    return notes


def read_eflesh_session(folder: Path) -> SkinRecording:
    """Read a session of eFlesh as it was recorded: `states.csv` and `sensor_post_baselines.csv`, plain or gzip-ed.

    The states are time (s), x, y, z (mm) and, where it was read, the load in grams (-1: not read). As in
    `i2t.convert.eflesh`, a session with two boards is one in which the probe shears two skins along z, and its load is
    the shear force; in any other it presses one skin along z, and depth counts from the highest z.

    Args:
        folder: of the session.

    Returns:
        The recording, with the channels of all boards.

    Raises:
        DataError: a table is missing, or no row has a finite reading.
    """
    states, values = _loose_table(folder, "states"), _loose_table(folder, "sensor_post_baselines")
    if states.shape[1] < 4 or values.shape[1] < 1 + AXES_OF_CHIP or (values.shape[1] - 1) % AXES_OF_CHIP:
        raise DataError(
            f"{folder}: has {states.shape[1]} columns of states and {values.shape[1]} of values; give time, x, y, z "
            "and time with three values for each chip"
        )
    rows, partner = rows_together(states[:, 0], values[:, 0])
    if not len(rows):
        raise DataError(f"{folder}: no state was recorded within {1e3 * SAME_ROW:g} ms of a sensor row")
    notes = (
        [f"left out: {len(values) - len(rows)} rows without a state at their time"] if len(rows) < len(values) else []
    )
    states, values = states[partner], values[rows]
    silent = np.repeat(silent_chips_of(folder, values), AXES_OF_CHIP, axis=1)
    readings, place = np.where(silent, np.nan, values[:, 1:]), 1e-3 * states[:, 1:4]
    sheared = readings.shape[1] > EFLESH_READINGS
    middle = (np.nanmin(place, 0) + np.nanmax(place, 0)) / 2
    load = load_of_states(states)
    targets = {"position": place[:, :2] - middle[:2]}
    if sheared:
        notes += ["assumed: the stroke (robot z) shears along tool x, and the load is the shear force"]
        targets["position"] = targets["position"] + np.column_stack([place[:, 2] - middle[2], np.zeros(len(place))])
        targets["shear"] = load[:, None]
    else:
        notes += [f"assumed: depth counts from the highest z, {1e3 * np.nanmax(place[:, 2]):.3f} mm"]
        targets |= {"depth": (np.nanmax(place[:, 2]) - place[:, 2])[:, None], "force": load[:, None]}
    session = stroke_numbers(states[:, 0], place[:, 2]) if states.shape[1] > 4 else np.zeros(len(states), int)
    recording = SkinRecording(
        folder.name, readings, targets, session, states[:, 0], notes=tuple(notes), baseline=baselines(folder, values)
    )
    return _finite(_cleaned(recording), folder)


def _finite(recording: SkinRecording, where: Path) -> SkinRecording:
    """A recording without damaged rows; values that no sensor sends are damage too."""
    readings, notes = recording.readings, recording.notes
    with np.errstate(invalid="ignore"):
        sent = np.abs(readings) < MAX_VALUE
    dead = ~sent.any(0)
    if dead.any() and not dead.all():
        readings = np.where(dead[None], 0.0, readings)
        sent = sent | dead[None]
        notes = (*notes, f"channels {', '.join(map(str, np.flatnonzero(dead)))} hold no number: taken as zero")
    good = sent.all(1)
    if not good.any():
        raise DataError(f"{where}: no row has a finite reading; record it again")
    if not good.all():
        notes = (*notes, f"left out: {np.sum(~good)} rows whose reading is not finite, first row {np.argmin(good) + 1}")
    kept = replace(recording, readings=readings, notes=notes).rows(good)
    return replace(kept, targets={name: values for name, values in kept.targets.items() if kept.known(name).any()})


def _cleaned(recording: SkinRecording) -> SkinRecording:
    """A recording with the targets that are known, and contact where the force tells it."""
    clean = {key: np.where(np.abs(values) < MAX_VALUE, values, np.nan) for key, values in recording.targets.items()}
    if "contact" not in clean or not np.isfinite(clean["contact"]).any():
        loads = [np.abs(clean[key]).max(1) for key in ("force", "shear") if key in clean]
        if loads:
            load = np.fmax.reduce(loads)
            in_contact = np.where(load >= TOUCHING_FORCE_N, 1.0, np.nan)
            clean["contact"] = np.where(load <= AIR_FORCE_N, 0.0, in_contact)[:, None]
    known = {key: values for key, values in clean.items() if np.isfinite(values).all(1).any()}
    return replace(recording, targets=known)


def _numbers(cells: list[str], count: int) -> list[float]:
    """Numbers of a line; NaN for other text."""
    numbers = [parse_number(cell) for cell in [*cells, *[""] * count][:count]]
    return [np.nan if number is None else number for number in numbers]


def _loose_table(folder: Path, name: str) -> np.ndarray:
    """One table of a session without its damage: rows in the order of time, unreadable cells as NaN."""
    path = table_path(folder, name)
    try:
        lines = [line for line in csv.reader(read_text(path).splitlines()) if line]
    except csv.Error as error:
        raise DataError(f"{path}: is no comma-separated table ({error}); save it as CSV") from error
    if not lines:
        raise DataError(f"{path}: holds no row; restore it from the source")
    width = Counter(map(len, lines)).most_common(1)[0][0]
    nothing = [np.nan] * width
    table = np.array([_numbers(line, width) if len(line) == width else nothing for line in lines])
    table = table[np.isfinite(table[:, 0])]
    if not len(table):
        raise DataError(f"{path}: holds no row that begins with a time; restore it from the source")
    return table[np.argsort(table[:, 0], kind="stable")]
