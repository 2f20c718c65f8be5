"""Data set of presses of one tip (`i2t.recordings.presses`), in which every converter of presses ends.

Missing or wrong information in a recording is diagnosed session by session (`i2t.recordings.diagnose`), described in a
sentence and corrected. Patches, poses and names of the data set follow from the columns.

Frames: the skin is fixed, and its tool frame T is the world's. The object O is the tip, its axes as T's and its origin
at its lowest point; a mesh keeps its own frame, whose z axis is the tip's.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple, TypeAlias

import numpy as np

from i2t.dataset import Dataset, missing_views
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
    rotate_board,
)
from i2t.recordings.log import ReadingLog
from i2t.recordings.presses import Presses
from i2t.types import Board, ReturnCode, Touches

# Function that maps distances (m) from the axis of a body of revolution to the height (m) of its surface above its
# lowest point, infinite beyond its edge.
Profile: TypeAlias = Callable[[np.ndarray], np.ndarray]


class SessionCheck(NamedTuple):
    """Diagnosis of a session from its readings: findings on its coordinates (axes, zero height, ...), the board turned
    accordingly, and notes for the data set.
    """

    board: Board
    findings: tuple[Finding, ...] = ()
    meta: Mapping[str, str] = MappingProxyType({})

    @property
    def zero(self) -> Finding | None:
        """Finding on the height of first contact; None if there is none."""
        return find(self.findings, FindingName.HEIGHT_ZERO)

    @property
    def correction(self) -> Correction:
        """Correction of the session's recorded columns that follows from the findings."""
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
    """Estimate properties of a session that its recording does not state or misstates, from the readings.

    Args:
        name: Name of the session.
        presses: Presses of the session as recorded, before any correction.
        board: Board of the skin as the user describes it.
        notes: Log that receives a sentence on each finding.
        stated_zero: Height (m) of first contact that the recording states.
        keep_zero: Whether that height is kept even if the readings contradict it.

    Returns:
        The findings, the board (turned if a finding requires it), and the findings as entries of a data set's `meta`.
    """
    findings = diagnose(presses, board, stated_zero=stated_zero)
    for finding in sorted(findings, key=lambda finding: not finding.wrong):
        kept = keep_zero and finding.name == FindingName.HEIGHT_ZERO
        notes.finding(finding, f" in {name}", kept=kept)
    turn = correction_of(findings).board_from_stage
    return SessionCheck(
        board if turn is None else rotate_board(board, turn), tuple(findings), findings_to_meta(name, findings)
    )


class Indenter(NamedTuple):
    """An indenter: its name, a function that makes depth patches (m) of its tip at given positions, and the z (m) of
    the tip's lowest point in its own frame.
    """

    name: str
    # function that makes patches from x, y, window and reach (m)
    patches: Callable[[np.ndarray, np.ndarray, float, float], np.ndarray]
    lowest: float = 0.0  # m, z of the tip's lowest point in its own frame


def round_tip(name: str, profile: Profile) -> Indenter:
    """Make an indenter whose tip is a body of revolution.

    Args:
        name: Name of the object in the data set.
        profile: Function from the distance (m) to the tip's axis to the height (m) of its surface above the lowest
            point.

    Returns:
        The indenter, with its lowest point at z = 0 of its own frame.
    """
    return Indenter(name, lambda x, y, window, reach: tip_patches(profile, x, y, window, reach))


def presses_dataset(
    presses: Presses,
    tip: Indenter,
    board: Board,
    notes: ReadingLog,
    *,
    whose: object,
    window: float,
    reach: float,
    source: str = "real",
    meta: dict[str, str] | None = None,
) -> Dataset:
    """Make a data set of presses of one indenter, with a depth patch computed from the indenter's shape.

    Args:
        presses: Corrected presses of one skin, or of several with one board, with heights, forces, times, pads and
            sessions.
        tip: Tip that pressed.
        board: Board of the readings.
        notes: Log that receives a sentence on what was left out.
        whose: Name of the source in messages.
        window: Edge (m) of the square that a patch shows; presses whose tip it does not show are left out.
        reach: Depth (m) behind the tip's lowest point to which patches are clipped.
        source: "real", "simulated" or "mixed".
        meta: Provenance, in words.

    Returns:
        The data set, with one touch for each press.

    Raises:
        DataError: If the window shows the tip of no press.
    """
    patch = tip.patches(presses.position[:, 0], presses.position[:, 1], window, reach)
    # A press beside the window is kept if its patch shows a part of the tip; calibrations do not use patches.
    shown = (np.abs(presses.position) <= window / 2).all(1) | (patch < reach).any((1, 2))
    if not shown.any():
        raise DataError(f"{whose}: no press lies inside the window of {1e3 * window:g} mm; widen --window-mm")
    if not shown.all():
        outside = f"{np.sum(~shown)} presses whose tip is outside the window of {1e3 * window:g} mm"
        notes.change("window", f"left out: {outside}; a larger --window-mm keeps them")
    position, readings, height, force, time, pad, session = presses.rows(shown)
    assert height is not None
    assert time is not None
    assert pad is not None
    assert session is not None
    n, (x, y) = len(readings), position.T
    pads, sessions = (tuple(dict.fromkeys(names.tolist())) for names in (pad, session))
    T_w_o = np.tile(np.eye(4), (n, 1, 1))
    T_w_o[:, :3, 3] = np.column_stack([x, y, np.nan_to_num(height) - tip.lowest])
    touches = Touches(
        patch=patch[shown],
        view=missing_views(n),
        nearest=height,
        reading=readings,
        force=force,
        travel=np.maximum(-height, 0),
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
    """Make the profile of a sphere's lower half: height h = R - sqrt(R^2 - r^2) at distance r from the axis.

    Args:
        radius: Radius (m) of the sphere.

    Returns:
        Function from distance to height (m).
    """
    return lambda r: np.where(r < radius, radius - np.sqrt(np.maximum(radius**2 - r**2, 0)), np.inf)


def cylinder(radius: float) -> Profile:
    """Make the profile of the flat end of a cylinder: height 0 up to its radius.

    Args:
        radius: Radius (m) of the cylinder.

    Returns:
        Function from distance to height (m).
    """
    return lambda r: np.where(r <= radius, 0.0, np.inf)


def tip_patches(profile: Profile, x: np.ndarray, y: np.ndarray, window: float, reach: float) -> np.ndarray:
    """Compute depth patches of an indenter tip whose axis is perpendicular to the skin.

    Depth counts from the tip's lowest point, which may lie between two pixels.

    Args:
        profile: Function from the distance (m) to the tip's axis to the height (m) of its surface.
        x: `(n,)` x (m) of the axis in the tool frame.
        y: `(n,)` y (m) of the axis in the tool frame.
        window: Edge (m) of the square that a patch shows.
        reach: Depth (m) to which patches are clipped.

    Returns:
        `(n, 48, 48)` patches (m), float32.
    """
    centres = ((np.arange(PATCH_PIXELS) + 0.5) / PATCH_PIXELS - 0.5) * window
    result = np.empty((len(x), PATCH_PIXELS, PATCH_PIXELS), np.float32)
    batch = 512  # bounds the memory of the intermediate arrays
    for start in range(0, len(x), batch):
        rows = slice(start, start + batch)
        r = np.hypot(centres[None, :, None] - y[rows, None, None], centres[None, None, :] - x[rows, None, None])
        result[rows] = np.minimum(profile(r), reach)
    return result
