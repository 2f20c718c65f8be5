"""Sensor boards: where magnetometers sit below the skin, in which order a board sends them, and how they are turned.

A board has any number n of chips and sends readings of 3 n values. `make_board` knows the boards of the field and
square grids by name; any other is a `Board` of its chips' positions and rotations. Where nothing else is said the board
is `reskin_board()`, with five chips.

Order and rotation of the chips are facts about a board, not about the code. NumPy only, so that file readers and the
hardware layer can use it.
"""

import re
from collections.abc import Callable, Mapping
from functools import partial

import numpy as np

from i2t.types import PAD_WINDOW, Board

CHIP_PITCH_M = 7e-3  # from the centre chip to each of the others
CHIP_DEPTH_M = 3.5e-3  # of the chips below the skin's surface: 2 mm of elastomer and 1.5 mm of package and cover
MAX_CHIPS = 25  # of a grid by name
CHIP_TOLERANCE_M = 3e-3  # nominal boards and fitted pads differ by less in the depth of their chips
CHIP_ROTATION_TOLERANCE = 0.2  # of an entry of a chip's rotation
DEFAULT_BOARD = "reskin"  # where nothing else is said

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
    """The AnySkin board, also used for eFlesh: centre, left, right, up, down (-x, +x, +y, -y) as public viewers draw
    it.

    How its chips are turned has not been measured here; they are taken as aligned, which matters only where readings
    are turned into tool axes. The makers' viewer (github raunaqbhirangi/anyskin, `chip_xy_rotations`) turns each chip's
    x and y by -90, -90, 180, 90 and 0 degrees in this order, on a screen whose y points down.

    Args:
        depth: m, nominal, of the chips below the surface.

    Returns:
        A board of 5 chips.

    Example:
        board = i2t.anyskin_board()
    """
    cells = np.array([[0, 0], [-1, 0], [1, 0], [0, 1], [0, -1]])
    return _board(CHIP_PITCH_M * cells, np.tile(np.eye(3), (5, 1, 1)), depth)


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
    **{f"grid-{n}x{n}": partial(grid_board, n, n) for n in range(1, 6)},
}


def make_board(name: str) -> Board:
    """The board of a name: one of `BOARDS`, or `grid-RxC` for R rows and C columns.

    Args:
        name: "reskin", "anyskin", "grid-2x2", "grid-4x4", "grid-3x5", ...

    Returns:
        The board.

    Raises:
        ValueError: the name is not known.
    """
    if name in BOARDS:
        return BOARDS[name]()
    grid = _GRID_NAME.fullmatch(name)
    rows, columns = (int(grid[1]), int(grid[2])) if grid else (0, 0)
    if not 0 < rows * columns <= MAX_CHIPS:
        known = ", ".join(BOARDS)
        raise ValueError(
            f"Board {name!r} is not known; choose one of {known}, or grid-RxC of {MAX_CHIPS} chips or less."
        )
    return grid_board(rows, columns)


def same_board(one: Board, other: Board) -> bool:
    """Whether two boards have the same chips, in the same order and turned alike.

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


def _board(positions: np.ndarray, rotations: np.ndarray, depth: float) -> Board:
    chips = np.column_stack([positions, np.full(len(positions), -depth)])
    return Board(chips.astype(np.float32), rotations.astype(np.float32))
