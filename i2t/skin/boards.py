"""Sensor boards: positions of magnetometers below the skin, their order in a reading, and their turns.

A board has any number n of chips and sends readings of 3 n values. `make_board` knows the boards of the field and
square grids by name, and reads any other from a file of its chips' positions and turns. Where nothing else is said the
board is `reskin_board()`, with five chips.

Order and rotation of the chips are facts about a board, not about the code. NumPy only, so that file readers and the
hardware layer can use it.
"""

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from i2t import validation
from i2t.errors import did_you_mean
from i2t.files.reading import read_toml
from i2t.patches.dimensions import ORTHOGONALITY_TOLERANCE, PAD_WINDOW
from i2t.types import Board

CHIP_PITCH_M = 7e-3  # from the centre chip to each of the others
CHIP_DEPTH_M = 3.5e-3  # of the chips below the skin's surface: 2 mm of elastomer and 1.5 mm of package and cover
AXES_OF_CHIP = 3
MAX_CHIPS = 25  # of a board by name or in a file
MAX_CHIP_M, MIN_APART_M = 0.1, 1e-4  # of a chip in a file from the skin's centre; from one to the next
BOARD_FILE_ENDING = ".toml"
CHIP_TOLERANCE_M = 3e-3  # nominal boards and fitted pads differ by less in the depth of their chips
CHIP_ROTATION_TOLERANCE = 0.2  # of an entry of a chip's rotation
DEFAULT_BOARD = "reskin"  # where nothing else is said

ANYSKIN_QUARTER_TURNS = (-1, -1, 2, 1, 0)  # of each chip on the makers' screen, as their viewer publishes them

_ANYSKIN_CELLS = np.array([[0, 0], [-1, 0], [1, 0], [0, 1], [0, -1]])
_SCREEN_TO_TOOL = np.diag([1.0, -1.0, -1.0])  # x right and y down, so z into the picture, to tool axes
_QUARTER_TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # about z, from x to y
_GRID_NAME = re.compile(r"grid-([1-9][0-9]?)x([1-9][0-9]?)")


def reskin_board(depth: float = CHIP_DEPTH_M) -> Board:
    """The ReSkin board: centre, +x, +y, -y, -x, with chips turned by 0, 90, 0, -90 and 180 degrees.

    Recorded on one real board: order from presses, rotations from the ambient field, which with chip 0 (x0, y0) as
    reference appeared on chip 1 as (y0, -x0), on chip 2 aligned, on chip 3 as (-y0, x0) and on chip 4 as (-x0, -y0).

    Args:
        depth: m, nominal, of the chips below the surface.

    Returns:
        A board of 5 chips.

    Example:
        board = i2t.reskin_board()
        pad = i2t.nominal_pad(board=board)
    """
    cells = np.array([[0, 0], [1, 0], [0, 1], [0, -1], [-1, 0]])
    rotations = [np.linalg.matrix_power(_QUARTER_TURN, turns) for turns in (0, 1, 0, 3, 2)]
    return _board(CHIP_PITCH_M * cells, np.stack(rotations), depth)


def anyskin_board(depth: float = CHIP_DEPTH_M) -> Board:
    """The AnySkin board: centre, left, right, up, down (-x, +x, +y, -y), with its chips turned as the makers publish.

    Their viewer (github raunaqbhirangi/anyskin, `chip_xy_rotations`) turns each chip's x and y by -90, -90, 180, 90 and
    0 degrees, in this order, on a screen whose y points down. A chip's axes are right-handed, so its z then points into
    the picture. Nothing of this was measured here; a board that lies otherwise is given as a file (`read_board`).
    Turned against the middle chip, its chips are those of `reskin_board`, at places that are mirrored to it: if both
    are one board, the picture shows it from behind.

    Args:
        depth: m, nominal, of the chips below the surface.

    Returns:
        A board of 5 chips.

    Example:
        board = i2t.anyskin_board()
    """
    turns = [np.linalg.matrix_power(_QUARTER_TURN, quarters % 4) for quarters in ANYSKIN_QUARTER_TURNS]
    return _board(CHIP_PITCH_M * _ANYSKIN_CELLS, _SCREEN_TO_TOOL @ np.stack(turns), depth)


def eflesh_board(depth: float = CHIP_DEPTH_M) -> Board:
    """AnySkin's board as it lies under eFlesh's lattices: the same order, with all chips taken as aligned.

    The order agrees with where each chip of the `spatial` recording reads most. How the chips are turned cannot be read
    off these recordings: discrete magnets make no radial field.

    Args:
        depth: m, nominal, of the chips below the surface.

    Returns:
        A board of 5 chips.
    """
    return _board(CHIP_PITCH_M * _ANYSKIN_CELLS, np.tile(np.eye(3), (5, 1, 1)), depth)


def grid_board(rows: int, columns: int, pitch: float | None = None, depth: float = CHIP_DEPTH_M) -> Board:
    """A board of chips on a square grid about the skin's centre, all with the tool's axes.

    Chips are in the order of rows along tool y, and along tool x within a row.

    Args:
        rows: chips along tool y.
        columns: chips along tool x.
        pitch: m, between neighbours; by default the skin's edge over the larger count, one chip below each cell.
        depth: m, of the chips below the surface.

    Returns:
        A board of rows * columns chips.
    """
    pitch = PAD_WINDOW / max(rows, columns) if pitch is None else pitch
    y, x = np.meshgrid(np.arange(rows) - (rows - 1) / 2, np.arange(columns) - (columns - 1) / 2, indexing="ij")
    positions = pitch * np.column_stack([x.ravel(), y.ravel()])
    return _board(positions, np.tile(np.eye(3), (rows * columns, 1, 1)), depth)


BOARDS: Mapping[str, Callable[[], Board]] = {
    "reskin": reskin_board,
    "anyskin": anyskin_board,
    "eflesh": eflesh_board,
    **{f"grid-{n}x{n}": partial(grid_board, n, n) for n in range(1, 6)},
}


def make_board(name: str) -> Board:
    """The board of a name: one of `BOARDS`, `grid-RxC` for R rows and C columns, or a file of one's own.

    Args:
        name: "reskin", "anyskin", "grid-2x2", "grid-4x4", "grid-3x5", ..., or "my_board.toml" (`read_board`).

    Returns:
        The board.

    Raises:
        ValueError: the name is not known, or the file says what no board can be.
    """
    if name in BOARDS:
        return BOARDS[name]()
    if name.endswith(BOARD_FILE_ENDING):
        return read_board(name)
    grid = _GRID_NAME.fullmatch(name)
    rows, columns = (int(grid[1]), int(grid[2])) if grid else (0, 0)
    if not 0 < rows * columns <= MAX_CHIPS:
        remedy = f"choose one of {', '.join(BOARDS)}, grid-RxC of {MAX_CHIPS} chips or less, or a file that ends in "
        remedy += f"{BOARD_FILE_ENDING}."
        if not name.startswith("grid-"):
            remedy = did_you_mean(name, BOARDS, remedy)
        raise ValueError(f"Board {name!r} is not known; {remedy}")
    return grid_board(rows, columns)


def read_board(path: str | Path) -> Board:
    """A board that a TOML file describes.

        chips = [[0, 0, -0.0035], [0.007, 0, -0.0035]]   # m, in the skin's frame: z out of it, so chips lie below 0
        turns = [0, 90]                                  # degrees, of each chip's axes about z; or, in place of it,
        rotations = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], ...]   # from each chip's axes to the skin's

    Args:
        path: Of the file.

    Returns:
        The board, its chips in the order in which it sends them.

    Raises:
        ValueError: The file is missing, or says what no board can be; one sentence names file and key.
    """
    path = Path(path)
    try:
        table = read_toml(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); check the name") from error
    unknown = sorted(set(table) - {"chips", "turns", "rotations"})
    if unknown:
        raise ValueError(f"{path}: {unknown[0]!r} is no key of a board; known are chips, and turns or rotations")
    chips = _array(path, table, "chips", 2)
    n = len(chips)
    if chips.shape != (n, 3) or not 0 < n <= MAX_CHIPS:
        raise ValueError(f"{path}: chips is {_said(chips)}; give x, y and z of 1 to {MAX_CHIPS} chips")
    if np.abs(chips).max() > MAX_CHIP_M or chips[:, 2].max() > 0:
        raise ValueError(
            f"{path}: chips lie up to {np.abs(chips).max():g} m from the skin's centre, at heights up to "
            f"{chips[:, 2].max():g} m; give metres within {MAX_CHIP_M:g}, and z below the surface"
        )
    if n > 1 and min(np.linalg.norm(one - other) for i, one in enumerate(chips) for other in chips[:i]) < MIN_APART_M:
        raise ValueError(f"{path}: two chips lie in one place; correct chips")
    if ("turns" in table) == ("rotations" in table):
        raise ValueError(f"{path}: give turns or rotations, one of both")
    if "turns" in table:
        return Board(chips.astype(np.float32), _turned(path, _array(path, table, "turns", 1), n).astype(np.float32))
    rotations = _array(path, table, "rotations", 3)
    if rotations.shape != (n, 3, 3):
        raise ValueError(f"{path}: rotations is {_said(rotations)}; give 3 rows of 3 for each of {n} chips")
    wrong = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max((1, 2)) > ORTHOGONALITY_TOLERANCE
    if wrong.any():
        raise ValueError(f"{path}: rotations of chip {int(np.argmax(wrong))} is no rotation; give six digits or more")
    return Board(chips.astype(np.float32), rotations.astype(np.float32))


def board_note(name: str) -> str:
    """Note on the source of chip order and turns of a named board.

    Args:
        name: As `make_board` has it.

    Returns:
        One line; empty where there is nothing to say.
    """
    return {
        "anyskin": "board anyskin: chips turned as its makers' viewer publishes (chip_xy_rotations), not measured "
        "here; give your own as a file, --board my_board.toml",
        "eflesh": "board eflesh: how its chips are turned is not known; they are taken as aligned",
    }.get(name, "")


def name_of_board(board: Board) -> str:
    """The name under which a board is known, as `make_board` has it.

    Args:
        board: Any.

    Returns:
        Its name; empty where no board of a name has the same chips (`same_board`).
    """
    sides = range(1, MAX_CHIPS + 1)
    grids = [f"grid-{rows}x{columns}" for rows in sides for columns in sides if rows * columns == board.num_chips]
    names = (name for name in (*BOARDS, *grids) if same_board(make_board(name), board))
    return next(names, "")


def same_board(one: Board, other: Board) -> bool:
    """Test two boards for the same chips, in the same order and turned alike.

    Args:
        one: A board.
        other: Another.

    Returns:
        Whether they are the same up to what nominal boards and fitted pads differ by.
    """
    if np.shape(one.chips) != np.shape(other.chips):
        return False
    apart = np.abs(np.asarray(one.chips, float) - np.asarray(other.chips, float)).max()
    turned = np.abs(np.asarray(one.rotations, float) - np.asarray(other.rotations, float)).max()
    return bool(apart < CHIP_TOLERANCE_M and turned < CHIP_ROTATION_TOLERANCE)


def board_as_lists(board: Board) -> dict[str, Any]:
    """A board as lists of numbers, for JSON and TOML; `board_from_lists` turns them back.

    Args:
        board: Any.

    Returns:
        Its chips and rotations, as in a board file.
    """
    return {name: np.asarray(part, np.float64).round(9).tolist() for name, part in board._asdict().items()}


def board_from_lists(lists: Any) -> Board | None:
    """The board of `board_as_lists`.

    Args:
        lists: What a file holds.

    Returns:
        The board; None where they are none.
    """
    try:
        board = Board(*(np.array(lists[name], np.float32) for name in Board._fields))
        fits = board.chips.shape[1:] == (3,) and board.rotations.shape == (len(board.chips), 3, 3)
    except (KeyError, TypeError, ValueError):
        return None
    return board if fits else None


def _board(positions: np.ndarray, rotations: np.ndarray, depth: float) -> Board:
    validation.number("depth", depth, "metres below the surface, 0 or more", least=0)
    chips = np.column_stack([positions, np.full(len(positions), -depth)])
    return Board(chips.astype(np.float32), rotations.astype(np.float32))


def _turned(path: Path, turns: np.ndarray, n: int) -> np.ndarray:
    """Rotations (n, 3, 3) about z."""
    if turns.shape != (n,):
        raise ValueError(f"{path}: turns is {_said(turns)}; give one number for each of {n} chips")
    if np.abs(turns).max() > 360 or (turns.any() and np.abs(turns).max() < 2 * np.pi):
        raise ValueError(f"{path}: turns is {turns.tolist()}; give degrees, each within 360")
    cosine, sine = np.cos(np.radians(turns)), np.sin(np.radians(turns))
    zero, one = np.zeros(n), np.ones(n)
    rows = [[cosine, -sine, zero], [sine, cosine, zero], [zero, zero, one]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _array(path: Path, table: Mapping[str, Any], key: str, dimensions: int) -> np.ndarray:
    """The numbers of a key, or a sentence on their error."""
    if key not in table:
        raise ValueError(f"{path}: {key} is missing; add it")
    try:
        array = np.array(table[key])
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "iuf" or array.ndim != dimensions or not np.isfinite(array).all():
        raise ValueError(f"{path}: {key} is {_said(array)}; give {'lists of ' * (dimensions - 1)}numbers")
    return array.astype(float)


def _said(array: np.ndarray) -> str:
    return " x ".join(map(str, array.shape)) + " numbers" if array.dtype.kind in "iuf" and array.ndim else "no numbers"


def silent_chips(readings: Float[np.ndarray, "n c"], *, differences: bool = False) -> Bool[np.ndarray, "n chips"]:
    """Chips that did not answer: a chip that fails sends exactly zero along all three axes, as no field is.

    The difference of two readings can be rounded to zero, though. Where the other chips of a row answered, three zeros
    of a chip are taken for such a difference if one of them is a rounded negative number (-0.0), or if the chip's other
    rows are zero along two axes at least as often.

    Args:
        readings: (n, 3 chips) as a board sent them, or differences of such readings, in any unit.
        differences: Something was subtracted.

    Returns:
        Where a chip did not answer; not where it is missing (NaN) already.
    """
    rows = np.asarray(readings)
    by_chip = rows.reshape(len(rows), rows.shape[1] // AXES_OF_CHIP, AXES_OF_CHIP)
    zero_axes = np.sum(by_chip == 0, axis=2)
    silent = zero_axes == AXES_OF_CHIP
    if not differences:
        return silent
    whole = silent.all(1, keepdims=True)
    rounded = np.signbit(by_chip).any(2)
    coarse = np.sum(zero_axes == AXES_OF_CHIP - 1, axis=0) >= np.sum(silent & ~whole, axis=0)
    return silent & (whole | ~(rounded | coarse))


def without_silent_chips(readings: Float[np.ndarray, "n c"], *, differences: bool = False) -> Float[np.ndarray, "n c"]:
    """Readings in which chips that did not answer are missing, as by `silent_chips`.

    Args:
        readings: (n, 3 chips) as a board sent them, or differences of such readings, in any unit.
        differences: Something was subtracted.

    Returns:
        The readings, NaN where a chip did not answer.
    """
    silent = silent_chips(readings, differences=differences)
    return np.where(np.repeat(silent, AXES_OF_CHIP, axis=1), np.nan, readings)


def mean_known(values: Float[np.ndarray, "*n"], axis: int) -> Float[np.ndarray, "*m"]:
    """Mean of the values that are not NaN, as those of a missing chip are.

    Args:
        values: Any numbers, some of them missing.
        axis: Along which the mean is taken.

    Returns:
        The mean; NaN where nothing is known.
    """
    known = np.isfinite(values)
    count = known.sum(axis)
    total = np.where(known, values, 0.0).sum(axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
