"""What a data set of i2t cannot state of itself, diagnosed when it is read: the sign of its loads, and the height that
its depths count from.

Units, axes and board of a data set are stated, and its converter has judged them. Whoever learns from recorded touches
takes them from `corrected_dataset`, so that a force is positive where it presses and a depth is travel past first
contact, whatever the recording counted. A set that is corrected already stays as it is.
"""

from dataclasses import replace

import numpy as np

from i2t.dataset import Dataset
from i2t.recordings.diagnose import Finding, correction_of, find_depth_sign, find_force_sign, find_height_zero
from i2t.recordings.presses import dataset_presses
from i2t.types import ReturnCode

NO_DEPTH_SHARE = 0.2  # of the touches of a set that has depths and no force: beyond it, the height of contact is judged
MIN_DEPTH_M = 10e-6  # that counts as a press


def corrected_dataset(dataset: Dataset) -> tuple[Dataset, tuple[str, ...]]:
    """A data set whose forces press and whose depths count from first contact.

    Args:
        dataset: Recorded or simulated touches.

    Returns:
        The data set, corrected where its readings or signs contradict it, and a sentence for each correction.
    """
    touches = dataset.touches
    signs = [
        find_force_sign(touches.force.astype(np.float64), touches.reading),
        find_depth_sign(touches.depth.astype(np.float64)),
    ]
    todo = correction_of(signs)
    if any(finding.wrong for finding in signs):
        touches = touches._replace(force=todo.force * touches.force, depth=todo.height * touches.depth)
        dataset = replace(dataset, touches=touches)
    zero = _height_zero(dataset)
    if zero is not None and zero.wrong:
        dataset = _counted_from(dataset, zero.correction["height_zero_m"])
    findings = [*signs, *([] if zero is None else [zero])]
    return dataset, tuple(finding.sentence for finding in findings if finding.wrong)


def _height_zero(dataset: Dataset) -> Finding | None:
    """The finding on the height of first contact, where many presses of one tip have no depth and no force."""
    touches = dataset.touches
    depth = touches.depth[np.isfinite(touches.depth)]
    if np.isfinite(touches.force).any() or not len(depth) or np.mean(depth < MIN_DEPTH_M) <= NO_DEPTH_SHARE:
        return None
    presses = dataset_presses(dataset)
    known = np.isfinite(presses.position).all(1) & np.isfinite(presses.readings).all(1)
    if len(np.unique(touches.object)) > 1 or len(np.unique(touches.pad)) > 1 or not known.any():
        return None
    return find_height_zero(presses.rows(known), stated=0.0)


def _counted_from(dataset: Dataset, zero: float) -> Dataset:
    """The data set with depths from another height of the tip (m, above the one that they count from)."""
    touches = dataset.touches
    height = dataset_presses(dataset).height - np.float64(zero)  # type: ignore[operator]
    T_w_o = touches.T_w_o.copy()
    T_w_o[:, :3, 3] -= np.float32(zero) * touches.T_w_t[:, :3, 2]
    met = (touches.code == ReturnCode.FREE) & (height <= 0)
    return replace(
        dataset,
        touches=touches._replace(
            depth=np.maximum(-height, 0).astype(np.float32),
            nearest=touches.nearest - np.float32(zero),
            T_w_o=T_w_o,
            code=np.where(met, int(ReturnCode.UNDEFINED), touches.code).astype(touches.code.dtype),
        ),
    )
