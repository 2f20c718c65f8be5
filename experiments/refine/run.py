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

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.common.runs import begin, write_json
from experiments.refine.arguments import RefineArgs
from experiments.refine.cases import Cases, Views, draw_cases, draw_views, list_objects
from experiments.refine.figures import ERROR_BINS, draw_bounds, draw_patches
from experiments.refine.scores import MM_PER_M, judge, success, table, unobservable_motion
from i2t import viz
from i2t.objects import Object
from i2t.progress import progress
from i2t.registration.patch import (
    PatchRegistrationConfig,
    observable_directions,
    refine_pose,
    refine_pose_multistart,
    resolvable_eigenvalue,
)
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, stack_surfaces
from i2t.types import PATCH_PIXELS, TWIST_LEVER_M, Surface


class Method(NamedTuple):
    """A way to seek a pose."""

    search: Callable[..., Any]  # key, surface, patch and T_o_t to a pose
    noisy: bool  # whether it is given what a camera sees


def run(args: RefineArgs) -> dict:
    """Run every method on the same cases; print the table, write metrics.json, config.json and figures."""
    sizes = args.sizes
    begin(args.out, args, sizes, None, args.overwrite)
    objects = list_objects(args)
    key_sites, key_noise, key_search = jax.random.split(jax.random.key(args.seed), 3)
    surfaces = stack_surfaces([prepare_surface(item.mesh) for item in objects])
    cases = draw_cases(key_sites, objects, surfaces, -(-sizes.cases // len(objects)), args)
    views = draw_views(key_noise, surfaces, cases, args.noise)
    methods = list_methods(args)
    keys = jax.random.split(key_search, len(methods))
    found = {
        name: seek(key, name, method, surfaces=surfaces, cases=cases, views=views)
        for key, (name, method) in zip(keys, methods.items(), strict=True)
    }
    bound = resolvable_eigenvalue(
        args.noise, min(args.close, np.radians(args.close_angle) * TWIST_LEVER_M), PATCH_PIXELS
    )
    report = evaluate(found, cases, bound, objects, args)
    write_json(args.out / "metrics.json", report)
    figure = draw_patches(
        objects,
        surfaces,
        views=views,
        cases=cases,
        found=found[f"one start, {camera_name(args)}"],
        observable=np.asarray(observable_directions(cases.eigenvalues, bound)),
    )
    viz.save_figure(figure, args.out / "patches.png")
    curves = {name: success(T_o_t, cases, ERROR_BINS, args) for name, T_o_t in found.items()}
    viz.save_figure(draw_bounds(curves, bound), args.out / "bounds.png")
    print(table(report))
    return report


def camera_name(args: RefineArgs) -> str:
    """Name of the camera in a method's name."""
    return f"noise {args.noise * MM_PER_M:g} mm"


def list_methods(args: RefineArgs) -> dict[str, Method]:
    """Methods from one start and from several, without noise and with a camera's."""
    starts = args.sizes.starts
    precise = PatchRegistrationConfig()
    careful = replace(precise, final_scale=max(precise.final_scale, 3 * args.noise))  # the loss takes noise for noise

    def single(key, surface, observed, T_o_t, how):
        return refine_pose(surface, observed, T_o_t, how)

    several = partial(
        refine_pose_multistart,
        translation_std=args.distance / 3**0.5,  # per axis
        rotation_std=np.radians(args.angle) / 3**0.5,
        num_starts=starts,
    )
    methods = {
        "one start, no noise": Method(partial(single, how=precise), False),
        f"one start, {camera_name(args)}": Method(partial(single, how=careful), True),
    }
    if starts > 1:
        methods[f"{starts} starts, no noise"] = Method(partial(several, config=precise), False)
        methods[f"{starts} starts, {camera_name(args)}"] = Method(partial(several, config=careful), True)
    return methods


def seek(key: jax.Array, name: str, method: Method, *, surfaces: Surface, cases: Cases, views: Views) -> np.ndarray:
    """The poses that a method finds, (objects, cases of each, 4, 4)."""
    patches = views.noisy if method.noisy else views.clean
    batch = jax.jit(jax.vmap(method.search, (0, None, 0, 0)))
    objects, each = cases.true.shape[:2]
    return np.stack(
        [
            jax.device_get(batch(jax.random.split(key, each), element(surfaces, i), patches[i], cases.start[i]).T_o_t)
            for i, key in enumerate(progress(jax.random.split(key, objects), desc=name))
        ]
    )


def evaluate(
    found: dict[str, np.ndarray], cases: Cases, bound: float, objects: Sequence[Object], args: RefineArgs
) -> dict:
    """Every method's scores, and what the cases are like."""
    observable = np.asarray(observable_directions(cases.eigenvalues, bound))
    return {
        "source": "simulated",
        "cases": observable[..., 0].size,
        "objects": len(objects),
        "bound": bound,
        "observable_share": float(observable.mean()),
        "observable_directions": np.bincount(observable.sum(-1).ravel(), minlength=7).tolist(),  # cases with 0 to 6
        "unobservable_motion": unobservable_motion(cases.directions, observable),
        "at_start": judge(cases.start, cases, bound, objects, args),
        "methods": {name: judge(T_o_t, cases, bound, objects, args) for name, T_o_t in found.items()},
        "seed": args.seed,
    }
