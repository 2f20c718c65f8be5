"""Loads of the touches of a data set: the load from which contact pressure is predicted, and touches without one."""

from typing import Literal, NamedTuple

import numpy as np

from i2t.contact.pressure import PressureModelConfig
from i2t.dataset import Dataset
from i2t.recordings.sets import MIN_TRAVEL_M
from i2t.types import Touches

ASSUMED_FORCE_N = 1.0  # N, force assumed for touches whose force was not recorded


class PressLoad(NamedTuple):
    """Load from which contact pressure is predicted."""

    control: Literal["force", "travel"] | None  # None if no load is known
    notes: tuple[str, ...]  # sentences for the user
    constant: bool = False  # whether the same force is assumed for all touches


def press_load(touches: Touches) -> PressLoad:
    """Choose the load of a recording: the force if it was measured, otherwise the travel.

    Args:
        touches: Touches of a data set that `corrected_dataset` returned.

    Returns:
        The load, with notes about its problems.
    """
    force, travel = (np.asarray(getattr(touches, name), np.float64) for name in ("force", "travel"))
    if len(force) and np.isfinite(force).all():
        by_force = _force_load(force)
        if by_force.control or not np.isfinite(travel).all():
            return by_force
        by_travel = _travel_load(travel)
        return by_travel._replace(notes=(*by_force.notes, *by_travel.notes))
    if len(travel) and np.isfinite(travel).all():
        return _travel_load(travel)
    if not np.isfinite(force).any() and not np.isfinite(travel).any():
        note = (
            f"neither force nor travel is known: contact pressure is predicted for {ASSUMED_FORCE_N:g} N in all touches"
        )
        return PressLoad("force", (note,), constant=True)
    missing = f"force is missing at {np.sum(~np.isfinite(force))} and travel at {np.sum(~np.isfinite(travel))}"
    return PressLoad(None, (f"{missing} of {len(force)} touches: methods on predicted contact pressure are left out",))


def _force_load(force: np.ndarray) -> PressLoad:
    """Use forces as the load, unless over half of them are zero or negative."""
    floor = PressureModelConfig.floor
    zero, median = float(np.mean(force <= floor)), float(np.median(force))
    share = f"{100 * zero:.0f} % of the forces are zero or negative"
    if zero > 0.5:
        note = f"{share} (median {median:.3f} N), so methods on predicted contact pressure cannot use them"
        return PressLoad(None, (note,))
    return PressLoad("force", (f"{share} and count as {floor:g} N",) if zero > 0.02 else ())


def _travel_load(travel: np.ndarray) -> PressLoad:
    """Use travels as the load, with a note if over half of them are zero."""
    zero = float(np.mean(travel < MIN_TRAVEL_M))
    if zero <= 0.5:
        return PressLoad("travel", ())
    note = (
        f"{100 * zero:.0f} % of the travels are zero, because they are measured from a height of first contact that is "
        "too low; give that height (--z0-mm of the converter)"
    )
    return PressLoad("travel", (note,))


def rows_with_load(dataset: Dataset, max_share: float = 0.1) -> tuple[np.ndarray, tuple[str, ...]]:
    """Leave out touches without the force or the travel, whichever is known more often, if they are few.

    Args:
        dataset: n touches.
        max_share: Maximum share of touches that may be left out.

    Returns:
        `(n,)` mask of the touches that are kept, and a sentence if touches were left out.
    """
    touches = dataset.touches
    finite = {name: np.isfinite(getattr(touches, name)) for name in ("force", "travel")}
    name = max(finite, key=lambda quantity: int(finite[quantity].sum()))  # the force if both are known as often
    lost = int(np.sum(~finite[name]))
    if not 0 < lost <= max_share * len(dataset):
        return np.ones(len(dataset), bool), ()
    return finite[name], (f"left out: {lost} touches whose {name} is not known",)


def usual_load(values: np.ndarray, default: float) -> float:
    """Compute the median of the finite forces (N) or travels (m) of touches.

    Args:
        values: `(n,)` loads, NaN if unknown.
        default: Load that is returned if no value is finite.

    Returns:
        The median load.
    """
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if len(finite) else default


def several_skins(dataset: Dataset) -> list[str]:
    """Note that one predictor is trained on the readings of several skins.

    Args:
        dataset: The touches.

    Returns:
        A list of one sentence, or an empty list.
    """
    skins = [dataset.pads[i] for i in np.unique(dataset.touches.pad)]
    if len(skins) < 2 or dataset.source == "simulated":
        return []
    named = f"{', '.join(skins[:3])}{', ...' if len(skins) > 3 else ''}"
    return [
        f"touches of {len(skins)} skins ({named}) are predicted as if there were one skin; convert them separately "
        "(--board, --pad of the converter)"
    ]
