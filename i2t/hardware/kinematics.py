"""Kinematics of arms of revolute joints: reachable poses, distance to joint limits and singularities, joint paths.

An arm is a chain of fixed motions with a rotation about z between each two, which describes any arm of revolute joints;
`from_links` makes it of the makers' tables. Poses are solved for joints by damped least squares from
many starts at once (Sugihara, Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method, IEEE
Transactions on Robotics 27(5), 2011), lines are followed in small steps from there. The makers' tables are nominal: a
real arm's own calibration moves its flange by a millimetre or so, and its reach as little.

Frames: B robot base, F flange; metres and radians. NumPy only.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float

from i2t.geometry import so3_exp, so3_log, transform
from i2t.types import Array

RANDOM_STARTS, ITERATIONS = 48, 80
MAX_START_SOLUTIONS = 6  # of a first pose, the most dexterous ones, from which lines are followed
SOLUTION_TOLERANCE_M, SOLUTION_TOLERANCE_RAD = 1e-5, 1e-4
SQUARED_ERROR, STALLED_RAD = 1e-13, 1e-9  # at which a descent ends
STEP_M, STEP_RAD = 0.02, 0.1  # along a line, at the most
JUMP_RAD = 0.5  # of a joint within one step, above which the arm would have to fold over
MIN_MARGIN_RAD = np.radians(3.0)  # from a joint's limit
MIN_DEXTERITY = 0.03  # least singular value of the Jacobian, lengths as shares of the reach; zero in a singularity


@dataclass(frozen=True)
class SerialArm:
    """A chain of revolute joints; T_B_F(q) = fixed[0] Rz(q_0) fixed[1] Rz(q_1) ... fixed[n]."""

    name: str
    fixed: Float[np.ndarray, "n_plus_1 4 4"]
    low: Float[np.ndarray, " n"]  # rad
    high: Float[np.ndarray, " n"]  # rad

    @property
    def reach(self) -> float:
        """Length (m) of the stretched chain."""
        return float(np.linalg.norm(self.fixed[:, :3, 3], axis=1).sum())


@dataclass(frozen=True)
class JointPath:
    """Joint path of an arm along a line of poses."""

    joints: Float[np.ndarray, "k n"]  # rad, at each of the poses
    margin: float  # rad, least distance of a joint from its limit on the way
    dexterity: float  # least singular value of the Jacobian on the way, lengths as shares of the reach


def from_links(
    name: str, a: Sequence[float], d: Sequence[float], alpha: Sequence[float], *, low: Array, high: Array
) -> SerialArm:
    """An arm of n joints from n + 1 fixed motions Tz(d) Tx(a) Rx(alpha), before, between and behind its rotations.

    Denavit and Hartenberg's parameters are these with a first row of zeros; Craig's modified ones are these with d
    moved one row down, and the flange's distance in the last.

    Args:
        name: Of the arm.
        a: m, of each motion.
        d: m, likewise.
        alpha: rad, likewise.
        low: (n,) rad, least of each joint.
        high: (n,) rad, greatest of each joint.

    Returns:
        The arm.
    """
    fixed = np.tile(np.eye(4), (len(a), 1, 1))
    fixed[:, 0, 3], fixed[:, 2, 3] = a, d
    fixed[:, 1, 1] = fixed[:, 2, 2] = np.cos(alpha)
    fixed[:, 2, 1], fixed[:, 1, 2] = np.sin(alpha), -np.sin(alpha)
    return SerialArm(name, fixed, np.asarray(low, float), np.asarray(high, float))


def forward(arm: SerialArm, joints: Float[Array, "*batch n"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Pose of the flange.

    Args:
        arm: Any.
        joints: (..., n) rad.

    Returns:
        (..., 4, 4) T_B_F.
    """
    return _chain(arm, np.asarray(joints, float))[0]


def solve(
    arm: SerialArm, T_b_f: Float[Array, "4 4"], *, near: Float[Array, " n"] | None = None, seed: int = 0
) -> Float[np.ndarray, "k n"]:
    """Joints that bring the flange to a pose.

    Args:
        arm: Any.
        T_b_f: The pose, m.
        near: rad, joints to start from; by default many starts, drawn between the limits.
        seed: Of those.

    Returns:
        (k, n) rad within the limits, the most dexterous first; none where the pose is out of reach.
    """
    limits = np.clip(arm.low, -np.pi, None), np.clip(arm.high, None, np.pi)
    rng = np.random.default_rng(seed)
    starts = rng.uniform(*limits, (RANDOM_STARTS, len(arm.low))) if near is None else np.asarray(near, float)[None]
    q, solved = _descend(arm, starts, np.asarray(T_b_f, float))
    found = q[solved]
    return found[np.argsort(-_dexterity(arm, found), kind="stable")] if len(found) else found


def follow(arm: SerialArm, goals: Sequence[Float[Array, "4 4"]], start: Float[Array, " n"]) -> JointPath | str:
    """Follow straight lines of the flange from pose to pose.

    Args:
        arm: Any.
        goals: Poses T_B_F, m; the first is that of `start`.
        start: rad.

    Returns:
        The joints on the way, or one sentence why it cannot be followed.
    """
    way = [np.asarray(start, float)]
    for number, (one, other) in enumerate(itertools.pairwise(goals), 2):
        for pose in _between(np.asarray(one, float), np.asarray(other, float)):
            moved, solved = _descend(arm, way[-1][None], pose)
            if not solved[0]:
                return f"{arm.name} meets the end of a joint or of its reach on the line to pose {number}"
            if np.abs(moved[0] - way[-1]).max() > JUMP_RAD:
                return f"{arm.name} would have to fold over on the line to pose {number}"
            way.append(moved[0])
    joints = np.stack(way)
    margin = float(np.minimum(joints - arm.low, arm.high - joints).min())
    return JointPath(joints, margin, float(_dexterity(arm, joints).min()))


def plan(arm: SerialArm, goals: Sequence[Float[Array, "4 4"]]) -> JointPath | str:
    """The best way to follow straight lines from pose to pose, of all ways to stand at the first.

    Args:
        arm: Any.
        goals: Poses T_B_F, m.

    Returns:
        The way that keeps furthest from singularities among those that keep clear of joint limits, or one sentence why
        there is none.
    """
    starts = _distinct(solve(arm, goals[0]))[:MAX_START_SOLUTIONS]
    if not len(starts):
        apart = float(np.linalg.norm(np.asarray(goals[0])[:3, 3]))
        return f"{arm.name} cannot reach it: {apart:.2f} m from its base, in that direction of the tool"
    ways = [follow(arm, goals, start) for start in starts]
    whole = [way for way in ways if isinstance(way, JointPath)]
    if not whole:
        return next(way for way in ways if isinstance(way, str))
    best = max(whole, key=lambda way: (way.margin >= MIN_MARGIN_RAD, way.dexterity))
    if best.margin < MIN_MARGIN_RAD:
        return f"{arm.name} reaches it only {np.degrees(best.margin):.1f} degrees from a joint's limit"
    if best.dexterity < MIN_DEXTERITY:
        return f"{arm.name} comes too near to a singularity (least singular value {best.dexterity:.3f})"
    return best


@cache
def arms() -> dict[str, SerialArm]:
    """Arms by name, with their makers' published tables.

    Returns:
        Universal Robots (its page on DH parameters for kinematics and dynamics) and Franka Emika (its documentation of
        the control parameters).
    """
    half = np.pi / 2
    turn = np.array([2, 2, 1, 2, 2, 2]) * np.pi  # an elbow turns by half a turn each way
    tables = {
        "ur3": ((-0.24365, -0.21325), (0.1519, 0.11235, 0.08535, 0.0819)),
        "ur5": ((-0.425, -0.39225), (0.089159, 0.10915, 0.09465, 0.0823)),
        "ur10": ((-0.612, -0.5723), (0.1273, 0.163941, 0.1157, 0.0922)),
        "ur3e": ((-0.24355, -0.2132), (0.15185, 0.13105, 0.08535, 0.0921)),
        "ur5e": ((-0.425, -0.3922), (0.1625, 0.1333, 0.0997, 0.0996)),
        "ur10e": ((-0.6127, -0.57155), (0.1807, 0.17415, 0.11985, 0.11655)),
        "ur16e": ((-0.4784, -0.36), (0.1807, 0.17415, 0.11985, 0.11655)),
    }
    turns = (0.0, half, 0.0, 0.0, half, -half, 0.0)
    known = {
        name: from_links(
            name, (0.0, 0.0, *a, 0.0, 0.0, 0.0), (0.0, d[0], 0.0, 0.0, *d[1:]), turns, low=-turn, high=turn
        )
        for name, (a, d) in tables.items()
    }
    known["panda"] = from_links(
        "panda",
        (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088, 0.0),
        (0.0, 0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.107),
        (0.0, -half, half, half, -half, half, half, 0.0),
        low=np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]),
        high=np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]),
    )
    return known


def _chain(arm: SerialArm, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Flange (..., 4, 4) and its Jacobian (..., 6, n): m and rad of each radian, along the base's axes."""
    T = np.broadcast_to(arm.fixed[0], (*q.shape[:-1], 4, 4))
    axes, points = [], []
    for i in range(q.shape[-1]):
        axes.append(T[..., :3, 2])
        points.append(T[..., :3, 3])
        turn = np.zeros((*q.shape[:-1], 4, 4))
        c, s = np.cos(q[..., i]), np.sin(q[..., i])
        turn[..., 0, 0], turn[..., 0, 1], turn[..., 1, 0], turn[..., 1, 1] = c, -s, s, c
        turn[..., 2, 2] = turn[..., 3, 3] = 1.0
        T = T @ turn @ arm.fixed[i + 1]
    axis = np.stack(axes, -1)
    moved = np.cross(axis, T[..., :3, 3, None] - np.stack(points, -1), axis=-2)
    return T, np.concatenate([moved, axis], -2)


def _dexterity(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    """Least singular value of the Jacobian of joints (k, n), lengths as shares of the reach."""
    scale = np.repeat([arm.reach, 1.0], 3)[:, None]
    return np.linalg.svd(_chain(arm, q)[1] / scale, compute_uv=False)[..., -1]


def _descend(arm: SerialArm, q: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Joints (k, n) within the limits, from others towards a pose of the flange, and whether they got there (k,)."""
    scale = np.repeat([arm.reach, 1.0], 3)
    for _ in range(ITERATIONS):
        T, J = _chain(arm, q)
        error, J = _error(T, goal) / scale, J / scale[:, None]
        size = 0.5 * (error**2).sum(1)
        turned, damping = np.swapaxes(J, 1, 2), (size[:, None, None] + 1e-9) * np.eye(q.shape[1])
        step = np.linalg.solve(turned @ J + damping, turned @ error[..., None])[..., 0]
        moved = np.clip(q + np.clip(step, -JUMP_RAD, JUMP_RAD), arm.low, arm.high)
        if (size < SQUARED_ERROR).all() or np.abs(moved - q).max() < STALLED_RAD:
            break
        q = moved
    off = np.linalg.norm(_error(_chain(arm, q)[0], goal).reshape(-1, 2, 3), axis=2)
    return q, (off < [SOLUTION_TOLERANCE_M, SOLUTION_TOLERANCE_RAD]).all(1)


def _error(T: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Error (k, 6) to the goal: position (m), and the rotation vector (rad), base axes."""
    turn = so3_log(goal[:3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2))
    return np.concatenate([goal[:3, 3] - T[:, :3, 3], turn], 1)


def _between(one: np.ndarray, other: np.ndarray) -> list[np.ndarray]:
    """Poses on the straight line between two, without the first."""
    turn = so3_log(other[:3, :3] @ one[:3, :3].T)
    apart = other[:3, 3] - one[:3, 3]
    steps = math.ceil(max(1.0, np.linalg.norm(apart) / STEP_M, np.linalg.norm(turn) / STEP_RAD))
    shares = [(i + 1) / steps for i in range(steps)]
    return [transform(so3_exp(share * turn) @ one[:3, :3], one[:3, 3] + share * apart) for share in shares]


def _distinct(joints: np.ndarray) -> list[np.ndarray]:
    """Joint vectors that differ by more than a tenth of a radian in some joint, in their order."""
    kept: list[np.ndarray] = []
    for each in joints:
        if all(np.abs(each - one).max() > 0.1 for one in kept):
            kept.append(each)
    return kept
