"""Skin, arm and depth camera of a lab that is not there, behind the protocols of the real ones.

    lab = Lab(Scene(mesh, T_b_o, pad, errors), Virtual())
    with SimulatedSkin(lab) as skin, SimulatedArm(lab, rig.limits) as arm: ...

All three live in one `Lab`, in whose time a tool moves (`i2t.emulators.robot_motion`) and meets an object
(`i2t.emulators.scene`). On a `Virtual` clock nobody waits: whoever would wait moves time on, and a touch of ten seconds
takes a fraction of one. On the clock of this machine it takes as long as in a lab. What the arm is told reaches it
`latency` seconds late, which is what a press runs past its limit by. They call themselves simulated.
"""

import threading
from collections import deque
from collections.abc import Callable
from typing import Any, SupportsIndex, TypeVar

import numpy as np

from i2t.depth.camera import Camera
from i2t.emulators.robot_motion import Robot
from i2t.emulators.scene import Feeler, Met, Scene, noisy, see, shades
from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.clock import Clock
from i2t.hardware.limits import Limits
from i2t.hardware.protocols import (
    ApproachResult,
    ArmFeatures,
    ArmState,
    CameraFeatures,
    Samples,
    SkinCounters,
    SkinFeatures,
    View,
)
from i2t.hardware.reskin.stream import CHANNELS
from i2t.hardware.ur.driver import BRAKE, from_ur, to_ur
from i2t.types import CHIPS, READINGS, Array

TICK = 2.5e-3  # s, of motion and of the skin's samples
LOOK = 3  # ticks between two looks at an arm that is watched
STATES = 125.0  # Hz
EARTH = (18.0, -7.0, -41.0)  # uT in tool axes
WARM, WARMTH = 24.6, 0.1  # degrees Celsius, and their noise
FAR = 3  # ticks that a tool far from everything moves at once
SLOW = 1.0  # s, after which the slow common field is another one; an assumption
BLOCK = 1024  # samples whose noise is drawn at once
IDLE = 60.0  # s: what nobody looked at for longer is left out
HOME = (0.4, 0.0, 0.3, np.pi, 0.0, 0.0)  # pose of the tool at the start: pointing down

D = TypeVar("D", bound="_Simulated")


class Virtual:
    """Time that passes only when somebody waits; `wall` is the Unix time at which it begins."""

    def __init__(self, wall: float) -> None:
        self._now, self._begun = 0.0, wall

    def now(self) -> float:
        """Seconds since it was made."""
        return self._now

    def wall(self) -> float:
        """Unix time (s)."""
        return self._begun + self._now

    def sleep(self, seconds: float) -> None:
        """Move on."""
        self._now += max(0.0, seconds)


class Lab:
    """A tool that moves in a scene, and its skin's samples, up to the clock's present."""

    def __init__(self, scene: Met, clock: Clock, seed: int = 0, feeler: Feeler | None = None) -> None:
        self.scene, self.clock, self.noise = scene, clock, scene.errors.noise
        self.feeler = feeler or Feeler(scene)
        self.robot = Robot(np.array(HOME), self.feeler, np.zeros(6), scene.errors.force)
        self.time = clock.now()
        self.lock = threading.RLock()
        self.samples: deque[tuple[int, float, Array, Array]] = deque(maxlen=4096)
        self.number = 0
        self.recording = False  # whether somebody holds the skin
        self._random = np.random.default_rng((seed, 1))
        self._rest = scene.rest + scene.board.to_board(np.tile(np.array(EARTH), (CHIPS, 1)))
        self._slow = np.zeros(3)
        steps = self.noise.steps(scene.board.num_chips)
        self._steps = np.where(steps > 0, steps, 1e-6)
        self._noise: list[tuple[Array, Array]] = []

    def catch_up(self) -> None:
        """Move tool and samples on to the present."""
        with self.lock:
            now = self.clock.now()
            self.time = max(self.time, now - IDLE)
            while self.time + TICK <= now:
                ticks = min(FAR if self.feeler.far(self.robot.position) else 1, max(1, int((now - self.time) / TICK)))
                if self.robot.motion is not None:
                    self.robot.step(ticks * TICK)
                self.robot.felt()
                for _ in range(ticks):
                    self.time += TICK
                    if self.recording:
                        self.samples.append((self.number, self.time, *self._sample()))
                        self.number += 1

    def _sample(self) -> tuple[Array, Array]:
        """A reading (15,) uT and temperatures (5,)."""
        if not self._noise:
            self._noise = self._draw()
        noise, celsius = self._noise.pop()
        reading = self._rest + self.feeler.reading + noise
        return np.rint(reading / self._steps) * self._steps, celsius

    def _draw(self) -> list[tuple[Array, Array]]:
        """Noise as `i2t.skin.noise` has it, but with a slow field that changes by and by."""
        size = self.noise
        drawn = self._random.standard_normal((BLOCK, READINGS + 3 + CHIPS))
        kept = np.exp(-TICK / SLOW)
        slow = np.empty((BLOCK, 3))
        for i, news in enumerate(np.sqrt(1 - kept**2) * drawn[:, READINGS : READINGS + 3]):
            self._slow = kept * self._slow + news
            slow[i] = self._slow
        slow *= np.sqrt(size.common) * np.array([size.xy, size.xy, size.z])
        white = size.sigma(CHIPS) * np.sqrt(1 - size.common) * drawn[:, :READINGS]
        noise = white + self.scene.board.to_board(np.repeat(slow[:, None], CHIPS, axis=1))
        celsius = WARM + WARMTH * (size.xy > 0) * drawn[:, READINGS + 3 :]
        return list(zip(noise, celsius, strict=True))


class _Simulated:
    """What the devices of a lab share."""

    def __init__(self, lab: Lab, name: str) -> None:
        self.lab, self._name = lab, name
        self._trouble: DeviceError | None = NotConnectedError(f"{name} is not connected; call connect() or use with")

    def connect(self) -> None:
        """Start it."""
        self._trouble = None

    def close(self) -> None:
        """Let it go."""
        self._trouble = NotConnectedError(f"{self._name} was closed; connect it again")

    def __enter__(self: D) -> D:
        self.connect()
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def _check(self) -> None:
        if self._trouble is not None:
            raise type(self._trouble)(*self._trouble.args)
        self.lab.catch_up()


class SimulatedSkin(_Simulated):
    """A skin (`i2t.hardware.protocols.Skin`) at 400 Hz. `silent` makes it fall silent, for rehearsals."""

    def __init__(self, lab: Lab) -> None:
        super().__init__(lab, "the simulated skin")
        self.silent = False
        self._connects = 0

    @property
    def features(self) -> SkinFeatures:
        """Known before `connect`."""
        return SkinFeatures(self._name, "simulated", CHANNELS, "uT", 1 / TICK)

    @property
    def counters(self) -> SkinCounters:
        """So far; nothing is ever lost."""
        rate = 1 / TICK if self._trouble is None else 0.0
        return SkinCounters(samples=self.lab.number, connects=self._connects, rate=rate)

    def connect(self) -> None:
        """Begin to send; the past is not sent."""
        with self.lab.lock:
            self.lab.catch_up()
            self.lab.recording = True
        self._connects += 1
        super().connect()
        self.read(1)

    def close(self) -> None:
        """Stop sending."""
        self.lab.recording = False
        super().close()

    def latest(self, timeout: float = 0.4) -> Samples:
        """The newest sample, one row; raises DeviceTimeoutError if it is older than `timeout`."""
        self._check()
        with self.lab.lock:
            age = self.lab.clock.now() - self.lab.samples[-1][1]
            if age > timeout:
                raise DeviceTimeoutError(f"{self._name} has been silent for {age:.2g} s")
            return _rows([self.lab.samples[-1]])

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """The next `count` samples."""
        if not 0 < count <= 4096:
            raise ValueError(f"{count} samples were asked for; the queue holds 1 to 4096")
        self._check()
        called, before = self.lab.clock.now(), self.lab.number - 1
        timeout = 2 * count * TICK + 0.5 if timeout is None else timeout
        while True:
            self._check()
            with self.lab.lock:
                got = [row for row in self._after(before) if row[1] > called][:count]
            if len(got) == count:
                return _rows(got)
            if self.lab.clock.now() - called >= timeout:
                raise DeviceTimeoutError(f"{self._name} gave {len(got)} of {count} samples in {timeout:.2g} s")
            self.lab.clock.sleep(min((count - len(got)) * TICK, timeout))

    def since(self, number: SupportsIndex) -> Samples:
        """Samples after sample `number` that are still queued."""
        self._check()
        with self.lab.lock:
            return _rows(self._after(int(number)))

    def _after(self, number: int) -> list[tuple[int, float, Array, Array]]:
        if self.silent:
            self.lab.recording = False
        rows = []
        for row in reversed(self.lab.samples):
            if row[0] <= number:
                break
            rows.append(row)
        return rows[::-1]


class SimulatedArm(_Simulated):
    """An arm (`i2t.hardware.protocols.Arm`) with guarded approaches, as `i2t.hardware.ur.driver.UR` has them.

    What it is told to do while it moves reaches it `latency` (s) late.
    """

    def __init__(self, lab: Lab, limits: Limits, latency: float = 0.03) -> None:
        super().__init__(lab, "the simulated arm")
        self.limits, self.latency = limits, latency

    @property
    def features(self) -> ArmFeatures:
        """Known before `connect`."""
        box = np.array([self.limits.lower, self.limits.upper], float)
        return ArmFeatures(self._name, "simulated", STATES, box, self.limits.speed, self.limits.acceleration)

    def connect(self) -> None:
        """Take it."""
        super().connect()
        self.lab.catch_up()

    def close(self) -> None:
        """Stop it and let it go."""
        with self.lab.lock:
            self.lab.robot.stop(BRAKE)
        super().close()

    def state(self, timeout: float = 0.1) -> ArmState:
        """The present state."""
        self._check()
        with self.lab.lock:
            robot = self.lab.robot
            wrench = robot.measured().reshape(2, 3) @ robot.turned
            T_b_t = np.eye(4)
            T_b_t[:3, :3], T_b_t[:3, 3] = robot.turned, robot.position
            return ArmState(
                self.lab.time,
                T_b_t,
                np.zeros(6),
                robot.twist,
                wrench.ravel(),
                robot.motion is not None,
                True,
            )

    def move(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> Array:
        """Start a straight motion; one under way is replaced."""
        self._check()
        speed = self.limits.speed if speed is None else speed
        acceleration = self.limits.acceleration if acceleration is None else acceleration
        self.limits.check(T_b_t, speed, acceleration)
        if self.lab.robot.motion is not None:
            self.stop()
        with self.lab.lock:
            robot = self.lab.robot
            self.lab.feeler.stands(robot.position, robot.turned)  # however short it stood
            robot.line_to(np.array(to_ur(T_b_t)), speed, acceleration)
        return from_ur(to_ur(T_b_t))

    def stop(self, timeout: float = 1.0) -> None:
        """Brake and return when it stands."""
        self._check()
        with self.lab.lock:
            self.lab.robot.stop(BRAKE)
        for _ in range(round(timeout / TICK)):
            if not self.state().moving:
                return
            self.lab.clock.sleep(TICK)
        raise DeviceError(f"{self._name} was not seen to stop within {timeout:g} s")

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Take the wrench felt now as zero."""
        if self.state().moving:
            raise DeviceError("The wrench can be zeroed only while the arm stands.")
        robot = self.lab.robot
        robot.zero = robot.felt() + robot.bias

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move straight to a pose and return the state at rest; raises DeviceError if something is in the way."""
        felt = float(np.linalg.norm(self.state().wrench[:3]))
        self.move(T_b_t, speed, acceleration)
        while True:
            self.lab.clock.sleep(LOOK * TICK)
            state = self.state()
            force = float(np.linalg.norm(state.wrench[:3]))
            if not state.moving:
                return state
            if force > max(self.limits.force, 1.1 * felt):
                self.stop()
                raise DeviceError(f"The arm met something on its way ({force:.1f} N) and was stopped.")

    def approach(
        self,
        travel: float,
        speed: float = 0.005,
        verdict: Callable[[ArmState], Any] | None = None,
        force: float = 8.0,
        torque: float = 8.0,
        acceleration: float = 0.2,
    ) -> ApproachResult:
        """Move along the tool's z axis until something says stop."""
        self.limits.check_approach(travel, force, torque)
        start = self.state().T_b_t
        goal = start.copy()
        goal[:3, 3] += travel * goal[:3, 2]
        self.move(goal, speed, acceleration)
        reason: Any = "travel"
        said: Any = None
        try:
            while True:
                self.lab.clock.sleep(LOOK * TICK)
                trigger = self.state()
                if not trigger.moving:
                    break
                said = verdict(trigger) if verdict is not None else None
                size = np.linalg.norm(trigger.wrench.reshape(2, 3), axis=1)
                reason = "force" if size[0] > force else "torque" if size[1] > torque else "verdict" if said else reason
                if reason != "travel":
                    break
        finally:
            if self.lab.robot.motion is not None:
                self.lab.clock.sleep(self.latency)
                self.lab.catch_up()
                self.stop()
        state = self.state()
        moved = float(np.linalg.norm(state.T_b_t[:3, 3] - start[:3, 3]))
        return ApproachResult(reason, said, trigger, state, moved)


class SimulatedCamera:
    """A depth camera (`i2t.hardware.protocols.DepthCamera`) on a tool, of which `pose` tells T_b_t: of a simulated arm,
    or of any other that moves in the scene.
    """

    def __init__(
        self, scene: Scene, camera: Camera, T_t_c: Array, pose: Callable[[], Array], clock: Clock, seed: int = 0
    ) -> None:
        self._scene, self._camera, self._pose, self._clock = scene, camera, pose, clock
        self._T_t_c = scene.T_t_camera @ np.asarray(T_t_c)
        self._random = np.random.default_rng((seed, 2))
        self._open = False

    @property
    def features(self) -> CameraFeatures:
        """Known before `connect`."""
        return CameraFeatures("the simulated camera", "simulated", 0.03, 30.0)

    @property
    def camera(self) -> Camera:
        """Size and lens."""
        return self._camera

    def connect(self) -> None:
        """Switch it on."""
        self._open = True

    def close(self) -> None:
        """Switch it off."""
        self._open = False

    def __enter__(self) -> "SimulatedCamera":
        self.connect()
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def capture(self, timeout: float = 2.0) -> View:
        """A view from where the tool is now."""
        if not self._open:
            raise NotConnectedError("the simulated camera is not connected; call connect() or use with")
        self._clock.sleep(1 / self.features.rate)
        T_b_c = self._pose() @ self._T_t_c
        depth, which = see(self._scene.triangles, T_b_c, self._camera)
        colour = shades(self._scene.triangles, which, T_b_c)
        return View(self._clock.now(), noisy(depth, self._scene.errors, self._random), colour)


def _rows(rows: list[tuple[int, float, Array, Array]]) -> Samples:
    return Samples(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows], np.float64),
        np.array([row[2] for row in rows], np.float64).reshape(len(rows), READINGS),
        np.array([row[3] for row in rows], np.float64).reshape(len(rows), CHIPS),
    )
