"""Free poses before a session: the tool turns above everything, touches nothing, and the ambient field is fitted.

Where the tool may go is decided before the first motion, and what is not allowed is refused, never replaced: every
place lies inside the rig's box and `clearance` above the height at which the tool goes across the object. Orientations
tilt the tool away from pointing down, and turn it about its own axis, by no more than the settings say; between two
poses the tool is put upright where it stands, moved and turned upright, and tilted again, so that on the way it is
tilted no further either. Among many such poses those are taken that tell most about the field (a D-optimal design,
chosen greedily). The field of each skin is kept in the folder of the touches, and compared with what the skin reads
before each touch.

Frames: W world, B robot base, T tool, S skin; metres and radians.
"""

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.collect.path import TouchPath
from i2t.collect.procedure import Procedure, is_at
from i2t.collect.settings import AmbientSettings
from i2t.collect.touch import SkinOnTool, TouchResult, UnreachableError
from i2t.geometry import so3_exp, transform
from i2t.hardware.limits import format_position
from i2t.skin.ambient import (
    AmbientField,
    FreePoses,
    ambient_changed,
    fit_ambient,
    load_ambient,
    save_ambient,
    subtract_ambient,
)
from i2t.types import Array

CANDIDATES = 400  # poses among which the best are chosen
BURST_SAMPLES = 10  # that are read at once
INFORMATION_FLOOR = 1e-3  # of a pose, before the first is chosen
AMBIENT_FILE = ".ambient.npz"  # hidden, as it is no touch
TOUCH_FALSE_ALARM = 1e-3  # of touches, at which a field that has not changed is called changed


class FreePose(NamedTuple):
    """A pose above everything, and the upright one at the same place from which it is tilted."""

    upright: Float[Array, "4 4"]  # T_b_t
    tilted: Float[Array, "4 4"]


def plan_free_poses(
    path: TouchPath, T_b_t: Float[Array, "4 4"], settings: AmbientSettings, seed: int = 0
) -> list[FreePose]:
    """Choose free poses; nothing moves.

    Args:
        path: Of the touches, which knows the box and the way across.
        T_b_t: Where the tool is, m: it keeps its turn about its own axis where it points down.
        settings: How many, and how far they tilt.
        seed: Of the candidates.

    Returns:
        The poses in the order in which they are taken.

    Raises:
        UnreachableError: The box leaves no room above the way across.
    """
    low, high = _free_box(path, settings)
    down = _pointing_down(path, np.asarray(T_b_t, float))
    rng = np.random.default_rng(seed)
    places = rng.uniform(low, high, (CANDIDATES, 3))
    turns = math.radians(settings.turn) * rng.uniform(-1.0, 1.0, CANDIDATES)
    tilts = math.radians(settings.tilt) * np.sqrt(rng.uniform(0.0, 1.0, CANDIDATES))
    ways = rng.uniform(0.0, 2 * np.pi, CANDIDATES)
    upright = down @ so3_exp(turns[:, None] * np.array([0.0, 0.0, 1.0]))
    axes = np.column_stack([np.cos(ways), np.sin(ways), np.zeros(CANDIDATES)])
    tilted = upright @ so3_exp(tilts[:, None] * axes)
    chosen = _most_informative(tilted, settings.poses)
    return [FreePose(transform(upright[i], places[i]), transform(tilted[i], places[i])) for i in chosen]


def _free_box(path: TouchPath, settings: AmbientSettings) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) m of where free poses may be, in the base."""
    lower, upper = path.rig.limits.box
    low = path.transfer_height() + settings.clearance
    if not low <= upper[2]:
        raise UnreachableError(
            f"free poses would begin at {low:.3f} m in the base, {1e3 * settings.clearance:.0f} mm above the way "
            f"across, and the box ends at {upper[2]:.3f} m; raise the box, or leave out the free poses"
        )
    middle = (lower + upper) / 2
    half = np.minimum((upper - lower) / 2, settings.spread / 2)
    first, last = middle - half, middle + half
    first[2], last[2] = low, min(upper[2], low + settings.spread)
    return first, last


def _pointing_down(path: TouchPath, T_b_t: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) of a tool that points down in the world and keeps its turn, in the base."""
    z = -path.rig.T_base_world[:3, 2]
    x = T_b_t[:3, 0] - (T_b_t[:3, 0] @ z) * z
    if np.linalg.norm(x) < 0.1:  # its x axis points up or down: the other one does not
        y = T_b_t[:3, 1] - (T_b_t[:3, 1] @ z) * z
        x = np.cross(y, z)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def _most_informative(rotations: np.ndarray, count: int) -> list[int]:
    """Poses that together tell most about the field next to constant offsets, one after the other.

    A pose reads R^T e + o; what it adds to the information about (e, o) is X^T X with X = (R^T, I).
    """
    back = rotations.swapaxes(-1, -2)
    rows = np.concatenate([back, np.broadcast_to(np.eye(3), back.shape)], axis=-1)
    each = np.einsum("pik,pil->pkl", rows, rows)
    information = INFORMATION_FLOOR * np.eye(6)
    chosen: list[int] = []
    for _ in range(count):
        gains = np.linalg.slogdet(information + each)[1]
        gains[chosen] = -np.inf
        best = int(np.argmax(gains))
        chosen.append(best)
        information = information + each[best]
    return chosen


def gather_free_poses(
    procedure: Procedure, poses: Sequence[FreePose], settings: AmbientSettings
) -> dict[str, FreePoses]:
    """Take the poses, with all skins read at each; the tool ends upright, above everything.

    Args:
        procedure: Its devices are connected, and the tool has retreated from whatever it touched.
        poses: As `plan_free_poses` planned them.
        settings: How long the skins are read.

    Returns:
        Of each skin, by its name, its poses in the base as the arm reports them, with its samples.

    Raises:
        UnreachableError: The tool stands where it may not be lifted from, or a pose is not free; nothing has moved.
        DeviceError: The arm met something or stopped, or a skin fell silent.
    """
    arm, path = procedure.arm, procedure.path
    low = _free_box(path, settings)[0][2]
    lifted = np.array(arm.state().T_b_t)
    lifted[2, 3] = max(low, lifted[2, 3])
    for goal in (*(each.tilted for each in poses), lifted):
        if not (path.rig.limits.contains(goal[:3, 3]) and goal[2, 3] >= low - 1e-9):
            raise UnreachableError(
                f"a free pose would be at {format_position(goal[:3, 3])} m, outside the box or too low; move the tool "
                "above the object with the pendant, or raise the box"
            )

    def go(*goals: Array) -> None:
        for goal in goals:
            if not is_at(arm.state(), goal):
                arm.go(goal, path.free_speed, path.settings.acceleration)

    go(lifted, transform(_pointing_down(path, lifted), lifted[:3, 3]))
    T_b_t: list[Array] = []
    read: dict[str, list[np.ndarray]] = {each.name: [] for each in procedure.skins}
    for pose in poses:
        go(pose.upright, pose.tilted)
        procedure.clock.sleep(path.settings.settle)
        T_b_t.append(np.array(arm.state().T_b_t))
        for each in procedure.skins:
            bursts = math.ceil(settings.seconds * each.skin.features.rate / BURST_SAMPLES)
            samples = [each.skin.read(BURST_SAMPLES).reading for _ in range(bursts)]
            read[each.name].append(np.concatenate(samples))
        go(pose.upright)
    return {
        each.name: FreePoses(np.stack(T_b_t) @ each.T_tool_skin, np.stack(read[each.name])) for each in procedure.skins
    }


def fitted_ambient(
    procedure: Procedure, settings: AmbientSettings, out: Path, *, seed: int = 0
) -> dict[str, AmbientField]:
    """The ambient fields for the touches that follow: newly fitted ones, or those of the folder.

    Args:
        procedure: Its devices are connected.
        settings: How many free poses are taken; with none the earlier fields of the folder are used.
        out: Folder of the touches, in which the fields are kept.
        seed: Of the poses.

    Returns:
        The field of each skin that has one, by the skin's name.

    Raises:
        ValueError: The rig's box leaves no room for free poses, the arm's limits forbid their speed, or the folder's
            field is damaged or another board's.
        DeviceError: A device fails.
    """
    paths = {each.name: out / (f".ambient-{each.name}.npz" if each.name else AMBIENT_FILE) for each in procedure.skins}
    boards = {each.name: each.board for each in procedure.skins}
    fields = {name: load_ambient(path, boards[name])[0] for name, path in paths.items() if path.exists()}
    if not settings.poses:
        for name, field in fields.items():
            print(f"ambient field of {paths[name]}: {_said(field)}")
        return fields
    procedure.path.check_settings()
    poses = plan_free_poses(procedure.path, procedure.arm.state().T_b_t, settings, seed)
    procedure.retreat()
    print(f"{len(poses)} free poses ...", flush=True)
    free = gather_free_poses(procedure, poses, settings)
    for each in procedure.skins:
        fields[each.name] = _newly_fitted(free[each.name], each, paths[each.name], burst=procedure.settings.ambient)
    return fields


def _newly_fitted(free: FreePoses, skin: SkinOnTool, path: Path, *, burst: int) -> AmbientField:
    """The field of a skin from its free poses, kept in its file."""
    field = fit_ambient(free, skin.board, burst=burst)
    turned = np.sqrt(np.nanmean((free.reading - np.nanmean(free.reading, axis=0)) ** 2))
    left = np.sqrt(np.nanmean(subtract_ambient(field, skin.board, free.T_b_t, free.reading) ** 2))
    print(f"ambient field{f' of {skin.name}' if skin.name else ''}: {_said(field)}")
    print(f"               changes readings by {turned:.1f} uT from pose to pose, and by {left:.1f} uT once subtracted")
    features = skin.skin.features
    fitted = f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
    save_ambient(path, field, {"skin": features.name, "source": features.source, "fitted": fitted})
    return field


def _said(field: AmbientField) -> str:
    earth = ", ".join(f"{value:.1f} +- {error:.1f}" for value, error in zip(field.earth, field.earth_std, strict=True))
    silent = np.flatnonzero(np.isnan(field.offset).any(1))
    missing = f"; without chips {', '.join(map(str, silent))}" if len(silent) else ""
    return f"({earth}) uT in the base{missing}"


def contradiction(fields: Mapping[str, AmbientField], procedure: Procedure, touch: TouchResult) -> str:
    """Contradiction of the fitted fields by what the skins read before a touch.

    Args:
        fields: Of the skins that have one, by their names.
        procedure: That made the touch.
        touch: With what the skins read.

    Returns:
        What contradicts; "" where nothing does.
    """
    sentences = []
    for each in procedure.skins:
        if each.name in fields:
            felt = touch.skins[each.name]
            pose = FreePoses((procedure.rig.T_base_world @ felt.T_w_s)[None], felt.ambient[None, None])
            change = ambient_changed(fields[each.name], each.board, pose, false_alarm=TOUCH_FALSE_ALARM)
            sentences += [f"{each.name}: {change.sentence}" if each.name else change.sentence] if change.changed else []
    return "; ".join(sentences)
