"""Free poses before a session: the tool turns above everything, touches nothing, and the ambient field is fitted.

Where the tool may go is decided before the first motion, and what is not allowed is refused, never replaced: every
place lies inside the rig's box and `clearance` above the height at which the tool goes across the object. Orientations
tilt the tool away from pointing down, and turn it about its own axis, by no more than the settings say; between two
poses the tool is put upright where it stands, moved and turned upright, and tilted again, so that on the way it is
tilted no further either. Among many such poses those are taken that tell most about the field (a D-optimal design,
chosen greedily).

Frames: W world, B robot base, T tool; metres and radians.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.collect.path import TouchPath
from i2t.collect.procedure import is_at
from i2t.collect.settings import AmbientSettings
from i2t.collect.touch import UnreachableError
from i2t.geometry import so3_exp, transform
from i2t.hardware.clock import Clock
from i2t.hardware.limits import MotionLimits, format_position
from i2t.hardware.protocols import GuardedArm, Skin
from i2t.skin.ambient import FreePoses
from i2t.types import Array

CANDIDATES = 400  # poses among which the best are chosen
BURST_SAMPLES = 10  # that are read at once
INFORMATION_FLOOR = 1e-3  # of a pose, before the first is chosen


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
    poses = [FreePose(transform(upright[i], places[i]), transform(tilted[i], places[i])) for i in chosen]
    for pose in poses:
        _require_free(path.rig.limits, pose, low)
    return poses


def gather_free_poses(
    arm: GuardedArm,
    skin: Skin,
    clock: Clock,
    path: TouchPath,
    poses: Sequence[FreePose],
    *,
    settings: AmbientSettings,
    on_pose: Callable[[int], None] | None = None,
) -> FreePoses:
    """Take the poses, with the skin read at each; the tool ends upright, above everything.

    Args:
        arm: Connected, retreated from whatever it touched.
        skin: Connected.
        clock: That the devices share.
        path: As for `plan_free_poses`.
        poses: As that planned them.
        settings: How long the skin is read.
        on_pose: Hears the number of poses that are done.

    Returns:
        Poses as the arm reports them, with their samples.

    Raises:
        UnreachableError: The tool stands where it may not be lifted from; nothing has moved.
        DeviceError: The arm met something or stopped, or the skin fell silent.
    """
    found = gather_of_skins(arm, {"": (skin, np.eye(4))}, clock, path, poses, settings=settings, on_pose=on_pose)
    return found[""]


def gather_of_skins(
    arm: GuardedArm,
    skins: Mapping[str, tuple[Skin, Float[Array, "4 4"]]],
    clock: Clock,
    path: TouchPath,
    poses: Sequence[FreePose],
    *,
    settings: AmbientSettings,
    on_pose: Callable[[int], None] | None = None,
) -> dict[str, FreePoses]:
    """Take the poses as `gather_free_poses`, with several skins on the tool at once.

    Args:
        arm: As there.
        skins: Each connected, with its frame T_tool_skin (4, 4), by name.
        clock: As there.
        path: As there.
        poses: As there.
        settings: As there.
        on_pose: As there.

    Returns:
        Of each skin its own poses in the base, with its samples.

    Raises:
        UnreachableError: As there.
        DeviceError: As there.
    """
    speed, acceleration = path.free_speed, path.settings.acceleration
    low = _free_box(path, settings)[0][2]
    start = np.array(arm.state().T_b_t)
    lifted = np.array(start)
    lifted[2, 3] = max(low, lifted[2, 3])
    for pose in (*(part for each in poses for part in each), lifted):
        if not path.rig.limits.contains(pose[:3, 3]):
            raise UnreachableError(
                f"a free pose would be at {format_position(pose[:3, 3])} m, outside the box; move the tool above the "
                "object with the pendant, or raise the box"
            )

    def go(*goals: Array) -> None:
        for goal in goals:
            if not is_at(arm.state(), goal):
                arm.go(goal, speed, acceleration)

    go(lifted, transform(_pointing_down(path, lifted), lifted[:3, 3]))
    stated: list[Array] = []
    read: dict[str, list[np.ndarray]] = {name: [] for name in skins}
    for number, pose in enumerate(poses):
        go(pose.upright, pose.tilted)
        clock.sleep(path.settings.settle)
        stated.append(np.array(arm.state().T_b_t))
        samples = _samples([skin for skin, _ in skins.values()], clock, settings.seconds)
        for name, rows in zip(skins, samples, strict=True):
            read[name].append(rows)
        go(pose.upright)
        if on_pose is not None:
            on_pose(number + 1)
    T_b_t = np.stack(stated)
    return {name: FreePoses(T_b_t @ pose, _stacked(read[name])) for name, (_, pose) in skins.items()}


def _samples(skins: Sequence[Skin], clock: Clock, seconds: float) -> list[np.ndarray]:
    """Samples (s, c) uT of each skin, of some seconds, whatever their rates are; they take turns."""
    end = clock.now() + seconds
    parts = [[skin.read(BURST_SAMPLES).reading] for skin in skins]
    while clock.now() < end:
        for own, skin in zip(parts, skins, strict=True):
            own.append(skin.read(BURST_SAMPLES).reading)
    return [np.concatenate(own) for own in parts]


def _stacked(read: list[np.ndarray]) -> np.ndarray:
    """Stack samples (p, s, c) uT; poses at which fewer samples came are filled up with NaN."""
    most = max(map(len, read))
    stacked = np.full((len(read), most, read[0].shape[1]), np.nan)
    for pose, samples in enumerate(read):
        stacked[pose, : len(samples)] = samples
    return stacked


def _free_box(path: TouchPath, settings: AmbientSettings) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) m of where free poses may be, in the base."""
    lower, upper = path.rig.limits.box
    low = path.transfer_height() + settings.clearance
    if low > upper[2]:
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


def _require_free(limits: MotionLimits, pose: FreePose, low: np.ndarray) -> None:
    """Refuse a pose that is not where free poses may be; nothing takes its place."""
    for part in pose:
        if not limits.contains(part[:3, 3]) or part[2, 3] < low[2] - 1e-9:
            raise UnreachableError(f"a free pose would be at {format_position(part[:3, 3])} m, where it may not be")
