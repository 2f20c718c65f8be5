"""The data set of presses of one tip (`i2t.recordings.presses`), which every converter of presses ends in.

What the recording does not say or says wrongly is diagnosed session by session (`i2t.recordings.diagnose`), said in a
sentence and corrected; patches, poses and names of the data set follow from the columns.

Frames: the skin is fixed, and its tool frame T is the world's. The object O is the tip, its axes as T's and its origin
at its lowest point; a mesh keeps its own frame, whose z axis is the tip's.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np

from i2t.dataset import Dataset, missing_context
from i2t.errors import DataError
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.recordings.diagnose import (
    Correction,
    Finding,
    FindingName,
    correction_of,
    diagnose,
    find,
    findings_to_meta,
    turn_board,
)
from i2t.recordings.log import ReadingLog
from i2t.recordings.presses import Presses
from i2t.types import Board, ReturnCode, Touches

ROWS_AT_ONCE = 512  # bounds the memory of the intermediate arrays

# A tip is a body of revolution whose axis stands on the skin: the height (m) of its surface above its lowest point at a
# distance (m) from its axis, infinite where there is nothing.
Profile: TypeAlias = Callable[[np.ndarray], np.ndarray]


class SessionCheck(NamedTuple):
    """Findings in one session, ready to be applied to its presses."""

    board: Board
    findings: tuple[Finding, ...] = ()
    meta: Mapping[str, str] = MappingProxyType({})

    @property
    def zero(self) -> Finding | None:
        """Finding on the height of first contact."""
        return find(self.findings, FindingName.HEIGHT_ZERO)

    @property
    def correction(self) -> Correction:
        """What to do to the session's columns."""
        return correction_of(self.findings)


def check_session(
    name: str,
    presses: Presses,
    board: Board,
    notes: ReadingLog,
    *,
    stated_zero: float | None = None,
    keep_zero: bool = False,
) -> SessionCheck:
    """Estimate the unknowns of a session and note every sentence.

    Args:
        name: Of the session.
        presses: As recorded.
        board: As described.
        notes: That hear the sentences.
        stated_zero: Height of first contact (m) that the recording states.
        keep_zero: Whether that height stays, whatever readings say.

    Returns:
        What to apply.
    """
    findings = diagnose(presses, board, stated_zero=stated_zero)
    for finding in sorted(findings, key=lambda finding: not finding.wrong):
        kept = keep_zero and finding.name == FindingName.HEIGHT_ZERO
        verdict = "found" if not finding.wrong else "contradicted" if kept else "corrected"
        notes.info(f"{verdict} in {name}: {finding.sentence}")
    turn = correction_of(findings).board_from_stage
    return SessionCheck(
        board if turn is None else turn_board(board, turn), tuple(findings), findings_to_meta(name, findings)
    )


class Tip(NamedTuple):
    """What presses."""

    name: str
    patches: Callable[[np.ndarray, np.ndarray, float, float], np.ndarray]  # of x, y, window and reach (m)
    lowest: float = 0.0  # m, z of its lowest point in its own frame


def round_tip(name: str, profile: Profile) -> Tip:
    """A tip that is a body of revolution.

    Args:
        name: Of the object in the data set.
        profile: Of the tip.

    Returns:
        The tip.
    """
    return Tip(name, lambda x, y, window, reach: tip_patches(profile, x, y, window, reach))


def presses_dataset(
    presses: Presses,
    tip: Tip,
    board: Board,
    notes: ReadingLog,
    *,
    whose: object,
    window: float,
    reach: float,
    source: str = "real",
    meta: dict[str, str] | None = None,
) -> Dataset:
    """The data set of presses.

    Args:
        presses: Of one skin or several with one board, corrected; with heights, forces, times, pads and sessions.
        tip: What pressed.
        board: Which the readings are of.
        notes: That hear what is left out.
        whose: Names the source in messages.
        window: m, edge of the square that a patch shows; presses whose axis lies outside it are left out.
        reach: m, patches are clipped to this depth behind the tip's lowest point.
        source: "real", "simulated" or "mixed".
        meta: Provenance, in words.

    Returns:
        A touch for each press.

    Raises:
        DataError: No press lies inside the window.
    """
    inside = (np.abs(presses.position) <= window / 2).all(1)
    if not inside.all():
        notes.info(f"left out: {np.sum(~inside)} presses outside the window of {1e3 * window:g} mm")
    if not inside.any():
        raise DataError(f"{whose}: no press lies inside the window of {1e3 * window:g} mm; widen --window-mm")
    position, readings, height, force, time, pad, session = presses.rows(inside)
    assert height is not None
    assert time is not None
    assert pad is not None
    assert session is not None
    n, (x, y) = len(readings), position.T
    pads, sessions = (tuple(dict.fromkeys(names.tolist())) for names in (pad, session))
    T_w_o = np.tile(np.eye(4), (n, 1, 1))
    T_w_o[:, :3, 3] = np.column_stack([x, y, np.nan_to_num(height) - tip.lowest])
    touches = Touches(
        patch=tip.patches(x, y, window, reach),
        wide=missing_context(n),
        nearest=height,
        reading=readings,
        force=force,
        depth=np.maximum(-height, 0),
        T_w_t=np.tile(np.eye(4), (n, 1, 1)),
        T_w_o=T_w_o,
        object=np.zeros(n),
        pad=np.array([pads.index(name) for name in pad]),
        session=np.array([sessions.index(name) for name in session]),
        code=np.where(height > 0, ReturnCode.FREE, ReturnCode.UNDEFINED),
        time=None if np.isnan(time).all() else time,
    )
    return Dataset(
        touches, (tip.name,), pads, sessions, board=board, source=source, window=window, reach=reach, meta=meta or {}
    )


def sphere(radius: float) -> Profile:
    """The lower half of a sphere: h = R - sqrt(R^2 - r^2).

    Args:
        radius: m.

    Returns:
        Its profile.
    """
    return lambda r: np.where(r < radius, radius - np.sqrt(np.maximum(radius**2 - r**2, 0)), np.inf)


def cylinder(radius: float) -> Profile:
    """The flat end of a cylinder.

    Args:
        radius: m.

    Returns:
        Its profile.
    """
    return lambda r: np.where(r <= radius, 0.0, np.inf)


def tip_patches(profile: Profile, x: np.ndarray, y: np.ndarray, window: float, reach: float) -> np.ndarray:
    """Patches of a tip whose axis stands upright on the skin.

    Depth counts from the tip's lowest point, which may lie between two pixels.

    Args:
        profile: of the tip.
        x: (n,) m, of the axis in the tool frame.
        y: (n,) m, likewise.
        window: m, edge of the square that a patch shows.
        reach: m, to which depth is clipped.

    Returns:
        (n, 48, 48) m, float32.
    """
    centres = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * window
    result = np.empty((len(x), PATCH_PIXELS, PATCH_PIXELS), np.float32)
    for start in range(0, len(x), ROWS_AT_ONCE):
        rows = slice(start, start + ROWS_AT_ONCE)
        r = np.hypot(centres[None, :, None] - y[rows, None, None], centres[None, None, :] - x[rows, None, None])
        result[rows] = np.minimum(profile(r), reach)
    return result
