"""Question: how far does one depth patch correct a pose that is 2 mm and 4 degrees off?

    python -m experiments.refine --out runs/refine               200 cases on primitives, stamps, tools, random shapes
    python -m experiments.refine --data FOLDER --out runs/ycb    and on the meshes (STL, metres) of a folder
    python -m experiments.refine --preset debug                  few cases, too few to mean anything

A patch is rendered at a random safe site of every object; the pose is moved by exactly 2 mm and 4 degrees in random
directions and sought again from `(patch, nearest)` alone, by Levenberg-Marquardt through the renderer's derivatives
(`i2t.registration.patch`), from a single start and from the best of several, without noise and with that of a camera.
Everything is simulated.

A flat patch says nothing about sliding on it, so errors count in observable directions: eigenvectors of the
Gauss-Newton matrix at the true pose whose eigenvalue is at least the bound at which noise of 0.3 mm in each pixel
leaves 0.3 degrees, at half a window from the axis, at two standard deviations (0.079; the same rule for 0.1 mm gives
0.016, which is less strict on what counts). The error is the twist from the true pose to the found one, projected
on them; a case succeeds with at most 0.1 mm and 0.3 degrees of it. Two to three minutes on two cores. Expect at least
98 % without noise.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from matplotlib.figure import Figure
from scipy.stats import binomtest
from tqdm import tqdm

from experiments.common.presets import RENAMED, answer_renamed_value
from experiments.common.runs import reported, settings, write_json
from i2t import viz
from i2t.geometry import log, so3_exp
from i2t.objects import Object, catalogue, read_mesh
from i2t.registration.patch import (
    PatchRegistrationConfig,
    observable_directions,
    pose_information,
    refine_pose,
    refine_pose_multistart,
    resolvable_eigenvalue,
)
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.simulation.sites import collect_sites
from i2t.types import PATCH_PIXELS, PATCH_WINDOW, REACH, TWIST_LEVER_M, Patch, Surface
from i2t.viz import style

MM_PER_M = 1e3
BOUNDS = np.logspace(-5, 0, 26)
MAX_SHOWN_MM = 0.3  # where the colours of a difference end
TWIST_PARTS = {"sliding": [0, 1], "approach": [2], "tilt": [3, 4], "spin": [5]}


@dataclass(frozen=True)
class RefineArgs:
    """Seek poses from single patches and say how often they are found."""

    out: Path = Path("runs/refine")  # folder for what is made
    preset: Literal["paper", "debug"] = "paper"
    data: Path | None = None  # folder of mesh files in metres that join the objects
    cases: int = 200
    objects: int = 40  # different ones, besides those of --data; the cases are shared among all
    distance: float = 2e-3  # m off at the start
    angle: float = 4.0  # degrees off at the start
    noise: float = 0.3e-3  # m, of a camera's depth pixel
    close: float = 0.1e-3  # m, what counts as found
    close_angle: float = 0.3  # degrees, likewise
    starts: int = 4  # of the methods with several; 1 leaves them out
    seed: int = 0
    overwrite: bool = False  # replace a finished run in --out


class Cases(NamedTuple):
    """Where the tool was and where it is thought to be: (objects, cases of each) of everything."""

    true: np.ndarray  # T_w_t
    start: np.ndarray  # T_w_t
    eigenvalues: np.ndarray  # (..., 6) of the Gauss-Newton matrix at the true pose
    directions: np.ndarray  # (..., 6, 6)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    answer_renamed_value(argv, "--preset", RENAMED)
    args = tyro.cli(RefineArgs, args=argv, description=__doc__, prog="python -m experiments.refine")
    return reported(partial(run, args))


def run(args: RefineArgs) -> dict:
    """Run every method on the same cases; print the table, write metrics.json, config.json and figures."""
    if args.preset == "debug":
        args = replace(args, cases=6, objects=3, starts=1)
    if (args.out / "metrics.json").exists() and not args.overwrite:
        raise ValueError(f"{args.out} holds a finished run; choose another --out, or pass --overwrite")
    objects = list_objects(args)
    each = -(-args.cases // len(objects))
    key_sites, key_noise, key_search = jax.random.split(jax.random.key(args.seed), 3)
    surfaces = stack_surfaces([prepare_surface(item.mesh) for item in objects])
    cases = draw_cases(key_sites, objects, surfaces, each, args)
    bound = resolvable_eigenvalue(
        args.noise, min(args.close, np.radians(args.close_angle) * TWIST_LEVER_M), PATCH_PIXELS
    )

    looks = jax.jit(jax.vmap(render_patch, (None, 0)))
    clean = [jax.device_get(looks(element(surfaces, i), poses)) for i, poses in enumerate(cases.true)]
    noisy = [
        jax.device_get(jax.vmap(add_noise, (0, 0, None))(jax.random.split(key, each), patch, args.noise))
        for key, patch in zip(jax.random.split(key_noise, len(objects)), clean, strict=True)
    ]
    precise = PatchRegistrationConfig()
    careful = replace(precise, final_scale=max(precise.final_scale, 3 * args.noise))  # the loss takes noise for noise
    spread = args.distance / 3**0.5, np.radians(args.angle) / 3**0.5  # per axis

    def single(key, surface, observed, T_w_t, how):
        return refine_pose(surface, observed, T_w_t, how)

    def several(key, surface, observed, T_w_t, how):
        return refine_pose_multistart(
            key,
            surface,
            observed,
            T_w_t,
            translation_std=spread[0],
            rotation_std=spread[1],
            num_starts=args.starts,
            config=how,
        )

    camera = f"noise {args.noise * MM_PER_M:g} mm"
    methods = {
        "one start, no noise": (single, precise, clean),
        f"one start, {camera}": (single, careful, noisy),
        f"{args.starts} starts, no noise": (several, precise, clean),
        f"{args.starts} starts, {camera}": (several, careful, noisy),
    }
    if args.starts == 1:
        methods = {name: method for name, method in methods.items() if method[0] is single}
    found: dict[str, np.ndarray] = {}
    metrics = {}
    key_methods = jax.random.split(key_search, len(methods))
    for key_method, (name, (method, how, patches)) in zip(key_methods, methods.items(), strict=True):
        batch = jax.jit(jax.vmap(partial(method, how=how), (0, None, 0, 0)))
        poses = [
            jax.device_get(batch(jax.random.split(key, each), element(surfaces, i), patches[i], cases.start[i]).T_w_t)
            for i, key in enumerate(tqdm(jax.random.split(key_method, len(objects)), desc=name, file=sys.stderr))
        ]
        found[name] = np.stack(poses)
        metrics[name] = judge(found[name], cases, bound, objects, args)
    observable = np.asarray(observable_directions(cases.eigenvalues, bound))
    report = {
        "source": "simulated",
        "cases": observable[..., 0].size,
        "objects": len(objects),
        "bound": bound,
        "observable_share": float(observable.mean()),
        "observable_directions": np.bincount(observable.sum(-1).ravel(), minlength=7).tolist(),  # cases with 0 to 6
        "unobservable_motion": unobservable_motion(cases.directions, observable),
        "at_start": judge(cases.start, cases, bound, objects, args),
        "methods": metrics,
        "seed": args.seed,
    }
    args.out.mkdir(parents=True, exist_ok=True)
    write_json(args.out / "config.json", settings(args))
    write_json(args.out / "metrics.json", report)
    ends = found[f"one start, {camera}"]
    viz.save_figure(draw_patches(objects, surfaces, clean, noisy, cases, ends, observable), args.out / "patches.png")
    viz.save_figure(
        draw_bounds({k: success(T, cases, BOUNDS, args) for k, T in found.items()}, bound), args.out / "bounds.png"
    )
    print(table(report))
    return report


def list_objects(args: RefineArgs) -> list[Object]:
    """Named objects first, then random ones, then the meshes of a folder."""
    named = [catalogue.make_object(name) for name in catalogue.NAMES[: args.objects]]
    objects = named + [catalogue.random_object(seed) for seed in range(args.objects - len(named))]
    if args.data is not None:
        files = sorted(args.data.glob("*.stl"))
        if not files:
            raise ValueError(f"{args.data}: holds no STL file; give --data a folder of meshes in metres")
        objects += [Object(file.stem, read_mesh(file, "m")[0].mesh, "file") for file in files]
    return objects


def draw_cases(key: jax.Array, objects: Sequence[Object], surfaces: Surface, each: int, args: RefineArgs) -> Cases:
    """Safe sites of every object and poses exactly as far off as the arguments say."""
    rng = np.random.default_rng(args.seed)
    poses = [
        np.asarray(collect_sites(k, element(surfaces, i), each, name=item.name))
        for i, (k, item) in enumerate(zip(jax.random.split(key, len(objects)), objects, strict=True))
    ]
    true = np.stack(poses)
    along, axis = rng.normal(size=(2, *true.shape[:2], 3))
    motion = np.broadcast_to(np.eye(4), true.shape).copy()
    motion[..., :3, 3] = args.distance * along / np.linalg.norm(along, axis=-1, keepdims=True)
    turn = np.radians(args.angle) * axis / np.linalg.norm(axis, axis=-1, keepdims=True)
    motion[..., :3, :3] = so3_exp(turn)
    look = jax.jit(jax.vmap(partial(pose_information, pixels=PATCH_PIXELS), (None, 0)))
    values, directions = zip(*(look(element(surfaces, i), poses[i]) for i in range(len(objects))), strict=True)
    start = (true @ motion).astype(np.float32)
    return Cases(true, start, np.stack(values), np.stack(directions))


def add_noise(key: jax.Array, patch: Patch, noise: float) -> Patch:
    """What a camera with independent noise in every pixel makes of a patch: what it sees at the reach stays there."""
    heights = jnp.where(patch.depth < REACH, patch.nearest + patch.depth, jnp.inf)
    heights = heights + noise * jax.random.normal(key, heights.shape)
    nearest = jnp.min(heights)
    return Patch(jnp.minimum(heights - nearest, REACH), nearest)


def remaining(T_w_t: np.ndarray, cases: Cases, bound: float) -> tuple[np.ndarray, np.ndarray]:
    """Error in the observable directions: translation (m) and rotation (degrees)."""
    # Of a motion that leaves what is seen unchanged the logarithm has no part in the directions that can be seen.
    error = log(np.linalg.inv(cases.true.astype(float)) @ T_w_t) * ([1.0] * 3 + [TWIST_LEVER_M] * 3)
    along = np.einsum("...ji,...j->...i", cases.directions, error) * (cases.eigenvalues >= bound)
    error = np.einsum("...ij,...j->...i", cases.directions, along)
    return np.linalg.norm(error[..., :3], axis=-1), np.degrees(np.linalg.norm(error[..., 3:], axis=-1) / TWIST_LEVER_M)


def judge(T_w_t: np.ndarray, cases: Cases, bound: float, objects: Sequence[Object], args: RefineArgs) -> dict:
    """Success with its 95 % interval (Wilson), its rate in each family, and the errors."""
    distance, angle = remaining(T_w_t, cases, bound)
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


def success(T_w_t: np.ndarray, cases: Cases, bounds: np.ndarray, args: RefineArgs) -> np.ndarray:
    """Success for each bound."""
    errors = [remaining(T_w_t, cases, bound) for bound in bounds]
    return np.array([np.mean((d <= args.close) & (a <= args.close_angle)) for d, a in errors])


def unobservable_motion(directions: np.ndarray, observable: np.ndarray) -> dict[str, float]:
    """How much of each kind of motion lies in the directions that do not count, 0 to 1, on average."""
    share = (directions**2 * ~observable[..., None, :]).sum(-1).reshape(-1, 6).mean(0)
    return {name: float(share[axes].mean()) for name, axes in TWIST_PARTS.items()}


def table(report: dict) -> str:
    """What was found, as text."""
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


def draw_patches(
    objects: Sequence[Object],
    surfaces: Surface,
    clean: list[Patch],
    noisy: list[Patch],
    cases: Cases,
    found: np.ndarray,
    observable: np.ndarray,
    rows: int = 4,
) -> Figure:
    """What the camera saw, what the start shows, what the found pose shows, and how far that is from the truth, for the
    objects with the most observable directions.
    """
    rows = min(rows, len(objects))
    figure = Figure(figsize=(9.5, 2.4 * rows + 0.9), layout="constrained")
    axes = figure.subplots(rows, 4, squeeze=False, sharex=True, sharey=True)
    look = jax.jit(jax.vmap(render_patch, (None, 0)))
    best = observable.sum(-1).argmax(1)
    chosen = np.argsort(-observable.sum(-1).max(1), kind="stable")[:rows]
    for row, i in zip(axes, chosen, strict=True):
        j = best[i]
        before, after = (element(look(element(surfaces, i), T[i]), j) for T in (cases.start, found))
        floor = clean[i].nearest[j] + REACH
        off = np.minimum(after.nearest + after.depth, floor) - clean[i].nearest[j] - clean[i].depth[j]
        for axis, depth in zip(row[:3], (noisy[i].depth[j], before.depth, after.depth), strict=True):
            image = viz.draw_patch(axis, depth, PATCH_WINDOW, REACH)
        left = row[3].imshow(
            MM_PER_M * off,
            origin="lower",
            extent=image.get_extent(),
            cmap="RdBu",
            vmin=-MAX_SHOWN_MM,
            vmax=MAX_SHOWN_MM,
        )
        row[0].set_ylabel(f"{objects[i].name}\ntool y (mm)")
    for axis, title in zip(axes[0], ("observed", "at the start", "refined", "refined - true"), strict=True):
        axis.set_title(title, fontsize=10)
    for axis in axes[-1]:
        axis.set_xlabel("tool x (mm)")
    figure.colorbar(image, ax=axes[:, :3], label="depth behind nearest (mm)", location="bottom", aspect=50)
    figure.colorbar(left, ax=axes[:, 3], label="height (mm)", location="bottom", aspect=16)
    figure.suptitle("Poses sought from one noisy patch, from one start (simulated)")
    return figure


def draw_bounds(curves: dict[str, np.ndarray], bound: float) -> Figure:
    """How success depends on which directions count."""
    figure = Figure(figsize=(6, 3.8), layout="constrained")
    axes = figure.subplots()
    colours = (style.BLUE, style.ORANGE, style.GREEN, style.RED)
    for (name, rate), colour in zip(curves.items(), colours, strict=False):
        axes.semilogx(BOUNDS, rate, color=colour, label=name)
    axes.axvline(bound, color=style.GREY, lw=1, ls="--", label="the bound that is used")
    axes.axhline(0.9, color=style.GREY, lw=1, ls=":")
    axes.set(
        ylim=(0, 1.02),
        xlabel="smallest eigenvalue that counts",
        ylabel="success",
        title="Poses found, by what counts (simulated)",
    )
    axes.legend(fontsize=8, loc="lower right")
    return figure


if __name__ == "__main__":
    sys.exit(main())
