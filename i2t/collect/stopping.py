"""Stop of a press by the skins on the tool, and beginning of that press.

A press ends where the mean change of some samples of a skin is large enough, and differs enough between chips: a change
that all chips see alike, turned to common axes, is a field of the room. Afterwards the contact onset is found by
following the samples back to zero change.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from i2t.collect.recorder import EventLog
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import SkinOnTool
from i2t.errors import DeviceError
from i2t.hardware.protocols import ArmState
from i2t.skin.boards import mean_known
from i2t.types import Array, Board

ONSET_RANGE = (0.15, 0.7)  # shares of the final change between which the line of the contact onset is fitted
MIN_ONSET_SAMPLES = 3
AT_REST_SILENCE_S = 0.4  # that a skin may be silent while the arm still stands
FELT_SHARE = 0.5  # of the change that stops a press, above which a skin has felt it


class SkinStopCondition:
    """The stop condition of one skin, asked with every state of an approach; it keeps what it saw.

    Args:
        on_tool: The skin, connected.
        settings: Which change is enough.
        ambient: (3 chips,) uT, the reading before contact.
        log: That hears of every sample.
    """

    def __init__(
        self, on_tool: SkinOnTool, settings: TouchSettings, ambient: Float[Array, " c"], log: EventLog
    ) -> None:
        self.ambient = ambient
        self._on_tool, self._settings, self._log = on_tool, settings, log
        self._number = int(on_tool.skin.latest(max(settings.silence, AT_REST_SILENCE_S)).number[-1])
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
        settings = self._settings
        if len(self._last) < settings.averaged_samples:
            return None
        change = mean_known(np.array(self._last), axis=0) - self.ambient
        self._check_chips(change)
        size, nonuniform = _size(change), _size(nonuniform_field(change, self._on_tool.board))
        enough = size > settings.skin_change and nonuniform > settings.nonuniform_share * settings.skin_change
        return size if enough else None

    def _check_chips(self, change: Array) -> None:
        """Raise DeviceError if a chip that answered before the press does not any more: what it feels is not known."""
        lost = np.isfinite(self.ambient) & ~np.isfinite(change)
        if lost.any():
            raise DeviceError(
                f"chip {int(np.argmax(lost)) // 3} of {self._on_tool.skin.features.name} stopped answering during an "
                "approach; check its cable and its solder"
            )

    def _hear(self, state: ArmState) -> None:
        """Take new samples; raises DeviceTimeoutError if the skin is silent."""
        skin = self._on_tool.skin
        fresh = skin.since(self._number)
        self._states.append((state.time, (state.T_b_t @ self._on_tool.T_tool_skin)[:3, 3]))
        if not len(fresh.number):
            skin.latest(self._settings.silence)
            return
        self._log.samples(fresh, self._on_tool.name)
        self._number = int(fresh.number[-1])
        self._times.append(fresh.time)
        self._readings.append(fresh.reading)
        self._last = [*self._last, *fresh.reading][-self._settings.averaged_samples :]

    def press(self, started: float, T_b_s: Float[Array, "4 4"]) -> tuple[Float[Array, "n c"], Float[Array, " n"]]:
        """Samples of a press, and where the skin was when they were taken.

        Args:
            started: s, when the press began.
            T_b_s: (4, 4) skin in base where it ended.

        Returns:
            Readings (n, 3 chips) uT, and how far (n,) m the skin was before that end, along its z.
        """
        if not self._readings:
            return np.zeros((0, self._on_tool.board.num_readings)), np.zeros(0)
        times, readings = np.concatenate(self._times), np.concatenate(self._readings)
        state_times = np.array([time for time, _ in self._states])
        before = np.array([(T_b_s[:3, 3] - position) @ T_b_s[:3, 2] for _, position in self._states])
        during = times >= started
        return readings[during], np.interp(times[during], state_times, before)


class StopCondition:
    """Stops an approach as soon as one of the skins on the tool does.

    Args:
        skins: Connected.
        settings: Which change is enough.
        ambient: (3 chips,) uT of each skin before contact, by its name.
        log: That hears of every sample and state.
    """

    def __init__(
        self,
        skins: Sequence[SkinOnTool],
        settings: TouchSettings,
        ambient: Mapping[str, Float[Array, " c"]],
        log: EventLog,
    ) -> None:
        self.of = {each.name: SkinStopCondition(each, settings, ambient[each.name], log) for each in skins}
        self.stopped_by: list[str] = []  # names of the skins that stopped it
        self._log = log

    def __call__(self, state: ArmState) -> float | None:
        """Test whether a skin has changed enough.

        Args:
            state: The arm's newest.

        Returns:
            The change (uT) of the first skin that has, else None.

        Raises:
            DeviceTimeoutError: A skin is silent.
            DeviceError: A chip has stopped answering.
        """
        self._log.state(state)
        answers = {name: condition(state) for name, condition in self.of.items()}
        self.stopped_by = [name for name, answer in answers.items() if answer is not None]
        return answers[self.stopped_by[0]] if self.stopped_by else None


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
