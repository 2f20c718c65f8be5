"""An object on a table as skin and camera meet it: the physics of `i2t.simulation.touches`, for a tool that moves in
time.

Along one line of approach (a pose of the tool and its z axis) everything that a press can do is found once: where the
skin first meets the object (`i2t.contact.approach`), and force, its centre and the reading at growing loads
(`i2t.skin.pad.press_force`), with the series compliance of arm and mount. In between is interpolated, so that a press
costs nothing in time. The skin neither rubs nor remembers, and an object is met only along a line on which the tool
stood still before: flange, mount and what is moved into sideways meet nothing. Everything here is simulated.
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

LINE_LENGTH_M = 0.12  # of a line on which the object is looked for
TABULATED_LOADS_N = np.geomspace(0.02, 60.0, 14)
LINE_TOLERANCE_M, LINE_TOLERANCE_RAD = 20e-6, 1e-4  # how far from its line a tool is still on it
ROOM_FIELD_UT = np.array([18.0, 7.0, 41.0])  # base axes: the Earth's about, in its southern half
STANDING_QUERIES = 3  # times that the same pose is asked for before the tool is taken to stand


class ContactLine(NamedTuple):
    """Contact of the skin on its way along its own z axis."""

    T_b_t: Array  # (4, 4) where the line begins
    first: float  # m from there to first contact, inf where there is none
    past_contact: Array  # (k,) m past it, from 0
    force: Array  # (k,) N
    centre: Array  # (k, 2) m, of the pressure, in the tool's x and y
    reading: Array  # (k, 3 chips) uT, without noise

    def distance_along(self, position: Array, turned: Array) -> float | None:
        """Distance of a pose along the line.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.

        Returns:
            m from the line's beginning, negative behind it; None off the line.
        """
        axis = self.T_b_t[:3, 2]
        away = position - self.T_b_t[:3, 3]
        along = float(away @ axis)
        off_line = away - along * axis
        if off_line @ off_line > LINE_TOLERANCE_M**2 or np.abs(turned - self.T_b_t[:3, :3]).max() > LINE_TOLERANCE_RAD:
            return None
        return along

    def covers(self, along: float) -> bool:
        """Test whether the contact ahead of a position on the line is known.

        The object is looked for only `LINE_LENGTH_M` ahead of the line's beginning: where nothing was found, more may
        come behind its end.

        Args:
            along: m, of the position from the line's beginning.

        Returns:
            True at the beginning, and further on where the line has a first contact.
        """
        begun = along >= -LINE_TOLERANCE_M
        return begun and bool(np.isfinite(self.first) or along <= LINE_TOLERANCE_M)

    def contact_at(self, along: float) -> tuple[float, Array, Array]:
        """Contact of the skin at a place of the line; beyond the last load that is known it goes on straight.

        Args:
            along: m from the line's beginning.

        Returns:
            Force (N), its centre (2,) m on the skin, and the reading (3 chips,) uT.
        """
        past = along - self.first
        if past <= 0:
            return 0.0, np.zeros(2), np.zeros(self.reading.shape[1])
        i = int(np.clip(np.searchsorted(self.past_contact, past), 1, len(self.past_contact) - 1))
        before, after = self.past_contact[i - 1 : i + 1]
        part = (past - before) / (after - before)
        force, reading = ((1 - part) * row[i - 1] + part * row[i] for row in (self.force, self.reading))
        return float(force), self.centre[i], reading


# Compiled once, whichever seed.
_draw_errors = jax.jit(sample_session_errors)


class ObjectScene:
    """An object that stands where it really is, not where the lab believes, and a pad that touches it.

    Args:
        mesh: Of the object.
        T_b_o: (4, 4) where the lab believes it.
        pad: That touches it.
        errors: Of the lab.
        stiffness: N/m, of arm and mount.
        seed: The same makes the same errors.
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
        self.T_t_camera = np.asarray(run.T_t_camera, float)  # where it looks from, seen from where the lab believes
        self.rest = np.asarray(pad.board.to_board(rest_field(pad)), float)  # (3 chips,) uT
        self._surface = jax.device_put(prepare_surface(mesh))
        self._random = np.random.default_rng(seed)
        placed = transform_mesh(mesh, self.T_b_o)
        self.triangles = np.concatenate([placed.vertices[placed.faces], table_triangles(np.asarray(T_b_o))])
        corners = placed.vertices
        self._middle = (corners.min(0) + corners.max(0)) / 2
        self._radius = float(np.linalg.norm(corners - self._middle, axis=1).max())

    def near(self, position: Array) -> bool:
        """Test whether the object may be within a line's reach.

        Args:
            position: (3,) m, in the base.

        Returns:
            False only where nothing can be met.
        """
        return float(np.linalg.norm(position - self._middle)) < self._radius + LINE_LENGTH_M

    def ahead(self, T_b_t: Array) -> ContactLine:
        """The line from a pose along tool z, with what the skin meets on it.

        Args:
            T_b_t: (4, 4) pose that the arm reports; the tool is off it by the arm's own errors.

        Returns:
            The line.
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
            past_contact=np.maximum.accumulate(past + 1e-9 * np.arange(len(past))),  # rounding must not turn it back
            force=np.append(0.0, TABULATED_LOADS_N),
            centre=np.concatenate([centre[:1], centre]).astype(float),
            reading=np.concatenate([np.zeros_like(reading[:1]), reading]).astype(float),
        )


@jax.jit
@full_precision
def _meet(surface: Surface, T_o_t: Array, pad: Pad, loads: Array) -> tuple[Array, Array, Array, Array]:
    """Distance (m) to first contact, and the depth (m), centre (m) and reading (uT) of each load."""
    (_, distance, hit), facing = meet(surface, T_o_t, before=0.0, beyond=LINE_LENGTH_M)
    # The cells of the pad meet a point between their middles a little late.
    first = jnp.where(hit, distance + facing.nearest, jnp.inf)

    def press(load: Array) -> tuple[Array, Array, Array]:
        pressed = press_force(pad, facing.depth, load)
        return pressed.indentation, centre_of_pressure(pressed.pressure, GRID), pressed.reading

    return first, *jax.lax.map(press, loads)


class ContactModel:
    """Contact of a skin on a moving tool, and the skin's reading.

    A line is worked out once the tool stands somewhere near the object; with `wait` False that happens in the
    background (it takes hundredths of a second), and until it is done, while it is `busy`, nothing is met. A board that
    is told by datagrams what the skin feels keeps the newest: the skin's own field at rest, the room's as the tool is
    turned, and what a press changes.

    Args:
        scene: What is touched.
        wait: Whether a line is worked out before the tool goes on.
        T_tool_skin: (4, 4) where the skin is; by default the tool's frame is its own.
        to: Where an emulated board listens.
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
        self.reading = np.zeros(scene.board.num_readings)  # uT, at the pose that was asked for last
        self._line: ContactLine | None = None
        self._coming: Future[ContactLine] | None = None
        self._beside = None if wait else ThreadPoolExecutor(1, "scene")
        self._seen: tuple[Array, Array] = (np.full(3, np.inf), np.zeros((3, 3)))
        self._times = 0
        self._to, self._sent = to, np.full(scene.board.num_readings, np.nan)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM) if to else None

    @property
    def busy(self) -> bool:
        """Tell whether a line is being worked out in the background."""
        return self._coming is not None

    def __call__(self, position: Array, turned: Array) -> Array:
        """Wrench (6,) on the tool about its own origin, at a pose of the tool, base axes."""
        self._look(position, turned)
        at, own_turned = self._skin_pose(position, turned)
        along = None if self._line is None else self._line.distance_along(at, own_turned)
        wrench = np.zeros(6)
        self.reading = np.zeros(self.scene.board.num_readings)
        if self._line is not None and along is not None:
            force, (x, y), self.reading = self._line.contact_at(along)
            wrench[:3] = own_turned @ [0.0, 0.0, -force]
            wrench[3:] = own_turned @ [-force * y, force * x, 0.0] + np.cross(at - position, wrench[:3])
        if self._to and self._socket:
            self._tell(self._socket, self._to, self.at_rest(turned) + self.reading)
        return wrench

    def at_rest(self, turned: Array) -> Array:
        """Reading of a skin that touches nothing: its own field and the room's.

        Args:
            turned: (3, 3) rotation of the tool in the base.

        Returns:
            (3 chips,) uT.
        """
        scene, field = self.scene, ROOM_FIELD_UT @ turned @ self.T_tool_skin[:3, :3]
        room = np.tile(field, (scene.board.num_chips, 1))
        return scene.rest + scene.gains * np.asarray(scene.board.to_board(room))

    def stands(self, position: Array, turned: Array) -> None:
        """Work out what is ahead of a tool that stands somewhere, unless that is known or nothing is near.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.
        """
        at, own_turned = self._skin_pose(position, turned)
        if not self.scene.near(at):
            return
        along = None if self._line is None else self._line.distance_along(at, own_turned)
        if self._line is not None and along is not None and self._line.covers(along):
            return
        T_b_s = transform(own_turned, at)
        if self._beside is None:
            self._line = self.scene.ahead(T_b_s)
        elif self._coming is None:
            self._coming = self._beside.submit(self.scene.ahead, T_b_s)
        else:
            self._times = 0  # ask again once the line before is known

    def _skin_pose(self, position: Array, turned: Array) -> tuple[Array, Array]:
        """Position (3,) m and rotation (3, 3) of the skin in the base, of those of the tool."""
        return position + turned @ self.T_tool_skin[:3, 3], turned @ self.T_tool_skin[:3, :3]

    def _tell(self, sender: socket.socket, to: Address, reading: Array) -> None:
        """Send a reading to the board, if it is another one."""
        if not np.array_equal(reading, self._sent):
            with contextlib.suppress(OSError):
                sender.sendto(struct.pack(f"<{len(reading)}f", *reading), to)
                self._sent = reading

    def _look(self, position: Array, turned: Array) -> None:
        if self._coming is not None and self._coming.done():
            self._line, self._coming = self._coming.result(), None
        same = bool((position == self._seen[0]).all() and (turned == self._seen[1]).all())
        self._times = self._times + 1 if same else 0
        self._seen = position, turned
        if self._times == STANDING_QUERIES:
            self.stands(position, turned)


class Contacts:
    """The contact of a tool with all its skins, whose forces add up, as an `i2t.emulators.robot_motion.Robot` asks.

    Args:
        models: Of the skins.
    """

    def __init__(self, models: Sequence[ContactModel]) -> None:
        self.models = list(models)

    @property
    def busy(self) -> bool:
        """Tell whether the contact ahead of a skin is being worked out."""
        return any(model.busy for model in self.models)

    def __call__(self, position: Array, turned: Array) -> Array:
        """Wrench (6,) on the tool at a pose, base axes."""
        return np.asarray(sum((model(position, turned) for model in self.models), start=np.zeros(6)))

    def stands(self, position: Array, turned: Array) -> None:
        """Work out what is ahead of each skin, as in `ContactModel.stands`."""
        for model in self.models:
            model.stands(position, turned)
