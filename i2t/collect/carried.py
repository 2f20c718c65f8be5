"""Further skins on the tool, next to the one that presses: they are read in each touch, and each may stop a press.

A skin has felt a press if its change differs between its chips by half of what stops a press. The arm measures one
force for all skins: it is a skin's own where no other felt the press, and unknown (NaN) else. A skin that felt nothing
met air, whatever ended the press.

Frames: W world, B robot base, T tool, S skin; `T_a_b` maps points in b to a. Metres, newtons, microtesla.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.collect.event_log import TouchLog
from i2t.collect.stopping import SkinStopCondition, StopRule, nonuniform_field, onset_distance
from i2t.collect.touch import CarriedTouch, SeenPatch
from i2t.errors import DeviceError
from i2t.hardware.protocols import ArmState, Samples, Skin, SkinCounters
from i2t.skin.ambient import (
    AmbientChange,
    AmbientField,
    FreePoses,
    ambient_changed,
    mean_known,
    predict_ambient,
)
from i2t.types import Array, Board, ReturnCode

MIN_CHIP_SHARE = 0.5  # of the chips, that must answer for an approach
FALSE_ALARM = 1e-3  # of touches, at which an ambient field that has not changed is called changed
FELT_SHARE = 0.5  # of the change that stops a press, above which a skin has felt it


@dataclass
class SkinOnTool:
    """A further skin.

    Args:
        name: In files.
        skin: Connected.
        board: Of the skin.
        T_tool_skin: (4, 4), its frame in the tool.
        ambient_field: Fitted from free poses, in the base; None if there is none.
        pad: Its name in the data set.
    """

    name: str
    skin: Skin
    board: Board
    T_tool_skin: Float[Array, "4 4"]
    ambient_field: AmbientField | None = None
    pad: str = ""


class RestReading(NamedTuple):
    """Reading of a skin before a press."""

    ambient: Float[Array, " c"]  # uT
    expected: Float[Array, " c"] | None  # uT, by the fitted field
    change: AmbientChange | None  # whether it contradicts that field


class SkinLog:
    """A touch's log as a further skin's stop condition sees it; states are written once, by the skin at the tool.

    Args:
        log: Of the touch.
        skin: Name of the skin.
    """

    def __init__(self, log: TouchLog, skin: str) -> None:
        self._log, self._skin = log, skin

    def samples(self, samples: Samples, skin: str = "") -> None:
        """Keep samples of this skin, as in `TouchLog.samples`."""
        self._log.samples(samples, self._skin)

    def state(self, state: ArmState) -> None:
        """Keep nothing: the skin at the tool keeps states, as in `TouchLog.state`."""

    def event(self, text: str) -> None:
        """Keep what happened, as in `TouchLog.event`."""
        self._log.event(text)


class AnyStopCondition:
    """Stops an approach as soon as one of several skins does.

    Args:
        own: Of the skin at the tool.
        carried: Of further skins, by their names.
    """

    def __init__(self, own: SkinStopCondition, carried: Mapping[str, SkinStopCondition]) -> None:
        self.own, self.carried = own, dict(carried)
        self.stopped: tuple[str, ...] = ()  # names of the skins that stopped it; "" for the one at the tool

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
        answers = {name: condition(state) for name, condition in {"": self.own, **self.carried}.items()}
        self.stopped = tuple(name for name, answer in answers.items() if answer is not None)
        return answers[self.stopped[0]] if self.stopped else None


def rest_reading(skin: Skin, board: Board, count: int, log: TouchLog) -> Float[Array, " c"]:
    """The mean of some samples of a skin that touches nothing.

    Args:
        skin: Connected.
        board: Of the skin.
        count: Of samples.
        log: That hears of them.

    Returns:
        (3 chips,) uT; NaN for a chip that does not answer.

    Raises:
        DeviceError: The skin is silent, or too few chips answer.
    """
    samples = skin.read(count)
    log.samples(samples)
    reading = mean_known(samples.reading, axis=0)
    answering = int(np.isfinite(reading).sum()) // 3
    if answering < MIN_CHIP_SHARE * board.num_chips:
        raise DeviceError(
            f"only {answering} of {board.num_chips} chips of {skin.features.name} answer, too few to feel a press; "
            "check the board's cables"
        )
    return reading


def compared(
    ambient: Float[Array, " c"],
    field: AmbientField | None,
    board: Board,
    T_b_s: Float[Array, "4 4"],
    log: TouchLog,
    *,
    name: str = "",
) -> RestReading:
    """A reading at rest, with what the fitted field predicts here, and whether it contradicts that.

    Args:
        ambient: uT.
        field: Fitted from free poses; None if there is none.
        board: Of the skin.
        T_b_s: (4, 4) of the skin.
        log: That hears of a contradiction.
        name: Of a further skin.

    Returns:
        All three; None for the last two without a field.
    """
    if field is None:
        return RestReading(ambient, None, None)
    change = ambient_changed(field, board, FreePoses(T_b_s[None], ambient[None, None]), false_alarm=FALSE_ALARM)
    if change.changed:
        log.event(f"{name}: {change.sentence}" if name else change.sentence)
    return RestReading(ambient, predict_ambient(field, board, T_b_s)[0], change)


def felt(change: Float[Array, " c"], board: Board, rule: StopRule) -> bool:
    """Test whether a skin has felt a press.

    Args:
        change: (3 chips,) uT, of its reading.
        board: Of the skin.
        rule: That stops presses.

    Returns:
        True where its change differs between chips by half of what stops a press; with a rule that asks for no
        difference, where all of its change does.
    """
    differing = nonuniform_field(change, board) if rule.nonuniform_share else change
    return bool(np.sqrt(np.nansum(differing**2)) > FELT_SHARE * rule.skin_change)


def own_code(code: ReturnCode, felt_by: bool, alone: bool) -> ReturnCode:
    """Return code of a press for one of several skins.

    Args:
        code: Of the press.
        felt_by: Whether this skin felt it.
        alone: Whether no skin felt it: then force did, and the code stands for the skin at the tool.

    Returns:
        The code of the press, or AIR for a skin that felt nothing while another did.
    """
    return code if felt_by or alone else ReturnCode.AIR


def carried_touch(
    skin: SkinOnTool,
    rest: RestReading,
    condition: SkinStopCondition,
    *,
    reading: Float[Array, " c"],
    T_w_b: Float[Array, "4 4"],
    states: Sequence[ArmState],
    started: float,
    code: ReturnCode,
    felt_by: Collection[str],
    seen: SeenPatch | None,
    counters: SkinCounters,
) -> CarriedTouch:
    """Result of a touch for a further skin.

    Args:
        skin: Which.
        rest: Before the press.
        condition: Of the press, with what it saw.
        reading: (c,) uT, the change in contact.
        T_w_b: (4, 4) of the base.
        states: Of the arm in contact.
        started: s, when the press began.
        code: Of the press.
        felt_by: Names of the skins that felt it.
        seen: Before this skin.
        counters: Of this touch.

    Returns:
        Everything that is kept of it.
    """
    T_b_s = states[-1].T_b_t @ skin.T_tool_skin
    has_felt, alone = skin.name in felt_by, set(felt_by) == {skin.name}
    along = skin.T_tool_skin[:3, 2]
    force = -float(np.mean([state.wrench[:3] @ along for state in states])) if alone else np.nan
    depth = onset_distance(*condition.press(started, T_b_s), rest.ambient, reading) if has_felt else np.nan
    return CarriedTouch(
        T_w_s=T_w_b @ T_b_s,
        code=code if has_felt else ReturnCode.AIR,
        ambient=rest.ambient,
        reading=reading,
        force=force,
        depth=depth,
        seen=seen,
        counters=counters,
        expected_ambient=rest.expected,
        ambient_change=rest.change,
    )
