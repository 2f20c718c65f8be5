"""The ambient field of a simulated lab: the Earth's, of iron in the room, and of iron on the tool.

A vector in the base frame, a dipole that stands in the room, and a ball of soft iron behind the skin, which the field
magnetises anew in every pose: a ball of radius a in a field B is a dipole of moment 4 pi a^3 B / mu_0 (Jackson,
"Classical electrodynamics", 5.11). Microtesla and metres, NumPy only.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.types import Array, Board

DIPOLE_UT_M3 = 0.1  # uT m^3 of an ampere square metre: mu_0 / 4 pi


class RoomField(NamedTuple):
    """Sources of the ambient field. The defaults are a lab of the southern half of the Earth with some iron in it: a
    tool that points down, at the emulators' first pose, feels about (18, -7, -41) uT, and iron makes about 1 uT of it.
    """

    earth: Float[Array, "3"] = (18.0, 7.0, 41.0)  # uT, base axes
    iron_place: Float[Array, "3"] = (0.4, -0.45, 0.0)  # m, in the base
    iron_moment: Float[Array, "3"] = (0.3, 0.1, -0.8)  # A m^2, base axes
    tool_iron_place: Float[Array, "3"] = (0.0, 0.02, -0.05)  # m, in the tool
    tool_iron_radius: Float[Array, ""] = 0.01  # m, of a ball

    @classmethod
    def none(cls) -> "RoomField":
        """A room without any field."""
        return cls(earth=(0.0, 0.0, 0.0), iron_moment=(0.0, 0.0, 0.0))


def room_field(room: RoomField, board: Board, T_b_t: Float[Array, "4 4"]) -> Float[np.ndarray, "chips 3"]:
    """The room's field at a board's chips.

    Args:
        room: What makes it.
        board: Of the skin.
        T_b_t: Tool in base, m.

    Returns:
        uT, tool axes.
    """
    rotation, chips = T_b_t[:3, :3], np.asarray(board.chips, float)
    field = np.asarray(room.earth, float) + _dipole(
        chips @ rotation.T + T_b_t[:3, 3] - room.iron_place, DIPOLE_UT_M3 * np.asarray(room.iron_moment, float)
    )
    turned = field @ rotation
    induced = float(room.tool_iron_radius) ** 3 * turned.mean(0)
    return turned + _dipole(chips - room.tool_iron_place, induced)


def _dipole(away: Float[np.ndarray, "n 3"], moment: Float[np.ndarray, "3"]) -> Float[np.ndarray, "n 3"]:
    """Field (uT) of a dipole (uT m^3) at some distances (m) from it."""
    square = np.sum(away * away, axis=1, keepdims=True)
    return (3 * away * (away @ moment)[:, None] / square - moment) / square**1.5
