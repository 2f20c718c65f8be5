"""The ambient field: its remainder once the tool has turned, and how often a change is seen or invented.

Free poses are those that `i2t.collect` would take; samples have the room's field at each pose, chips whose gains and
offsets differ, and noise, slow field and steps as the simulated lab has them. All simulated.
"""

from collections.abc import Callable
from functools import partial
from typing import TypeAlias

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from experiments.faults.closed_form import BOARD, make_procedure
from experiments.faults.table import Fault, Measure, Trial
from i2t.collect.free_poses import plan_free_poses
from i2t.collect.settings import AmbientSettings
from i2t.emulators.in_process import SLOW_FIELD_S, TICK_S
from i2t.emulators.room import RoomField, room_field
from i2t.skin.ambient import BURST, FreePoses, ambient_changed, fit_ambient, subtract_ambient
from i2t.skin.noise import Noise

Poses: TypeAlias = Callable[[np.random.Generator, int], np.ndarray]  # (p, 4, 4), by their number

FREE_POSES, TURNS = 12, 30
SECONDS = 2.0  # that the skin is read at a pose
GAIN_STD, OFFSET_STD_UT = 0.05, 300.0  # of the chips
GOAL_UT = 2.0
ALARM_SHARE = 0.01  # at which the test is asked to raise false alarms
ALARM_TRIALS = 40  # tests for each room
STEP_UT = 10.0  # changes that should be seen


def turned(free_poses: Callable[[int], np.ndarray], poses: Poses, seed: int) -> Trial:
    """Root mean squares (uT) over turns and channels, in one room.

    Args:
        free_poses: Poses of the fit, of a seed.
        poses: Poses in which the skin is read then.
        seed: Of the room's skin.

    Returns:
        The change of the reading, what is left with the field subtracted, the error of the prediction itself, and the
        noise of the readings.
    """
    rng = np.random.default_rng((seed, 2))
    chips, free = _Chips(rng), free_poses(seed)
    field = fit_ambient(FreePoses(free, chips.samples(rng, free)), BOARD)
    turns = poses(rng, TURNS)
    truth, read = chips.truth(turns), chips.samples(rng, turns).mean(1)
    left = subtract_ambient(field, BOARD, turns, read)
    wrong = subtract_ambient(field, BOARD, turns, truth)
    parts = {"change": read - read[0], "left": left, "prediction off by": wrong, "noise": read - truth}
    return {"rooms": 1, **{name: float(np.sqrt(np.mean(part**2))) for name, part in parts.items()}}


def changes(seed: int) -> Trial:
    """False alarms and changes that are seen by bursts of a touch's size, in one room."""
    rng = np.random.default_rng((seed, 3))
    chips, free = _Chips(rng), _free_poses(seed)
    field = fit_ambient(FreePoses(free, chips.samples(rng, free)), BOARD)
    counts = np.zeros(3, int)
    for _ in range(ALARM_TRIALS):
        pose = _tilted_poses(rng, 1)
        samples = chips.samples(rng, pose, BURST * TICK_S)
        room = np.tile(pose[0, :3, :3].T @ [STEP_UT, 0.0, 0.0], (BOARD.num_chips, 1))
        for i, change in enumerate((0.0, np.asarray(BOARD.to_board(room)), np.eye(BOARD.num_readings)[0] * STEP_UT)):
            counts[i] += ambient_changed(
                field, BOARD, FreePoses(pose, samples + change), false_alarm=ALARM_SHARE
            ).changed
    names = ("false alarms", "unseen in the room", "unseen in a chip")
    return {
        "bursts": ALARM_TRIALS,
        **dict(zip(names, map(int, [counts[0], *(ALARM_TRIALS - counts[1:])]), strict=True)),
    }


class _Chips:
    """A skin in a room: gains and offsets of its chips."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.gains = 1 + GAIN_STD * rng.standard_normal(BOARD.num_readings)
        self.offset = OFFSET_STD_UT * rng.standard_normal(BOARD.num_readings)

    def truth(self, poses: np.ndarray) -> np.ndarray:
        """Readings (p, c) uT, without noise."""
        fields = np.stack([room_field(RoomField(), BOARD, pose) for pose in poses])
        return np.asarray(self.gains * np.asarray(BOARD.to_board(fields)) + self.offset)

    def samples(self, rng: np.random.Generator, poses: np.ndarray, seconds: float = SECONDS) -> np.ndarray:
        """Samples (p, s, c) uT, of an arm that has stood for long."""
        noise, chips = Noise(), BOARD.num_chips
        count, kept = max(1, round(seconds / TICK_S)), np.exp(-TICK_S / SLOW_FIELD_S)
        news = rng.standard_normal((len(poses), count, 3))
        news[:, 1:] *= np.sqrt(1 - kept**2)
        slow = lfilter([1.0], [1.0, -kept], news, axis=1) * np.sqrt(noise.common) * [noise.xy, noise.xy, noise.z]
        white = rng.standard_normal((len(poses), count, BOARD.num_readings))
        white *= np.sqrt(1 - noise.common) * noise.sigma(chips)
        shared = np.asarray(BOARD.to_board(np.repeat(slow[:, :, None], chips, axis=2)))
        steps = noise.steps(chips)
        return np.asarray(np.rint((self.truth(poses)[:, None] + white + shared) / steps) * steps)


def _free_poses(seed: int) -> np.ndarray:
    """Poses (p, 4, 4) as a collection would take them."""
    procedure = make_procedure()
    settings = AmbientSettings(poses=FREE_POSES, seconds=SECONDS)
    plan = plan_free_poses(procedure.path, procedure.arm.state().T_b_t, settings, seed)
    return np.stack([pose.tilted for pose in plan])


def _tilted_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Poses (p, 4, 4) like those that sites ask for: within the tilts and turns of the free poses."""
    settings = AmbientSettings()
    tilt = np.radians(settings.tilt) * np.sqrt(rng.uniform(size=count))
    way, turn = rng.uniform(0, 2 * np.pi, count), np.radians(settings.turn) * rng.uniform(-1, 1, count)
    axes = np.column_stack([np.cos(way), np.sin(way), np.zeros(count)])
    upright = Rotation.from_euler("x", np.pi) * Rotation.from_rotvec(turn[:, None] * np.array([0.0, 0.0, 1.0]))
    return _placed(rng, (upright * Rotation.from_rotvec(tilt[:, None] * axes)).as_matrix())


def _any_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """(p, 4, 4) poses of any orientation."""
    return _placed(rng, Rotation.random(count, random_state=int(rng.integers(1 << 30))).as_matrix())


def _placed(rng: np.random.Generator, rotations: np.ndarray) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(rotations), 1, 1))
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = np.array([0.4, 0.0, 0.2]) + rng.uniform(-0.05, 0.05, (len(rotations), 3))
    return poses


LEFT = (
    Measure("left", GOAL_UT, " uT", of="rooms"), Measure("left", unit="uT"), Measure("change", unit=" uT", of="rooms"),
    Measure("prediction off by", unit=" uT", of="rooms"), Measure("noise", unit=" uT", of="rooms"),
)  # fmt: skip
SEEN = (
    Measure("false alarms", 2 * ALARM_SHARE, of="bursts"), Measure("unseen in the room", of="bursts"),
    Measure("unseen in a chip", of="bursts"),
)  # fmt: skip
AMBIENT_FAULTS = (
    Fault("ambient", "tilts to 45 degrees", partial(turned, _free_poses, _tilted_poses), 20, LEFT),
    Fault("ambient", "any orientation",
          partial(turned, lambda seed: _any_poses(np.random.default_rng((seed, 1)), FREE_POSES), _any_poses), 20, LEFT),
    Fault("ambient", "changes seen by one burst", changes, 20, SEEN),
)  # fmt: skip
