"""Causes of a poor predictor trained on a recording: each likely one is tested on its training touches.

The recording is changed as if it had a fault the other way round (another tip, travels from another height, forces of
the other sign, the view upside down, units, a softer skin), contact pressures are predicted anew, and a Gaussian
process on them is scored on held-out groups of touches. A cause is found where the change explains clearly more than
the recording as it is. For labels of another row it is a smooth model on what was seen.

A flip of the patch along x or y, or a turn of it, changes nothing that methods on predicted pressure could notice,
because their covariance is the same for mirrored pressures.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.sections import CannotTellError, Section
from experiments.train.configs import PRESETS
from experiments.train.loads import MIN_GAIN, TRIED_TOUCHES, Tried, explained, some_groups, tried_touches
from experiments.train.prepare import prepare
from i2t.contact.pressure import PressureModelConfig
from i2t.convert.press_table import sphere, tip_patches
from i2t.dataset import Dataset, load_dataset
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.prediction.baselines import features_of, image_components, touch_features
from i2t.recordings.diagnose import Finding, FindingName
from i2t.recordings.diagnose.lag import lag_between

TIP, VIEW = "tip radius", "view"
SOFTNESS = "softness"
CAUSES = (
    FindingName.HEIGHT_ZERO, FindingName.FORCE_SIGN, TIP, VIEW, FindingName.UNITS, FindingName.LAG, SOFTNESS,
)  # fmt: skip

LAG_TOUCHES = 1500  # in the order of their rows
LAG_FEATURES = 4  # of the views, that vary most
TIP_FACTORS = (0.5, 2.0)
SCALES = (0.1, 10.0)
HEIGHTS_M = (-0.5e-3, 0.5e-3, 1e-3, 2e-3)  # added to travels
SOFTNESSES = (4.0, 16.0)  # of a skin, in units of the nominal one's


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
    section.sentences += prepared.notes  # on loads: what is odd about signs, units and zeros
    found = [*late_rows(touches.dataset)]
    if cfg is not None and preset.try_causes:
        known = np.isfinite(getattr(touches.dataset.touches, cfg.control)[split.train]).all()
        found += tried_changes(touches.dataset, split.train, split.groups, cfg) if known else []
    section.sentences += [finding.sentence for finding in found if finding.wrong]
    guilty, tested = {finding.name for finding in found if finding.wrong}, {finding.name for finding in found}
    for said, causes in (
        ("Tested and not found: ", [cause for cause in CAUSES if cause in tested - guilty]),
        ("Could not be tested: ", [cause for cause in CAUSES if cause not in tested]),
    ):
        section.sentences += [said + ", ".join(causes)] if causes else []
    section.numbers["causes"] = [finding.to_json() for finding in found]


def late_rows(dataset: Dataset) -> Iterator[Finding]:
    """Lag: whether readings agree better with what was seen some rows before or after.

    Args:
        dataset: Of touches in the order of time.

    Yields:
        A finding, where the recording can tell.
    """
    touches, which = dataset.touches, slice(LAG_TOUCHES)
    patches = touches.patch[which]
    columns = [getattr(touches, name)[which] for name in ("force", "travel")]
    measured = np.column_stack([column for column in columns if np.isfinite(column).all()] or [np.zeros(len(patches))])
    points = np.asarray(features_of(touch_features(image_components(patches), measured), patches, measured))
    points = points[:, np.argsort(-points.std(0))[:LAG_FEATURES]]
    found = lag_between(points.astype(np.float64), touches.reading[which].astype(np.float64))
    if found.identifiable:
        yield found


def tried_changes(dataset: Dataset, rows: np.ndarray, groups: np.ndarray, cfg: PressureModelConfig) -> list[Finding]:
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
    as_is = max(explained(seen, cfg), 0.0)
    best: dict[str, tuple[float, str]] = {}
    for cause, said, changed in _changes(dataset, which, seen, cfg):
        best[cause] = max(best.get(cause, (-np.inf, "")), (explained(changed, cfg), said))
    return [
        Finding(
            cause,
            f"with {said} predicted pressures explain {r2:.2f} of held-out training touches instead of {as_is:.2f}",
            identifiable=True,
            wrong=r2 > as_is + MIN_GAIN,
            evidence={"r2": r2, "r2_as_recorded": as_is},
        )
        for cause, (r2, said) in best.items()
    ]


def _changes(
    dataset: Dataset, which: np.ndarray, seen: Tried, cfg: PressureModelConfig
) -> Iterator[tuple[str, str, Tried]]:
    """Changes to try: the cause, how it is changed, and the touches that the method then sees."""
    known, load = np.nan_to_num(seen.views, nan=dataset.reach), getattr(seen, cfg.control)
    upside_down = np.asarray(dataset.reach - known, np.float32)
    yield VIEW, "the view upside down (near for far)", seen._replace(views=upside_down)
    if cfg.control == "force":
        yield FindingName.FORCE_SIGN, "forces of the other sign", seen._replace(force=-seen.force)
        for softness in SOFTNESSES:  # pressures of a softer layer are in proportion to those of a larger force
            said = f"a layer {softness:g} times as soft (--softness {softness * cfg.softness:g})"
            yield SOFTNESS, said, seen._replace(force=np.float32(softness) * seen.force)
    else:
        for height in HEIGHTS_M:
            lifted = seen._replace(travel=seen.travel + np.float32(height))
            yield FindingName.HEIGHT_ZERO, f"travels {1e3 * height:+g} mm", lifted
    for scale in SCALES:
        changed = seen._replace(**{cfg.control: np.float32(scale) * load})
        yield FindingName.UNITS, f"{cfg.control}s {scale:g} times as large", changed
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
    return radius if radius and np.isfinite(dataset.touches.T_w_o).all() else None
