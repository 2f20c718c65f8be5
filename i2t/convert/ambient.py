"""Take a fitted ambient field out of a recording whose readings were zeroed once, while the tool turned.

A reading that is the change since the rest at one pose holds, at another pose, the turn of the Earth's field as well.
Where the poses are known and the field was fitted (`i2t.skin.ambient`), that part is predicted and subtracted: the
prediction at a touch less the prediction at the first touch of its session. A recording of `i2t.collect` needs none of
this, as each touch's own ambient is subtracted there.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from i2t.convert.common import Converted
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.geometry import so3_exp
from i2t.skin.ambient import AmbientField, subtract_ambient

SUBTRACTED_KEY = "ambient field"  # of the provenance


def without_ambient(
    dataset: Dataset, field: AmbientField, name: str, *, base_turn: Sequence[float] = (0.0, 0.0, 0.0)
) -> Converted:
    """Readings without what the tool's turn made of the ambient field.

    Args:
        dataset: Of one skin, with the tool's pose at every touch.
        field: Fitted with that skin on that arm.
        name: Of the field, for the provenance.
        base_turn: (3,) rad, rotation vector of the robot's base in the data set's world.

    Returns:
        The data set, with what was done in its provenance, and the same as a sentence.

    Raises:
        DataError: The ambient is subtracted already, a pose is missing, or the field is of another board.
    """
    if "i2t.collect" in dataset.meta.get("made by", "") or SUBTRACTED_KEY in dataset.meta:
        raise DataError("the ambient was subtracted from these readings already; leave them as they are")
    if len(field.offset) != dataset.board.num_chips:
        raise DataError(
            f"{name}: is the ambient field of {len(field.offset)} chips, and the data set's board has "
            f"{dataset.board.num_chips}; name the field of this skin"
        )
    touches = dataset.touches
    known = np.isfinite(touches.T_w_t).all((1, 2))
    if not known.all():
        raise DataError(
            f"{(~known).sum()} of {len(dataset)} touches have no pose of the tool, so nobody knows how the ambient "
            "field lay in them; leave those touches out"
        )
    T_b_t = touches.T_w_t.astype(float)
    T_b_t[:, :3, :] = np.asarray(so3_exp(np.asarray(base_turn, float))).T @ T_b_t[:, :3, :]
    silent = np.isnan(field.offset)
    whole = field._replace(offset=np.where(silent, 0.0, field.offset))  # offsets cancel in a difference
    minus_field = subtract_ambient(whole, dataset.board, T_b_t, np.zeros(touches.reading.shape))
    for session in np.unique(touches.session):
        rows = np.flatnonzero(touches.session == session)
        minus_field[rows] -= minus_field[rows[0]]
    turns = T_b_t[:, :3, :3]
    cosine = (np.einsum("nij,nij->n", turns, np.broadcast_to(turns[:1], turns.shape)) - 1) / 2
    turn = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max(initial=0.0))
    note = (
        f"the ambient field {name} was subtracted, relative to the first touch of each session: readings change by up "
        f"to {np.abs(minus_field).max(initial=0.0):.1f} uT, the tool turned by up to {turn:.0f} degrees"
    )
    reading = touches.reading + minus_field.astype(np.float32)
    meta = {**dataset.meta, SUBTRACTED_KEY: note}
    return Converted(replace(dataset, touches=touches._replace(reading=reading), meta=meta), (note,))
