"""Procedure that makes one touch after another, as the paper does: choose, look, extract the patch, prepare, measure
the ambient field, press, retreat.

    look      The camera looks at the site from `rig.looking_distance`; a given function extracts the patch.
    prepare   The skin stands at `prepare` before the site, its z along the site's. The wrench is zeroed in the air.
    approach  The tool goes fast to `near` before the site. A contact here was not expected: the touch has failed.
    ambient   Mean of some samples at rest.
    press     The tool goes on slowly until a skin, force, torque or distance limit is reached. Then the mean of some
              samples in contact is measured.
    retreat   The tool goes back to where it prepared. Between sites it goes up, across and down.

Every motion is one of an arm that guards itself (`i2t.hardware.protocols.GuardedArm`). Its goals are checked before the
first motion (`i2t.collect.path`). A press without contact has failed if the camera sees a surface there. A plain
callable, `choose(history) -> site`, chooses the next site. Numbers are those of the paper and its code, if they state
them, except where `TouchSettings` gives a reason.

All skins on the tool are read, and each may stop an approach. A skin has felt a press if the part of its change that
differs between its chips exceeds half of what stops a press. A press that a skin did not feel counts as no contact of
that skin, whatever ended it. If none felt the press, the touch is attributed to the pressing skin. The arm measures one
force for all skins: it is assigned to a skin if no other felt the press, and is unknown (NaN) otherwise.

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
from i2t.collect.stopping import StopCondition, is_felt, onset_distance, press_samples
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
from i2t.hardware.poses import translated_along_z
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
from i2t.skin.boards import mean_finite
from i2t.types import Array, ReturnCode

# Return code of a press, by the reason for which it stopped.
RETURN_CODES: Mapping[StopReason, ReturnCode] = {
    "condition": ReturnCode.SKIN,
    "force": ReturnCode.WRENCH,
    "torque": ReturnCode.WRENCH,
    "distance": ReturnCode.AIR,
}


class HeldPress(NamedTuple):
    """A press that has ended and whose readings were taken, before the tool retreats; if it ended by distance, nothing
    was met.
    """

    result: ApproachResult
    log: EventLog  # log of the touch
    period: tuple[float, float]  # times (s) at which the press began and ended
    ambient: dict[str, Array]  # (c,) reading (uT) of each skin before the press, by its name
    states: list[ArmState]  # states before and after the samples in contact
    changes: dict[str, Array]  # (c,) change (uT) of each skin in contact, by its name
    felt_by: list[str]  # names of the skins that detected the press; the pressing skin if none did


@dataclass
class Procedure:
    """Touch procedure: looks at sites of an object, presses the skin onto them and records the readings.

    Args:
        arm: The arm; it is connected, like skins and camera.
        skins: Skins on the tool, the pressing one first.
        camera: Camera that the arm carries.
        rig: Calibration of the lab.
        extract_patch: Function that extracts a depth patch from a view, given also the camera, its pose T_w_c and the
            tool's pose T_w_t.
        top: Height (m) of the object's highest point in W.
        settings: Distances, speeds and limits of a touch.
        clock: Common clock of the devices.
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
        """Touch the chosen sites until none is chosen.

        Args:
            choose: Function that chooses the next site from the outcomes of earlier ones, or returns None to end.
            recorder: Recorder of the touches.

        Yields:
            The outcome of each site, once its touch is stored.

        Raises:
            ValueError: If the settings exceed the arm's limits; nothing has moved then.
            DeviceError: If a person is needed to go on, as in `attempt`.
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
        """Touch a site, with further attempts if necessary, and record the result.

        Args:
            site: The site to touch.
            recorder: Recorder of the touch.

        Returns:
            The touch and its return code, or the reason why there is no touch.

        Raises:
            DeviceError: If a person is needed: the arm was stopped, a device does not respond again, the disk is full,
                or every attempt met nothing although the camera sees a surface.
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
        """Make one touch of a site: look, approach, press, read the skins and retreat.

        Args:
            site: The site to touch.
            log: Log of all events.
            attempt: Number of earlier attempts at this site, 0 for the first.

        Returns:
            The touch, after the retreat of the tool.

        Raises:
            DeviceError: If the touch failed; a TouchFailedError if the site is the cause.
        """
        look, prepare, _, _ = self.path.poses(site)
        self.path.check(site)
        before = {on_tool.name: on_tool.skin.counters for on_tool in self.skins}
        view, T_w_c = self._look(site, look, log)
        self.prepare(prepare, log)
        press = self.press(log)
        log.event("retreat")
        self.arm.go(prepare, self.path.retreat_speed, self.settings.acceleration)
        skins = {
            on_tool.name: self._skin_touch(on_tool, press, view, T_w_c, before[on_tool.name]) for on_tool in self.skins
        }
        reason = press.result.reason
        if RETURN_CODES[reason] == ReturnCode.AIR:
            self._check_air(skins[TOOL].seen)
        return TouchResult(site, attempt, reason, skins, view, T_w_c)

    def _look(self, site: Site, look: Array, log: EventLog) -> tuple[View, Array]:
        """Take a view of the site that does not contradict the rig. Return it with the camera's pose T_w_c (4, 4)."""
        log.event("look")
        self.move_above(look)
        self.clock.sleep(self.settings.settle)
        T_w_c = self.rig.T_world_base @ self.arm.state().T_b_t @ self.rig.T_tool_camera
        view = self.camera.capture()
        self._check_view(self.extract_patch(view, self.camera.camera, T_w_c, site.T_w_t))
        return view, T_w_c

    def prepare(self, prepare: Array, log: EventLog) -> None:
        """Move to a pose before a site, zero the force sensor there, and approach the site fast.

        Args:
            prepare: `(4, 4)` pose T_b_t (m) of the tool before the site.
            log: Log of all events.

        Raises:
            TouchFailedError: If the approach meets something.
            DeviceError: If a device fails.
        """
        settings = self.settings
        log.event("prepare")
        if not is_at(self.arm.state(), prepare):
            self.arm.go(prepare, self.path.free_speed, settings.acceleration)
            self.clock.sleep(settings.settle)
        self.arm.zero_wrench()
        distance = settings.prepare - settings.near
        result, _ = self._approach(distance, settings.approach, self._measure_ambient(log), log)
        if result.reason != "distance":
            raise TouchFailedError(
                f"something was met {1e3 * (settings.prepare - result.distance):.0f} mm before the site"
            )

    def press(self, log: EventLog) -> HeldPress:
        """Measure the ambient field, press until a limit of skin, force, torque or distance, and read the skins.

        Args:
            log: Log of all events.

        Returns:
            The press, with the tool still in contact.

        Raises:
            DeviceError: If a device fails.
        """
        settings = self.settings
        log.event("ambient")
        ambient = self._measure_ambient(log)
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
        felt_by = [on_tool.name for on_tool in self.skins if is_felt(changes[on_tool.name], on_tool.board, settings)]
        return HeldPress(result, log, period, ambient, states, changes, felt_by or [TOOL])

    def _check_alive(self, log: EventLog, period: tuple[float, float]) -> None:
        """Refuse a press at whose end a skin, other than a simulated one without noise, repeated one sample."""
        for on_tool in self.skins:
            rows = [row[1:] for _, row in sorted(log.readings[on_tool.name].items()) if row[0] >= period[0]]
            if rows and on_tool.skin.features.source != "simulated":
                defect = frozen_sentence(np.array(rows[-48:])[:, : on_tool.board.num_readings])
                if defect:
                    raise DeviceError(f"{on_tool.skin.features.name}: {defect}")

    def _skin_touch(
        self, on_tool: SkinOnTool, press: HeldPress, view: View, T_w_c: Array, before: SkinCounters
    ) -> SkinTouch:
        """Evaluate a press for one skin; `before` holds its counters before the touch."""
        name = on_tool.name
        change, ambient = press.changes[name], press.ambient[name]
        T_b_s = press.states[-1].T_b_t @ on_tool.T_tool_skin
        T_w_s = self.rig.T_world_base @ T_b_s
        code = RETURN_CODES[press.result.reason] if name in press.felt_by else ReturnCode.AIR
        force = travel = np.nan
        if press.felt_by == [name]:
            along = on_tool.T_tool_skin[:3, 2]
            force = -float(np.mean([state.wrench[:3] @ along for state in press.states]))
        if code != ReturnCode.AIR:
            travel = onset_distance(*press_samples(press.log, on_tool, press.period, T_b_s), ambient, change)
        seen = self.extract_patch(view, self.camera.camera, T_w_c, T_w_s)
        counters = _counter_differences(on_tool.skin.counters, before)
        return SkinTouch(T_w_s, code, ambient, change, force, travel, seen, counters)

    def _means(self, count: int, log: EventLog) -> dict[str, Array]:
        """Average the next samples of each skin: (c,) readings (uT) by the names of the skins."""
        means = {}
        for on_tool in self.skins:
            samples = on_tool.skin.read(count)
            log.samples(samples, on_tool.name)
            means[on_tool.name] = mean_finite(samples.reading, axis=0)
        return means

    def _measure_ambient(self, log: EventLog) -> dict[str, Array]:
        """Measure the (c,) reading (uT) of each skin at rest, by its name; NaN for a chip that does not answer."""
        means = self._means(self.settings.ambient, log)
        for on_tool in self.skins:
            answering = int(np.isfinite(means[on_tool.name]).sum()) // 3
            if answering < 0.5 * on_tool.board.num_chips:
                raise DeviceError(
                    f"only {answering} of {on_tool.board.num_chips} chips of {on_tool.skin.features.name} answer, too "
                    "few to detect a press; check the board's cables"
                )
        return means

    def _approach(
        self, distance: float, speed: float, ambient: Mapping[str, Array], log: EventLog
    ) -> tuple[ApproachResult, StopCondition]:
        """Move along tool z under the stop condition of the skins."""
        settings, start = self.settings, self.arm.state()
        bounds = {"force": settings.force, "torque": settings.torque}
        motion = {"distance": distance, "speed": speed, **bounds}
        watch = MotionWatch(self.arm, self.rig.limits, start, **motion, clock=self.clock)
        stop = StopCondition(self.skins, settings, ambient, log, watch)
        if distance <= 0:
            return ApproachResult("distance", None, start, start, 0.0), stop
        return stop.corrected(
            self.arm.approach(distance, speed, stop, **bounds, acceleration=settings.acceleration)
        ), stop

    def _check_view(self, seen: SeenPatch) -> None:
        """Refuse a site that the camera contradicts."""
        if not seen.visible_share >= self.settings.min_visible_share:
            raise TouchFailedError(
                f"the camera saw {100 * seen.visible_share:.0f} % of the surface around the site; check whether it is "
                "covered or shiny"
            )
        if not seen.nearest >= -self.settings.surface_tolerance:
            raise TouchFailedError(
                f"the camera sees a surface {-1e3 * seen.nearest:.1f} mm before the site: register the object again, "
                "or clear the table"
            )

    def _check_air(self, seen: SeenPatch | None) -> None:
        """Refuse a press that met nothing although it went through a surface that the camera sees."""
        if seen is not None and seen.nearest < -self.settings.air_tolerance:
            raise MissedContactError(
                f"the press met nothing, but the camera sees a surface {-1e3 * seen.nearest:.1f} mm before its end: "
                "check that the arm measures force, and the camera's calibration"
            )

    # Between touches

    @property
    def path(self) -> TouchPath:
        """Poses and path of the tool in each touch, with their checks."""
        planned = self.arm.why_unreachable if isinstance(self.arm, PlanningArm) else None
        return TouchPath(self.rig, self.settings, self.top, planned)

    def move_above(self, goal: Array) -> None:
        """Move the tool up, across above the object and down to a pose, unless the tool is there already.

        Args:
            goal: `(4, 4)` pose T_b_t (m) of the tool in the base.
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
        """Move the tool out of a possible contact: back along its axis, as far as the box allows, then up.

        At the edge of the box, there may be no room to move back along the axis. A skin that faces down is then lifted
        straight up, away from what it pressed; contact along its side is stopped by the force limit of free motions.
        CAUTION: a skin that faces up would be lifted into what it touches, so that a person must move it.

        Raises:
            DeviceError: If the tool is outside the box, or faces up where the box ends behind it, or if the arm fails.
        """
        T_b_t = self.arm.state().T_b_t
        height = self.path.transfer_height()
        if T_b_t[2, 3] >= height:
            return
        steps = (translated_along_z(T_b_t, -part * self.settings.prepare) for part in (1.0, 0.5, 0.25, 0.1, 0.0))
        back = next((pose for pose in steps if self.rig.limits.contains(pose[:3, 3])), None)
        if back is None:
            raise DeviceError(
                f"the tool at {format_position(T_b_t[:3, 3])} m is outside its box: bring it back with the pendant"
            )
        faces_up = T_b_t[2, 2] > 0
        if faces_up and np.linalg.norm(back[:3, 3] - T_b_t[:3, 3]) < 0.99 * self.settings.prepare:
            raise DeviceError(
                f"the skin faces up at {format_position(T_b_t[:3, 3])} m, and the box ends behind the tool: lifting "
                "the tool might push the skin into an obstacle; bring it back with the pendant"
            )
        self.arm.go(back, self.path.retreat_speed, self.settings.acceleration)
        back[2, 3] = max(height, back[2, 3])
        self.arm.go(back, self.path.free_speed, self.settings.acceleration)

    def recover(self) -> None:
        """Recover from a failed touch: stop the arm, retreat, and reconnect skins and camera that fail.

        Raises:
            DeviceError: If the arm fails, or another device still fails after `settings.patience`.
        """
        self.arm.stop()
        self.arm.state()
        self.retreat()
        give_up = self.clock.now() + self.settings.patience
        for on_tool in self.skins:
            self._reconnect(on_tool.skin, partial(on_tool.skin.read, 1), give_up)
        self._reconnect(self.camera, self.camera.capture, give_up)

    def _reconnect(self, device: Skin | DepthCamera, speak: Callable[[], object], give_up: float) -> None:
        """Connect a device until it responds. Raise its DeviceError after a time (s)."""
        while True:
            try:
                speak()
                return
            except DeviceError:
                if self.clock.now() > give_up:
                    raise
            self.clock.sleep(0.2)
            with contextlib.suppress(DeviceError):
                device.connect()


def _without_images(touch: TouchResult) -> TouchResult:
    """Copy a touch without its images, which would fill the memory of a history."""
    return touch._replace(
        camera_view=None, skins={name: skin._replace(seen=None) for name, skin in touch.skins.items()}
    )


def _counter_differences(now: SkinCounters, before: SkinCounters) -> SkinCounters:
    counted = {name: getattr(now, name) - getattr(before, name) for name in now._fields if name != "rate"}
    return SkinCounters(**counted, rate=now.rate)


def is_at(state: ArmState, goal: Array) -> bool:
    """Test whether the tool is at a pose.

    Args:
        state: State of the arm.
        goal: `(4, 4)` pose T_b_t (m) to compare with.

    Returns:
        True if they agree within a millimetre and about half a degree.
    """
    distance = np.linalg.norm(state.T_b_t[:3, 3] - goal[:3, 3])
    turn = np.abs(state.T_b_t[:3, :3] - goal[:3, :3]).max()
    return bool(distance < 1e-3 and turn < 0.01)
