"""Stop of a press by the skins on the tool, and estimate of its first contact.

A press ends if the mean change of some samples of a skin is large enough, and differs enough between chips: a change
that all chips see alike, in common axes, is a field of the room. It also ends if the arm's states exceed the requested
limits, whether or not the arm enforces them itself. Afterwards, first contact is found by extrapolating the samples to
zero change.
"""

from collections.abc import Mapping, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float

from i2t.collect.recorder import EventLog
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import SkinOnTool
from i2t.errors import DeviceError
from i2t.hardware.guarded import MotionWatch
from i2t.hardware.protocols import ApproachResult, ArmState
from i2t.skin.boards import mean_finite
from i2t.types import Array, Board


class StopCondition:
    """Condition that stops an approach as soon as force or torque exceeds its limit, or the mean of one skin's last
    samples differs enough from ambient, in its norm and in its non-uniform part. The arm calls it with every state.

    Args:
        skins: Connected skins.
        settings: Settings with the change that stops an approach.
        ambient: `(3 chips,)` reading (uT) of each skin before contact, by its name.
        log: Log that receives every sample and state.
        watch: Check of the arm's states against the limits of the motion.
    """

    def __init__(
        self,
        skins: Sequence[SkinOnTool],
        settings: TouchSettings,
        ambient: Mapping[str, Float[Array, " c"]],
        log: EventLog,
        watch: MotionWatch,
    ) -> None:
        self.stopped_by: list[str] = []  # names of the skins that stopped the approach
        self._watch, self._asked = watch, False
        self._above: Literal["force", "torque"] | None = None
        self._skins, self._settings, self._ambient, self._log = skins, settings, ambient, log
        silence = max(settings.silence, 0.4)  # s, before the arm has started
        self._numbers = {on_tool.name: int(on_tool.skin.latest(silence).number[-1]) for on_tool in skins}
        self._last: dict[str, list[Array]] = {on_tool.name: [] for on_tool in skins}

    def __call__(self, state: ArmState) -> float | str | None:
        """Test whether a skin has changed enough, or whether force or torque exceeds its limit.

        Args:
            state: The arm's newest state.

        Returns:
            The change (uT) of the first skin that stops the approach, or "force" or "torque", else None.

        Raises:
            DeviceTimeoutError: If a skin is silent, or the state is old.
            DeviceError: If a chip has stopped answering, or the arm is where it should not be.
        """
        self._asked = True
        self._log.state(state)
        self._above = self._watch(state)
        if self._above:
            return self._above
        answers = {on_tool.name: self._stopping_change(on_tool) for on_tool in self._skins}
        self.stopped_by = [name for name, answer in answers.items() if answer is not None]
        return answers[self.stopped_by[0]] if self.stopped_by else None

    def corrected(self, result: ApproachResult) -> ApproachResult:
        """Correct the reason for an approach's end: force or torque if a state of the arm exceeded that limit.

        Args:
            result: Outcome that the arm reports.

        Returns:
            The outcome, whose reason is "force" or "torque" if a state exceeded that limit.

        Raises:
            DeviceError: If the arm did not call the condition as it moved, still moves, or is not where the approach
                should have ended.
        """
        above = self._watch(result.state)
        if result.state.moving:
            raise DeviceError("the arm still moves after its approach has ended; see `approach` of its driver")
        if not (self._asked or result.distance <= 1e-3):  # a shorter approach may end before it asks
            raise DeviceError("the arm's approach did not evaluate its stop condition; see `approach` of its driver")
        if result.reason == "distance":
            return result._replace(reason=above or "distance")
        return result._replace(reason=self._above, answer=None) if self._above else result

    def _stopping_change(self, on_tool: SkinOnTool) -> float | None:
        """Return the change (uT) of a skin if it stops the approach, else None."""
        settings = self._settings
        self._take_samples(on_tool)
        last = self._last[on_tool.name]
        if len(last) < settings.averaged_samples:
            return None
        change = mean_finite(np.array(last), axis=0) - self._ambient[on_tool.name]
        self._check_chips(change, on_tool)
        size, nonuniform = _size(change), _size(nonuniform_field(change, on_tool.board))
        if not np.isfinite(size):
            raise DeviceError(f"{on_tool.skin.features.name} sends infinite values; check the board")
        enough = not size <= settings.skin_change and not nonuniform <= settings.nonuniform_share * settings.skin_change
        return size if enough else None

    def _check_chips(self, change: Array, on_tool: SkinOnTool) -> None:
        """Raise DeviceError if a chip stopped answering, because its contact would go unnoticed."""
        lost = np.isfinite(self._ambient[on_tool.name]) & ~np.isfinite(change)
        if lost.any():
            raise DeviceError(
                f"chip {int(np.argmax(lost)) // 3} of {on_tool.skin.features.name} stopped answering during an "
                "approach; check its cable and its solder"
            )

    def _take_samples(self, on_tool: SkinOnTool) -> None:
        """Take new samples. Raise DeviceTimeoutError if the skin is silent."""
        name, skin = on_tool.name, on_tool.skin
        fresh = skin.since(self._numbers[name])
        if not len(fresh.number):
            skin.latest(self._settings.silence)
            return
        self._log.samples(fresh, name)
        self._numbers[name] = int(fresh.number[-1])
        self._last[name] = [*self._last[name], *fresh.reading][-self._settings.averaged_samples :]


def press_samples(
    log: EventLog, on_tool: SkinOnTool, period: tuple[float, float], T_b_s: Float[Array, "4 4"]
) -> tuple[Float[Array, "n c"], Float[Array, " n"]]:
    """Collect the samples of a press from its log, and the distance of the skin from its final position at each.

    Args:
        log: Log of the touch.
        on_tool: The skin whose samples are collected.
        period: Monotonic times (s) at which the press began and ended.
        T_b_s: `(4, 4)` final pose (m) of the skin in the base.

    Returns:
        `(n, 3 chips)` readings (uT), and `(n,)` distances (m) that the skin still had to go along its z, positive
        before the end.
    """
    begun, ended = period
    rows = [row for _, row in sorted(log.readings[on_tool.name].items()) if begun <= row[0] <= ended]
    states = [state for state in log.states if begun <= state.time <= ended]
    if not rows or not states:
        return np.zeros((0, on_tool.board.num_readings)), np.zeros(0)
    samples = np.array(rows)
    positions = np.array([(state.T_b_t @ on_tool.T_tool_skin)[:3, 3] for state in states])
    before = (T_b_s[:3, 3] - positions) @ T_b_s[:3, 2]
    readings = samples[:, 1 : 1 + on_tool.board.num_readings]
    return readings, np.interp(samples[:, 0], [state.time for state in states], before)


def is_felt(change: Float[Array, " c"], board: Board, settings: TouchSettings) -> bool:
    """Test whether a skin has felt a press.

    Args:
        change: `(3 chips,)` change (uT) of the reading since before the press.
        board: Board of the skin.
        settings: Settings with the change that stops a press.

    Returns:
        True if the part of the change that differs between chips exceeds half of what stops a press. If the settings
        require no difference, the whole change counts.
    """
    differing = nonuniform_field(change, board) if settings.nonuniform_share else change
    return _size(differing) > 0.5 * settings.skin_change


def nonuniform_field(change: Float[Array, " c"], board: Board) -> Float[Array, "chips 3"]:
    """Compute the part of a reading's change that differs between chips: the change minus its mean over the chips.

    Args:
        change: `(3 chips,)` change (uT) of a reading; NaN for a missing chip.
        board: Board of the reading.

    Returns:
        `(chips, 3)` field (uT) in tool axes, with mean zero over the chips that answered.
    """
    field = np.asarray(board.to_tool(change))
    return field - mean_finite(field, axis=0)


def onset_distance(
    readings: Float[Array, "n c"],
    before: Float[Array, " n"],
    ambient: Float[Array, " c"],
    change: Float[Array, " c"],
    *,
    fit_range: tuple[float, float] = (0.15, 0.7),
    min_samples: int = 3,
) -> float:
    """Estimate how far a press went past first contact from the readings during it.

    A line is fitted to the samples whose change, along the final change, is within a range of it, and extrapolated to
    zero change. Missing chips are left out. The line is right for a flat face; if the force grows as the indentation to
    the power 1.5, the result is a fifth too short.

    Args:
        readings: `(n, c)` readings (uT) of the press.
        before: `(n,)` distances (m) that the tool still had to go to its final position at these readings.
        ambient: `(c,)` reading (uT) before contact.
        change: `(c,)` final change (uT).
        fit_range: Fractions of the final change between which samples are fitted.
        min_samples: Minimum number of samples in that range.

    Returns:
        Distance (m) from first contact to the end; NaN if the samples in the range are too few or too alike for a line.
    """
    answered = np.isfinite(change)
    complete = np.isfinite(readings[:, answered]).all(1)
    readings, before, ambient, change = (
        readings[complete][:, answered],
        before[complete],
        ambient[answered],
        change[answered],
    )
    size = float(np.linalg.norm(change))
    fraction = (readings - ambient) @ change / max(size, 1e-9) ** 2
    low = fraction < fit_range[0]
    last_low = len(fraction) - int(np.argmax(low[::-1])) if low.any() else 0
    rising = (np.arange(len(fraction)) >= last_low) & (fraction <= fit_range[1])
    if rising.sum() < min_samples or np.ptp(fraction[rising]) < 0.1:
        return float("nan")
    slope, onset = np.polyfit(fraction[rising], before[rising], 1)
    return float(max(0.0, onset)) if slope < 0 else float("nan")


def _size(change: Array) -> float:
    return float(np.sqrt(np.nansum(change**2)))
