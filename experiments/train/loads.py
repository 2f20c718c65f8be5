"""What says how hard each touch was pressed, asked before anything is computed: the force or the depth, in the sign and
from the height that the recording counts them, or nothing.
"""

from typing import Literal, NamedTuple

import numpy as np

from i2t.dataset import Dataset
from i2t.prediction.pressure import PressureModelConfig
from i2t.types import Touches

MAX_UNKNOWN_SHARE = 0.1  # of touches that are left out because neither force nor depth is known of them
PULLING_SHARE = 0.8  # of touches with a force below zero, from which on the sign is taken to be the other
NIL_SHARE = 0.5  # of touches without a load, from which on it says nothing
ALIKE_FORCE_N = 1.0  # as `median_conditions` has it where no force was measured
LEAST_DEPTH_M = 10e-6  # that counts as a press


class PressLoad(NamedTuple):
    """What contact pressure can be predicted from."""

    control: Literal["force", "depth"] | None  # None: nothing says how hard a touch was pressed
    force_sign: float  # -1 where a pressing force is counted negative
    nil_share: float  # of touches that this load says were not pressed at all
    notes: tuple[str, ...]  # what a person is told, a sentence each
    constant: bool = False  # nothing is known, and all touches are taken to be pressed alike


def press_load(touches: Touches) -> PressLoad:
    """Choose the load of a recording: its force where it was measured, else its depth.

    Args:
        touches: That methods are to learn from.

    Returns:
        The load, and what is odd about it.
    """
    force, depth = (np.asarray(getattr(touches, name), np.float64) for name in ("force", "depth"))
    if len(force) and np.isfinite(force).all():
        found = _forced(force)
        if found.control or not np.isfinite(depth).all():
            return found
        other = _deep(depth)
        return other._replace(notes=(*found.notes, *other.notes))
    if len(depth) and np.isfinite(depth).all():
        return _deep(depth)
    if not np.isfinite(force).any() and not np.isfinite(depth).any():
        said = "neither force nor depth is known: contact pressure is predicted as if all touches were pressed with"
        return PressLoad("force", 1.0, 0.0, (f"{said} {ALIKE_FORCE_N:g} N",), constant=True)
    missing = f"force is missing at {np.sum(~np.isfinite(force))} and depth at {np.sum(~np.isfinite(depth))}"
    return PressLoad(
        None, 1.0, 1.0, (f"{missing} of {len(force)} touches: methods on predicted contact pressure are left out",)
    )


def _forced(force: np.ndarray) -> PressLoad:
    """How far forces say how hard was pressed."""
    floor = PressureModelConfig.floor
    pulling, median = float(np.mean(force < -floor)), float(np.median(force))
    if pulling >= PULLING_SHARE:
        said = (
            f"forces along the pressing axis are negative at {100 * pulling:.0f} % of the touches (median "
            f"{median:.2f} N), and a press pushes: their sign is turned to predict contact pressure; correct the axes "
            "of the recording"
        )
        return PressLoad("force", -1.0, float(np.mean(-force <= floor)), (said,))
    nil = float(np.mean(force <= floor))
    if nil > NIL_SHARE:
        said = f"{100 * nil:.0f} % of the forces do not push (median {median:.3f} N), so forces do not say how hard"
        return PressLoad(None, 1.0, nil, (f"{said}: methods on predicted contact pressure cannot use them",))
    notes = (f"{100 * nil:.0f} % of the forces do not push and count as {floor:g} N",) if nil > 0.02 else ()
    return PressLoad("force", 1.0, nil, notes)


def _deep(depth: np.ndarray) -> PressLoad:
    """How far depths say how hard was pressed."""
    nil = float(np.mean(depth < LEAST_DEPTH_M))
    if nil > NIL_SHARE:
        said = (
            f"{100 * nil:.0f} % of the depths are nil, so the height of first contact that they count from is too low; "
            "give its height (--z0-mm of the converter)"
        )
        return PressLoad("depth", 1.0, nil, (said,))
    return PressLoad("depth", 1.0, nil, ())


def with_known_load(dataset: Dataset) -> tuple[Dataset, str | None]:
    """Leave out the few touches of which neither force nor depth is known; many of them are no reason to.

    Args:
        dataset: Of touches.

    Returns:
        The data set, and a sentence where touches were left out.
    """
    touches = dataset.touches
    known = {name: np.isfinite(getattr(touches, name)) for name in ("force", "depth")}
    name = max(known, key=lambda one: int(known[one].sum()))  # the force where both are known as often
    lost = int(np.sum(~known[name]))
    if not 0 < lost <= MAX_UNKNOWN_SHARE * len(dataset):
        return dataset, None
    return dataset.select(known[name]), f"left out: {lost} touches whose {name} is not known"


def several_skins(dataset: Dataset) -> list[str]:
    """A sentence where one predictor would be trained on the readings of several skins."""
    skins = [dataset.pads[i] for i in np.unique(dataset.touches.pad)]
    if len(skins) < 2 or dataset.source == "simulated":
        return []
    named = f"{', '.join(skins[:3])}{', ...' if len(skins) > 3 else ''}"
    return [
        f"touches of {len(skins)} skins ({named}) are predicted as if they were of one; convert them apart (--board, "
        "--pad of the converter)"
    ]
