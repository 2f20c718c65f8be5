"""The ambient field of a session: fitted from free poses before its first touch, kept in its folder, and compared with
an earlier one.
"""

from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from i2t.collect.free_poses import gather_free_poses, plan_free_poses
from i2t.collect.procedure import Procedure
from i2t.collect.settings import AmbientSettings
from i2t.skin.ambient import (
    MODELS,
    AmbientField,
    FreePoses,
    ambient_changed,
    fit_ambient,
    load_ambient,
    save_ambient,
    subtract_ambient,
)
from i2t.types import Array

AMBIENT_FILE = ".ambient.npz"  # hidden, as it is no touch
AMBIENT_FALSE_ALARM = 0.01  # of sessions, at which a field that has not changed since the last one is called changed


def fitted_ambient(procedure: Procedure, settings: AmbientSettings, out: Path, *, seed: int = 0) -> AmbientField | None:
    """The field for the touches that follow.

    Args:
        procedure: Its devices are connected.
        settings: How many free poses are taken; with none an earlier field of the folder is used.
        out: Folder of the touches.
        seed: Of the poses.

    Returns:
        The field, which is in the folder too; None if there is none.

    Raises:
        ValueError: The rig's box leaves no room for free poses, the arm's limits forbid their speed, or the folder's
            field is damaged or another board's.
        DeviceError: A device fails.
    """
    path = out / AMBIENT_FILE
    before = load_ambient(path, procedure.board)[0] if path.exists() else None
    if not settings.poses:
        if before is not None:
            print(f"ambient field of {path}: {_said(before)}")
        return before
    procedure.path.check_settings()
    poses = plan_free_poses(procedure.path, procedure.arm.state().T_b_t, settings, seed)
    procedure.retreat()
    print(f"{len(poses)} free poses ...", flush=True)
    free = gather_free_poses(procedure.arm, procedure.skin, procedure.clock, procedure.path, poses, settings=settings)
    field = fit_ambient(free, procedure.board, burst=procedure.settings.ambient)
    print(f"ambient field: {_said(field)}")
    print(
        f"               readings change by {_turned(free):.1f} uT from pose to pose, {_rest(field, procedure, free)}"
    )
    if before is not None:
        change = ambient_changed(before, procedure.board, free, false_alarm=AMBIENT_FALSE_ALARM)
        print(f"               since the folder was begun: {change.sentence}")
        path.replace(_aside(path))
    about = {"skin": procedure.skin.features.name, "source": procedure.skin.features.source}
    save_ambient(path, field, {**about, "fitted": f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"})
    return field


def _said(field: AmbientField) -> str:
    earth = ", ".join(f"{value:.1f} +- {error:.1f}" for value, error in zip(field.earth, field.earth_std, strict=True))
    silent = np.flatnonzero(np.isnan(field.offset).any(1))
    missing = f"; without chips {', '.join(map(str, silent))}" if len(silent) else ""
    return f"({earth}) uT in the base, model {field.model!r} of {', '.join(MODELS)}{missing}"


def _turned(free: FreePoses) -> float:
    """uT, root mean square over channels of the change from pose to pose."""
    return float(np.sqrt(np.nanmean((free.reading - np.nanmean(free.reading, axis=0)) ** 2)))


def _rest(field: AmbientField, procedure: Procedure, free: FreePoses) -> str:
    left: Array = subtract_ambient(field, procedure.board, free.T_b_t, free.reading)
    tried = field.left_out[~np.isnan(field.left_out)]
    outside = f", {tried.min():.1f} on poses left out" if len(tried) else ""
    return f"and by {np.sqrt(np.nanmean(left**2)):.1f} uT with the field subtracted{outside}"


def _aside(path: Path) -> Path:
    """A name for an earlier field, which is kept."""
    number = 1
    while (kept := path.with_name(f"{path.stem}-{number}{path.suffix}")).exists():
        number += 1
    return kept
