"""One touch after another, as the paper makes them: choose, look, extract the patch, prepare, ambient, press, retreat.

    look      the camera over the site, `rig.looking_distance` away; the patch is extracted by a function that is given
    prepare   the skin `prepare` before the site, its z along the site's; the wrench is zeroed where nothing is touched
    approach  to `near` before the site, quickly: whatever is met here was not expected, and the touch has failed
    ambient   the mean of some samples at rest
    press     on, slowly, until a skin, force, torque or the distance is enough; then the mean of some samples
    retreat   back to where it prepared; between sites the tool goes up, across and down

Every motion is one of an arm that guards itself (`i2t.hardware.protocols.GuardedArm`). Where it goes is
checked before the first motion (`i2t.collect.path`). A press that met nothing where the camera sees a surface has
failed. Which site is next is asked of a plain callable, `choose(history) -> site`. Numbers are those of the paper and
its code where it has them, except where `TouchSettings` says why.

All skins on the tool are read, and each may stop an approach. A skin has felt a press if its change differs between
its chips by half of what stops a press. One that felt nothing met air, whatever ended the press; where none did, the
touch is that of the skin at the tool. The arm measures one force for all: it is a skin's own where no other felt the
press, and unknown (NaN) else.

Frames: W world, B robot base, T tool, S skin, C camera; `T_a_b` maps points in b to a. Metres, newtons, microtesla.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import numpy as np

from i2t.collect.path import TouchPath
from i2t.collect.recorder import EventLog, Recorder
from i2t.collect.settings import TouchSettings
from i2t.collect.stopping import StopCondition, felt, onset_distance, press_samples
from i2t.collect.touch import (
    TOOL,
    ChooseSite,
    ExtractPatch,
    MissedContactError,
    SeenPatch,
    Site,
    SiteOutcome,
    SkinOnTool,
    SkinTouch,
    TouchFailedError,
    TouchResult,
    UnreachableError,
)
from i2t.errors import DeviceError, MotionStoppedError
from i2t.hardware.clock import Clock, MonotonicClock
from i2t.hardware.guarded import MotionWatch
from i2t.hardware.motion_limits import format_position
from i2t.hardware.poses import shifted_along_z
from i2t.hardware.protocols import (
    ApproachResult,
    ArmState,
    DepthCamera,
    GuardedArm,
    PlanningArm,
    Skin,
    SkinCounters,
    StopReason,
    View,
)
from i2t.hardware.rig import Rig
from i2t.hardware.skin_health import frozen_sentence
from i2t.skin.boards import mean_known
from i2t.types import Array, ReturnCode

RETURN_CODES: Mapping[StopReason, ReturnCode] = {
    "condition": ReturnCode.SKIN,
    "force": ReturnCode.WRENCH,
    "torque": ReturnCode.WRENCH,
    "distance": ReturnCode.AIR,
}
LAST_SAMPLES = 48  # of a press, in which a skin must have changed
MIN_CHIP_SHARE = 0.5  # of the chips, that must answer for an approach
RECONNECT_WAIT_S = 0.2  # between attempts to connect
POSE_TOLERANCES = (1e-3, 0.01)  # m, and of a rotation's elements: so near a pose the tool is there
RETREAT_SHARES = (1.0, 0.5, 0.25, 0.1, 0.0)  # of `prepare`, that a retreat tries to go back along the tool's axis


class Press(NamedTuple):
    """Press that has ended, with the tool still in contact."""

    result: ApproachResult
    log: EventLog  # that heard of everything
    period: tuple[float, float]  # s, when it began and ended
    ambient: dict[str, Array]  # (c,) uT of each skin before it, by its name
    states: list[ArmState]  # before and after the samples in contact
    changes: dict[str, Array]  # (c,) uT, of each skin in contact
    felt_by: list[str]  # names of the skins that felt it, of that at the tool where none did


@dataclass
class Procedure:
    """Touches with these devices.

    Args:
        arm: Connected, as are skins and camera.
        skins: On the tool, first the one that presses.
        camera: That the arm carries.
        rig: Where everything is.
        extract_patch: Makes a patch of a view, the camera, T_w_c and T_w_t.
        top: m, height of the object's highest point in W.
        settings: How a touch is made.
        clock: That the devices share.
    """

    arm: GuardedArm
    skins: Sequence[SkinOnTool]
    camera: DepthCamera
    rig: Rig
    extract_patch: ExtractPatch
    top: float
    settings: TouchSettings = field(default_factory=TouchSettings)
    clock: Clock = field(default_factory=MonotonicClock)

    def run(self, choose: ChooseSite, recorder: Recorder) -> Iterator[SiteOutcome]:
        """Touch the chosen sites, until none is chosen.

        Args:
            choose: Gives the next site by what became of the others, None at the end.
            recorder: Records touches.

        Yields:
            What became of each site, once its touch is safe.

        Raises:
            ValueError: The settings are beyond the arm's limits; nothing has moved.
            DeviceError: A person is needed.
        """
        self.path.check_settings()
        history: list[SiteOutcome] = []
        failures = 0
        self.retreat()
        while (site := choose(history)) is not None:
            outcome = self.attempt(site, recorder)
            touch = outcome.touch
            history.append(outcome._replace(touch=touch and _without_images(touch)))
            if outcome.reachable:
                failures = failures + 1 if outcome.code == ReturnCode.FAILED else 0
            yield outcome
            if failures >= self.settings.failures:
                raise DeviceError(f"{failures} sites in a row could not be touched, the last because: {outcome.reason}")

    def attempt(self, site: Site, recorder: Recorder) -> SiteOutcome:
        """Touch a site, more than once if need be, and record what came of it.

        Args:
            site: Where.
            recorder: Records the touch.

        Returns:
            The touch, or why there is none.

        Raises:
            DeviceError: A person is needed: the arm was stopped, a device does not speak again, the disk is full, or
                every attempt met nothing where the camera sees a surface.
        """
        errors: list[DeviceError] = []
        for attempt in range(1 + self.settings.retries):
            log = recorder.begin(site, attempt)
            try:
                touch = self.touch(site, log, attempt)
            except UnreachableError as error:
                recorder.abandon(str(error))
                return SiteOutcome(site, ReturnCode.FAILED, str(error), reachable=False)
            except MotionStoppedError as error:
                recorder.abandon(str(error))
                raise
            except DeviceError as error:
                errors.append(error)
                log.event(str(error))
                recorder.abandon(str(error))
                self.recover()
            except BaseException as error:
                recorder.abandon(f"ended by {type(error).__name__}")
                raise
            else:
                recorder.save(touch)
                return SiteOutcome(site, touch.code, touch.reason, touch)
        if all(isinstance(error, MissedContactError) for error in errors):
            raise errors[-1]
        return SiteOutcome(site, ReturnCode.FAILED, str(errors[-1]))

    # One touch

    def touch(self, site: Site, log: EventLog, attempt: int = 0) -> TouchResult:
        """Make one touch.

        Args:
            site: Where.
            log: Receives everything that happens.
            attempt: How often it was tried before.

        Returns:
            The touch; the tool has retreated.

        Raises:
            DeviceError: It failed; a TouchFailedError if the site is at fault.
        """
        look, prepare, _, _ = self.path.poses(site)
        self.path.check(site)
        before = {each.name: each.skin.counters for each in self.skins}
        view, T_w_c = self._look(site, look, log)
        self.prepare(prepare, log)
        press = self.press(log)
        log.event("retreat")
        self.arm.go(prepare, self.path.retreat_speed, self.settings.acceleration)
        skins = {each.name: self._skin_touch(each, press, view, T_w_c, before[each.name]) for each in self.skins}
        reason = press.result.reason
        if RETURN_CODES[reason] == ReturnCode.AIR:
            self._check_air(skins[TOOL].seen)
        return TouchResult(site, attempt, reason, skins, view, T_w_c)

    def _look(self, site: Site, look: Array, log: EventLog) -> tuple[View, Array]:
        """A view of the site that the rig does not contradict, and T_w_c (4, 4) where it was taken."""
        log.event("look")
        self.move_above(look)
        self.clock.sleep(self.settings.settle)
        T_w_c = self.rig.T_world_base @ self.arm.state().T_b_t @ self.rig.T_tool_camera
        view = self.camera.capture()
        self._check_view(self.extract_patch(view, self.camera.camera, T_w_c, site.T_w_t))
        return view, T_w_c

    def prepare(self, prepare: Array, log: EventLog) -> None:
        """Zero the wrench before a site, and go near it.

        Args:
            prepare: T_b_t (4, 4), m, before the site.
            log: Receives everything that happens.

        Raises:
            TouchFailedError: Something is met there.
            DeviceError: A device fails.
        """
        settings = self.settings
        log.event("prepare")
        if not is_at(self.arm.state(), prepare):
            self.arm.go(prepare, self.path.free_speed, settings.acceleration)
            self.clock.sleep(settings.settle)
        self.arm.zero_wrench()
        distance = settings.prepare - settings.near
        met, _ = self._approach(distance, settings.approach, self._rest_readings(log), log)
        if met.reason != "distance":
            raise TouchFailedError(
                f"something was met {1e3 * (settings.prepare - met.distance):.0f} mm before the site"
            )

    def press(self, log: EventLog) -> Press:
        """Take the ambient, press until something says stop, and read the skins in contact.

        Args:
            log: Receives everything that happens.

        Returns:
            The press; the tool is still in contact.

        Raises:
            DeviceError: A device fails.
        """
        settings = self.settings
        log.event("ambient")
        ambient = self._rest_readings(log)
        log.event("press")
        started = self.clock.now()
        result, stop = self._approach(settings.near + settings.overtravel, settings.press, ambient, log)
        stopped_by = " and ".join(name or self.rig.skin for name in stop.stopped_by)
        period = started, self.clock.now()
        which = f" {stopped_by}" if len(self.skins) > 1 and stopped_by else ""
        log.event(f"stopped by {'skin' if result.reason == 'condition' else result.reason}{which}")
        self.clock.sleep(settings.hold)
        states = [self.arm.state()]
        changes = {name: mean - ambient[name] for name, mean in self._means(settings.contact, log).items()}
        states.append(self.arm.state())
        for state in states:
            log.state(state)
        self._check_alive(log, period)
        felt_by = [each.name for each in self.skins if felt(changes[each.name], each.board, settings)]
        return Press(result, log, period, ambient, states, changes, felt_by or [TOOL])

    def _check_alive(self, log: EventLog, period: tuple[float, float]) -> None:
        """Refuse a press at whose end a skin sent one sample again and again; a simulated one may be without noise."""
        for each in self.skins:
            rows = [row[1:] for _, row in sorted(log.readings[each.name].items()) if row[0] >= period[0]]
            if rows and each.skin.features.source != "simulated":
                stands = frozen_sentence(np.array(rows[-LAST_SAMPLES:])[:, : each.board.num_readings])
                if stands:
                    raise DeviceError(f"{each.skin.features.name}: {stands}")

    def _skin_touch(
        self, on_tool: SkinOnTool, press: Press, view: View, T_w_c: Array, before: SkinCounters
    ) -> SkinTouch:
        """What a skin felt in a press; `before` are its counters before the touch."""
        name = on_tool.name
        change, ambient = press.changes[name], press.ambient[name]
        T_b_s = press.states[-1].T_b_t @ on_tool.T_tool_skin
        T_w_s = self.rig.T_world_base @ T_b_s
        code = RETURN_CODES[press.result.reason] if name in press.felt_by else ReturnCode.AIR
        force = depth = np.nan
        if press.felt_by == [name]:
            along = on_tool.T_tool_skin[:3, 2]
            force = -float(np.mean([state.wrench[:3] @ along for state in press.states]))
        if code != ReturnCode.AIR:
            depth = onset_distance(*press_samples(press.log, on_tool, press.period, T_b_s), ambient, change)
        seen = self.extract_patch(view, self.camera.camera, T_w_c, T_w_s)
        counters = _counted_since(on_tool.skin.counters, before)
        return SkinTouch(T_w_s, code, ambient, change, force, depth, seen, counters)

    def _means(self, count: int, log: EventLog) -> dict[str, Array]:
        """(c,) uT, the mean of the next samples of each skin, by its name."""
        means = {}
        for each in self.skins:
            samples = each.skin.read(count)
            log.samples(samples, each.name)
            means[each.name] = mean_known(samples.reading, axis=0)
        return means

    def _rest_readings(self, log: EventLog) -> dict[str, Array]:
        """(c,) uT of each skin at rest, by its name; NaN for a chip that does not answer."""
        means = self._means(self.settings.ambient, log)
        for each in self.skins:
            answering = int(np.isfinite(means[each.name]).sum()) // 3
            if answering < MIN_CHIP_SHARE * each.board.num_chips:
                raise DeviceError(
                    f"only {answering} of {each.board.num_chips} chips of {each.skin.features.name} answer, too few to "
                    "feel a press; check the board's cables"
                )
        return means

    def _approach(
        self, distance: float, speed: float, ambient: Mapping[str, Array], log: EventLog
    ) -> tuple[ApproachResult, StopCondition]:
        """Go along tool z under the skins' stop condition."""
        settings, start = self.settings, self.arm.state()
        most = {"force": settings.force, "torque": settings.torque}
        motion = {"distance": distance, "speed": speed, **most}
        watch = MotionWatch(self.arm, self.rig.limits, start, **motion, clock=self.clock)
        stop = StopCondition(self.skins, settings, ambient, log, watch)
        if distance <= 0:
            return ApproachResult("distance", None, start, start, 0.0), stop
        return stop.judged(self.arm.approach(distance, speed, stop, **most, acceleration=settings.acceleration)), stop

    def _check_view(self, seen: SeenPatch) -> None:
        """Refuse a site that the camera contradicts."""
        if not seen.visible_share >= self.settings.min_visible_share:
            raise TouchFailedError(
                f"the camera saw {100 * seen.visible_share:.0f} % of the site's surroundings; is it covered, or shiny?"
            )
        if not seen.nearest >= -self.settings.surface_tolerance:
            raise TouchFailedError(
                f"the camera sees a surface {-1e3 * seen.nearest:.1f} mm before the site: register the object again, "
                "or clear the table"
            )

    def _check_air(self, seen: SeenPatch | None) -> None:
        """Refuse a press that met nothing although it went through what the camera sees."""
        if seen is not None and seen.nearest < -self.settings.air_tolerance:
            raise MissedContactError(
                f"the press met nothing, but the camera sees a surface {-1e3 * seen.nearest:.1f} mm before its end: "
                "check that the arm measures force, and the camera's calibration"
            )

    # Between touches

    @property
    def path(self) -> TouchPath:
        """Path of the tool, and its checks."""
        planned = self.arm.why_unreachable if isinstance(self.arm, PlanningArm) else None
        return TouchPath(self.rig, self.settings, self.top, planned)

    def move_above(self, goal: Array) -> None:
        """Go up, across and down to a pose, unless the tool is there.

        Args:
            goal: (4, 4) T_b_t, m.
        """
        state = self.arm.state()
        if is_at(state, goal):
            return
        height = max(self.path.transfer_height(), goal[2, 3])
        lifted, over = state.T_b_t.copy(), goal.copy()
        lifted[2, 3], over[2, 3] = max(height, lifted[2, 3]), max(height, lifted[2, 3])
        for T_b_t in (lifted, over, goal):
            if not is_at(state, T_b_t):
                state = self.arm.go(T_b_t, self.path.free_speed, self.settings.acceleration)

    def retreat(self) -> None:
        """Retreat from whatever the tool may touch: back along its axis, as far as the box allows, then up.

        At the edge of the box there may be no way back along the axis. A skin that faces down is then lifted straight
        up: that leads away from what it pressed, and what slides along its side is stopped by the force limit of free
        motions. A skin that faces up would be lifted into what it touches, so that a person is asked.

        Raises:
            DeviceError: The tool is outside the box, or faces up where the box ends behind it, or the arm fails.
        """
        T_b_t = self.arm.state().T_b_t
        height = self.path.transfer_height()
        if T_b_t[2, 3] >= height:
            return
        steps = (shifted_along_z(T_b_t, -share * self.settings.prepare) for share in RETREAT_SHARES)
        back = next((pose for pose in steps if self.rig.limits.contains(pose[:3, 3])), None)
        if back is None:
            raise DeviceError(
                f"the tool at {format_position(T_b_t[:3, 3])} m is outside its box: bring it back with the pendant"
            )
        faces_up = T_b_t[2, 2] > 0
        if faces_up and np.linalg.norm(back[:3, 3] - T_b_t[:3, 3]) < 0.99 * self.settings.prepare:
            raise DeviceError(
                f"the skin faces up at {format_position(T_b_t[:3, 3])} m, and the box ends behind the tool: lifted, it "
                "might push into what it touches; bring it back with the pendant"
            )
        self.arm.go(back, self.path.retreat_speed, self.settings.acceleration)
        back[2, 3] = max(height, back[2, 3])
        self.arm.go(back, self.path.free_speed, self.settings.acceleration)

    def recover(self) -> None:
        """Recover from a failure: stand, retreat, and reconnect skins and camera where they fail.

        Raises:
            DeviceError: The arm, or after `patience` another device, needs a person.
        """
        self.arm.stop()
        self.arm.state()
        self.retreat()
        give_up = self.clock.now() + self.settings.patience
        for each in self.skins:
            self._reconnect(each.skin, partial(each.skin.read, 1), give_up)
        self._reconnect(self.camera, self.camera.capture, give_up)

    def _reconnect(self, device: Skin | DepthCamera, speak: Callable[[], object], give_up: float) -> None:
        """Connect a device until it speaks; raises its DeviceError after a time (s)."""
        while True:
            try:
                speak()
                return
            except DeviceError:
                if self.clock.now() > give_up:
                    raise
            self.clock.sleep(RECONNECT_WAIT_S)
            with contextlib.suppress(DeviceError):
                device.connect()


def _without_images(touch: TouchResult) -> TouchResult:
    """A touch as a history keeps it: images would fill the memory."""
    return touch._replace(view=None, skins={name: each._replace(seen=None) for name, each in touch.skins.items()})


def _counted_since(now: SkinCounters, before: SkinCounters) -> SkinCounters:
    counted = {name: getattr(now, name) - getattr(before, name) for name in now._fields if name != "rate"}
    return SkinCounters(**counted, rate=now.rate)


def is_at(state: ArmState, goal: Array) -> bool:
    """Test whether the tool stands at a pose.

    Args:
        state: Of the arm.
        goal: (4, 4) T_b_t, m.

    Returns:
        True within a millimetre and half a degree.
    """
    away = np.linalg.norm(state.T_b_t[:3, 3] - goal[:3, 3])
    turned = np.abs(state.T_b_t[:3, :3] - goal[:3, :3]).max()
    return bool(away < POSE_TOLERANCES[0] and turned < POSE_TOLERANCES[1])
