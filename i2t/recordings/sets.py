"""Correction of data sets when they are read: the sign of the loads, and the height from which travel counts.

A data set states its units, axes and board, and its converter has tested them. Code that learns from recorded touches
takes them from `corrected_dataset`, where a force is positive if it presses and travel counts from first contact. A
data set that is already correct stays unchanged.
"""

from dataclasses import replace

import numpy as np

from i2t.dataset import Dataset
from i2t.recordings.diagnose import Finding, correction_of, find_force_sign, find_height_zero, find_travel_sign
from i2t.recordings.presses import dataset_presses
from i2t.types import ReturnCode

MIN_TRAVEL_M = 10e-6  # m, travel from which a touch counts as a press


def corrected_dataset(dataset: Dataset) -> tuple[Dataset, tuple[str, ...]]:
    """Correct the signs of a data set's forces and travels, and the height from which its travel counts.

    Args:
        dataset: Recorded or simulated touches.

    Returns:
        The data set, corrected where its readings or signs contradict it, and a sentence for each correction.
    """
    touches = dataset.touches
    signs = [
        find_force_sign(touches.force.astype(np.float64), touches.reading),
        find_travel_sign(touches.travel.astype(np.float64)),
    ]
    correction = correction_of(signs)
    if any(finding.wrong for finding in signs):
        touches = touches._replace(force=correction.force * touches.force, travel=correction.height * touches.travel)
        dataset = replace(dataset, touches=touches)
    zero = _height_zero(dataset)
    if zero is not None and zero.wrong:
        dataset = _with_height_zero(dataset, zero.correction["height_zero_m"])
    findings = [*signs, *([] if zero is None else [zero])]
    return dataset, tuple(finding.sentence for finding in findings if finding.wrong)


def _height_zero(dataset: Dataset) -> Finding | None:
    """Test the height of first contact if over a fifth of the presses of one tip have no travel, and none a force."""
    touches = dataset.touches
    travel = touches.travel[np.isfinite(touches.travel)]
    if np.isfinite(touches.force).any() or not len(travel) or np.mean(travel < MIN_TRAVEL_M) <= 0.2:
        return None
    presses = dataset_presses(dataset)
    finite = np.isfinite(presses.position).all(1) & np.isfinite(presses.readings).all(1)
    if len(np.unique(touches.object)) > 1 or len(np.unique(touches.pad)) > 1 or not finite.any():
        return None
    return find_height_zero(presses.rows(finite), stated=0.0)


def _with_height_zero(dataset: Dataset, zero: float) -> Dataset:
    """Count travel from another height of the tip, in m above the height from which it counts."""
    touches = dataset.touches
    height = dataset_presses(dataset).height - np.float64(zero)  # type: ignore[operator]
    T_w_o = touches.T_w_o.copy()
    T_w_o[:, :3, 3] -= np.float32(zero) * touches.T_w_t[:, :3, 2]
    in_contact = (touches.code == ReturnCode.FREE) & (height <= 0)
    return replace(
        dataset,
        touches=touches._replace(
            travel=np.maximum(-height, 0).astype(np.float32),
            nearest=touches.nearest - np.float32(zero),
            T_w_o=T_w_o,
            code=np.where(in_contact, int(ReturnCode.UNDEFINED), touches.code).astype(touches.code.dtype),
        ),
    )
