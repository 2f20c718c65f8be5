"""Load of each touch, chosen before anything is computed: the force, the travel, or nothing."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from i2t.contact.pressure import PressureModelConfig, predict_pressures
from i2t.dataset import Dataset
from i2t.prediction.methods import ASSUMED_FORCE_N, views_of
from i2t.recordings.sets import MIN_TRAVEL_M
from i2t.skin_models import pressure_gp as gp
from i2t.types import Touches

MAX_UNKNOWN_SHARE = 0.1  # of touches that are left out because neither force nor travel is known of them
NIL_SHARE = 0.5  # of touches without a load, from which on it says nothing
MIN_GAIN = 0.05  # of R2, from which on a change is taken for right
TRIED_TOUCHES = 200  # on which changes are tried
TRIED_STEPS = 20  # of the choice of hyperparameters


class PressLoad(NamedTuple):
    """Quantity that contact pressure can be predicted from."""

    control: Literal["force", "travel"] | None  # None: nothing says how hard a touch was pressed
    notes: tuple[str, ...]  # what a person is told, a sentence each
    constant: bool = False  # nothing is known, and all touches are taken to be pressed alike


def press_load(touches: Touches) -> PressLoad:
    """Choose the load of a recording: its force where it was measured, else its travel.

    Args:
        touches: That methods are to learn from, of a set that `corrected_dataset` gave.

    Returns:
        The load, and what is odd about it.
    """
    force, travel = (np.asarray(getattr(touches, name), np.float64) for name in ("force", "travel"))
    if len(force) and np.isfinite(force).all():
        found = _forced(force)
        if found.control or not np.isfinite(travel).all():
            return found
        other = _deep(travel)
        return other._replace(notes=(*found.notes, *other.notes))
    if len(travel) and np.isfinite(travel).all():
        return _deep(travel)
    if not np.isfinite(force).any() and not np.isfinite(travel).any():
        said = "neither force nor travel is known: contact pressure is predicted as if all touches were pressed with"
        return PressLoad("force", (f"{said} {ASSUMED_FORCE_N:g} N",), constant=True)
    missing = f"force is missing at {np.sum(~np.isfinite(force))} and travel at {np.sum(~np.isfinite(travel))}"
    return PressLoad(None, (f"{missing} of {len(force)} touches: methods on predicted contact pressure are left out",))


def _forced(force: np.ndarray) -> PressLoad:
    """Judge forces as a load."""
    floor = PressureModelConfig.floor
    nil, median = float(np.mean(force <= floor)), float(np.median(force))
    if nil > NIL_SHARE:
        said = f"{100 * nil:.0f} % of the forces do not push (median {median:.3f} N), so forces do not say how hard"
        return PressLoad(None, (f"{said}: methods on predicted contact pressure cannot use them",))
    notes = (f"{100 * nil:.0f} % of the forces do not push and count as {floor:g} N",) if nil > 0.02 else ()
    return PressLoad("force", notes)


def _deep(travel: np.ndarray) -> PressLoad:
    """Judge travels as a load."""
    nil = float(np.mean(travel < MIN_TRAVEL_M))
    if nil > NIL_SHARE:
        said = (
            f"{100 * nil:.0f} % of the travels are zero: the height of first contact that they count from is too low; "
            "give its height (--z0-mm of the converter)"
        )
        return PressLoad("travel", (said,))
    return PressLoad("travel", ())


def with_known_load(dataset: Dataset) -> tuple[Dataset, str | None]:
    """Leave out touches of which neither force nor travel is known, where they are few.

    Args:
        dataset: Of touches.

    Returns:
        The data set, and a sentence where touches were left out.
    """
    touches = dataset.touches
    known = {name: np.isfinite(getattr(touches, name)) for name in ("force", "travel")}
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


class Tried(NamedTuple):
    """Inputs of n touches for a method on predicted pressure."""

    views: np.ndarray  # (n, w, w) m
    force: np.ndarray  # (n,) N
    travel: np.ndarray  # (n,) m
    readings: np.ndarray  # (n, 3 chips) uT
    groups: np.ndarray  # (n,)


def tried_touches(dataset: Dataset, which: np.ndarray, groups: np.ndarray) -> Tried:
    """Inputs of some touches for a method on predicted pressure."""
    touches, views = dataset.touches, np.asarray(views_of(dataset)[which])
    return Tried(views, touches.force[which], touches.travel[which], touches.reading[which], groups[which])


def explained(seen: Tried, cfg: PressureModelConfig) -> float:
    """R2 of the Gaussian process on held-out groups; minus infinity where it cannot be fitted."""
    pressure = predict_pressures(cfg, seen.views, seen.force, seen.travel)
    try:
        _, r2 = gp.choose_hyperparameters(
            pressure, jnp.asarray(seen.readings), seen.groups, steps=TRIED_STEPS, limit=TRIED_TOUCHES
        )
    except ValueError:
        return float("-inf")
    return float(np.nanmax(np.asarray(r2)))


def some_groups(which: np.ndarray, groups: np.ndarray, count: int) -> np.ndarray:
    """Rows of whole groups, in random order of the groups, up to a number of rows."""
    rng = np.random.default_rng(0)
    names, of = np.unique(groups[which], return_inverse=True)
    rank = rng.permutation(len(names))[of.ravel()]
    return np.sort(which[np.argsort(rank, kind="stable")[:count]])
