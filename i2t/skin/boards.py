"""Sensor boards: positions, order and rotations of the magnetometers below the skin.

A board has any number n of chips and sends readings of 3 n values. `make_board` makes the boards of the field and
square grids by name, and reads any other board from a file with the positions and rotations of its chips. The default
is `reskin_board()`, with five chips.

Order and rotation of the chips are facts about a board, not about the code. The module uses only NumPy, so that file
readers and the hardware layer can import it.
"""

import re
from collections.abc import Callable, Mapping, Sequence
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

CHIP_PITCH_M = 7e-3  # m, distance of ReSkin's centre chip from each of the others
# m, depth of ReSkin's chips below the skin's surface: 2 mm of elastomer and 1.5 mm of package and cover
CHIP_DEPTH_M = 3.5e-3
AXES_OF_CHIP = 3  # number of values of a chip: its field along x, y and z
MAX_CHIPS = 25  # largest accepted number of chips on a board
DEFAULT_BOARD = "reskin"  # name of the board that is assumed if none is stated


def reskin_board(depth: float = CHIP_DEPTH_M) -> Board:
    """Make the ReSkin board: centre, +x, +y, -y, -x, with chips rotated by 0, 90, 0, -90 and 180 degrees.

    Recorded on one real board: the order from presses, the rotations from the ambient field. With chip 0 (x0, y0) as
    the reference, that field appeared on chip 1 as (y0, -x0), on chip 2 unchanged, on chip 3 as (-y0, x0) and on chip 4
    as (-x0, -y0).

    Args:
        depth: Nominal depth (m) of the chips below the surface.

    Returns:
        A board of 5 chips.

    Example:
        board = i2t.reskin_board()
        pad = i2t.nominal_pad(board=board)
    """
    cells = np.array([[0, 0], [1, 0], [0, 1], [0, -1], [-1, 0]])
    return _board(CHIP_PITCH_M * cells, _quarter_turns((0, 1, 0, 3, 2)), depth)


def anyskin_board(depth: float = CHIP_DEPTH_M) -> Board:
    """Make the AnySkin board: centre, -x, +x, +y, -y, with the rotations that its makers publish.

    Their viewer (github raunaqbhirangi/anyskin, `chip_xy_rotations`) rotates each chip's x and y by -90, -90, 180, 90
    and 0 degrees, in this order, on a screen whose y points down. A chip's axes are right-handed, so its z then points
    into the picture. None of this was measured here; a board with other rotations is given as a file (`read_board`).
    Relative to the centre chip, the chips are rotated as on `reskin_board`, at mirrored places: if both are the same
    board, the picture shows it from behind.

    Args:
        depth: Nominal depth (m) of the chips below the surface.

    Returns:
        A board of 5 chips.

    Example:
        board = i2t.anyskin_board()
    """
    cells = np.array([[0, 0], [-1, 0], [1, 0], [0, 1], [0, -1]])
    screen_to_tool = np.diag([1.0, -1.0, -1.0])  # on the screen x points right and y down, so z into the picture
    return _board(CHIP_PITCH_M * cells, screen_to_tool @ _quarter_turns((-1, -1, 2, 1, 0)), depth)


def eflesh_board(depth: float = CHIP_DEPTH_M) -> Board:
    """Make AnySkin's board as it lies under eFlesh's lattices: in the same order, with all chips assumed aligned.

    The order agrees with the places where the chips of the `spatial` recording read most. The rotations of the chips
    cannot be determined from these recordings, because discrete magnets make no radial field.

    Args:
        depth: Nominal depth (m) of the chips below the surface.

    Returns:
        A board of 5 chips.
    """
    return anyskin_board(depth)._replace(rotations=np.tile(np.eye(3, dtype=np.float32), (5, 1, 1)))


def grid_board(rows: int, columns: int, pitch: float | None = None, depth: float = CHIP_DEPTH_M) -> Board:
    """Make a board of chips on a square grid about the skin's centre, all with the tool's axes.

    Chips are in the order of rows along tool y, and along tool x within a row.

    Args:
        rows: Number of chips along tool y.
        columns: Number of chips along tool x.
        pitch: Distance (m) between neighbours; by default the skin's edge divided by the larger count, so that one chip
            is below each cell.
        depth: Depth (m) of the chips below the surface.

    Returns:
        A board of rows * columns chips.
    """
    pitch = PAD_WINDOW / max(rows, columns) if pitch is None else pitch
    y, x = np.meshgrid(np.arange(rows) - (rows - 1) / 2, np.arange(columns) - (columns - 1) / 2, indexing="ij")
    positions = pitch * np.column_stack([x.ravel(), y.ravel()])
    return _board(positions, np.tile(np.eye(3), (rows * columns, 1, 1)), depth)


# Functions that make the boards with a name.
BOARDS: Mapping[str, Callable[[], Board]] = {
    "reskin": reskin_board,
    "anyskin": anyskin_board,
    "eflesh": eflesh_board,
    **{f"grid-{n}x{n}": partial(grid_board, n, n) for n in range(1, 6)},
}


def make_board(name: str) -> Board:
    """Make a board by name: one of `BOARDS`, `grid-RxC` for R rows and C columns, or the user's own file.

    Args:
        name: "reskin", "anyskin", "grid-2x2", "grid-4x4", "grid-3x5", ..., or "my_board.toml" (`read_board`).

    Returns:
        The board with the positions and rotations of its chips.

    Raises:
        ValueError: The name is unknown, or the file does not describe a board.
    """
    if name in BOARDS:
        return BOARDS[name]()
    if name.endswith(".toml"):
        return read_board(name)
    grid = re.fullmatch(r"grid-([1-9][0-9]?)x([1-9][0-9]?)", name)
    rows, columns = (int(grid[1]), int(grid[2])) if grid else (0, 0)
    if not 0 < rows * columns <= MAX_CHIPS:
        remedy = f"choose one of {', '.join(BOARDS)}, grid-RxC of {MAX_CHIPS} chips or less, or a file that ends in "
        remedy += ".toml."
        if not name.startswith("grid-"):
            remedy = did_you_mean(name, BOARDS, remedy)
        raise ValueError(f"Board {name!r} is not known; {remedy}")
    return grid_board(rows, columns)


def read_board(path: str | Path) -> Board:
    """Read a board from a TOML file.

        chips = [[0, 0, -0.0035], [0.007, 0, -0.0035]]   # m, in the skin's frame: z out of it, so chips lie below 0
        turns = [0, 90]                                  # degrees, of each chip's axes about z; or, in place of it,
        rotations = [[[1, 0, 0], [0, 1, 0], [0, 0, 1]], ...]   # from each chip's axes to the skin's

    Args:
        path: Path of the file.

    Returns:
        The board, its chips in the order in which it sends them.

    Raises:
        ValueError: The file is missing or does not describe a board; one sentence names file and key.
    """
    max_offset, min_spacing = 0.1, 1e-4  # m, from the skin's centre and from chip to chip
    path = Path(path)
    try:
        table = read_toml(path)
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); check the name") from error
    unknown = sorted(set(table) - {"chips", "turns", "rotations"})
    if unknown:
        raise ValueError(f"{path}: {unknown[0]!r} is not a key of a board; give chips, and turns or rotations")
    chips = _array(path, table, "chips", 2)
    n = len(chips)
    if chips.shape != (n, 3) or not 0 < n <= MAX_CHIPS:
        raise ValueError(f"{path}: chips is {_describe(chips)}; give x, y and z of 1 to {MAX_CHIPS} chips")
    if np.abs(chips).max() > max_offset or chips[:, 2].max() > 0:
        raise ValueError(
            f"{path}: chips lie up to {np.abs(chips).max():g} m from the skin's centre, at heights up to "
            f"{chips[:, 2].max():g} m; give metres within {max_offset:g}, and z below the surface"
        )
    if n > 1 and min(np.linalg.norm(chip - other) for i, chip in enumerate(chips) for other in chips[:i]) < min_spacing:
        raise ValueError(f"{path}: two chips lie in one place; correct chips")
    if ("turns" in table) == ("rotations" in table):
        raise ValueError(f"{path}: give either turns or rotations")
    if "turns" in table:
        turns = _array(path, table, "turns", 1)
        return Board(chips.astype(np.float32), _rotations_about_z(path, turns, n).astype(np.float32))
    rotations = _array(path, table, "rotations", 3)
    if rotations.shape != (n, 3, 3):
        raise ValueError(f"{path}: rotations is {_describe(rotations)}; give 3 rows of 3 for each of {n} chips")
    wrong = np.abs(rotations @ rotations.swapaxes(1, 2) - np.eye(3)).max((1, 2)) > ORTHOGONALITY_TOLERANCE
    if wrong.any():
        raise ValueError(
            f"{path}: rotations of chip {int(np.argmax(wrong))} is not a rotation; give six digits or more"
        )
    return Board(chips.astype(np.float32), rotations.astype(np.float32))


def board_note(name: str) -> str:
    """Describe the source of a named board's chip order and rotations.

    Args:
        name: A name as for `make_board`.

    Returns:
        One line of text; empty if there is nothing to remark.
    """
    return {
        "anyskin": "board anyskin: chips turned as its makers' viewer publishes (chip_xy_rotations), not measured "
        "here; give your own as a file, --board my_board.toml",
        "eflesh": "board eflesh: the rotations of its chips are unknown; they are taken as aligned",
    }.get(name, "")


def name_of_board(board: Board) -> str:
    """Find the name of a board, as for `make_board`.

    Args:
        board: Any board.

    Returns:
        Its name; empty if no named board has the same chips (`same_board`).
    """
    sides = range(1, MAX_CHIPS + 1)
    grids = [f"grid-{rows}x{columns}" for rows in sides for columns in sides if rows * columns == board.num_chips]
    names = (name for name in (*BOARDS, *grids) if same_board(make_board(name), board))
    return next(names, "")


def same_board(
    board: Board, other: Board, *, position_tolerance: float = 3e-3, rotation_tolerance: float = 0.2
) -> bool:
    """Test whether two boards have the same chips, in the same order and with the same rotations.

    Args:
        board: A board.
        other: Another board.
        position_tolerance: Tolerance (m) of a coordinate; nominal boards and fitted pads differ by less in the depth of
            their chips.
        rotation_tolerance: Tolerance of an entry of a chip's rotation matrix.

    Returns:
        True if the boards are the same within the tolerances.
    """
    if np.shape(board.chips) != np.shape(other.chips):
        return False
    apart = np.abs(np.asarray(board.chips, float) - np.asarray(other.chips, float)).max()
    turned = np.abs(np.asarray(board.rotations, float) - np.asarray(other.rotations, float)).max()
    return bool(apart < position_tolerance and turned < rotation_tolerance)


def board_as_lists(board: Board) -> dict[str, Any]:
    """Convert a board to lists of numbers, for JSON and TOML; `board_from_lists` is the inverse.

    Args:
        board: Any board.

    Returns:
        Its chips and rotations, as in a board file.
    """
    return {name: np.asarray(part, np.float64).round(9).tolist() for name, part in board._asdict().items()}


def board_from_lists(lists: Any) -> Board | None:
    """Convert the result of `board_as_lists` to a board.

    Args:
        lists: Content of a file.

    Returns:
        The board; None if the content does not describe a board.
    """
    try:
        board = Board(*(np.array(lists[name], np.float32) for name in Board._fields))
        fits = board.chips.shape[1:] == (3,) and board.rotations.shape == (len(board.chips), 3, 3)
    except (KeyError, TypeError, ValueError):
        return None
    return board if fits else None


def _board(positions: np.ndarray, rotations: np.ndarray, depth: float) -> Board:
    validation.number("depth", depth, "metres below the surface, 0 or more", minimum=0)
    chips = np.column_stack([positions, np.full(len(positions), -depth)])
    return Board(chips.astype(np.float32), rotations.astype(np.float32))


def _quarter_turns(counts: Sequence[int]) -> np.ndarray:
    """Make rotations (n, 3, 3) about z, from x to y, by these numbers of quarter turns."""
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    return np.stack([np.linalg.matrix_power(turn, count % 4) for count in counts])


def _rotations_about_z(path: Path, turns: np.ndarray, n: int) -> np.ndarray:
    """Make rotations (n, 3, 3) about z by angles in degrees."""
    if turns.shape != (n,):
        raise ValueError(f"{path}: turns is {_describe(turns)}; give one number for each of {n} chips")
    if np.abs(turns).max() > 360 or (turns.any() and np.abs(turns).max() < 2 * np.pi):
        raise ValueError(f"{path}: turns is {turns.tolist()}; give degrees, each within 360")
    cosine, sine = np.cos(np.radians(turns)), np.sin(np.radians(turns))
    zeros, ones = np.zeros(n), np.ones(n)
    rows = [[cosine, -sine, zeros], [sine, cosine, zeros], [zeros, zeros, ones]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _array(path: Path, table: Mapping[str, Any], key: str, dimensions: int) -> np.ndarray:
    """Read the numbers of a key; raise ValueError if they are missing or invalid."""
    if key not in table:
        raise ValueError(f"{path}: {key} is missing; add it")
    try:
        array = np.array(table[key])
    except ValueError:
        array = np.array(None)
    if array.dtype.kind not in "iuf" or array.ndim != dimensions or not np.isfinite(array).all():
        raise ValueError(f"{path}: {key} is {_describe(array)}; give {'lists of ' * (dimensions - 1)}numbers")
    return array.astype(float)


def _describe(array: np.ndarray) -> str:
    return " x ".join(map(str, array.shape)) + " numbers" if array.dtype.kind in "iuf" and array.ndim else "no numbers"


def silent_chips(readings: Float[np.ndarray, "n c"], *, differences: bool = False) -> Bool[np.ndarray, "n chips"]:
    """Find chips that did not answer: a failed chip sends exactly zero along all three axes, which no field does.

    The difference of two readings may be rounded to zero, however. If the other chips of a row answered, three zeros of
    a chip count as such a difference if one of them is a rounded negative number (-0.0), or if the chip's other rows
    are zero along two axes at least as often.

    Args:
        readings: `(n, 3 chips)` readings as the board sent them, or differences of such readings, in any unit.
        differences: Whether the values are differences, such as readings minus the ambient.

    Returns:
        `(n, chips)` mask of the chips that did not answer; false for chips that are already missing (NaN).
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
    """Replace the readings of chips that did not answer (`silent_chips`) by NaN.

    Args:
        readings: `(n, 3 chips)` readings as the board sent them, or differences of such readings, in any unit.
        differences: Whether the values are differences, such as readings minus the ambient.

    Returns:
        `(n, 3 chips)` readings, NaN for chips that did not answer.
    """
    silent = silent_chips(readings, differences=differences)
    return np.where(np.repeat(silent, AXES_OF_CHIP, axis=1), np.nan, readings)


def mean_finite(values: Float[np.ndarray, "*n"], axis: int) -> Float[np.ndarray, "*m"]:
    """Average values along an axis, ignoring those that are not finite, such as those of a missing chip.

    Args:
        values: Any numbers, some of them missing.
        axis: Axis along which the mean is taken.

    Returns:
        The mean in the unit of `values`; NaN if no value is finite.
    """
    finite = np.isfinite(values)
    count = finite.sum(axis)
    total = np.where(finite, values, 0.0).sum(axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
