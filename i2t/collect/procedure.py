"""One touch after another, as the paper makes them: choose, look, cut the patch, prepare, ambient, press, retreat.

    look      the camera over the site, `rig.looking_distance` away; the patch is cut by a function that is given
    prepare   the skin `prepare` before the site, its z along the site's; the wrench is zeroed where nothing is touched
    approach  to `near` before the site, quickly: whatever is met here was not expected, and the touch has failed
    ambient   the mean of some samples at rest
    press     on, slowly, until the skin's change, force, torque or the travel is enough; then the mean of some samples
    retreat   back to where it prepared; between sites the tool goes up, across and down

Every motion is one of an arm that guards itself (`i2t.hardware.ur.driver`); all goals of a touch are checked against
the box before the first. Which site is next is asked of a plain callable, `choose(history) -> site`. Numbers are those
of the paper and its code where it has them, except where `Settings` says why.

Frames: W world, B robot base, T tool, C camera; `T_a_b` maps points in b to a. Metres, newtons, microtesla.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from i2t.collect.stopping import Rule, Watch, onset
from i2t.depth.camera import Camera
from i2t.errors import DeviceError, MotionStoppedError
from i2t.hardware.clock import Clock, Monotonic
from i2t.hardware.limits import place
from i2t.hardware.protocols import ApproachResult, Arm, ArmState, DepthCamera, Samples, Skin, SkinCounters, View
from i2t.hardware.rig import Rig
from i2t.types import Array, Board, ReturnCode

CODES = {"verdict": ReturnCode.SKIN, "force": ReturnCode.WRENCH, "torque": ReturnCode.WRENCH, "travel": ReturnCode.AIR}
AGAIN = 0.2  # s between attempts to connect
AT = (1e-3, 0.01)  # m and of a rotation's elements: so near a pose a tool is there


@dataclass(frozen=True)
class Settings:
    """How a touch is made. Raises ValueError for numbers that make no sense.

    The speed of a press is what keeps it near its limits: at k N/m, t seconds late and braking with a, it runs
    k (v t + v^2 / 2a) past them; 10 N/mm, 60 ms and 2 mm/s give 1.2 N. The paper presses in steps; here the motion is
    one, watched all the time.
    """

    prepare: float = 40e-3  # m before the site
    near: float = (
        5e-3  # m before the site, where the quick approach ends and the ambient is taken (paper: within 10 mm)
    )
    past_goal: float = 6e-3  # m past the site, after which a press has met air (three extra steps of 2 mm)
    skin_change: float = 25.0  # uT, norm of the 15 values' change
    uneven: float = 0.5  # of it must differ between chips: a change that all chips see alike is the room's
    mean_of: int = 10  # samples; one alone is 25 uT off in two of a thousand
    force: float = 8.0  # N; the paper's recognition has 7
    torque: float = 8.0  # Nm
    ambient: int = 10  # samples
    contact: int = 10  # samples
    speed: float = 0.15  # m/s in the air
    approach: float = 0.02  # m/s
    press: float = 0.002  # m/s
    retreat: float = 0.05  # m/s
    acceleration: float = 0.3  # m/s^2
    settle: float = 0.2  # s that the arm swings, before it looks or zeroes
    hold: float = 0.05  # s from the stop to the samples in contact
    clearance: float = 0.1  # m above the object's highest point, on the way across
    seen: float = 0.5  # of the patch's pixels, at least
    nearer: float = 5e-3  # m that the camera may see the surface before the site
    silence: float = 0.15  # s without a sample, after which a press ends
    retries: int = 2  # of a touch that failed
    failures: int = 3  # sites in a row that fail, after which a person is asked
    patience: float = 10.0  # s, for a device that has to be connected again

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            zero = each.name in ("uneven", "settle", "hold", "retries", "seen", "patience")
            if not np.isfinite(value) or value < 0 or (value == 0 and not zero):
                raise ValueError(f"{each.name} is {value:g}; give a number above 0")
        if self.near > self.prepare:
            raise ValueError(f"near, {self.near:g} m, lies before prepare, {self.prepare:g} m; make it smaller")


class Site(NamedTuple):
    """A place to touch: the skin's pose where it would just lie on the surface."""

    number: int
    T_w_t: Array  # (4, 4)


class Seen(NamedTuple):
    """What the camera saw before the skin."""

    patch: Array  # (48, 48) m
    wide: Array  # (72, 72) m
    nearest: float  # m
    share: float  # of the patch's pixels that were measured


class Touched(NamedTuple):
    """A touch as it was made."""

    site: Site
    attempt: int
    code: ReturnCode
    reason: str
    T_w_t: Array  # (4, 4) at the end of the press
    ambient: Array  # (15,) uT
    reading: Array  # (15,) uT, mean in contact minus ambient
    force: float  # N, along tool z
    depth: float  # m past first contact; NaN where nothing was met
    seen: Seen | None  # from the pose at the end; None in a history, where images would fill the memory
    view: View | None
    T_w_c: Array  # (4, 4) from where it was taken
    counters: SkinCounters  # of this touch alone


class Outcome(NamedTuple):
    """What became of a site, for whoever chooses the next."""

    site: Site
    code: ReturnCode
    reason: str
    touched: Touched | None = None


@runtime_checkable
class Tape(Protocol):
    """What is told of a touch while it is made."""

    def samples(self, samples: Samples) -> None:
        """Of the skin."""

    def state(self, state: ArmState) -> None:
        """Of the arm."""

    def event(self, text: str) -> None:
        """What happened now."""


@runtime_checkable
class Keeper(Protocol):
    """Who keeps touches (`i2t.collect.recorder.Recorder`)."""

    def begin(self, site: Site, attempt: int) -> Tape:
        """A touch begins; raises DeviceError where it could not be kept."""

    def keep(self, touched: Touched) -> None:
        """It was made; once this returns it is safe."""

    def abandon(self, reason: str) -> None:
        """It was not."""


@runtime_checkable
class GuardedArm(Arm, Protocol):
    """An arm that follows its motions to their end (`i2t.hardware.ur.driver.UR`)."""

    def go(self, T_b_t: Array, speed: float, acceleration: float) -> ArmState:
        """Move there and return the state at rest."""

    def approach(
        self,
        travel: float,
        speed: float,
        verdict: Callable[[ArmState], Any],
        force: float,
        torque: float,
        acceleration: float,
    ) -> ApproachResult:
        """Move along tool z until something says stop."""


class Failed(DeviceError):
    """A touch cannot be made here; another place may do."""


class Unreachable(Failed):
    """The arm may not go there: trying again is no use."""


Choose = Callable[[Sequence[Outcome]], Site | None]
Cut = Callable[[View, Camera, Array, Array], Seen]  # view, camera, T_w_c, T_w_t


@dataclass
class Procedure:
    """Touches with these devices. `top` is the height (m) of the object's highest point in W."""

    arm: GuardedArm
    skin: Skin
    camera: DepthCamera
    rig: Rig
    board: Board
    cut: Cut
    top: float
    settings: Settings = field(default_factory=Settings)
    clock: Clock = field(default_factory=Monotonic)
    unreachable: dict[int, str] = field(default_factory=dict)  # by the site's number

    def run(self, choose: Choose, keeper: Keeper) -> Iterator[Outcome]:
        """Touch what is chosen, until nothing is. Raises DeviceError where a person is needed."""
        history: list[Outcome] = []
        failures = 0
        self.withdraw()
        while (site := choose(history)) is not None:
            outcome = self.attempt(site, keeper)
            touched = outcome.touched
            history.append(outcome._replace(touched=touched and touched._replace(seen=None, view=None)))
            if site.number not in self.unreachable:
                failures = failures + 1 if outcome.code == ReturnCode.FAILED else 0
            yield outcome
            if failures >= self.settings.failures:
                raise DeviceError(f"{failures} sites in a row could not be touched, the last because: {outcome.reason}")

    def attempt(self, site: Site, keeper: Keeper) -> Outcome:
        """Touch a site, more than once if need be, and keep what came of it."""
        reason = ""
        for attempt in range(1 + self.settings.retries):
            tape = keeper.begin(site, attempt)
            try:
                touched = self.touch(site, tape, attempt)
            except Unreachable as error:
                keeper.abandon(str(error))
                self.unreachable[site.number] = str(error)
                return Outcome(site, ReturnCode.FAILED, str(error))
            except MotionStoppedError as error:
                keeper.abandon(str(error))
                raise
            except DeviceError as error:
                reason = str(error)
                tape.event(reason)
                keeper.abandon(reason)
                self.recover()
            except BaseException as error:
                keeper.abandon(f"ended by {type(error).__name__}")
                raise
            else:
                keeper.keep(touched)
                return Outcome(site, touched.code, touched.reason, touched)
        return Outcome(site, ReturnCode.FAILED, reason)

    # One touch

    def touch(self, site: Site, tape: Tape, attempt: int = 0) -> Touched:
        """Make one touch; raises DeviceError, Failed if the place is at fault."""
        settings, arm, skin = self.settings, self.arm, self.skin
        look, prepare, _, _ = self.poses(site)
        self.check(site)
        before = skin.counters
        tape.event("look")
        self.travel(look)
        self.clock.sleep(settings.settle)
        T_w_c = self.rig.T_world_base @ arm.state().T_b_t @ self.rig.T_tool_camera
        view = self.camera.capture()
        self._expect(self.cut(view, self.camera.camera, T_w_c, site.T_w_t))

        tape.event("prepare")
        if not _there(arm.state(), prepare):
            arm.go(prepare, settings.speed, settings.acceleration)
            self.clock.sleep(settings.settle)
        arm.zero_wrench()
        met = self._approach(settings.prepare - settings.near, settings.approach, self._ambient(tape), tape)
        if met.reason != "travel":
            raise Failed(f"something was met {1e3 * (settings.prepare - met.travel):.0f} mm before the site")

        tape.event("ambient")
        ambient = self._ambient(tape)
        tape.event("press")
        started = self.clock.now()
        pressed = self._approach(settings.near + settings.past_goal, settings.press, ambient, tape)
        tape.event(f"stopped by {'skin' if pressed.reason == 'verdict' else pressed.reason}")
        self.clock.sleep(settings.hold)
        held = [arm.state()]
        contact = skin.read(settings.contact)
        held.append(arm.state())
        tape.samples(contact)
        for state in held:
            tape.state(state)
        reading = contact.reading.mean(axis=0) - ambient
        T_b_t = held[-1].T_b_t
        code = CODES[pressed.reason]

        tape.event("retreat")
        arm.go(prepare, settings.retreat, settings.acceleration)
        T_w_t = self.rig.T_world_base @ T_b_t
        began = np.nan if code == ReturnCode.AIR else onset(*self._watched.press(started, T_b_t), ambient, reading)
        return Touched(
            site,
            attempt,
            code,
            pressed.reason,
            T_w_t,
            ambient,
            reading,
            -float(np.mean([state.wrench[2] for state in held])),
            began,
            self.cut(view, self.camera.camera, T_w_c, T_w_t),
            view,
            T_w_c,
            _since(skin.counters, before),
        )

    def _ambient(self, tape: Tape) -> Array:
        samples = self.skin.read(self.settings.ambient)
        tape.samples(samples)
        return samples.reading.mean(axis=0)

    def _approach(self, travel: float, speed: float, ambient: Array, tape: Tape) -> ApproachResult:
        settings = self.settings
        rule = Rule(settings.skin_change, settings.uneven, settings.mean_of, settings.silence)
        self._watched = Watch(self.skin, self.board, rule, ambient, tape)
        if travel <= 0:
            state = self.arm.state()
            return ApproachResult("travel", None, state, state, 0.0)
        return self.arm.approach(travel, speed, self._watched, settings.force, settings.torque, settings.acceleration)

    def _expect(self, seen: Seen) -> None:
        """Refuse what the camera contradicts."""
        if seen.share < self.settings.seen:
            raise Failed(
                f"the camera saw {100 * seen.share:.0f} % of the site's surroundings; is it covered, or shiny?"
            )
        if seen.nearest < -self.settings.nearer:
            raise Failed(
                f"the camera sees a surface {-1e3 * seen.nearest:.1f} mm before the site: register the object again, "
                "or clear the table"
            )

    # Where the tool goes

    def poses(self, site: Site) -> tuple[Array, Array, Array, Array]:
        """T_b_t where the touch of a site looks, prepares, slows down and ends at the latest."""
        T_w_look = np.array(site.T_w_t)
        T_t_c = self.rig.T_tool_camera
        axis = site.T_w_t[:3, :3] @ T_t_c[:3, 2]
        T_w_look[:3, 3] -= self.rig.looking_distance * axis + site.T_w_t[:3, :3] @ T_t_c[:3, 3]
        along = (-self.settings.prepare, -self.settings.near, self.settings.past_goal)
        to_base = self.rig.T_base_world
        prepare, near, end = (to_base @ _shifted(site.T_w_t, z) for z in along)
        return to_base @ T_w_look, prepare, near, end

    def check(self, site: Site) -> None:
        """Raise Unreachable for a site of which any goal is outside the box."""
        if site.number in self.unreachable:
            raise Unreachable(self.unreachable[site.number])
        for name, goal in zip(("look", "prepare", "slow down", "end"), self.poses(site), strict=True):
            if not self.rig.limits.hold(goal[:3, 3]):
                raise Unreachable(
                    f"to {name} at site {site.number} the tool would be at {place(goal[:3, 3])} m, outside the box"
                )

    @property
    def across(self) -> float:
        """Height (m) in the base at which the tool goes from site to site."""
        wanted = self.top - self.rig.T_world_base[2, 3] + self.settings.clearance
        return float(np.clip(wanted, self.rig.limits.lower[2], self.rig.limits.upper[2]))

    def travel(self, goal: Array) -> None:
        """Up, across and down to a pose, unless the tool is there."""
        state = self.arm.state()
        if _there(state, goal):
            return
        height = max(self.across, goal[2, 3])
        lifted, over = state.T_b_t.copy(), goal.copy()
        lifted[2, 3], over[2, 3] = max(height, lifted[2, 3]), max(height, lifted[2, 3])
        for T_b_t in (lifted, over, goal):
            if not _there(state, T_b_t):
                state = self.arm.go(T_b_t, self.settings.speed, self.settings.acceleration)

    def withdraw(self) -> None:
        """Away from whatever the tool may touch: back along its axis, as far as the box allows, then up."""
        T_b_t = self.arm.state().T_b_t
        if T_b_t[2, 3] < self.across:
            steps = (_shifted(T_b_t, -part * self.settings.prepare) for part in (1.0, 0.5, 0.25, 0.1, 0.0))
            back = next((T for T in steps if self.rig.limits.hold(T[:3, 3])), T_b_t)
            self.arm.go(back, self.settings.retreat, self.settings.acceleration)
            back[2, 3] = max(self.across, back[2, 3])
            self.arm.go(back, self.settings.speed, self.settings.acceleration)

    def recover(self) -> None:
        """After a failure: stand, have skin and camera speak again, and withdraw. Raises DeviceError where the arm, or
        after `patience` another device, needs a person.
        """
        self.arm.stop()
        self.arm.state()
        self.withdraw()
        give_up = self.clock.now() + self.settings.patience
        for device, speaks in ((self.skin, lambda: self.skin.read(1)), (self.camera, self.camera.capture)):
            while True:
                try:
                    speaks()
                    break
                except DeviceError:
                    if self.clock.now() > give_up:
                        raise
                self.clock.sleep(AGAIN)
                with contextlib.suppress(DeviceError):
                    device.connect()


def _since(now: SkinCounters, before: SkinCounters) -> SkinCounters:
    counted = {name: getattr(now, name) - getattr(before, name) for name in now._fields if name != "rate"}
    return SkinCounters(**counted, rate=now.rate)


def _shifted(T: Array, z: float) -> Array:
    """A pose moved along its own z axis."""
    moved = np.array(T, float)
    moved[:3, 3] += z * moved[:3, 2]
    return moved


def _there(state: ArmState, goal: Array) -> bool:
    away = np.linalg.norm(state.T_b_t[:3, 3] - goal[:3, 3])
    return bool(away < AT[0] and np.abs(state.T_b_t[:3, :3] - goal[:3, :3]).max() < AT[1])
