"""Protocols of a skin, an arm and a depth camera of any make, and their data.

Building a device opens nothing; it reports its features, and works between `connect` and `close`, which `with` calls.
Times are `time.monotonic()` of this machine in seconds, taken as close to the measurement as the device allows. Every
call that waits has a `timeout` (s). Every failure raises a `DeviceError` with one sentence that names the device and
the remedy: from the call that failed, or from the next call if the failure happened in between. Units are those of
`i2t.types`: metres, radians, newtons, and microtesla for the skin.

Real drivers, emulated devices (real drivers connected to `i2t.emulators`), simulated and replayed devices implement the
same protocols and pass the same tests (`i2t.hardware.contract`).
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Protocol, Self, SupportsIndex, TypeAlias, runtime_checkable

from i2t.depth.camera import Camera
from i2t.types import Array

StopReason: TypeAlias = Literal["condition", "force", "torque", "distance"]


class Device(Protocol):
    """Methods of all devices: arm, skin and camera."""

    def connect(self) -> None:
        """Start the device, or restart it after a failure or `close`; raise DeviceError if that fails."""

    def close(self) -> None:
        """Stop the device and release its port; may be called repeatedly and from any thread, and never raises."""

    def __enter__(self) -> Self:
        """Connect."""

    def __exit__(self, *error: Any) -> None:
        """Close."""


class SkinFeatures(NamedTuple):
    """Name, source, names of channels, unit (uT) and nominal rate (Hz) of a skin, available before it is connected."""

    name: str  # name of the device, for messages
    source: str  # real, emulated or simulated; files record it with the readings
    channels: tuple[str, ...]  # names of the values of a reading, in the board's order
    unit: str  # unit of the readings: uT
    rate: float  # Hz, nominal rate of the samples


def channel_names(chips: int) -> tuple[str, ...]:
    """Name the values of a skin's reading.

    Args:
        chips: Number of chips of the board.

    Returns:
        Three names for each chip, in the board's order, such as "chip0_x".
    """
    return tuple(f"chip{chip}_{axis}" for chip in range(chips) for axis in "xyz")


class Samples(NamedTuple):
    """Samples of a skin, one in each row: number, monotonic time (s), reading (uT), temperatures (degrees Celsius).

    Readings are in the board's order and axes, with the ambient field.
    """

    number: Array  # (n,) int64, running number of the samples; the queue dropped the samples of a jump
    time: Array  # (n,) s, monotonic time, never decreasing
    reading: Array  # (n, c) uT, c = 3 values for each chip; NaN for a chip that did not answer, but never for all chips
    temperature: Array  # (n, chips) degrees Celsius; NaN if the skin does not report it


class SkinCounters(NamedTuple):
    """Counts of samples, bytes, losses and connections since the skin was first connected, and its rate (Hz).

    The rate is that of the last second; only it can fall.
    """

    samples: int = 0  # number of delivered samples
    lost: int = 0  # number of incomplete frames, by the board's own counter or by the bytes of their remains
    gaps: int = 0  # number of places where frames are missing
    bytes: int = 0  # number of received bytes
    skipped: int = 0  # number of received bytes outside frames
    empty: int = 0  # number of frames in which no chip answered; they are not delivered
    missing: int = 0  # number of missing chips, summed over all samples
    connects: int = 0  # number of connections that were made
    rate: float = 0.0  # Hz, rate of the samples over the last second

    @property
    def loss(self) -> float:
        """Fraction (0 to 1) of lost frames among lost and delivered ones; frames without any chip do not count."""
        return self.lost / max(1, self.samples + self.lost)


@runtime_checkable
class Skin(Device, Protocol):
    """A magnetic skin that sends samples continuously."""

    @property
    def features(self) -> SkinFeatures:
        """Name, source, channels, unit and rate of the skin, available before `connect`."""

    @property
    def counters(self) -> SkinCounters:
        """Counts of samples and losses since the first connection; available at any time, never raises."""

    def latest(self, timeout: float = 0.4) -> Samples:
        """Return the skin's newest sample without waiting.

        Args:
            timeout: Maximum age of the sample in s.

        Returns:
            The newest sample, as one row.

        Raises:
            DeviceTimeoutError: The newest sample is older than `timeout`.
        """

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """Wait for and return the next samples of the skin, all measured after the call.

        Args:
            count: Number of samples.
            timeout: Maximum wait in s; by default twice the time at the nominal rate, plus 2 s.

        Returns:
            The samples, as `count` rows.

        Raises:
            ValueError: The count is zero, or larger than the queue of samples.
            DeviceTimeoutError: The samples did not arrive in time.
        """

    def since(self, number: SupportsIndex) -> Samples:
        """Return the skin's samples after a given one, as far as they are still in the queue, without waiting.

        Args:
            number: Number of the given sample, as in `Samples`; -1 for all samples.

        Returns:
            The samples, one in each row; may be empty.
        """


class ArmFeatures(NamedTuple):
    """Name, source, rate of states (Hz) and limits of an arm, available before it is connected.

    The limits are the box (m) of the tool in the base, the speed (m/s) and the acceleration (m/s^2).
    """

    name: str  # name of the device, for messages
    source: str  # real, emulated or simulated
    rate: float  # Hz, rate of the arm's states
    box: Array  # (2, 3) m, lower and upper corner of the box for the tool's position in the base
    speed: float  # m/s, maximum speed
    acceleration: float  # m/s^2, maximum acceleration


class ArmState(NamedTuple):
    """Measured state of an arm at one time (s): pose, joints (rad), velocity and wrench of the tool, motion and safety.

    The pose is T_b_t (m), the velocity along the base's axes (m/s, rad/s), the wrench along the tool's axes (N, Nm).
    """

    time: float  # s, monotonic time of the state
    T_b_t: Array  # (4, 4) measured pose of the tool in the base, m
    joints: Array  # (joints,) rad, joint angles
    velocity: Array  # (6,) velocity of the tool along the base's axes: m/s, rad/s
    wrench: Array  # (6,) wrench on the tool along the tool's axes: N, Nm, zeroed by `zero_wrench`
    moving: bool  # whether a motion is under way
    safe: bool  # False in a protective stop, an emergency stop or a violation of safety limits


@runtime_checkable
class Arm(Device, Protocol):
    """An arm that carries the skin. Calls for motions return at once; `state` reports the progress.

    A goal outside the box or a speed above the limit is refused before anything moves.
    """

    @property
    def features(self) -> ArmFeatures:
        """Name, source, rate and limits of the arm, available before `connect`."""

    def state(self, timeout: float = 0.1) -> ArmState:
        """Return the arm's newest state.

        Args:
            timeout: Maximum age of the state in s.

        Returns:
            The newest state.

        Raises:
            DeviceTimeoutError: The newest state is older than `timeout`; a stop was sent to the arm if it can be
                reached.
        """

    def move(self, T_b_t: Array, speed: float, acceleration: float) -> Array:
        """Start a straight motion of the tool and return at once; it replaces a motion that is under way.

        Args:
            T_b_t: (4, 4) goal of the tool in the base, m.
            speed: Speed in m/s.
            acceleration: Acceleration in m/s^2.

        Returns:
            (4, 4) goal that was actually sent to the arm, m.

        Raises:
            ValueError: The goal is outside the box, or the motion is too fast; nothing was sent.
            DeviceError: The arm is lost or stopped, or refuses the motion.
        """

    def stop(self, timeout: float = 1.0) -> None:
        """Stop all motion and return when the arm stands still; may be called from any thread.

        Args:
            timeout: Time in s until the arm must stand.

        Raises:
            DeviceError: The arm was not seen to stand in time.
        """

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Zero the measured wrench at its present value; the arm must stand still and touch nothing.

        Args:
            timeout: Maximum wait in s.

        Raises:
            DeviceError: The arm moves, or the command took too long.
        """


@runtime_checkable
class PlanningArm(Protocol):
    """An arm that can check whether it reaches poses; for other arms only the box is checked."""

    def why_unreachable(self, goals: Sequence[Array]) -> str:
        """Explain, before anything moves, why the arm cannot move its tool along straight lines from pose to pose.

        Args:
            goals: Poses T_b_t (4, 4) of the tool, m.

        Returns:
            One sentence with the reason; empty if the arm can reach all poses.
        """


class CameraFeatures(NamedTuple):
    """Name, source, nearest depth (m) and nominal rate (Hz) of a depth camera, available before it is connected."""

    name: str  # name of the device, for messages
    source: str  # real, simulated or replay
    nearest: float  # m, shortest depth that the camera measures; NaN if only the device knows it
    rate: float  # Hz, nominal rate of the views


class View(NamedTuple):
    """A view of a depth camera: exposure time (s), depth image (m along the optical axis), colours of the same pixels.

    Depth is NaN for unmeasured pixels.
    """

    time: float  # s, monotonic time of the exposure, as precise as possible
    depth: Array  # (h, w) m along the optical axis; NaN for unmeasured pixels
    colour: Array | None  # (h, w, 3) uint8 RGB, colour of the same pixels


class ColourImage(NamedTuple):
    """A complete colour image with its exposure time (s), its lens, and its frame's pose (m) in the depth camera's.

    The colours of a `View` are missing where its depth is missing.
    """

    time: float  # s, monotonic time of the exposure
    image: Array  # (h, w, 3) uint8 RGB image
    camera: Camera  # lens of this image
    T_c_colour: Array  # (4, 4) pose of the image's frame in the depth camera's, m


@runtime_checkable
class DepthCamera(Device, Protocol):
    """A depth camera whose colours are aligned with depth."""

    @property
    def features(self) -> CameraFeatures:
        """Name, source, nearest depth and rate of the camera, available before `connect`."""

    @property
    def camera(self) -> Camera:
        """Image size and lens of the depth images; raises NotConnectedError while only the device knows them."""

    def capture(self, timeout: float = 2.0) -> View:
        """Take a view that is exposed after the call.

        Args:
            timeout: Maximum wait in s.

        Returns:
            The depth and the colours.

        Raises:
            DeviceTimeoutError: No view arrived in time.
            NotConnectedError: The camera is not connected.
        """


class ApproachResult(NamedTuple):
    """Outcome of a guarded approach: what ended it, the stop condition's answer, states of the arm, and distance (m).

    The states are the one that made the arm brake, and the one at rest; the distance is that from start to rest.
    """

    reason: StopReason  # what ended the approach
    answer: Any  # answer of the caller's stop condition if it stopped the arm, otherwise None
    trigger: ArmState  # state that made the arm brake
    state: ArmState  # state of the arm at rest after the approach
    distance: float  # m, distance from the start to the position at rest


@runtime_checkable
class GuardedArm(Arm, Protocol):
    """An arm that checks force, torque and position during its motions to their end, as touching requires."""

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move the tool straight to a pose and wait for the end of the motion.

        Args:
            T_b_t: (4, 4) goal, m.
            speed: Speed in m/s, by default the highest that is allowed in the air.
            acceleration: Acceleration in m/s^2, by default the highest allowed.

        Returns:
            The state at rest at the goal.

        Raises:
            ValueError: The goal is outside the box, or the motion is too fast; nothing has moved.
            DeviceError: The arm met something, or was lost; a stop was sent to it if it can be reached.
        """

    def approach(
        self,
        distance: float,
        speed: float = 0.005,
        stop_condition: Callable[[ArmState], Any] | None = None,
        force: float = 8.0,
        torque: float = 8.0,
        acceleration: float = 0.2,
    ) -> ApproachResult:
        """Move the tool along its z axis, out of the skin, until a stop condition, a load or the distance ends it.

        Args:
            distance: Maximum distance in m.
            speed: Speed in m/s.
            stop_condition: Function that is called with each new state, in the caller's thread; a true answer stops the
                arm.
            force: Norm of the force in N that stops the arm.
            torque: Norm of the torque in Nm that stops the arm.
            acceleration: Acceleration in m/s^2.

        Returns:
            The outcome of the approach; the arm stands.

        Raises:
            ValueError: The arm would leave the box or exceed a limit; nothing has moved.
            DeviceError: The arm was lost, or was stopped by request.
        """
