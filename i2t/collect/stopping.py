"""When the skin stops a press, and where that press began.

A press ends where the mean change of some samples is large enough, and differs enough between chips: a change that all
chips see alike, turned to common axes, is a field of the room. Afterwards its samples are followed back to first
contact.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from i2t.hardware.protocols import ArmState, Samples, Skin
from i2t.types import CHIPS, READINGS, Array, Board

RISING = (0.15, 0.7)  # parts of the final change between which a press is followed back to where it began


class Rule(NamedTuple):
    """How much is enough."""

    skin_change: float  # uT, norm of the 15 values' change
    uneven: float  # of it must differ between chips
    mean_of: int  # samples
    silence: float  # s without a sample


@runtime_checkable
class Listener(Protocol):
    """Who is told of what is seen."""

    def samples(self, samples: Samples) -> None:
        """Of the skin."""

    def state(self, state: ArmState) -> None:
        """Of the arm."""


class Watch:
    """The stop rule of the skin, asked with every state of an approach; it keeps what it saw."""

    def __init__(self, skin: Skin, board: Board, rule: Rule, ambient: Array, tape: Listener) -> None:
        self._skin, self._board, self._rule, self._ambient, self._tape = skin, board, rule, ambient, tape
        self._number = int(skin.latest().number[-1])
        self._last: list[Array] = []
        self._times: list[Array] = []
        self._readings: list[Array] = []
        self._states: list[tuple[float, Array]] = []

    def __call__(self, state: ArmState) -> float | None:
        """The change (uT) if it is enough; raises DeviceTimeoutError if the skin says nothing."""
        rule = self._rule
        fresh = self._skin.since(self._number)
        self._tape.state(state)
        self._states.append((state.time, state.T_b_t[:3, 3]))
        if len(fresh.number):
            self._tape.samples(fresh)
            self._number = int(fresh.number[-1])
            self._times.append(fresh.time)
            self._readings.append(fresh.reading)
            self._last = [*self._last, *fresh.reading][-rule.mean_of :]
        else:
            self._skin.latest(rule.silence)
        if len(self._last) < rule.mean_of:
            return None
        change = np.mean(self._last, axis=0) - self._ambient
        size = float(np.linalg.norm(change))
        apart = float(np.linalg.norm(unevenness(change, self._board)))
        return size if size > rule.skin_change and apart > rule.uneven * rule.skin_change else None

    def press(self, started: float, T_b_t: Array) -> tuple[Array, Array]:
        """Samples (n, 15) since a time, and how far (n,) m the tool was then before the pose where it ended."""
        if not self._readings or not self._states:
            return np.zeros((0, READINGS)), np.zeros(0)
        times, readings = np.concatenate(self._times), np.concatenate(self._readings)
        at = np.array([time for time, _ in self._states])
        before = np.array([(T_b_t[:3, 3] - place) @ T_b_t[:3, 2] for _, place in self._states])
        order = times >= started
        return readings[order], np.interp(times[order], at, before)


def unevenness(change: Array, board: Board) -> Array:
    """(5, 3) uT, tool axes: what of a change (15,) differs between chips."""
    field = np.asarray(board.to_tool(change)).reshape(CHIPS, 3)
    return field - field.mean(axis=0)


def onset(readings: Array, before: Array, ambient: Array, reading: Array) -> float:
    """How far (m) a press went past first contact: of its samples (n, 15), taken `before` (n,) m ahead of where it
    ended, those whose change along the final one (15,) has grown to between 15 and 70 % of it are followed back to
    none by a straight line. NaN where there are fewer than three.

    The line is that of a flat face; where force grows as travel to the power 1.5 it is a fifth of the way short.
    """
    size = float(np.linalg.norm(reading))
    grown = (readings - ambient) @ reading / max(size, 1e-9) ** 2
    end = len(grown) - int(np.argmax((grown < RISING[0])[::-1])) if (grown < RISING[0]).any() else 0
    rising = (np.arange(len(grown)) >= end) & (grown <= RISING[1])
    if rising.sum() < 3 or np.ptp(grown[rising]) < 0.1:
        return float("nan")
    slope, start = np.polyfit(grown[rising], before[rising], 1)
    return float(max(0.0, start)) if slope < 0 else float("nan")
