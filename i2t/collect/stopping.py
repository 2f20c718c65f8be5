"""Stop of a press by the skins on the tool, and beginning of that press.

A press ends where the mean change of some samples of a skin is large enough, and differs enough between chips: a change
that all chips see alike, turned to common axes, is a field of the room. It ends, too, where the arm's states are beyond
what was asked, whether or not the arm itself sees to that. Afterwards the contact onset is found by following the
samples back to zero change.
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
from i2t.skin.boards import mean_known
from i2t.types import Array, Board

ONSET_RANGE = (0.15, 0.7)  # shares of the final change between which the line of the contact onset is fitted
MIN_ONSET_SAMPLES = 3
AT_REST_SILENCE_S = 0.4  # that a skin may be silent while the arm still stands
UNASKED_M = 1e-3  # of an approach, in which its stop condition need not have been asked
FELT_SHARE = 0.5  # of the change that stops a press, above which a skin has felt it


class StopCondition:
    """Stops an approach as soon as one of the skins on the tool does; asked with every state of the approach.

    Args:
        skins: Connected.
        settings: Which change is enough.
        ambient: (3 chips,) uT of each skin before contact, by its name.
        log: Receives every sample and state.
        watch: Judges the arm's states.
    """

    def __init__(
        self,
        skins: Sequence[SkinOnTool],
        settings: TouchSettings,
        ambient: Mapping[str, Float[Array, " c"]],
        log: EventLog,
        watch: MotionWatch,
    ) -> None:
        self.stopped_by: list[str] = []  # names of the skins that stopped it
        self._watch, self._asked = watch, False
        self._above: Literal["force", "torque"] | None = None
        self._skins, self._settings, self._ambient, self._log = skins, settings, ambient, log
        silence = max(settings.silence, AT_REST_SILENCE_S)
        self._numbers = {each.name: int(each.skin.latest(silence).number[-1]) for each in skins}
        self._last: dict[str, list[Array]] = {each.name: [] for each in skins}

    def __call__(self, state: ArmState) -> float | str | None:
        """Test whether a skin has changed enough, or force or torque is above its limit.

        Args:
            state: The arm's newest.

        Returns:
            The change (uT) of the first skin that has, or "force" or "torque", else None.

        Raises:
            DeviceTimeoutError: A skin is silent, or the state old.
            DeviceError: A chip has stopped answering, or the arm is where it should not be.
        """
        self._asked = True
        self._log.state(state)
        self._above = self._watch(state)
        if self._above:
            return self._above
        answers = {each.name: self._enough(each) for each in self._skins}
        self.stopped_by = [name for name, answer in answers.items() if answer is not None]
        return answers[self.stopped_by[0]] if self.stopped_by else None

    def judged(self, result: ApproachResult) -> ApproachResult:
        """Outcome of the approach, as the states have it.

        Args:
            result: As the arm has it.

        Returns:
            It, with force or torque as its reason where the arm itself did not see to them.

        Raises:
            DeviceError: The arm did not ask on its way, moves on, or is where it should not be.
        """
        above = self._watch(result.state)
        if result.state.moving:
            raise DeviceError("the arm's approach has ended, and the arm moves; see `approach` of its driver")
        if not (self._asked or result.distance <= UNASKED_M):
            raise DeviceError("the arm's approach did not ask its stop condition; see `approach` of its driver")
        if result.reason == "distance":
            return result._replace(reason=above or "distance")
        return result._replace(reason=self._above, answer=None) if self._above else result

    def _enough(self, on_tool: SkinOnTool) -> float | None:
        """The change (uT) of a skin if it is enough, else None."""
        settings = self._settings
        self._hear(on_tool)
        last = self._last[on_tool.name]
        if len(last) < settings.averaged_samples:
            return None
        change = mean_known(np.array(last), axis=0) - self._ambient[on_tool.name]
        self._check_chips(change, on_tool)
        size, nonuniform = _size(change), _size(nonuniform_field(change, on_tool.board))
        if not np.isfinite(size):
            raise DeviceError(f"{on_tool.skin.features.name} sends infinite values; check the board")
        enough = not size <= settings.skin_change and not nonuniform <= settings.nonuniform_share * settings.skin_change
        return size if enough else None

    def _check_chips(self, change: Array, on_tool: SkinOnTool) -> None:
        """Raise DeviceError if a chip that answered before the press does not any more: what it feels is not known."""
        lost = np.isfinite(self._ambient[on_tool.name]) & ~np.isfinite(change)
        if lost.any():
            raise DeviceError(
                f"chip {int(np.argmax(lost)) // 3} of {on_tool.skin.features.name} stopped answering during an "
                "approach; check its cable and its solder"
            )

    def _hear(self, on_tool: SkinOnTool) -> None:
        """Take new samples; raises DeviceTimeoutError if the skin is silent."""
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
    """Samples of a press, and where the skin was when they were taken.

    Args:
        log: Of the touch.
        on_tool: The skin.
        period: s, when the press began and ended.
        T_b_s: (4, 4) skin in base, m, where it ended.

    Returns:
        Readings (n, 3 chips) uT, and how far (n,) m the skin was before that end, along its z.
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


def felt(change: Float[Array, " c"], board: Board, settings: TouchSettings) -> bool:
    """Test whether a skin has felt a press.

    Args:
        change: (3 chips,) uT, of its reading.
        board: Of the skin.
        settings: Which change stops a press.

    Returns:
        True where its change differs between chips by half of what stops a press; with settings that ask for no
        difference, where all of its change does.
    """
    differing = nonuniform_field(change, board) if settings.nonuniform_share else change
    return _size(differing) > FELT_SHARE * settings.skin_change


def nonuniform_field(change: Float[Array, " c"], board: Board) -> Float[Array, "chips 3"]:
    """Part of a change that differs between chips.

    Args:
        change: (3 chips,) uT, of a reading; NaN for a chip that is missing.
        board: Whose reading it is.

    Returns:
        (chips, 3) uT in tool axes, with mean zero over the chips that are there.
    """
    field = np.asarray(board.to_tool(change))
    return field - mean_known(field, axis=0)


def onset_distance(
    readings: Float[Array, "n c"],
    before: Float[Array, " n"],
    ambient: Float[Array, " c"],
    change: Float[Array, " c"],
) -> float:
    """Distance of a press past first contact.

    A line is fitted to the samples whose change, along the final change, is 15 to 70 % of it, and extrapolated to zero
    change; a chip that is missing is left out. The line is that of a flat face; where force grows as indentation to the
    power 1.5 the result is a fifth too short.

    Args:
        readings: uT, of the press.
        before: m, how far the tool was before its end then.
        ambient: uT, the reading before contact.
        change: uT, the final change.

    Returns:
        m from first contact to the end; NaN where fewer than three samples are in that range.
    """
    known = np.isfinite(change)
    there = np.isfinite(readings[:, known]).all(1)
    readings, before, ambient, change = readings[there][:, known], before[there], ambient[known], change[known]
    size = float(np.linalg.norm(change))
    share = (readings - ambient) @ change / max(size, 1e-9) ** 2
    low = share < ONSET_RANGE[0]
    last_low = len(share) - int(np.argmax(low[::-1])) if low.any() else 0
    rising = (np.arange(len(share)) >= last_low) & (share <= ONSET_RANGE[1])
    if rising.sum() < MIN_ONSET_SAMPLES or np.ptp(share[rising]) < 0.1:
        return float("nan")
    slope, onset = np.polyfit(share[rising], before[rising], 1)
    return float(max(0.0, onset)) if slope < 0 else float("nan")


def _size(change: Array) -> float:
    return float(np.sqrt(np.nansum(change**2)))
