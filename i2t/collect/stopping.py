"""Stop of a press by the skin, and beginning of that press.

A press ends where the mean change of some samples is large enough, and differs enough between chips: a change that all
chips see alike, turned to common axes, is a field of the room. Afterwards the contact onset is found by following the
samples back to zero change.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.collect.event_log import TouchLog
from i2t.errors import DeviceError
from i2t.hardware.protocols import ArmState, Skin
from i2t.skin.ambient import mean_known
from i2t.types import Array, Board

ONSET_RANGE = (0.15, 0.7)  # shares of the final change between which the line of the contact onset is fitted
MIN_ONSET_SAMPLES = 3
AT_REST_SILENCE_S = 0.4  # that a skin may be silent while the arm still stands


class StopRule(NamedTuple):
    """Rule by which the change of a reading stops a press."""

    skin_change: float  # uT, norm of the change of a reading
    nonuniform_share: float  # of it must differ between chips
    averaged_samples: int
    silence: float  # s without a sample, after which the press fails


class SkinStopCondition:
    """The stop condition of the skin, asked with every state of an approach; it keeps what it saw.

    Args:
        skin: Connected.
        board: Of the skin.
        rule: Which change is enough.
        ambient: (3 chips,) uT, the reading before contact.
        log: That hears of every sample and state.
        T_tool_skin: (4, 4) of a further skin on the tool; None for the one in the tool's frame.
    """

    def __init__(
        self,
        skin: Skin,
        board: Board,
        rule: StopRule,
        ambient: Float[Array, " c"],
        log: TouchLog,
        *,
        T_tool_skin: Float[Array, "4 4"] | None = None,
    ) -> None:
        self._skin, self._board, self._rule, self._ambient, self._log = skin, board, rule, ambient, log
        self._T_tool_skin = np.eye(4) if T_tool_skin is None else T_tool_skin
        self._number = int(skin.latest(max(rule.silence, AT_REST_SILENCE_S)).number[-1])
        self._last: list[Array] = []
        self._times: list[Array] = []
        self._readings: list[Array] = []
        self._states: list[tuple[float, Array]] = []

    def __call__(self, state: ArmState) -> float | None:
        """Test whether the skin has changed enough.

        Args:
            state: The arm's newest.

        Returns:
            The change (uT) if it is enough, else None.

        Raises:
            DeviceTimeoutError: The skin is silent.
            DeviceError: A chip has stopped answering.
        """
        self._hear(state)
        rule = self._rule
        if len(self._last) < rule.averaged_samples:
            return None
        change = mean_known(np.array(self._last), axis=0) - self._ambient
        self._check_chips(change)
        size = float(np.sqrt(np.nansum(change**2)))
        nonuniform = float(np.sqrt(np.nansum(nonuniform_field(change, self._board) ** 2)))
        enough = size > rule.skin_change and nonuniform > rule.nonuniform_share * rule.skin_change
        return size if enough else None

    def _check_chips(self, change: Array) -> None:
        """Raise DeviceError if a chip that answered before the press does not any more: what it feels is not known."""
        lost = np.isfinite(self._ambient) & ~np.isfinite(change)
        if lost.any():
            raise DeviceError(
                f"chip {int(np.argmax(lost)) // 3} of {self._skin.features.name} stopped answering during an approach; "
                "check its cable and its solder"
            )

    def _hear(self, state: ArmState) -> None:
        """Take new samples; raises DeviceTimeoutError if the skin is silent."""
        fresh = self._skin.since(self._number)
        self._log.state(state)
        self._states.append((state.time, (state.T_b_t @ self._T_tool_skin)[:3, 3]))
        if not len(fresh.number):
            self._skin.latest(self._rule.silence)
            return
        self._log.samples(fresh)
        self._number = int(fresh.number[-1])
        self._times.append(fresh.time)
        self._readings.append(fresh.reading)
        self._last = [*self._last, *fresh.reading][-self._rule.averaged_samples :]

    def press(self, started: float, T_b_s: Float[Array, "4 4"]) -> tuple[Float[Array, "n c"], Float[Array, " n"]]:
        """Samples of a press, and where the skin was when they were taken.

        Args:
            started: s, when the press began.
            T_b_s: (4, 4) skin in base where it ended: the tool, if it is the skin in the tool's frame.

        Returns:
            Readings (n, 3 chips) uT, and how far (n,) m the skin was before that end, along its z.
        """
        if not self._readings or not self._states:
            return np.zeros((0, self._board.num_readings)), np.zeros(0)
        times, readings = np.concatenate(self._times), np.concatenate(self._readings)
        state_times = np.array([time for time, _ in self._states])
        before = np.array([(T_b_s[:3, 3] - position) @ T_b_s[:3, 2] for _, position in self._states])
        during = times >= started
        return readings[during], np.interp(times[during], state_times, before)


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
