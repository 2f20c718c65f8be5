"""An object on a table as skin and camera meet it: the physics of `i2t.simulation.touches`, for a tool that moves in
time.

Along a line of approach (a pose of the tool and its z axis), the whole press is computed in advance: first contact
(`i2t.contact.approach`), and force, its centre and the reading at growing loads (`i2t.skin.pad.press_force`), with the
series compliance of arm and mount. Values in between are interpolated, so that a press costs no computing time. The
skin has neither friction nor hysteresis. An object is met only along a line on which the tool stood still before:
flange, mount and sideways motions meet nothing. Everything here is simulated.
"""

import contextlib
import socket
import struct
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from i2t.contact.approach import meet
from i2t.contact.pressure import centre_of_pressure
from i2t.emulators.processes import Address
from i2t.geometry import full_precision, inverse, so3_exp, transform
from i2t.objects.solids import Mesh, transform_mesh
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M
from i2t.rendering.render import prepare_surface
from i2t.simulation.depth_camera import table_triangles
from i2t.simulation.touches import SimulationErrors, sample_session_errors
from i2t.skin.contact import GRID
from i2t.skin.dipoles import rest_field
from i2t.skin.pad import press_force
from i2t.types import Array, Board, Pad, Surface

LINE_LENGTH_M = 0.12  # m, length of the line along tool z on which the emulated scene searches for the object
LINE_TOLERANCE_M = 20e-6  # m, largest distance of the tool from its line of contact at which the line is still used
# N, loads at which the contact of the skin with the object is computed; others are interpolated
TABULATED_LOADS_N = np.geomspace(0.02, 60.0, 14)
# uT, ambient field in base axes: about the Earth's field on the southern hemisphere
ROOM_FIELD_UT = np.array([18.0, 7.0, 41.0])


class ContactLine(NamedTuple):
    """Simulated contact of a skin that moves along its own z axis: distance (m) to first contact, and a table.

    The table holds force (N), centre of pressure (m) and reading (uT) by travel past first contact (m).
    """

    T_b_t: Array  # (4, 4) pose at the beginning of the line
    first: float  # m, distance from the beginning of the line to first contact; inf if there is none
    past_contact: Array  # (k,) m, tabulated travel past first contact, from 0
    force: Array  # (k,) N, force at each tabulated travel
    centre: Array  # (k, 2) m, centre of pressure in the tool's x and y
    reading: Array  # (k, 3 chips) uT, reading at each tabulated travel, without noise

    def distance_along(self, position: Array, rotation: Array) -> float | None:
        """Compute how far along the line a tool pose is.

        Args:
            position: `(3,)` position (m) of the tool in the base.
            rotation: `(3, 3)` rotation of the tool in the base.

        Returns:
            Distance (m) from the line's beginning, negative behind it; None for a pose off the line.
        """
        axis = self.T_b_t[:3, 2]
        away = position - self.T_b_t[:3, 3]
        along = float(away @ axis)
        off_line = away - along * axis
        if off_line @ off_line > LINE_TOLERANCE_M**2 or np.abs(rotation - self.T_b_t[:3, :3]).max() > 1e-4:
            return None
        return along

    def covers(self, along: float) -> bool:
        """Test whether the contact ahead of a position on the line is known.

        The object is searched only up to `LINE_LENGTH_M` from the line's beginning. If nothing was met, contact is
        possible beyond its end.

        Args:
            along: Distance (m) of the position from the line's beginning.

        Returns:
            True at the beginning, and further on if the line has a first contact.
        """
        begun = along >= -LINE_TOLERANCE_M
        return begun and bool(np.isfinite(self.first) or along <= LINE_TOLERANCE_M)

    def contact_at(self, along: float) -> tuple[float, Array, Array]:
        """Interpolate force and reading of the skin at a position on the line.

        Beyond the last tabulated load, both are extrapolated linearly. The centre is that of the next tabulated load.

        Args:
            along: Distance (m) of the position from the line's beginning.

        Returns:
            Force (N), its centre `(2,)` (m) in the skin's x and y, and the change of the reading `(3 chips,)` (uT).
        """
        past = along - self.first
        if past <= 0:
            return 0.0, np.zeros(2), np.zeros(self.reading.shape[1])
        i = int(np.clip(np.searchsorted(self.past_contact, past), 1, len(self.past_contact) - 1))
        before, after = self.past_contact[i - 1 : i + 1]
        part = (past - before) / (after - before)
        force, reading = ((1 - part) * row[i - 1] + part * row[i] for row in (self.force, self.reading))
        return float(force), self.centre[i], reading


# Compiled once for all seeds.
_draw_errors = jax.jit(sample_session_errors)


class ObjectScene:
    """A simulated object and the pad that touches it; the object's true pose differs from the assumed one.

    Args:
        mesh: Mesh of the object.
        T_b_o: `(4, 4)` assumed pose of the object.
        pad: Pad that touches the object.
        errors: Sizes of the errors of poses, sensors and camera in the lab.
        stiffness: Stiffness (N/m) of arm and mount.
        seed: Seed with which the errors are drawn.
    """

    def __init__(
        self,
        mesh: Mesh,
        T_b_o: Array,
        pad: Pad,
        errors: SimulationErrors,
        stiffness: float = ARM_STIFFNESS_N_PER_M,
        seed: int = 0,
    ) -> None:
        self.gains = np.asarray(pad.gains, float)
        run = _draw_errors(jax.random.key(seed), errors)
        self.pad, self.errors, self.stiffness = pad, errors, stiffness
        self.board = Board(*(np.asarray(part, float) for part in pad.board))
        self.T_b_o = np.asarray(T_b_o) @ np.asarray(run.T_o_placed, float)
        self.T_t_camera = np.asarray(run.T_t_camera, float)  # true pose of the camera in the assumed one
        self.rest = np.asarray(pad.board.to_board(rest_field(pad)), float)  # (3 chips,) uT
        self._surface = jax.device_put(prepare_surface(mesh))
        self._random = np.random.default_rng(seed)
        placed = transform_mesh(mesh, self.T_b_o)
        self.triangles = np.concatenate([placed.vertices[placed.faces], table_triangles(np.asarray(T_b_o))])
        corners = placed.vertices
        self._middle = (corners.min(0) + corners.max(0)) / 2
        self._radius = float(np.linalg.norm(corners - self._middle, axis=1).max())

    def is_near(self, position: Array) -> bool:
        """Test whether the object may be near enough to be met from a position.

        Args:
            position: `(3,)` position (m) of the tool in the base.

        Returns:
            False only if nothing can be met from there.
        """
        return float(np.linalg.norm(position - self._middle)) < self._radius + LINE_LENGTH_M

    def line_ahead(self, T_b_t: Array) -> ContactLine:
        """Compute the contact of the skin on the line from a tool pose along tool z.

        Args:
            T_b_t: `(4, 4)` pose that the arm reports; the tool deviates from it by the arm's own errors.

        Returns:
            The line from that pose.
        """
        off = np.eye(4)
        off[:3, 3] = self.errors.repeatability * self._random.standard_normal(3)
        off[:3, :3] = so3_exp(self.errors.approach_angle * self._random.standard_normal(3))
        T_o_t = inverse(self.T_b_o) @ T_b_t @ off
        first, past_contact, centre, reading = jax.device_get(
            _meet(self._surface, jnp.asarray(T_o_t, jnp.float32), self.pad, jnp.asarray(TABULATED_LOADS_N, jnp.float32))
        )
        past = np.append(0.0, past_contact + TABULATED_LOADS_N / self.stiffness)
        return ContactLine(
            T_b_t=np.array(T_b_t),
            first=float(first),
            past_contact=np.maximum.accumulate(past + 1e-9 * np.arange(len(past))),  # stays ascending despite rounding
            force=np.append(0.0, TABULATED_LOADS_N),
            centre=np.concatenate([centre[:1], centre]).astype(float),
            reading=np.concatenate([np.zeros_like(reading[:1]), reading]).astype(float),
        )


@jax.jit
@full_precision
def _meet(surface: Surface, T_o_t: Array, pad: Pad, loads: Array) -> tuple[Array, Array, Array, Array]:
    """Compute the distance (m) to first contact, and the indentation (m), centre (m) and reading (uT) of each load."""
    (_, distance, hit), facing = meet(surface, T_o_t, before=0.0, beyond=LINE_LENGTH_M)
    # A point between the centres of the pad's cells is met slightly late.
    first = jnp.where(hit, distance + facing.nearest, jnp.inf)

    def press(load: Array) -> tuple[Array, Array, Array]:
        pressed = press_force(pad, facing.depth, load)
        return pressed.indentation, centre_of_pressure(pressed.pressure, GRID), pressed.reading

    return first, *jax.lax.map(press, loads)


class SkinContactModel:
    """Simulated contact force on a skin of a moving tool, and the skin's reading.

    The contact along the line ahead of the tool is computed once the tool stands still near the object. With `wait`
    False, that happens in the background (it takes hundredths of a second); until it is done, while the model is
    `busy`, nothing is met. An emulated board receives the reading by datagrams and keeps the newest: the sum of the
    skin's own field, the room's field in the tool's orientation, and the change by a press.

    Args:
        scene: Scene with the object and the pad.
        wait: Whether the tool waits until the contact ahead of it is computed.
        T_tool_skin: `(4, 4)` pose of the skin on the tool; by default the tool's frame.
        to: UDP address of an emulated board that receives the readings; None sends none.
    """

    def __init__(
        self,
        scene: ObjectScene,
        wait: bool = True,
        T_tool_skin: Array | None = None,
        to: Address | None = None,
    ) -> None:
        self.scene = scene
        self.T_tool_skin = np.eye(4) if T_tool_skin is None else np.asarray(T_tool_skin, float)
        self.reading = np.zeros(scene.board.num_readings)  # uT, at the last pose
        self._line: ContactLine | None = None
        self._pending: Future[ContactLine] | None = None
        self._executor = None if wait else ThreadPoolExecutor(1, "scene")
        self._last_pose: tuple[Array, Array] = (np.full(3, np.inf), np.zeros((3, 3)))
        self._repeats = 0
        # line, wrench and board's reading at the last pose, used again while the tool stands still
        self._last_contact: tuple[ContactLine | None, Array, Array] | None = None
        self._to, self._sent = to, np.full(scene.board.num_readings, np.nan)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM) if to else None

    @property
    def busy(self) -> bool:
        """Whether the contact ahead of the tool is being computed in the background."""
        return self._pending is not None

    def __call__(self, position: Array, rotation: Array) -> Array:
        """Compute the wrench (6,) on the tool about the tool's origin at a pose of the tool: N and Nm, in base axes."""
        moved = self._follow(position, rotation)
        if moved or self._last_contact is None or self._last_contact[0] is not self._line:
            wrench = self._press(position, rotation)
            self._last_contact = self._line, wrench, self.reading_at_rest(rotation) + self.reading
        _, wrench, reading = self._last_contact
        if self._to and self._socket:
            self._send(self._socket, self._to, reading)
        return wrench.copy()

    def _press(self, position: Array, rotation: Array) -> Array:
        """Compute the wrench (6,) on the tool as in `__call__`, and store the change of the skin's reading."""
        skin_position, skin_rotation = self._skin_pose(position, rotation)
        along = None if self._line is None else self._line.distance_along(skin_position, skin_rotation)
        wrench = np.zeros(6)
        self.reading = np.zeros(self.scene.board.num_readings)
        if self._line is not None and along is not None:
            force, (x, y), self.reading = self._line.contact_at(along)
            wrench[:3] = skin_rotation @ [0.0, 0.0, -force]
            wrench[3:] = skin_rotation @ [-force * y, force * x, 0.0] + np.cross(skin_position - position, wrench[:3])
        return wrench

    def reading_at_rest(self, rotation: Array) -> Array:
        """Compute the reading of a skin without contact: its own field and the room's.

        Args:
            rotation: `(3, 3)` rotation of the tool in the base.

        Returns:
            `(3 chips,)` reading (uT).
        """
        scene, field = self.scene, ROOM_FIELD_UT @ rotation @ self.T_tool_skin[:3, :3]
        room = np.tile(field, (scene.board.num_chips, 1))
        return scene.rest + scene.gains * np.asarray(scene.board.to_board(room))

    def look_ahead(self, position: Array, rotation: Array) -> None:
        """Compute the contact ahead of a tool that stands still, unless it is known or the object is far away.

        Args:
            position: `(3,)` position (m) of the tool in the base.
            rotation: `(3, 3)` rotation of the tool in the base.
        """
        skin_position, skin_rotation = self._skin_pose(position, rotation)
        if not self.scene.is_near(skin_position):
            return
        along = None if self._line is None else self._line.distance_along(skin_position, skin_rotation)
        if self._line is not None and along is not None and self._line.covers(along):
            return
        T_b_s = transform(skin_rotation, skin_position)
        if self._executor is None:
            self._line = self.scene.line_ahead(T_b_s)
        elif self._pending is None:
            self._pending = self._executor.submit(self.scene.line_ahead, T_b_s)
        else:
            self._repeats = 0  # try again once the pending line is known

    def _skin_pose(self, position: Array, rotation: Array) -> tuple[Array, Array]:
        """Compute the position (3,) m and rotation (3, 3) of the skin in the base from those of the tool."""
        return position + rotation @ self.T_tool_skin[:3, 3], rotation @ self.T_tool_skin[:3, :3]

    def _send(self, sender: socket.socket, to: Address, reading: Array) -> None:
        """Send a reading to the board, unless it was sent before."""
        if not (reading is self._sent or np.array_equal(reading, self._sent)):
            with contextlib.suppress(OSError):
                sender.sendto(struct.pack(f"<{len(reading)}f", *reading), to)
                self._sent = reading

    def _follow(self, position: Array, rotation: Array) -> bool:
        """Look ahead of a tool that has stopped; return whether the tool has moved."""
        if self._pending is not None and self._pending.done():
            self._line, self._pending = self._pending.result(), None
        same = bool((position == self._last_pose[0]).all() and (rotation == self._last_pose[1]).all())
        self._repeats = self._repeats + 1 if same else 0
        self._last_pose = position, rotation
        if self._repeats == 3:  # the tool is taken to stand still
            self.look_ahead(position, rotation)
        return not same


class ToolContactModel:
    """Simulated contact wrench on a tool with several skins, whose forces add up; an `i2t.emulators.robot_motion.Robot`
    calls it.

    Args:
        models: Contact models of the skins on the tool.
    """

    def __init__(self, models: Sequence[SkinContactModel]) -> None:
        self.models = list(models)

    @property
    def busy(self) -> bool:
        """Whether the contact ahead of a skin is being computed."""
        return any(model.busy for model in self.models)

    def __call__(self, position: Array, rotation: Array) -> Array:
        """Compute the wrench (6,) on the tool about its origin at a pose: N and Nm, in base axes."""
        return np.asarray(sum((model(position, rotation) for model in self.models), start=np.zeros(6)))

    def look_ahead(self, position: Array, rotation: Array) -> None:
        """Compute the contact ahead of each skin, as in `SkinContactModel.look_ahead`."""
        for model in self.models:
            model.look_ahead(position, rotation)
