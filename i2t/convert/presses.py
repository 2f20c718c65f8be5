"""A general table of presses that any lab can write: one row for each press of a known indenter, upright on the skin
(docs/data.md describes it).

Columns, by name: x_mm, y_mm (the indenter's axis from the skin's centre, along the skin's edges), travel_mm (past first
contact) or z_mm (the tip's height), the values of the board's chips b0x_uT, b0y_uT, b0z_uT, b1x_uT ...
(to b4z_uT for five chips); optionally force_N (empty = not measured), a0x_uT ... (ambient, subtracted), time_s, pad and
session (names; a session may be called run), and source (real, as by default, or simulated). Travel may be missing if
there are forces.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from i2t import validation
from i2t.convert.common import Converted, converted
from i2t.convert.press_table import (
    Indenter,
    SessionCheck,
    check_session,
    cylinder,
    presses_dataset,
    round_tip,
    sphere,
)
from i2t.errors import DataError
from i2t.files.kinds import MESH_SUFFIXES
from i2t.objects.named import require_object, split_unit
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.recordings.columns import (
    FORCE_COLUMN,
    HEIGHT_COLUMNS,
    NAME_COLUMNS,
    PLACE_COLUMNS,
    SOURCE_COLUMN,
    TIME_COLUMN,
    ambient_columns,
    field_columns,
    notes_on_depth,
)
from i2t.recordings.diagnose import corrected_presses, find_travel_sign, first_contact
from i2t.recordings.log import ZERO_AMBIENT, ReadingLog, require_ambient
from i2t.recordings.presses import Presses, join_presses
from i2t.recordings.tables import TextTable, names_in, read_text_table, valid_rows
from i2t.skin.boards import AXES_OF_CHIP, silent_chips
from i2t.types import Board

M_PER_MM = 1e-3


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
    stated_source: str | None = None,
) -> Converted:
    """Convert a table with one press of an indenter in each row to a data set.

    Args:
        source: File of the table.
        indenter: `sphere:RADIUS` or `cylinder:RADIUS` with the radius in mm, or `mesh:FILE` in `unit`.
        board: Board that sent the values; the table has three columns for each of its chips.
        window: Edge (m) of the square that a patch shows; presses whose tip it does not show are left out.
        reach: Depth (m) behind the indenter's lowest point to which patches are clipped.
        unit: Unit of the mesh file: m, cm, mm or inch.
        as_stated: Whether to take all units, signs and axes as recorded, without a search for mistakes.
        skip_bad: Whether to leave out damaged rows, with a note, instead of raising an error.
        table: Contents of `source`, if they have been read already.
        stated_source: "real" or "simulated", for a table without a column `source`.

    Returns:
        The data set, and notes on assumptions and omissions.

    Raises:
        DataError: If the table or the indenter cannot be used.
    """
    notes = ReadingLog(skip_bad, unit="presses")
    tip = _tip(indenter, unit, notes)
    presses, column = _read(source, table or read_text_table(source), board.num_chips, notes)
    checks: list[SessionCheck] = []
    if not as_stated:
        presses, checks = _corrected(presses, board, notes)
    dataset = presses_dataset(
        presses,
        tip,
        checks[0].board if len(checks) == 1 else board,
        notes,
        whose=source,
        window=window,
        reach=reach,
        source=_one_source(source, column, stated_source),
        meta={
            "converter": "presses",
            "file": source.name,
            "indenter": indenter if indenter.lower().startswith("mesh:") else tip.name,
        }
        | {key: text for check in checks for key, text in check.meta.items()},
    )
    return converted(dataset, notes)


def _corrected(table: Presses, board: Board, notes: ReadingLog) -> tuple[Presses, list[SessionCheck]]:
    """Correct units, signs, axes and heights that a session contradicts in that session."""
    assert table.pad is not None
    assert table.session is not None
    kept, checks = [], []
    for pad, session in dict.fromkeys(zip(table.pad.tolist(), table.session.tolist(), strict=True)):
        part = table.rows((table.pad == pad) & (table.session == session))
        check = check_session(session, part, board, notes, stated_zero=0.0)
        checks.append(check)
        part = corrected_presses(part, check.findings)
        assert part.height is not None
        if check.correction.height < 0 or (check.zero is not None and check.zero.wrong):
            part = part._replace(height=part.height - first_contact(part.height, check.zero))
        kept.append(part)
    return join_presses(kept), checks


def _read(source: Path, table: TextTable, chips: int, notes: ReadingLog) -> tuple[Presses, str | None]:
    """Read the presses of a table and whether they are real, simulated or mixed. Refuse or count damaged rows."""
    for note in table.notes:
        notes.info(note)
    if table.log is not None:
        notes.include(table.log)
    for note in notes_on_depth(table.header, table.stated):
        notes.change("travel", note)
    height = next((name for name in HEIGHT_COLUMNS if name in table.header and "travel_mm" not in table.header), None)
    header = ["travel_mm" if name == height else name for name in table.header]
    values, ambient = _value_columns(source, header, chips, notes, table.stated)
    places = [name for name in PLACE_COLUMNS if name in header]
    columns = [*places, *values, *ambient, *([FORCE_COLUMN] if FORCE_COLUMN in header else [])]

    def needed(empty: np.ndarray) -> np.ndarray:
        """Compute the mask of fields that may not be empty: places, and the values of chips that answered."""
        first, end = len(places), len(places) + len(values)
        required = np.ones_like(empty)
        answering = ~np.all(empty[:, first:end].reshape(len(empty), chips, AXES_OF_CHIP), axis=2)
        for start in (first, end)[: 2 if ambient else 1]:
            required[:, start : start + len(values)] = np.repeat(answering, AXES_OF_CHIP, axis=1)
        required[:, end + len(ambient) :] = False
        return required

    rows, numbers = valid_rows(source, header, table.rows, columns, needed, notes)
    answered = notes.select_answered(
        _silent(source, numbers[:, len(places) : len(places) + len(values) + len(ambient)], chips, notes)
    )
    notes.require_answers(
        source, "check the board's cable and record again, or empty the fields of a chip that is missing"
    )
    rows, numbers = [row for row, kept in zip(rows, answered, strict=True) if kept], numbers[answered]
    column = dict(zip(columns, numbers.T, strict=True))
    unknown = np.full(len(rows), np.nan)
    travel = column.get("travel_mm", unknown)
    if height is not None and len(travel):
        highest = float(travel.max())
        notes.info(
            f"assumed: {height} increases away from the skin, and travel counts from its highest value, {highest:g} mm"
        )
        travel = highest - travel
    travel, kept = _positive(source, travel, [line for line, _ in rows], notes)
    readings = np.column_stack([column[name] for name in values])
    if ambient:
        readings = readings - np.column_stack([column[name] for name in ambient])
    presses = Presses(
        M_PER_MM * np.column_stack([column["x_mm"], column["y_mm"]]), readings,
        height=-M_PER_MM * travel, force=column.get(FORCE_COLUMN, unknown),
        time=np.array([_time(header, cells) for _, cells in rows]),
        **{kind: np.array([names_in(header, cells, kind) for _, cells in rows]) for kind in NAME_COLUMNS},
    ).rows(kept)  # fmt: skip
    if not kept.any():
        raise DataError(f"{source}: holds no press; give at least one row")
    if silent := int(np.isnan(presses.readings).any(1).sum()):
        notes.change("missing chips", f"in {silent} presses a chip did not answer: its values are missing")
    return presses, _sources(source, header, [row for row, keep in zip(rows, kept, strict=True) if keep])


def _silent(source: Path, fields: np.ndarray, chips: int, notes: ReadingLog) -> np.ndarray:
    """Compute the mask (n, chips) of chips for which a press is left out: they sent zeros, or no chip has a value.

    A press is kept if fields of only some chips are empty. Ambient columns that are zero in every row subtract nothing.
    """
    readings, ambient = fields[:, : AXES_OF_CHIP * chips], fields[:, AXES_OF_CHIP * chips :]
    subtracts = bool(ambient.any())
    if ambient.size and not subtracts:
        notes.doubt("ambient field", ZERO_AMBIENT)
    silent = silent_chips(readings, differences=not subtracts)
    if subtracts:
        silent_ambient = silent_chips(ambient)
        require_ambient(
            source, silent, silent_ambient, "correct its columns a0x_uT ..., or leave out those of all chips"
        )
        silent |= silent_ambient
    missing = np.isnan(readings).reshape(len(fields), chips, AXES_OF_CHIP).all(2)
    return silent | (silent | missing).all(1, keepdims=True)


def _time(header: list[str], cells: list[str]) -> float:
    """Read the time of a press (s), NaN if it was not recorded."""
    try:
        return float(cells[header.index(TIME_COLUMN)])
    except ValueError:
        return math.nan


def _one_source(file: Path, column: str | None, option: str | None) -> str:
    """Determine the source of a table from its column and the option; "real" if neither states it."""
    if column is not None and option not in (None, column):
        raise DataError(f"--source {option}: the column source of {file} has {column}; leave out the option")
    return option or column or "real"


def _sources(source: Path, header: list[str], rows: list[tuple[int, list[str]]]) -> str | None:
    """Determine whether rows are real, simulated or mixed; None without a column `source`."""
    if SOURCE_COLUMN not in header:
        return None
    line_of = {cells[header.index(SOURCE_COLUMN)].strip().lower() or "real": line for line, cells in reversed(rows)}
    for word, line in line_of.items():
        if word not in ("real", "simulated"):
            raise DataError(f"{source}: line {line} has the source {word!r}; write real or simulated")
    return "mixed" if len(line_of) > 1 else next(iter(line_of))


def _value_columns(
    source: Path, header: list[str], chips: int, notes: ReadingLog, stated: Sequence[str]
) -> tuple[list[str], list[str]]:
    """List the columns of a board's values and of its ambient field; refuse a table that lacks some."""
    by_force = "travel_mm" not in header and FORCE_COLUMN in header
    needed = PLACE_COLUMNS[:2] if by_force else PLACE_COLUMNS
    values = field_columns(source, header, chips, needed, stated=stated)
    if by_force:
        notes.info("no travel was recorded: presses are described by their force")
    ambient = ambient_columns(values)
    has_ambient = set(ambient) <= set(header)
    if not has_ambient and set(ambient) & set(header):
        raise DataError(
            f"{source}: some of the ambient columns {ambient[0]} ... {ambient[-1]} are missing; give all or none"
        )
    understood = {
        *PLACE_COLUMNS,
        *values,
        FORCE_COLUMN,
        TIME_COLUMN,
        SOURCE_COLUMN,
        *NAME_COLUMNS,
        *(ambient if has_ambient else ()),
    }
    if unknown := [name for name in header if name not in understood]:
        notes.change("columns", f"left out: columns {', '.join(unknown)}, which are not used")
    return values, ambient if has_ambient else []


def _positive(source: Path, travel: np.ndarray, lines: list[int], notes: ReadingLog) -> tuple[np.ndarray, np.ndarray]:
    """Make travels positive into the skin, and return a mask of rows to keep.

    If nearly all travels are negative, all are reversed; a single negative one counts as damage.
    """
    sign = find_travel_sign(M_PER_MM * travel)
    if sign.wrong:
        notes.change(sign.name, f"corrected: {sign.sentence}")
        travel = -travel
    for k in np.flatnonzero(travel < 0):
        counts = "travel_mm counts from first contact into the skin"
        notes.skip_row(DataError(f"{source}: line {lines[k]} has the negative travel {travel[k]:g}; {counts}"))
    return travel, ~(travel < 0)


def _tip(indenter: str, unit: str | None, notes: ReadingLog) -> Indenter:
    kind, _, value = indenter.partition(":")
    kind = kind.strip().lower()
    if kind == "mesh" and value:
        return _mesh_tip(value, unit, notes)
    if kind == "mesh" or (Path(indenter).suffix.lower() in MESH_SUFFIXES and kind not in validation.ROUND_TIPS):
        raise DataError(
            f"--indenter {indenter}: a mesh is given by its file, as mesh:{'FILE' if kind == 'mesh' else indenter}"
        )
    try:
        shape, radius = validation.round_tip(indenter)
    except ValueError as error:
        kinds = "" if str(error).endswith("?") else "; give sphere:RADIUS or cylinder:RADIUS in mm, or mesh:FILE"
        raise DataError(f"--indenter {indenter}: {error}{kinds}") from None
    if unit is not None:
        raise DataError("--unit applies to --indenter mesh:FILE only; leave it out: radii are in mm")
    return round_tip(f"{shape}:{value.strip()}", {"sphere": sphere, "cylinder": cylinder}[shape](M_PER_MM * radius))


def _mesh_tip(name: str, unit: str | None, notes: ReadingLog) -> Indenter:
    try:
        require_object(name, unit, flag="--indenter", catalogue=False)
    except ValueError as error:
        raise DataError(str(error)) from error
    file, own_unit = split_unit(name)
    import jax.numpy as jnp
    from jax import jit

    from i2t.objects import read_mesh
    from i2t.rendering import render

    try:
        thing, report = read_mesh(file, own_unit or unit, table=False)
    except (ValueError, OSError) as error:
        raise DataError(str(error)) from error
    notes.info(str(report))
    lowest = float(np.asarray(thing.mesh.vertices)[:, 2].min())
    surface = render.prepare_surface(thing.mesh)

    def patches(x: np.ndarray, y: np.ndarray, window: float, reach: float) -> np.ndarray:
        def depth(T_o_t: Any) -> Any:
            return render.render_patch(surface, T_o_t, window=window, pixels=PATCH_PIXELS, reach=reach).depth

        look = jit(depth)
        T_o_t = np.tile(np.eye(4, dtype=np.float32), (len(x), 1, 1))
        T_o_t[:, :3, 3] = np.column_stack([-x, -y, np.full(len(x), lowest)])
        return np.stack([np.asarray(look(jnp.asarray(T))) for T in T_o_t])

    return Indenter(thing.name, patches, lowest)
