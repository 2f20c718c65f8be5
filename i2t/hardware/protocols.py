"""Protocols of a skin, an arm and a depth camera, whoever made them; and their data.

A device is built without touching anything, tells its features, and works between `connect` and `close`, which `with`
calls. Times are `time.monotonic()` of this machine in seconds, taken as near to the measurement as the device allows.
Every call that waits says how long (`timeout`, s), and whatever goes wrong comes out as a `DeviceError` of one sentence
that names the device and the remedy: from the call that was made, or from the next one if it happened in between. Units
are those of `i2t.types`: metres, radians, newtons, and microtesla for the skin.

Real drivers, emulated devices (real drivers talking to `i2t.emulators`), simulated and replayed ones meet the same
protocols and pass the same tests (`i2t.hardware.contract`).
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, Protocol, SupportsIndex, TypeAlias, TypeVar, runtime_checkable

from i2t.depth.camera import Camera
from i2t.types import Array

READ_SPARE_S = 2.0  # that samples may come late by: a busy computer's pauses, and the arm stands still meanwhile

T = TypeVar("T")
StopReason: TypeAlias = Literal["condition", "force", "torque", "distance"]


class Device(Protocol):
    """Methods that all devices share."""

    def connect(self) -> None:
        """Start the device; calling it again after a failure or `close` starts it anew. Raises DeviceError."""

    def close(self) -> None:
        """Stop it and give its port back, from any thread, as often as one likes; raises nothing."""

    def __enter__(self: T) -> T:
        """Connect."""

    def __exit__(self, *error: Any) -> None:
        """Close."""


class SkinFeatures(NamedTuple):
    """Features of a skin, known before it is connected."""

    name: str  # of the device, for messages
    source: str  # real, emulated or simulated: what a file must say of its readings
    channels: tuple[str, ...]  # one for each value of a reading, in the board's order
    unit: str  # uT
    rate: float  # Hz, nominal


def channel_names(chips: int) -> tuple[str, ...]:
    """Names of the values of a reading.

    Args:
        chips: Of the board.

    Returns:
        3 chips names, in the board's order.
    """
    return tuple(f"chip{chip}_{axis}" for chip in range(chips) for axis in "xyz")


class Samples(NamedTuple):
    """Samples of a skin, one on each row, in the board's order and axes; nothing has been subtracted."""

    number: Array  # (n,) int64, counts the samples of this device; a jump is what its queue had to let go
    time: Array  # (n,) s, monotonic and never decreasing
    reading: Array  # (n, c) uT, c = 3 values for each chip; NaN for a chip that did not answer, in no sample for all
    temperature: Array  # (n, chips) degrees Celsius, of each chip; NaN if the skin does not tell


class SkinCounters(NamedTuple):
    """Counts of samples, bytes and losses, since the skin was first connected. Only `rate` ever falls."""

    samples: int = 0  # delivered
    lost: int = 0  # frames that did not come whole, by the board's own count or the bytes of them that were left
    gaps: int = 0  # places where frames are missing
    bytes: int = 0  # that came
    skipped: int = 0  # of those, in no frame
    empty: int = 0  # frames in which no chip answered; they are not delivered
    missing: int = 0  # chips that did not answer, in all samples together
    connects: int = 0  # connections made
    rate: float = 0.0  # Hz, over the last second

    @property
    def loss(self) -> float:
        """Part of the frames that was lost."""
        return self.lost / max(1, self.samples + self.lost)


@runtime_checkable
class Skin(Device, Protocol):
    """A magnetic skin that sends samples by itself."""

    @property
    def features(self) -> SkinFeatures:
        """Features, known before `connect`."""

    @property
    def counters(self) -> SkinCounters:
        """Counts so far; can be asked for at any time and never raises."""

    def latest(self, timeout: float = 0.4) -> Samples:
        """The newest sample, at once.

        Args:
            timeout: s, how old it may be.

        Returns:
            One row.

        Raises:
            DeviceTimeoutError: The newest is older.
        """

    def read(self, count: int, timeout: float | None = None) -> Samples:
        """The next samples, all measured after the call.

        Args:
            count: How many.
            timeout: s; by default twice what the nominal rate needs, and `READ_SPARE_S`.

        Returns:
            `count` rows.

        Raises:
            ValueError: More were asked for than the queue can hold, or none.
            DeviceTimeoutError: They did not come in time.
        """

    def since(self, number: SupportsIndex) -> Samples:
        """Samples after a given one that are still in the queue, without waiting.

        Args:
            number: Of that sample, as in `Samples`; -1 for all.

        Returns:
            As many rows as there are; maybe none.
        """


class ArmFeatures(NamedTuple):
    """Features of an arm, known before it is connected."""

    name: str  # of the device, for messages
    source: str  # real, emulated or simulated
    rate: float  # Hz, of its states
    box: Array  # (2, 3) m, lowest and highest tool position in the base frame that any motion may reach
    speed: float  # m/s, the greatest that is accepted
    acceleration: float  # m/s^2


class ArmState(NamedTuple):
    """The arm at one moment."""

    time: float  # s, monotonic
    T_b_t: Array  # (4, 4) tool in base, as measured
    joints: Array  # (joints,) rad
    velocity: Array  # (6,) of the tool: m/s, rad/s, along the base's axes
    wrench: Array  # (6,) on the tool, along the tool's axes: N, Nm, zeroed by `zero_wrench`
    moving: bool  # whether a motion is under way
    safe: bool  # False in a protective stop, an emergency stop or a violation


@runtime_checkable
class Arm(Device, Protocol):
    """An arm that carries the skin. Motions start and return at once; `state` tells how they go.

    A target outside the box and a speed above the limit are refused before anything moves.
    """

    @property
    def features(self) -> ArmFeatures:
        """Features, known before `connect`."""

    def state(self, timeout: float = 0.1) -> ArmState:
        """The newest state.

        Args:
            timeout: s, how old it may be.

        Returns:
            The state.

        Raises:
            DeviceTimeoutError: The newest is older; the arm was stopped as far as it can be told to.
        """

    def move(self, T_b_t: Array, speed: float, acceleration: float) -> Array:
        """Start a straight motion of the tool and return at once; one under way is replaced.

        Args:
            T_b_t: (4, 4) goal of the tool in the base, m.
            speed: m/s.
            acceleration: m/s^2.

        Returns:
            (4, 4) goal that was really sent.

        Raises:
            ValueError: The goal is outside the box or too fast; nothing was sent.
            DeviceError: The arm is lost, stopped or does not take the motion.
        """

    def stop(self, timeout: float = 1.0) -> None:
        """Stop all motion and return when the arm stands still, from any thread.

        Args:
            timeout: s, until it must have been seen to stand.

        Raises:
            DeviceError: It could not be seen to stand in time.
        """

    def zero_wrench(self, timeout: float = 1.0) -> None:
        """Take the wrench felt now as zero; only with the arm standing still and touching nothing.

        Args:
            timeout: s, until the arm must have done it.

        Raises:
            DeviceError: The arm moves, or it took longer.
        """


@runtime_checkable
class PlanningArm(Protocol):
    """An arm that knows where it can go; others are asked for nothing but the box."""

    def why_unreachable(self, goals: Sequence[Array]) -> str:
        """Reason why it cannot follow straight lines from pose to pose, asked before anything moves.

        Args:
            goals: Poses T_b_t (4, 4) of the tool, m.

        Returns:
            One sentence why not; empty where it can.
        """


class CameraFeatures(NamedTuple):
    """Features of a depth camera, known before it is connected."""

    name: str  # of the device, for messages
    source: str  # real, simulated or replay
    nearest: float  # m, below which it measures nothing; NaN where only the device knows it
    rate: float  # Hz, nominal


class View(NamedTuple):
    """One depth image and the colours of the same pixels."""

    time: float  # s, monotonic, of the exposure as near as is known
    depth: Array  # (h, w) m along the optical axis; NaN where nothing was measured
    colour: Array | None  # (h, w, 3) uint8 RGB


class ColourImage(NamedTuple):
    """A colour image as it was taken, for what must see fine print: colours of a `View` have depth's holes."""

    time: float  # s, monotonic
    image: Array  # (h, w, 3) uint8 RGB
    camera: Camera  # of this image
    T_c_colour: Array  # (4, 4), its frame in the depth camera's


@runtime_checkable
class DepthCamera(Device, Protocol):
    """A depth camera with colour aligned to depth."""

    @property
    def features(self) -> CameraFeatures:
        """Known before `connect`."""

    @property
    def camera(self) -> Camera:
        """Size and lens of its depth images; raises NotConnectedError where only the device knows them."""

    def capture(self, timeout: float = 2.0) -> View:
        """A view exposed after the call.

        Args:
            timeout: s.

        Returns:
            Depth and colour.

        Raises:
            DeviceTimeoutError: None came in time.
            NotConnectedError: The camera is not connected.
        """


class ApproachResult(NamedTuple):
    """Outcome of a guarded approach."""

    reason: StopReason  # what ended the approach
    answer: Any  # what the caller's stop condition returned, None unless it stopped the arm
    trigger: ArmState  # what was known when the arm was told to brake
    state: ArmState  # at rest
    distance: float  # m from the start to rest


@runtime_checkable
class GuardedArm(Arm, Protocol):
    """An arm that follows its motions to their end; the touch procedure needs one."""

    def go(self, T_b_t: Array, speed: float | None = None, acceleration: float | None = None) -> ArmState:
        """Move straight to a pose and wait.

        Args:
            T_b_t: (4, 4) goal, m.
            speed: m/s, by default the greatest that is allowed.
            acceleration: m/s^2, by default the greatest that is allowed.

        Returns:
            The state at rest at the goal.

        Raises:
            ValueError: The goal is outside the box or too fast; nothing has moved.
            DeviceError: The arm met something, or was lost; it stands as far as it can be told to.
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
        """Move along the tool's z axis, out of the skin, until something says stop.

        Args:
            distance: m, after which it stops at the latest.
            speed: m/s.
            stop_condition: Called with each new state in the caller's thread; anything true stops the arm.
            force: N, norm of the force that stops the arm.
            torque: Nm, norm of the torque that stops the arm.
            acceleration: m/s^2.

        Returns:
            How it ended; the arm stands.

        Raises:
            ValueError: It would leave the box or exceed a limit; nothing has moved.
            DeviceError: The arm was lost, or stopped by somebody else.
        """
