"""A springy plane as a scene: everything about its contacts is known in closed form."""

import numpy as np

from i2t.emulators.scene import LINE_LENGTH_M, ContactLine, ObjectScene
from i2t.simulation.depth_camera import table_triangles
from i2t.simulation.touches import SimulationErrors
from i2t.types import Array, Board

SEEN_AT_M = (0.4, 0.0)  # middle of what a camera sees of the plane, below the tool's first pose
TABLES_SEEN = 5  # times as wide as a table


class SpringPlane(ObjectScene):
    """A horizontal plane that pushes back like a spring: everything about it is known in closed form.

    Args:
        height: m, in the base.
        stiffness: N/m, with arm and mount in it.
        gain: (3 chips,) uT/N, by which each newton changes the reading.
        errors: Errors of the lab.
        board: Board of the skin.
    """

    def __init__(self, height: float, stiffness: float, gain: Array, errors: SimulationErrors, board: Board) -> None:
        self.height, self.stiffness, self.gain = height, stiffness, gain
        self.errors, self.board = errors, board
        self.rest, self.gains = np.zeros(board.num_readings), np.ones(board.num_readings)
        self.triangles = TABLES_SEEN * table_triangles(np.eye(4)) + np.array([*SEEN_AT_M, height])
        self.T_t_camera = np.eye(4)

    def is_near(self, position: Array) -> bool:
        return bool(abs(position[2] - self.height) < LINE_LENGTH_M)

    def line_ahead(self, T_b_t: Array) -> ContactLine:
        down = -T_b_t[2, 2]
        first = (T_b_t[2, 3] - self.height) / down if down > 0 else np.inf
        force = np.array([0.0, 1.0])
        return ContactLine(
            T_b_t=T_b_t,
            first=float(first),
            past_contact=force / self.stiffness,
            force=force,
            centre=np.zeros((2, 2)),
            reading=force[:, None] * self.gain[None],
        )
