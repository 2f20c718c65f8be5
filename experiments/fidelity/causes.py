"""Causes of a poor predictor trained on a recording: each likely one is tested on its training touches.

Some causes show in the numbers themselves: loads that are nil, forces that pull, values that no press has, chips that
answer on the other side. The others are tried: the recording is changed as if it had the fault the other way round
(another tip, depths from another height, forces of the other sign, the view upside down, units, a softer skin), contact
pressures are predicted anew, and a Gaussian process on them is scored on held-out groups of touches; for labels of
another row it is the nearest patches. A cause is found where the change explains clearly more than the recording as it
is.

A flip of the patch along x or y, or a turn of it, changes nothing that methods on predicted pressure could notice,
because their covariance is the same for mirrored pressures; it shows where chips near the contact answer less than
those far from it.
"""

from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.sections import CannotTellError, Section
from experiments.train.configs import PRESETS
from experiments.train.loads import (
    HEIGHTS_M,
    LEAST_DEPTH_M,
    MIN_GAIN,
    TRIED_TOUCHES,
    Tried,
    explained,
    some_groups,
    tried_touches,
)
from experiments.train.prepare import prepare
from i2t.convert.press_table import sphere, tip_patches
from i2t.dataset import Dataset, load_dataset
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.prediction.baselines import features_of, touch_features
from i2t.prediction.gp import CELL_MM, ContactPressure
from i2t.prediction.metrics import nearest_neighbours
from i2t.prediction.pressure import PressureModelConfig
from i2t.types import Board

HEIGHT, SIGN, TIP, AXES, UNITS, LAG = "height zero", "force sign", "tip radius", "axes", "units", "lag of rows"
SOFTNESS = "softness"
CAUSES = (HEIGHT, SIGN, TIP, AXES, UNITS, LAG, SOFTNESS)

LAG_TOUCHES = 1500  # in the order of their rows
MAX_LAG = 3  # rows
MIN_NIL_SHARE = 0.2  # of touches without pressure, from which on they are a cause
MIN_PULLING_SHARE = 0.5  # of forces that do not push
TIP_FACTORS = (0.5, 2.0)
SCALES = (0.1, 10.0)
SOFTNESSES = (4.0, 16.0)  # of a skin, in units of the nominal one's
LOADS = {"force": (0.02, 100.0, "N"), "depth": (20e-6, 20e-3, "m")}  # median between which a press is one
LEAST_RELIEF_M = 2e-6  # median relief of patches, below which they show nothing
SMALLEST_READING_UT, LARGEST_READING_UT = 0.5, 50e3  # median norm
NEAR_CHIP_M = 6e-3  # over which a chip's answer falls
MIN_ALIGNMENT = 0.2  # correlation of chips' answers with their nearness, and how much more of it a flip must give


class CauseFound(NamedTuple):
    """A cause that was tested and the result."""

    cause: str  # one of CAUSES
    found: bool
    evidence: str  # a sentence


def cause_section(path: Path, preset: FidelityPreset, seed: int, section: Section) -> None:
    """Causes in a data set that may keep a predictor from learning: found, not found, and not testable."""
    dataset = load_dataset(path)
    if dataset.source == "simulated":
        raise CannotTellError("The touches are simulated, and the simulation makes none of these mistakes.")
    try:
        prepared = prepare(dataset, PRESETS["paper"], "auto", seed)
    except DataError as error:
        raise CannotTellError(f"Nothing can be held out: {error}") from error
    touches, split, cfg = prepared.touches, prepared.split, prepared.touches.pressure_model
    section.sentences += prepared.notes
    found = seen_in_numbers(touches.dataset, split.train, cfg, touches.pressure)
    load_known = cfg is not None and np.isfinite(getattr(touches.dataset.touches, cfg.control)[split.train]).all()
    if cfg is not None and load_known and preset.try_causes:
        found += tried_changes(touches.dataset, split.train, split.groups, cfg)
    section.sentences += [each.evidence for each in found if each.found]
    guilty, tested = {each.cause for each in found if each.found}, {each.cause for each in found}
    for said, causes in (
        ("Tested and not found: ", [cause for cause in CAUSES if cause in tested - guilty]),
        ("Could not be tested: ", [cause for cause in CAUSES if cause not in tested]),
    ):
        section.sentences += [said + ", ".join(causes)] if causes else []
    section.numbers["causes"] = [each._asdict() for each in found]


def seen_in_numbers(
    dataset: Dataset, rows: np.ndarray, cfg: PressureModelConfig | None, pressure: ContactPressure | None
) -> list[CauseFound]:
    """Causes that show without anything being tried: values, nil pressures, signs, lag, and how the board lies.

    Args:
        dataset: Of n touches.
        rows: (n,) bool, those that methods learn from.
        cfg: How contact pressure was predicted; None where it was not.
        pressure: The n predicted contact pressures, likewise.

    Returns:
        A finding for each cause that can be tested on this recording.
    """
    touches = dataset.touches
    found = [*wrong_values(touches.patch[rows], touches.reading[rows], touches.force[rows], touches.depth[rows])]
    if cfg is not None and pressure is not None:
        known = np.asarray(pressure.pressure)[rows]
        found += flipped_board(known, touches.reading[rows], dataset.board)
        load_known = bool(np.isfinite(getattr(touches, cfg.control)[rows]).all())
        if load_known:
            found.append(nil_pressures(known.sum((1, 2)), cfg, touches.force[rows], touches.depth[rows]))
        if load_known and cfg.control == "force":
            found.append(pulling_forces(touches.force[rows], cfg.force_sign))
    return [*found, *late_rows(dataset, rows)]


def nil_pressures(total: np.ndarray, cfg: PressureModelConfig, force: np.ndarray, depth: np.ndarray) -> CauseFound:
    """Height zero: whether predicted pressures are nil or as good as nil.

    Args:
        total: (n,) N, of each predicted pressure.
        cfg: How it was predicted.
        force: (n,) N.
        depth: (n,) m.

    Returns:
        The finding.
    """
    if cfg.control == "force":
        nil = float(np.mean(~(cfg.force_sign * force > cfg.floor)))
        said = f"{100 * nil:.0f} % of the forces do not push, so that predicted pressures are almost nil"
        return CauseFound(SIGN, nil >= MIN_NIL_SHARE, said)
    nil = float(np.mean(~(total > cfg.floor / 10)))
    same = float(np.ptp(depth)) < LEAST_DEPTH_M
    at_one = ", as all presses go to one height" if same else ""
    said = (
        f"{100 * nil:.0f} % of the predicted pressures are nil{at_one}: depths count from a height that is not that of "
        "first contact"
    )
    return CauseFound(HEIGHT, nil >= MIN_NIL_SHARE, said)


def pulling_forces(force: np.ndarray, sign: float = 1.0) -> CauseFound:
    """Force sign: whether a press pushes.

    Args:
        force: (n,) N, along tool z.
        sign: That was taken.

    Returns:
        The finding.
    """
    pulling, median = float(np.mean(force < 0)), float(np.median(force))
    turned = ", which was turned here" if sign < 0 else ""
    said = f"{100 * pulling:.0f} % of the forces along the pressing axis are negative (median {median:.2f} N{turned})"
    return CauseFound(SIGN, pulling >= MIN_PULLING_SHARE and sign > 0, said)


def wrong_values(
    patches: np.ndarray, readings: np.ndarray, force: np.ndarray, depth: np.ndarray
) -> Iterator[CauseFound]:
    """Units: whether any quantity has values that no press has.

    Args:
        patches: (n, h, w) m.
        readings: (n, 3 chips) uT.
        force: (n,) N.
        depth: (n,) m.

    Yields:
        Findings.
    """
    wrong = []
    for name, values in (("force", force), ("depth", depth)):
        low, high, unit = LOADS[name]
        known = np.abs(values[np.isfinite(values)])
        middle = float(np.median(known)) if len(known) else 0.0
        if middle > 0 and not low <= middle <= high:
            wrong.append(f"the median {name} is {middle:.3g} {unit}, which no press has: its unit is another")
    relief = float(np.median(np.ptp(patches.reshape(len(patches), -1), axis=1)))
    if relief < LEAST_RELIEF_M:
        wrong.append(f"patches are flat to {1e6 * relief:.2g} um: their unit is another, or they show nothing")
    norm = float(np.median(np.linalg.norm(readings, axis=1)))
    if not SMALLEST_READING_UT <= norm <= LARGEST_READING_UT:
        wrong.append(f"the median reading is {norm:.3g} uT: its unit is another, or the skin was not touched")
    yield CauseFound(UNITS, bool(wrong), "; ".join(wrong) or "values are those of presses")


def flipped_board(pressure: np.ndarray, readings: np.ndarray, board: Board) -> Iterator[CauseFound]:
    """Axes: whether chips near the contact answer more than others, or would if the patch were flipped or turned.

    Args:
        pressure: (n, m, m) N on each cell.
        readings: (n, 3 chips) uT.
        board: Whose chips answer.

    Yields:
        A finding, where contacts and chips are spread enough to say.
    """
    found = alignments(pressure, readings, board)
    if found is None:
        return
    as_is, best = found["as recorded"], max(found, key=lambda name: found[name])
    flipped = found[best] > max(as_is, 0.0) + MIN_ALIGNMENT and found[best] > MIN_ALIGNMENT
    said = (
        f"chips near the contact answer most with the patch {best} (correlation {found[best]:.2f}, {as_is:.2f} as "
        "recorded): its axes are not the board's, which matters where chips' places do, and not to a predictor"
    )
    yield CauseFound(AXES, flipped, said)


def alignments(pressure: np.ndarray, readings: np.ndarray, board: Board) -> dict[str, float] | None:
    """Correlation of chips' answers with their nearness to the contact, for each flip and turn of the patch.

    Args:
        pressure: (n, m, m) N on each cell.
        readings: (n, 3 chips) uT.
        board: Whose chips answer.

    Returns:
        Correlations by what is done to the patch; None where it cannot be said.
    """
    total = pressure.sum((1, 2))
    used = total > 0
    chips = np.asarray(board.chips, np.float64)[:, :2]
    if used.sum() < 20 or len(chips) < 3:
        return None
    m = pressure.shape[-1]
    at = 1e-3 * CELL_MM * (np.arange(m) - (m - 1) / 2)
    x = (pressure[used].sum(1) * at).sum(1) / total[used]
    y = (pressure[used].sum(2) * at).sum(1) / total[used]
    answer = np.linalg.norm(readings[used].reshape(used.sum(), len(chips), 3), axis=2)
    strong = answer.sum(1) > 0
    share = _centred(answer[strong] / answer[strong].sum(1, keepdims=True))
    found = {}
    for swapped, sx, sy in product((False, True), (1, -1), (1, -1)):
        place = np.column_stack([sx * (y if swapped else x), sy * (x if swapped else y)])[strong]
        square = ((place[:, None] - chips) ** 2).sum(-1)
        near = np.exp(-square / (2 * NEAR_CHIP_M**2)) + 1e-6
        near = _centred(near / near.sum(1, keepdims=True))
        scale = np.sqrt((near**2).sum() * (share**2).sum())
        if scale <= 1e-9:
            return None
        found[_flip_name(swapped, sx, sy)] = float((near * share).sum() / scale)
    return found


def late_rows(dataset: Dataset, rows: np.ndarray) -> Iterator[CauseFound]:
    """Lag: whether readings agree better with what was seen some rows before or after.

    Args:
        dataset: Of n touches.
        rows: (n,) bool, those to look at.

    Yields:
        A finding, where there are rows enough.
    """
    touches, which = dataset.touches, np.flatnonzero(rows)[:LAG_TOUCHES]
    columns = [getattr(touches, name)[which] for name in ("force", "depth")]
    measured = np.column_stack([column for column in columns if np.isfinite(column).all()] or [np.zeros(len(which))])
    points = features_of(touch_features(touches.patch[which], measured), touches.patch[which], measured)
    r2 = {lag: _lagged_r2(points, touches.reading[which], touches.session[which], which, lag) for lag in _LAGS}
    r2 = {lag: value for lag, value in r2.items() if np.isfinite(value)}
    if 0 not in r2:
        return
    best = max(r2, key=lambda lag: r2[lag])
    said = (
        f"readings agree best with labels of {best:+d} rows (R2 of neighbours {r2[best]:.2f}, {r2[0]:.2f} as recorded)"
    )
    # A press that follows another closely agrees with it too: only a clear gain over no lag counts.
    yield CauseFound(LAG, best != 0 and r2[best] > r2[0] + MIN_GAIN, said)


def tried_changes(dataset: Dataset, rows: np.ndarray, groups: np.ndarray, cfg: PressureModelConfig) -> list[CauseFound]:
    """Height zero, force sign, tip radius, the view's direction, units and softness: each is changed, and the Gaussian
    process on predicted pressures is scored again.

    Args:
        dataset: Of n touches.
        rows: (n,) bool, those that methods learned from.
        groups: (n,) which cross-validation leaves whole.
        cfg: How contact pressure is predicted.

    Returns:
        A finding for each cause that was tried.
    """
    which = some_groups(np.flatnonzero(rows), groups, TRIED_TOUCHES)
    seen = tried_touches(dataset, which, groups)
    as_is = explained(seen, cfg)
    best: dict[str, tuple[float, str]] = {}
    for cause, said, changed in _changes(dataset, which, seen, cfg):
        r2 = explained(changed, cfg)
        if r2 > best.get(cause, (-np.inf, ""))[0]:
            best[cause] = r2, said
    return [
        CauseFound(
            cause,
            r2 > max(as_is, 0.0) + MIN_GAIN,
            f"with {said} predicted pressures explain {r2:.2f} of held-out training touches instead of "
            f"{max(as_is, 0.0):.2f}",
        )
        for cause, (r2, said) in best.items()
    ]


def _changes(
    dataset: Dataset, which: np.ndarray, seen: Tried, cfg: PressureModelConfig
) -> Iterator[tuple[str, str, Tried]]:
    """Changes to try: the cause, how it is changed, and the touches that the method then sees."""
    known = np.nan_to_num(seen.views, nan=dataset.reach)
    yield (
        AXES,
        "the view upside down (near for far)",
        seen._replace(views=np.asarray(dataset.reach - known, np.float32)),
    )
    if cfg.control == "force":
        yield SIGN, "forces of the other sign", seen._replace(force=-seen.force)
        for softness in SOFTNESSES:  # pressures of a softer layer are in proportion to those of a larger force
            said = f"a layer {softness:g} times as soft (--softness {softness * cfg.softness:g})"
            yield SOFTNESS, said, seen._replace(force=np.float32(softness) * seen.force)
    else:
        for height in HEIGHTS_M:
            yield HEIGHT, f"depths {1e3 * height:+g} mm", seen._replace(depth=seen.depth + np.float32(height))
    load = cfg.control
    for scale in SCALES:
        yield (
            UNITS,
            f"{load}s {scale:g} times as large",
            seen._replace(**{load: np.float32(scale) * getattr(seen, load)}),
        )
    radius = tip_radius(dataset)
    if radius is not None and seen.views.shape[-1] == dataset.touches.patch.shape[-1]:
        T_t_o = inverse(dataset.touches.T_w_t[which].astype(np.float64)) @ dataset.touches.T_w_o[which]
        for factor in TIP_FACTORS:
            views = tip_patches(sphere(factor * radius), T_t_o[:, 0, 3], T_t_o[:, 1, 3], dataset.window, dataset.reach)
            yield TIP, f"a tip of radius {1e3 * factor * radius:g} mm", seen._replace(views=views)


def tip_radius(dataset: Dataset) -> float | None:
    """The radius (m) of the spherical tip that a converter made patches of.

    Args:
        dataset: That it made.

    Returns:
        The radius, or None where patches were seen and not made.
    """
    given = dataset.meta.get("tip_radius_m")
    kind, _, size = dataset.meta.get("indenter", "").partition(":")
    try:
        radius = float(given) if given else 1e-3 * float(size) if kind == "sphere" else None
    except ValueError:
        return None
    poses = dataset.touches.T_w_o
    return radius if radius and np.isfinite(poses).all() else None


def _lagged_r2(points: np.ndarray, readings: np.ndarray, session: np.ndarray, row: np.ndarray, lag: int) -> float:
    """R2 of four nearest neighbours where the labels of row i + lag belong to the reading of row i."""
    at = np.arange(max(0, -lag), len(points) - max(0, lag))
    together = (session[at] == session[at + lag]) & (row[at + lag] - row[at] == lag)
    x, y = points[at + lag][together], readings[at][together].astype(np.float64)
    if len(x) < 40:
        return float("nan")
    fold = np.random.default_rng(0).integers(5, size=len(x))
    error = np.concatenate(
        [y[fold == i] - nearest_neighbours(x[fold != i], y[fold != i], x[fold == i], 4) for i in range(5)]
    )
    return float(1 - (error**2).sum() / max(((y - y.mean(0)) ** 2).sum(), 1e-12))


_LAGS = (0, *(lag for k in range(1, MAX_LAG + 1) for lag in (k, -k)))


def _centred(values: np.ndarray) -> np.ndarray:
    return values - values.mean(0)


def _flip_name(swapped: bool, sx: int, sy: int) -> str:
    flips = [axis for axis, sign in (("x", sx), ("y", sy)) if sign < 0]
    done = [
        *(["with x and y swapped"] if swapped else []),
        *([f"flipped along {' and '.join(flips)}"] if flips else []),
    ]
    return " and ".join(done) or "as recorded"
