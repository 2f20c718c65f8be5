"""Tests of the likely reasons why a predictor trained on a recording is poor, made on its training touches.

Each test undoes one possible mistake (tip radius, height zero of the travels, sign of the forces, inverted view, units,
softness of the skin), predicts contact pressures again, and scores a Gaussian process on them on held-out groups of
touches. The mistake counts as found if the score rises clearly. Labels shifted by rows are tested with a smooth model
of the readings instead.

Mirrored or rotated patches cannot be tested in this way, because methods on predicted pressure have the same
covariance for mirrored pressures.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.sections import CannotTellError, Section
from experiments.fidelity.tried import MIN_GAIN, TRIED_TOUCHES, Tried, explained, some_groups, tried_touches
from experiments.train.configs import PRESETS
from experiments.train.prepare import prepare
from i2t.contact.pressure import PressureModelConfig
from i2t.convert.press_table import sphere, tip_patches
from i2t.dataset import Dataset, load_dataset
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.prediction.baselines import features_of, image_components, touch_features
from i2t.recordings.diagnose import Finding, FindingName
from i2t.recordings.diagnose.lag import lag_between

TIP, VIEW, SOFTNESS = "tip radius", "view", "softness"
CAUSES = (
    FindingName.HEIGHT_ZERO, FindingName.FORCE_SIGN, TIP, VIEW, FindingName.UNITS, FindingName.LAG, SOFTNESS,
)  # fmt: skip


def cause_section(path: Path, preset: FidelityPreset, seed: int, section: Section) -> None:
    """Report which likely causes of a poor predictor a data set shows, does not show, or does not allow to test."""
    dataset = load_dataset(path)
    if dataset.source == "simulated":
        raise CannotTellError("The touches are simulated, and the simulation makes none of these mistakes.")
    try:
        prepared = prepare(dataset, PRESETS["paper"], "auto", seed)
    except DataError as error:
        raise CannotTellError(f"Nothing can be held out: {error}") from error
    touches, split, cfg = prepared.touches, prepared.split, prepared.touches.pressure_model
    section.sentences += prepared.notes  # on signs, units and zeros of the loads
    findings = [*late_rows(touches.dataset)]
    if cfg is not None and preset.try_causes:
        loads_known = np.isfinite(getattr(touches.dataset.touches, cfg.control)[split.train]).all()
        findings += tried_changes(touches.dataset, split.train, split.groups, cfg) if loads_known else []
    section.sentences += [finding.sentence for finding in findings if finding.wrong]
    guilty, tested = {finding.name for finding in findings if finding.wrong}, {finding.name for finding in findings}
    for heading, causes in (
        ("Tested and not found: ", [cause for cause in CAUSES if cause in tested - guilty]),
        ("Could not be tested: ", [cause for cause in CAUSES if cause not in tested]),
    ):
        section.sentences += [heading + ", ".join(causes)] if causes else []
    section.numbers["causes"] = [finding.to_json() for finding in findings]


def late_rows(dataset: Dataset) -> Iterator[Finding]:
    """Test whether readings agree better with the patches of earlier or later rows.

    Args:
        dataset: Touches in the order of time; the first 1500 are used.

    Yields:
        One finding on the lag, if the recording allows the test.
    """
    touches, which = dataset.touches, slice(1500)
    patches = touches.patch[which]
    columns = [getattr(touches, name)[which] for name in ("force", "travel")]
    measured = np.column_stack([column for column in columns if np.isfinite(column).all()] or [np.zeros(len(patches))])
    points = np.asarray(features_of(touch_features(image_components(patches), measured), patches, measured))
    points = points[:, np.argsort(-points.std(0))[:4]]  # the features that vary most
    finding = lag_between(points.astype(np.float64), touches.reading[which].astype(np.float64))
    if finding.identifiable:
        yield finding


def tried_changes(dataset: Dataset, rows: np.ndarray, groups: np.ndarray, cfg: PressureModelConfig) -> list[Finding]:
    """Change height zero, force sign, tip radius, view direction, units and softness in turn, and score each change.

    Args:
        dataset: n touches.
        rows: `(n,)` bool, True for training touches.
        groups: `(n,)` indices of the groups that cross-validation keeps together.
        cfg: Model of contact pressure.

    Returns:
        One finding for each cause tested, with the R2 of its best change.
    """
    which = some_groups(np.flatnonzero(rows), groups, TRIED_TOUCHES)
    seen = tried_touches(dataset, which, groups)
    as_is = max(explained(seen, cfg), 0.0)
    best: dict[str, tuple[float, str]] = {}
    for cause, change, changed in _changes(dataset, which, seen, cfg):
        best[cause] = max(best.get(cause, (-np.inf, "")), (explained(changed, cfg), change))
    return [
        Finding(
            cause,
            f"with {change} predicted pressures explain {r2:.2f} of held-out training touches instead of {as_is:.2f}",
            identifiable=True,
            wrong=r2 > as_is + MIN_GAIN,
            evidence={"r2": r2, "r2_as_recorded": as_is},
        )
        for cause, (r2, change) in best.items()
    ]


def _changes(
    dataset: Dataset, which: np.ndarray, seen: Tried, cfg: PressureModelConfig
) -> Iterator[tuple[str, str, Tried]]:
    """Yield the cause, a description of the change, and the changed touches."""
    views, load = np.nan_to_num(seen.views, nan=dataset.reach), getattr(seen, cfg.control)
    upside_down = np.asarray(dataset.reach - views, np.float32)
    yield VIEW, "the view upside down (near for far)", seen._replace(views=upside_down)
    if cfg.control == "force":
        yield FindingName.FORCE_SIGN, "forces of the other sign", seen._replace(force=-seen.force)
        for softness in (4.0, 16.0):  # a softer layer has the pressures of a larger force, up to a factor
            change = f"a layer {softness:g} times as soft (--softness {softness * cfg.softness:g})"
            yield SOFTNESS, change, seen._replace(force=np.float32(softness) * seen.force)
    else:
        for height in (-0.5e-3, 0.5e-3, 1e-3, 2e-3):
            lifted = seen._replace(travel=seen.travel + np.float32(height))
            yield FindingName.HEIGHT_ZERO, f"travels {1e3 * height:+g} mm", lifted
    for scale in (0.1, 10.0):
        changed = seen._replace(**{cfg.control: np.float32(scale) * load})
        yield FindingName.UNITS, f"{cfg.control}s {scale:g} times as large", changed
    radius = tip_radius(dataset)
    if radius is not None and seen.views.shape[-1] == dataset.touches.patch.shape[-1]:
        T_t_o = inverse(dataset.touches.T_w_t[which].astype(np.float64)) @ dataset.touches.T_w_o[which]
        for factor in (0.5, 2.0):
            views = tip_patches(sphere(factor * radius), T_t_o[:, 0, 3], T_t_o[:, 1, 3], dataset.window, dataset.reach)
            yield TIP, f"a tip of radius {1e3 * factor * radius:g} mm", seen._replace(views=views)


def tip_radius(dataset: Dataset) -> float | None:
    """Read the radius of the spherical tip from which a converter computed the patches.

    Args:
        dataset: Data set with the converter's metadata.

    Returns:
        The radius in metres, or None if the patches are not computed from a spherical tip.
    """
    given = dataset.meta.get("tip_radius_m")
    kind, _, size = dataset.meta.get("indenter", "").partition(":")
    try:
        radius = float(given) if given else 1e-3 * float(size) if kind == "sphere" else None
    except ValueError:
        return None
    return radius if radius and np.isfinite(dataset.touches.T_w_o).all() else None
