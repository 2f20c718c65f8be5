"""Simulated skin, arm and depth camera of a lab, behind the protocols of the real ones.

    lab = SimulatedLab(ObjectScene(mesh, T_b_o, pad, errors), VirtualClock())
    with SimulatedSkin(lab) as skin, SimulatedArm(lab, rig.limits) as arm: ...

All three share one `SimulatedLab`, in whose time a tool moves (`i2t.emulators.robot_motion`) and touches an object
(`i2t.emulators.scene`). On a `VirtualClock`, a wait advances the time at once, and a touch of ten seconds takes a
fraction of one. On the clock of this machine, it takes as long as in a lab. A command reaches the arm `latency` seconds
late, which makes a press run past its limit. All devices declare themselves as simulated.
"""

import threading
from collections import deque
from collections.abc import Callable

import numpy as np

from i2t.depth.camera import Camera
from i2t.emulators.robot_motion import Robot
from i2t.emulators.scene import ObjectScene, SkinContactModel, ToolContactModel
from i2t.errors import NotConnectedError
from i2t.geometry import transform
from i2t.hardware.base import CameraBase
from i2t.hardware.clock import Clock
from i2t.hardware.guarded import PolledArm
from i2t.hardware.limits import SAFETY
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.poses import pose_to_vector
from i2t.hardware.protocols import (
    ArmState,
    CameraFeatures,
    SkinCounters,
    SkinFeatures,
    View,
    channel_names,
)
from i2t.hardware.skin_stream import QueuedSkin, StreamConfig, StreamRow
from i2t.simulation.depth_camera import add_depth_noise, render_view, shade_view
from i2t.types import Array

TICK_S = 2.5e-3  # s, period at which the emulated arm moves and the emulated skin is sampled
SLOW_FIELD_S = 1.0  # s, assumed correlation time of the slow ambient field that all chips of the emulated skin share


class VirtualClock:
    """Clock of a simulation, whose time passes only while a caller waits.

    Args:
        wall: Unix time (s) at which the clock begins.
    """

    def __init__(self, wall: float) -> None:
        self._now, self._begun = 0.0, wall

    def now(self) -> float:
        """Return the time (s) since the clock was made."""
        return self._now

    def wall(self) -> float:
        """Return the Unix time (s) of the simulation."""
        return self._begun + self._now

    def sleep(self, seconds: float) -> None:
        """Advance the time at once, as in `Clock.sleep`."""
        self._now += max(0.0, seconds)


class SkinInLab:
    """A simulated skin on the tool of a `SimulatedLab`, which records noisy samples at 400 Hz.

    Args:
        scene: Scene with the object that the skin touches.
        T_tool_skin: `(4, 4)` pose (m) of the skin on the tool; by default the tool's frame.
        seed: Seed of the noise.
    """

    def __init__(self, scene: ObjectScene, T_tool_skin: Array | None = None, seed: int = 0) -> None:
        self.scene, self.contact_model = scene, SkinContactModel(scene, T_tool_skin=T_tool_skin)
        self.samples: deque[StreamRow] = deque(maxlen=StreamConfig.queue_samples)
        self.number = 0
        self.recording = False  # whether the skin is connected
        self._random = np.random.default_rng((seed, 1))
        self._slow = np.zeros(3)
        steps = scene.errors.noise.steps(scene.board.num_chips)
        self._steps = np.where(steps > 0, steps, 1e-6)
        self._noise: list[tuple[Array, Array]] = []

    def measure(self, now: float, rotation: Array) -> None:
        """Record one sample of the skin, if it is connected.

        Args:
            now: Time (s) of the sample.
            rotation: `(3, 3)` rotation of the tool in the base.
        """
        if not self.recording:
            return
        if not self._noise:
            self._noise = self._draw()
        noise, celsius = self._noise.pop()
        reading = self.contact_model.reading_at_rest(rotation) + self.contact_model.reading + noise
        self.samples.append(StreamRow(self.number, now, np.rint(reading / self._steps) * self._steps, celsius))
        self.number += 1

    def _draw(self) -> list[tuple[Array, Array]]:
        """Draw noise as in `i2t.skin.noise`, but with a slow field that changes gradually."""
        size, board = self.scene.errors.noise, self.scene.board
        chips, channels = board.num_chips, board.num_readings
        block = 1024  # samples whose noise is drawn at once
        drawn = self._random.standard_normal((block, channels + 3 + chips))
        kept = np.exp(-TICK_S / SLOW_FIELD_S)
        slow = np.empty((block, 3))
        for i, news in enumerate(np.sqrt(1 - kept**2) * drawn[:, channels : channels + 3]):
            self._slow = kept * self._slow + news
            slow[i] = self._slow
        slow *= np.sqrt(size.common) * np.array([size.xy, size.xy, size.z])
        white = size.sigma(chips) * np.sqrt(1 - size.common) * drawn[:, :channels]
        noise = white + board.to_board(np.repeat(slow[:, None], chips, axis=1))
        celsius = 24.6 + 0.1 * (size.xy > 0) * drawn[:, channels + 3 :]
        return list(zip(noise, celsius, strict=True))


class SimulatedLab:
    """Simulation of a robot's tool that moves and touches an object, and of the samples of the skins on it.

    Args:
        scene: Scene with the object that the tool touches.
        clock: Clock up to whose time the simulation advances.
        seed: Seed of the noise.
    """

    def __init__(self, scene: ObjectScene, clock: Clock, seed: int = 0) -> None:
        self.scene, self.clock = scene, clock
        self.skins = [SkinInLab(scene, seed=seed)]  # the first is the pressing skin
        self.contacts = ToolContactModel([self.skins[0].contact_model])
        home = np.array([0.4, 0.0, 0.3, np.pi, 0.0, 0.0])  # m and rotation vector: pointing down
        self.robot = Robot(home, self.contacts, scene.errors.force)
        self.time = clock.now()
        self.lock = threading.RLock()

    def carry(self, skin: SkinInLab) -> SkinInLab:
        """Add a further skin to the tool, whose contact also pushes the tool.

        Args:
            skin: The skin, with the scene that it touches.

        Returns:
            The same skin, for convenience.
        """
        self.skins.append(skin)
        self.contacts.models.append(skin.contact_model)
        return skin

    def advance(self) -> None:
        """Advance the tool's motion and the skins' samples to the clock's present time, by the last 60 s at most."""
        with self.lock:
            now = self.clock.now()
            self.time = max(self.time, now - 60.0)  # a longer time without queries is skipped
            while self.time + TICK_S <= now:
                self.time += TICK_S
                if self.robot.motion is not None:
                    self.robot.step(TICK_S)
                self.robot.wrench()
                for skin in self.skins:
                    skin.measure(self.time, self.robot.rotation)


class SimulatedSkin(QueuedSkin):
    """A simulated skin with the interface of a real one (`i2t.hardware.protocols.Skin`).

    Setting `silent` ends its samples.

    Args:
        lab: Simulation of the tool that carries the skin.
        skin: One of the lab's skins; by default the pressing one.
    """

    def __init__(self, lab: SimulatedLab, skin: SkinInLab | None = None) -> None:
        self.lab, self.in_lab = lab, lab.skins[0] if skin is None else skin
        self.board = self.in_lab.scene.board
        channels = channel_names(self.board.num_chips)
        features = SkinFeatures("the simulated skin", "simulated", channels, "uT", 1 / TICK_S)
        super().__init__(features, self.in_lab.samples, lab.clock, lab.lock)
        self.silent = self._open = False
        self._connects = 0

    @property
    def counters(self) -> SkinCounters:
        """Counts of samples and connections since the skin was made; no sample is ever lost."""
        rate = 1 / TICK_S if self._open else 0.0
        return SkinCounters(samples=self.in_lab.number, connects=self._connects, rate=rate)

    def connect(self) -> None:
        """Start sending samples, and wait for the first one."""
        with self.lab.lock:
            self.lab.advance()
            self.in_lab.recording = self._open = True
        self._connects += 1
        self.read(1)

    def close(self) -> None:
        """Stop sending samples."""
        self.in_lab.recording = self._open = False

    def _check(self) -> None:
        if not self._open:
            raise NotConnectedError(f"{self._name} is not connected; call connect() or use with")

    def _catch_up(self) -> None:
        if self._open:
            self.lab.advance()
        if self.silent:
            self.in_lab.recording = False


class SimulatedArm(PolledArm):
    """A simulated arm with the interface of a real one (`i2t.hardware.protocols.GuardedArm`).

    Args:
        lab: Simulation of the tool that the arm moves.
        limits: Limits of every motion.
        latency: Delay (s) between a command to brake and braking.
    """

    name, source = "the simulated arm", "simulated"
    rate, poll_s, start_s = 125.0, 3 * TICK_S, 0.0

    def __init__(self, lab: SimulatedLab, limits: MotionLimits, latency: float = 0.03) -> None:
        super().__init__(limits, lab.clock)
        self.lab, self.latency = lab, latency

    def read_state(self) -> ArmState:
        """Return the simulated arm's present state, which is always safe and whose joint angles are zero."""
        with self.lab.lock:
            self.lab.advance()
            robot = self.lab.robot
            wrench = robot.measured_wrench().reshape(2, 3) @ robot.rotation
            return ArmState(
                time=self.lab.time,
                T_b_t=transform(robot.rotation, robot.position),
                joints=np.zeros(6),
                velocity=robot.twist,
                wrench=wrench.ravel(),
                moving=robot.motion is not None,
                safe=True,
            )

    def begin_line(self, T_b_t: Array, speed: float, acceleration: float) -> None:
        """Start a straight motion, as in `PolledArm.begin_line`."""
        with self.lab.lock:
            robot = self.lab.robot
            self.lab.contacts.look_ahead(robot.position, robot.rotation)  # even after a short standstill
            robot.line_to(np.array(pose_to_vector(T_b_t)), speed, acceleration)

    def brake(self) -> None:
        """Brake a moving tool after the delay `latency`."""
        if self.lab.robot.motion is not None:
            self.clock.sleep(self.latency)
        with self.lab.lock:
            self.lab.advance()
            self.lab.robot.stop(SAFETY.braking_m_s2)

    def zero_sensor(self) -> None:
        """Zero the force and torque sensor at the present wrench."""
        self.lab.robot.zero_wrench()


class SimulatedCamera(CameraBase):
    """A simulated depth camera (`i2t.hardware.protocols.DepthCamera`) on the tool of an arm.

    Args:
        scene: Scene with the object that the camera sees.
        camera: Image size and lens, without distortion.
        T_t_c: `(4, 4)` assumed pose (m) of the camera on the tool; the true one deviates by the scene's error.
        pose: Function that returns the present pose T_b_t (4, 4) of the tool, of a simulated arm or any other.
        clock: Clock that dates the views.
        seed: Seed of the noise.
    """

    def __init__(
        self,
        scene: ObjectScene,
        camera: Camera,
        T_t_c: Array,
        pose: Callable[[], Array],
        clock: Clock,
        seed: int = 0,
    ) -> None:
        super().__init__(CameraFeatures("the simulated camera", "simulated", nearest=0.03, rate=30.0))
        self._camera: Camera = camera
        self._scene, self._pose, self._clock = scene, pose, clock
        self._T_t_c = scene.T_t_camera @ np.asarray(T_t_c)
        self._random = np.random.default_rng((seed, 2))
        self._open = False

    def connect(self) -> None:
        """Switch the simulated camera on."""
        self._open = True

    def close(self) -> None:
        """Switch the simulated camera off."""
        self._open = False

    def capture(self, timeout: float = 2.0) -> View:
        """Wait for one frame and render a view, as in `DepthCamera.capture`; `timeout` has no effect."""
        if not self._open:
            raise self._not_connected()
        self._clock.sleep(1 / self.features.rate)
        T_b_c = self._pose() @ self._T_t_c
        depth, which = render_view(self._scene.triangles, T_b_c, self._camera)
        colour = shade_view(self._scene.triangles, which, T_b_c)
        return View(self._clock.now(), add_depth_noise(depth, self._scene.errors, self._random), colour)
