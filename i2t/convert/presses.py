"""A general table of presses that any lab can write: one row per press of a known indenter, upright on the skin
(docs/data.md describes it).

Columns, by name: x_mm, y_mm (the indenter's axis from the skin's centre, along the skin's edges), depth_mm (travel past
first contact) or z_mm (the tip's height), the values of the board's chips b0x_uT, b0y_uT, b0z_uT, b1x_uT ... (to b4z_uT
for five chips); if wanted force_N (empty = not measured), a0x_uT ... (ambient, subtracted), time_s, pad and session
(names; a session may be called run), and source (real, as by default, or simulated). Depth may be missing where there
are forces.

Frames: the skin is fixed, and its tool frame T is the world's. The object O is the indenter, its axes as T's: at the
lowest point of a sphere or cylinder, or a mesh's own frame, whose z axis is the indenter's and whose lowest point
touches first.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from i2t.convert.checked import AXES_OF_CHIP, SessionCheck, check_session
from i2t.convert.common import ConversionLog, Converted
from i2t.convert.tables import FIELD_COLUMN, HEIGHT_COLUMNS, TextTable, read_text_table
from i2t.dataset import Dataset, missing_context
from i2t.errors import DataError
from i2t.types import PATCH_PIXELS, PATCH_WINDOW, REACH, Board, ReturnCode, Touches
from i2t.unknowns import RecordedPresses

PLACES = ("x_mm", "y_mm", "depth_mm")
NAME_COLUMNS = ("pad", "session")
TIME = "time_s"
PRESS_SOURCES = ("real", "simulated")
MOST_NAMED = 5  # columns that a sentence names
TOO_FEW_OR_MANY = ""  # key of a row that has not a field for each column
TURNED_SHARE = 0.9  # of the rows with a depth, for all to be turned
MIN_TURNED = 5  # rows
ROWS_AT_ONCE = 512  # bounds the memory of the intermediate arrays

# A tip is a body of revolution whose axis stands on the skin: the height (m) of its surface above its lowest point at a
# distance (m) from its axis, infinite where there is nothing.
Profile: TypeAlias = Callable[[np.ndarray], np.ndarray]
MAX_TABLE_VALUE = 1e9  # of any number, in its unit


def convert(
    source: Path,
    *,
    indenter: str,
    board: Board,
    window: float = PATCH_WINDOW,
    reach: float = REACH,
    unit: str | None = None,
    as_stated: bool = False,
    skip_bad: bool = False,
    table: TextTable | None = None,
) -> Converted:
    """Convert a table of presses.

    Args:
        source: the table.
        indenter: `sphere:RADIUS` or `cylinder:RADIUS` with the radius in mm, or `mesh:FILE` in `unit`.
        board: which the values are of; the table has three columns for each of its chips.
        window: m, edge of the square that a patch shows; presses whose axis lies outside it are left out.
        reach: m, patches are clipped to this depth behind the indenter's lowest point.
        unit: of the mesh file: m, cm, mm or inch.
        as_stated: look for no mistake and correct none.
        skip_bad: leave out damaged rows, and note them.
        table: what `source` holds, where it was read already.

    Returns:
        The data set and what was assumed and left out.

    Raises:
        DataError: the table or the indenter cannot be used.
    """
    notes = ConversionLog(skip_bad)
    rows = _rows(source, table or read_text_table(source), board.num_chips, notes)
    rows, checks = _checked(rows, board, notes, as_stated=as_stated)
    numbers = np.array([[row[name] for name in (*PLACES, "force_N")] for row in rows])
    x, y, depth = 1e-3 * numbers[:, :3].T
    inside = (np.abs(x) <= window / 2) & (np.abs(y) <= window / 2)
    if not inside.all():
        notes.info(f"left out: {np.sum(~inside)} presses outside the window of {1e3 * window:g} mm")
    if not inside.any():
        raise DataError(f"{source}: no press lies inside the window of {1e3 * window:g} mm; widen --window-mm")
    kept = [row for row, keep in zip(rows, inside, strict=True) if keep]
    x, y, depth = x[inside], y[inside], depth[inside]
    patch, lowest = _patches(indenter, unit, x, y, window=window, reach=reach, notes=notes)
    n = len(x)
    T_w_o = np.tile(np.eye(4), (n, 1, 1))
    T_w_o[:, :3, 3] = np.column_stack([x, y, -np.nan_to_num(depth) - lowest])
    names = {kind: tuple(dict.fromkeys(row[kind] for row in kept)) for kind in NAME_COLUMNS}
    time = np.array([row[TIME] for row in kept])
    touches = Touches(
        patch=patch,
        wide=missing_context(n),
        nearest=-depth,
        reading=np.array([row["reading"] for row in kept]),
        force=numbers[inside, 3],
        depth=depth,
        T_w_t=np.tile(np.eye(4), (n, 1, 1)),
        T_w_o=T_w_o,
        object=np.zeros(n),
        pad=np.array([names["pad"].index(row["pad"]) for row in kept]),
        session=np.array([names["session"].index(row["session"]) for row in kept]),
        code=[ReturnCode.FREE if row.get("free") else ReturnCode.UNDEFINED for row in kept],
        time=None if np.isnan(time).all() else time,
    )
    sources = sorted({row["source"] for row in kept})
    meta = {key: text for check in checks for key, text in check.meta.items()}
    dataset = Dataset(
        touches,
        objects=(Path(indenter.partition(":")[2]).stem if indenter.startswith("mesh:") else indenter,),
        pads=names["pad"],
        sessions=names["session"],
        board=checks[0].board if len(checks) == 1 else board,
        source="mixed" if len(sources) > 1 else sources[0],
        window=window,
        reach=reach,
        meta={"converter": "presses", "file": source.name, "indenter": indenter} | meta,
    )
    return notes.close(dataset)


def _checked(
    rows: list[dict[str, Any]], board: Board, notes: ConversionLog, *, as_stated: bool
) -> tuple[list[dict[str, Any]], list[SessionCheck]]:
    """The rows with what each session contradicts put right, session by session."""
    if as_stated:
        return rows, []
    kept: list[dict[str, Any]] = []
    checks = []
    for session in dict.fromkeys((row["pad"], row["session"]) for row in rows):
        part = [row for row in rows if (row["pad"], row["session"]) == session]
        numbers = np.array([[row[name] for name in (*PLACES, "force_N")] for row in part])
        readings = np.array([row["reading"] for row in part])
        height = None if np.isnan(numbers[:, 2]).all() else -1e-3 * numbers[:, 2]
        force = None if np.isnan(numbers[:, 3]).all() else numbers[:, 3]
        presses = RecordedPresses(1e-3 * numbers[:, :2], readings, height=height, force=force)
        check = check_session(session[1], presses, board, notes, stated_zero=0.0)
        checks.append(check)
        kept += _corrected(part, numbers, readings, check)
    return kept, checks


def _corrected(
    part: list[dict[str, Any]], numbers: np.ndarray, readings: np.ndarray, check: SessionCheck
) -> list[dict[str, Any]]:
    """Rows of one session with their units, signs, lag, depths and chips put right."""
    factors = check.factors
    length, depth = factors.get("length_factor", 1.0), factors.get("depth_factor", 1.0)
    force = factors.get("force_factor", 1.0) * factors.get("force_sign", 1.0)
    numbers = numbers * [length, length, depth, force]
    found, free = check.zero, np.zeros(len(part), bool)
    turned = factors.get("height_sign", 1.0) < 0
    if turned or (found is not None and found.wrong):
        height = numbers[:, 2] if turned else -numbers[:, 2]
        zero = float(height.max())
        if found is not None and found.identifiable and found.estimate is not None:
            zero = 1e3 * found.estimate
        free = height > zero
        numbers[:, 2] = np.maximum(zero - height, 0)
    label_rows, reading_rows = check.rows(len(part))
    fields = check.fields(readings)[reading_rows]
    return [
        part[i]
        | dict(zip((*PLACES, "force_N"), numbers[i].tolist(), strict=True))
        | {"reading": field, "free": bool(free[i])}
        for i, field in zip(label_rows, fields, strict=True)
    ]


def sphere(radius: float) -> Profile:
    """The lower half of a sphere: h = R - sqrt(R^2 - r^2).

    Args:
        radius: m.

    Returns:
        Its profile.
    """

    def profile(r: np.ndarray) -> np.ndarray:
        return np.where(r < radius, radius - np.sqrt(np.maximum(radius**2 - r**2, 0)), np.inf)

    return profile


def cylinder(radius: float) -> Profile:
    """The flat end of a cylinder.

    Args:
        radius: m.

    Returns:
        Its profile.
    """
    return lambda r: np.where(r <= radius, 0.0, np.inf)


def tip_patches(profile: Profile, x: np.ndarray, y: np.ndarray, window: float, reach: float) -> np.ndarray:
    """Patches of a tip whose axis stands upright on the skin.

    Depth counts from the tip's lowest point, which may lie between two pixels.

    Args:
        profile: of the tip.
        x: (n,) m, of the axis in the tool frame.
        y: (n,) m, likewise.
        window: m, edge of the square that a patch shows.
        reach: m, to which depth is clipped.

    Returns:
        (n, 48, 48) m, float32.
    """
    centres = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * window
    result = np.empty((len(x), PATCH_PIXELS, PATCH_PIXELS), np.float32)
    for start in range(0, len(x), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        r = np.hypot(centres[None, :, None] - y[rows, None, None], centres[None, None, :] - x[rows, None, None])
        result[rows] = np.minimum(profile(r), reach)
    return result


class _Columns(NamedTuple):
    """Names of the columns that hold a board's values."""

    values: tuple[str, ...]
    ambient: tuple[str, ...]  # empty where the table has none


def _rows(source: Path, table: TextTable, chips: int, notes: ConversionLog) -> list[dict[str, Any]]:
    """The table's presses; damaged rows are refused or left out as `notes` has it."""
    header, lines = _by_depth(table, notes)
    columns = _check_header(source, header, chips, notes, table.beginning)
    rows: list[dict[str, Any]] = []
    for number, line in lines:
        try:
            rows.append(_row(source, number, line, columns))
        except DataError as error:
            notes.skip(error)
    rows = _of_positive_depth(source, rows, notes)
    if not rows:
        raise DataError(f"{source}: holds no press; give at least one row")
    if silent := sum(bool(np.isnan(row["reading"]).any()) for row in rows):
        notes.info(f"in {silent} presses a chip did not answer: its values are missing")
    return rows


def _by_depth(table: TextTable, notes: ConversionLog) -> tuple[list[str], list[tuple[int, dict[str, Any]]]]:
    """Names of the columns, and the rows with their numbers in the file; heights of the tip are turned into depths."""
    for note in table.notes:
        notes.info(note)
    header = table.header
    rows = [(number, _by_name(header, cells)) for number, cells in table.rows]
    height = next((name for name in HEIGHT_COLUMNS if name in header), None)
    if height is None or "depth_mm" in header:
        return header, rows
    highest = max((float(row[height]) for _, row in rows if _is_height(row.get(height))), default=0.0)
    notes.info(f"assumed: {height} grows out of the skin, and depth counts from its highest value, {highest:g} mm")
    header = ["depth_mm" if name == height else name for name in header]
    return header, [(number, _with_depth(row, height, highest)) for number, row in rows]


def _by_name(header: list[str], cells: list[str]) -> dict[str, Any]:
    """A row's fields by the names of their columns; None among them says that it has not as many."""
    row: dict[str, Any] = dict(zip(header, cells, strict=False))
    if len(cells) != len(header):
        row |= dict.fromkeys(header[len(cells) :])
        row[TOO_FEW_OR_MANY] = cells
    return row


def _is_number(text: Any, most: float = math.inf) -> bool:
    try:
        return abs(float(text)) < most
    except (TypeError, ValueError):
        return False


def _is_height(text: Any) -> bool:
    return _is_number(text, MAX_TABLE_VALUE)


def _with_depth(row: dict[str, Any], height: str, highest: float) -> dict[str, Any]:
    """A row whose height is a depth; what is no number stays, and is refused later."""
    text = row.pop(height)
    return row | {"depth_mm": repr(highest - float(text)) if _is_height(text) else text}


def _check_header(source: Path, header: list[str], chips: int, notes: ConversionLog, beginning: str) -> _Columns:
    """The columns of a board's values; a table that lacks some, or has those of another board, is refused."""
    values, ambient = (tuple(f"{kind}{chip}{axis}_uT" for chip in range(chips) for axis in "xyz") for kind in "ba")
    missing = [name for name in PLACES + values if name not in header]
    if missing == ["depth_mm"] and "force_N" in header:
        notes.info("no depth was recorded: presses are known by their force")
    elif missing:
        named = ", ".join(missing[:MOST_NAMED]) + (" ..." if len(missing) > MOST_NAMED else "")
        raise DataError(f"{source}: column {named} is missing ({beginning}); name columns as in docs/data.md")
    beyond = [name for name in header if FIELD_COLUMN.fullmatch(name) and name not in values]
    if beyond:
        raise DataError(
            f"{source}: column {', '.join(beyond)} is of no chip of the board, which has {chips}; name it with --board"
        )
    if len(set(header)) != len(header):
        raise DataError(f"{source}: a column name stands twice in the first line; rename one")
    has_ambient = set(ambient) <= set(header)
    if not has_ambient and set(ambient) & set(header):
        raise DataError(
            f"{source}: some of the ambient columns {ambient[0]} ... {ambient[-1]} are missing; give all or none"
        )
    known = {*PLACES, *values, "force_N", TIME, "source", *NAME_COLUMNS, *(ambient if has_ambient else ())}
    unknown = [name for name in header if name not in known]
    if unknown:
        notes.info(f"left out: columns {', '.join(unknown)}, which have no meaning here")
    return _Columns(values, ambient if has_ambient else ())


def _row(source: Path, number: int, line: dict[str, Any], columns: _Columns) -> dict[str, Any]:
    """One press: numbers by the names of their columns, names, its reading (uT), and its line in the file."""
    if TOO_FEW_OR_MANY in line:
        fields = len(line) - 1
        raise DataError(f"{source}: line {number} has not {fields} fields; give one for each column")
    row: dict[str, Any] = {
        name: _number(source, number, name, line[name]) if name in line else math.nan for name in PLACES
    }
    row["force_N"] = (
        _number(source, number, "force_N", line["force_N"]) if line.get("force_N", "").strip() else math.nan
    )
    row[TIME] = float(line[TIME]) if _is_number(line.get(TIME)) else math.nan
    answered, reading = _answered(line, columns.values), np.full(len(columns.values), np.nan)
    for i in np.flatnonzero(answered):
        reading[i] = _number(source, number, columns.values[i], line[columns.values[i]])
        if columns.ambient:
            reading[i] -= _number(source, number, columns.ambient[i], line[columns.ambient[i]])
    row |= {kind: (line.get(kind) or kind).strip() for kind in NAME_COLUMNS}
    row["source"] = (line.get("source") or "").strip().lower() or "real"
    if row["source"] not in PRESS_SOURCES:
        raise DataError(f"{source}: line {number} has the source {row['source']!r}; write {' or '.join(PRESS_SOURCES)}")
    return row | {"reading": reading, "line": number}


def _answered(line: dict[str, Any], names: tuple[str, ...]) -> np.ndarray:
    """Mask of a row's values from chips that answered: one without any of its values did not, if others did."""
    written = np.array([line[name].strip() != "" for name in names]).reshape(-1, AXES_OF_CHIP)
    answered = written.any(1) if written.any() else np.ones(len(written), bool)
    return np.repeat(answered, AXES_OF_CHIP)


def _number(source: Path, line: int, column: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) < MAX_TABLE_VALUE:
        raise DataError(f"{source}: line {line} has {text!r} in column {column}, which is no such number; correct it")
    return value


def _of_positive_depth(source: Path, rows: list[dict[str, Any]], notes: ConversionLog) -> list[dict[str, Any]]:
    """Rows whose depth counts into the skin: all are turned where nearly all are negative, a single one is damage."""
    depth = np.array([row["depth_mm"] for row in rows])
    if np.sum(depth < 0) > TURNED_SHARE * max(np.sum(depth != 0), MIN_TURNED):
        notes.info(
            f"corrected: depths are negative in {np.sum(depth < 0)} of {len(depth)} rows, as heights are: they are "
            "turned"
        )
        for row in rows:
            row["depth_mm"] = -row["depth_mm"]
    kept = []
    for row in rows:
        if not row["depth_mm"] < 0:
            kept.append(row)
            continue
        notes.skip(
            DataError(
                f"{source}: line {row['line']} has the negative depth {row['depth_mm']:g}; depth_mm counts from first "
                "contact into the skin"
            )
        )
    return kept


def _patches(
    indenter: str, unit: str | None, x: np.ndarray, y: np.ndarray, *, window: float, reach: float, notes: ConversionLog
) -> tuple[np.ndarray, float]:
    """Patches (n, 48, 48) m and the z of the indenter's lowest point in its own frame (m)."""
    kind, _, value = indenter.partition(":")
    if kind == "mesh" and value:
        return _mesh_patches(Path(value), unit, x, y, window=window, reach=reach, notes=notes)
    try:
        radius = 1e-3 * float(value)
    except ValueError:
        radius = math.nan
    if kind not in ("sphere", "cylinder") or not 0 < radius < 1:
        raise DataError(f"--indenter {indenter}: is unknown; give sphere:RADIUS or cylinder:RADIUS in mm, or mesh:FILE")
    return tip_patches({"sphere": sphere, "cylinder": cylinder}[kind](radius), x, y, window, reach), 0.0


def _mesh_patches(
    file: Path, unit: str | None, x: np.ndarray, y: np.ndarray, *, window: float, reach: float, notes: ConversionLog
) -> tuple[np.ndarray, float]:
    import jax.numpy as jnp
    from jax import jit

    from i2t.objects import read_mesh
    from i2t.rendering import render

    if unit is None:
        raise DataError(f"--indenter mesh:{file}: say in which unit the file is, for instance --unit mm")
    try:
        (_, mesh, _), report = read_mesh(file, unit, table=False)
    except (ValueError, OSError) as error:
        raise DataError(str(error)) from error
    notes.info(str(report))
    lowest = float(np.asarray(mesh.vertices)[:, 2].min())
    surface = render.prepare_surface(mesh)
    look = jit(lambda T_o_t: render.render_patch(surface, T_o_t, window=window, pixels=PATCH_PIXELS, reach=reach).depth)
    patch = np.empty((len(x), PATCH_PIXELS, PATCH_PIXELS), np.float32)
    for i, place in enumerate(zip(x, y, strict=True)):
        T_o_t = np.eye(4, dtype=np.float32)
        T_o_t[:3, 3] = (-place[0], -place[1], lowest)
        patch[i] = look(jnp.asarray(T_o_t))
    return patch, lowest
