"""Selection of the load of a recording, and input of the Gaussian process in tests of likely causes."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Dataset
from i2t.prediction.methods import ASSUMED_FORCE_N, views_of
from i2t.recordings.sets import MIN_TRAVEL_M
from i2t.skin_models import pressure_gp as gp
from i2t.types import Touches

MIN_GAIN = 0.05  # minimum gain of R2 by a correction that is reported as a likely cause
TRIED_TOUCHES = 200  # maximum number of touches for trying corrections


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


def with_known_load(dataset: Dataset, max_share: float = 0.1) -> tuple[Dataset, str | None]:
    """Leave out touches without the force or the travel, whichever is known more often, if they are few.

    Args:
        dataset: The touches.
        max_share: Maximum share of touches that may be left out.

    Returns:
        The data set, and a sentence if touches were left out.
    """
    touches = dataset.touches
    finite = {name: np.isfinite(getattr(touches, name)) for name in ("force", "travel")}
    name = max(finite, key=lambda quantity: int(finite[quantity].sum()))  # the force if both are known as often
    lost = int(np.sum(~finite[name]))
    if not 0 < lost <= max_share * len(dataset):
        return dataset, None
    return dataset.select(finite[name]), f"left out: {lost} touches whose {name} is not known"


def several_skins(dataset: Dataset) -> list[str]:
    """Note that one predictor is trained on the readings of several skins, as a list of at most one sentence."""
    skins = [dataset.pads[i] for i in np.unique(dataset.touches.pad)]
    if len(skins) < 2 or dataset.source == "simulated":
        return []
    named = f"{', '.join(skins[:3])}{', ...' if len(skins) > 3 else ''}"
    return [
        f"touches of {len(skins)} skins ({named}) are predicted as if there were one skin; convert them separately "
        "(--board, --pad of the converter)"
    ]


class Tried(NamedTuple):
    """Inputs of n touches for a method on predicted pressure."""

    views: np.ndarray  # (n, w, w) m
    force: np.ndarray  # (n,) N
    travel: np.ndarray  # (n,) m
    readings: np.ndarray  # (n, 3 chips) uT
    groups: np.ndarray  # (n,)


def tried_touches(dataset: Dataset, which: np.ndarray, groups: np.ndarray) -> Tried:
    """Select touches for a method on predicted pressure."""
    touches, views = dataset.touches, np.asarray(views_of(dataset)[which])
    return Tried(views, touches.force[which], touches.travel[which], touches.reading[which], groups[which])


def explained(seen: Tried, cfg: PressureModelConfig) -> float:
    """Compute R2 of the Gaussian process on held-out groups; minus infinity if it cannot be fitted."""
    pressure = predict_pressures(cfg, seen.views, seen.force, seen.travel)
    try:
        _, r2 = gp.choose_hyperparameters(
            pressure, jnp.asarray(seen.readings), seen.groups, steps=20, limit=TRIED_TOUCHES
        )
    except ValueError:
        return float("-inf")
    return float(np.nanmax(np.asarray(r2)))


def some_groups(which: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """Select rows of whole groups in random order, up to a number of rows."""
    rng = np.random.default_rng(0)
    names, of = np.unique(groups[which], return_inverse=True)
    rank = rng.permutation(len(names))[of.ravel()]
    return np.sort(which[np.argsort(rank, kind="stable")[:count]])
