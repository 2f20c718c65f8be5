"""Scores of `experiments.refine`: the error of a found pose in the directions that a patch shows."""

from collections.abc import Sequence

import numpy as np
from scipy.stats import binomtest

from experiments.refine.arguments import RefineArgs
from experiments.refine.cases import Cases
from i2t.geometry import inverse, log
from i2t.objects import Object
from i2t.types import TWIST_LEVER_M

MM_PER_M = 1e3
TWIST_PARTS = {"sliding": [0, 1], "approach": [2], "tilt": [3, 4], "spin": [5]}


def remaining(T_o_t: np.ndarray, cases: Cases, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """Error in the observable directions: translation (m) and rotation (degrees)."""
    # Of a motion that leaves what is seen unchanged the logarithm has no part in the directions that can be seen.
    error = log(inverse(cases.true.astype(float)) @ T_o_t) * ([1.0] * 3 + [TWIST_LEVER_M] * 3)
    along = np.einsum("...ji,...j->...i", cases.directions, error) * (cases.eigenvalues >= bound)
    error = np.einsum("...ij,...j->...i", cases.directions, along)
    return np.linalg.norm(error[..., :3], axis=-1), np.degrees(np.linalg.norm(error[..., 3:], axis=-1) / TWIST_LEVER_M)


def judge(T_o_t: np.ndarray, cases: Cases, bound: float, objects: Sequence[Object], args: RefineArgs) -> dict:
    """Success with its 95 % interval (Wilson), its rate in each family, and the errors."""
    distance, angle = remaining(T_o_t, cases, bound)
    ok = (distance <= args.close) & (angle <= args.close_angle)
    interval = binomtest(int(ok.sum()), ok.size).proportion_ci(method="wilson")
    families = np.array([item.family for item in objects])
    return {
        "success": float(ok.mean()),
        "success_interval": [interval.low, interval.high],
        "families": {name: float(ok[families == name].mean()) for name in sorted(set(families))},
        "distance_mm": (MM_PER_M * np.quantile(distance, (0.5, 0.95))).tolist(),
        "angle_deg": np.quantile(angle, (0.5, 0.95)).tolist(),
    }


def success(T_o_t: np.ndarray, cases: Cases, bounds: np.ndarray, args: RefineArgs) -> np.ndarray:
    """Success for each bound."""
    errors = [remaining(T_o_t, cases, bound) for bound in bounds]
    return np.array([np.mean((d <= args.close) & (a <= args.close_angle)) for d, a in errors])


def unobservable_motion(directions: np.ndarray, observable: np.ndarray) -> dict[str, float]:
    """Share of each kind of motion in the directions that do not count, 0 to 1, on average."""
    share = (directions**2 * ~observable[..., None, :]).sum(-1).reshape(-1, 6).mean(0)
    return {name: float(share[axes].mean()) for name, axes in TWIST_PARTS.items()}


def table(report: dict) -> str:
    """The scores as text."""
    cases, counts = report["cases"], report["observable_directions"]
    lines = [
        f"{'':28s}{'success':>8s}  {'95 % interval':15s}{'mm: median':>11s}{'95 %':>9s}{'deg: median':>13s}{'95 %':>9s}"
    ]
    for name, row in {"at the start": report["at_start"], **report["methods"]}.items():
        low, high = row["success_interval"]
        numbers = "".join(
            f"{v:>{w}.2g}" for v, w in zip(row["distance_mm"] + row["angle_deg"], (11, 9, 13, 9), strict=True)
        )
        lines.append(f"{name:28s}{row['success']:8.1%}  {f'{low:.1%} - {high:.1%}':15s}{numbers}")
    lines += [
        "",
        f"{cases} simulated cases on {report['objects']} objects; {report['observable_share']:.1%} of all directions"
        f" are observable (eigenvalue >= {report['bound']:.3g})",
        "observable directions: " + ", ".join(f"{k} in {n} cases" for k, n in enumerate(counts) if n),
        "unobservable part of a motion: "
        + ", ".join(f"{name} {share:.0%}" for name, share in report["unobservable_motion"].items()),
    ]
    return "\n".join(lines)
