"""Before a collection: what would be touched, and whether every device does its part, with nothing moved."""

import math
from pathlib import Path

import numpy as np

from i2t.collect.procedure import Procedure, Unreachable
from i2t.collect.site_plan import Plan, picture
from i2t.hardware.rig import summary

NOISE = 15.0  # uT, standard deviation of a channel at rest, above which a skin is not healthy


def dry_run(procedure: Procedure, plan: Plan, name: str, touches: int, out: Path) -> int:
    """Say what would be done with what, and whether it could; returns the exit code."""
    sites = [plan.site(number) for number in range(touches)]
    unreachable = []
    for site in sites:
        try:
            procedure.check(site)
        except Unreachable as error:
            unreachable.append((site.number, str(error)))
    settings, rig = procedure.settings, procedure.rig
    state = procedure.arm.state()
    samples = procedure.skin.read(200)
    noise = samples.reading.std(axis=0)
    span = max(samples.time[-1] - samples.time[0], 1e-9)
    view = procedure.camera.capture()
    seen = np.isfinite(view.depth)
    box = np.array([rig.limits.lower, rig.limits.upper]) + rig.T_world_base[:3, 3]
    path = out.with_name(f"{out.name}-plan.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    refused = {number for number, _ in unreachable}
    picture(plan, sites, refused, box, path, f"{name}: {len(sites)} sites ({procedure.arm.features.source} arm)")
    seconds = (
        4 * settings.settle
        + (settings.prepare - settings.near) / settings.approach
        + settings.near / settings.press
        + settings.prepare / settings.retreat
        + 3 * 0.1 / settings.speed
    )
    checks = [
        (procedure.arm.features.name, state.safe, f"tool at {np.round(state.T_b_t[:3, 3], 3).tolist()} m"),
        (
            procedure.skin.features.name,
            bool(noise.max() < NOISE),
            f"{len(samples.time) / span:.0f} Hz, noise up to {noise.max():.1f} uT",
        ),
        (
            procedure.camera.features.name,
            bool(seen.mean() > 0.1),
            f"{100 * seen.mean():.0f} % of the pixels measured"
            + (f", median {1e3 * np.nanmedian(view.depth):.0f} mm" if seen.any() else ""),
        ),
        ("sites", len(unreachable) < len(sites) / 2, f"{len(unreachable)} of {len(sites)} cannot be reached"),
    ]
    print(summary(rig))
    print(f"plan      {len(sites)} touches of {name}, about {seconds:.0f} s each; drawn in {path}")
    for number, why in unreachable[:5]:
        print(f"          site {number}: {why}")
    for what, good, said in checks:
        print(f"{'ok' if good else 'BAD':<9} {what}: {said}")
    print(
        "nothing was moved" + ("" if procedure.arm.features.source == "simulated" else "; the arm was taken and let go")
    )
    return 0 if all(good for _, good, _ in checks) else 1


def check_camera(procedure: Procedure) -> None:
    """Refuse (ValueError) a camera that cannot see as near as the rig looks."""
    camera, distance = procedure.camera.features, procedure.rig.looking_distance
    if math.isfinite(camera.nearest) and camera.nearest > distance:
        raise ValueError(
            f"{camera.name} measures nothing nearer than {1e3 * camera.nearest:.0f} mm, and the rig looks from "
            f"{1e3 * distance:.0f} mm; raise looking_distance or take another camera"
        )
