"""The ambient field of a session: fitted from free poses before its first touch, kept in its folder, and compared with
an earlier one.
"""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from i2t.collect.free_poses import gather_of_skins, plan_free_poses
from i2t.collect.procedure import Procedure
from i2t.collect.settings import AmbientSettings
from i2t.skin.ambient import (
    AmbientField,
    FreePoses,
    ambient_changed,
    fit_ambient,
    load_ambient,
    save_ambient,
    subtract_ambient,
)
from i2t.types import Array, Board

AMBIENT_FILE = ".ambient.npz"  # hidden, as it is no touch
AMBIENT_FALSE_ALARM = 0.01  # of sessions, at which a field that has not changed since the last one is called changed


def fitted_ambient(procedure: Procedure, settings: AmbientSettings, out: Path, *, seed: int = 0) -> AmbientField | None:
    """The field for the touches that follow; those of further skins on the tool are kept with these.

    Args:
        procedure: Its devices are connected; its further skins are given their fields.
        settings: How many free poses are taken; with none an earlier field of the folder is used.
        out: Folder of the touches.
        seed: Of the poses.

    Returns:
        The field of the skin at the tool, which is in the folder too; None if there is none.

    Raises:
        ValueError: The rig's box leaves no room for free poses, the arm's limits forbid their speed, or the folder's
            field is damaged or another board's.
        DeviceError: A device fails.
    """
    skins = {each.name: each for each in procedure.carried}
    boards = {"": procedure.board, **{name: each.board for name, each in skins.items()}}
    paths = {name: out / (AMBIENT_FILE if not name else f".ambient-{name}.npz") for name in boards}
    fields = {name: load_ambient(path, boards[name])[0] if path.exists() else None for name, path in paths.items()}
    if settings.poses:
        fields = _newly_fitted(procedure, settings, paths, boards, fields, seed=seed)
    else:
        for name, field in fields.items():
            if field is not None:
                print(f"ambient field of {paths[name]}: {_said(field)}")
    for name, each in skins.items():
        each.ambient_field = fields[name]
    return fields[""]


def _newly_fitted(
    procedure: Procedure,
    settings: AmbientSettings,
    paths: Mapping[str, Path],
    boards: Mapping[str, Board],
    earlier: Mapping[str, AmbientField | None],
    *,
    seed: int,
) -> dict[str, AmbientField | None]:
    """The fields of all skins from free poses, kept in their files."""
    procedure.path.check_settings()
    poses = plan_free_poses(procedure.path, procedure.arm.state().T_b_t, settings, seed)
    procedure.retreat()
    print(f"{len(poses)} free poses ...", flush=True)
    devices = {
        "": (procedure.skin, np.eye(4)),
        **{each.name: (each.skin, each.T_tool_skin) for each in procedure.carried},
    }
    found = gather_of_skins(procedure.arm, devices, procedure.clock, procedure.path, poses, settings=settings)
    fields: dict[str, AmbientField | None] = {}
    for name, free in found.items():
        board, path, before = boards[name], paths[name], earlier[name]
        field = fit_ambient(free, board, burst=procedure.settings.ambient)
        print(f"ambient field{f' of {name}' if name else ''}: {_said(field)}")
        print(
            f"               readings change by {_turned(free):.1f} uT from pose to pose, {_rest(field, board, free)}"
        )
        if before is not None:
            change = ambient_changed(before, board, free, false_alarm=AMBIENT_FALSE_ALARM)
            print(f"               since the folder was begun: {change.sentence}")
            path.replace(_aside(path))
        features = devices[name][0].features
        about = {"skin": features.name, "source": features.source}
        save_ambient(path, field, {**about, "fitted": f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"})
        fields[name] = field
    return fields


def _said(field: AmbientField) -> str:
    earth = ", ".join(f"{value:.1f} +- {error:.1f}" for value, error in zip(field.earth, field.earth_std, strict=True))
    silent = np.flatnonzero(np.isnan(field.offset).any(1))
    missing = f"; without chips {', '.join(map(str, silent))}" if len(silent) else ""
    return f"({earth}) uT in the base{missing}"


def _turned(free: FreePoses) -> float:
    """Change (uT) from pose to pose, root mean square over channels."""
    return float(np.sqrt(np.nanmean((free.reading - np.nanmean(free.reading, axis=0)) ** 2)))


def _rest(field: AmbientField, board: Board, free: FreePoses) -> str:
    left: Array = subtract_ambient(field, board, free.T_b_t, free.reading)
    return f"and by {np.sqrt(np.nanmean(left**2)):.1f} uT with the field subtracted"


def _aside(path: Path) -> Path:
    """A name for an earlier field, which is kept."""
    number = 1
    while (kept := path.with_name(f"{path.stem}-{number}{path.suffix}")).exists():
        number += 1
    return kept
