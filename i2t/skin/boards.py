"""Sensor boards that are known: five magnetometers, one in the centre and four 7 mm from it, in the order in which the
board sends them.

Order and rotation of the chips are facts about a board, not about the code. NumPy only, so that file readers and the
hardware layer can use it.
"""

import numpy as np

from i2t.types import Board

PITCH = 7e-3  # m, from the centre chip to each of the others
DEPTH = 3.5e-3  # m, of the chips below the skin's surface: 2 mm of elastomer and 1.5 mm of package and cover

_QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter turn about z, from x to y


def reskin(depth: float = DEPTH) -> Board:
    """The ReSkin board: centre, +x, +y, -y, -x, with chips turned by 0, 90, 0, -90 and 180 degrees.

    Recorded on one real board: order from presses, rotations from the ambient field, which with chip 0 (x0, y0) as
    reference appeared on chip 1 as (y0, -x0), on chip 2 aligned, on chip 3 as (-y0, x0) and on chip 4 as (-x0, -y0).
    `depth` (m) of the chips below the surface is nominal.
    """
    places = np.array([[0, 0], [1, 0], [0, 1], [0, -1], [-1, 0]])
    return _board(places, np.stack([np.linalg.matrix_power(_QUARTER, turns) for turns in (0, 1, 0, 3, 2)]), depth)


def anyskin(depth: float = DEPTH) -> Board:
    """The AnySkin board, also used for eFlesh: centre, left, right, up, down (-x, +x, +y, -y) as public viewers draw
    it.

    How its chips are turned is not published; they are taken as aligned, which matters only where readings are turned
    into tool axes.
    """
    places = np.array([[0, 0], [-1, 0], [1, 0], [0, 1], [0, -1]])
    return _board(places, np.tile(np.eye(3), (5, 1, 1)), depth)


def _board(places: np.ndarray, rotations: np.ndarray, depth: float) -> Board:
    chips = np.column_stack([PITCH * places, np.full(5, -depth)])
    return Board(chips.astype(np.float32), rotations.astype(np.float32))
