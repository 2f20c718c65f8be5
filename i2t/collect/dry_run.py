"""Dry run of a collection: what would be touched, and whether every device does its part, with nothing moved."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from i2t.collect.free_poses import plan_free_poses
from i2t.collect.path import TouchPath
from i2t.collect.procedure import Procedure
from i2t.collect.settings import AmbientSettings
from i2t.collect.site_plan import SiteSampler, draw_plan, draw_rig
from i2t.collect.touch import Site, UnreachableError
from i2t.hardware.rig import summary
from i2t.hardware.rig_checks import implausible, other_lens
from i2t.hardware.skin_health import check_skin, rest_samples

MIN_MEASURED_SHARE = 0.1  # of a view's pixels
TRANSFER_M = 0.1  # a guess of each of the three ways between sites, for the time of a touch
SHOWN_REFUSALS = 5


class _Check(NamedTuple):
    what: str
    good: bool
    said: str


def dry_run(
    procedure: Procedure,
    sampler: SiteSampler,
    name: str,
    touches: int,
    out: Path,
    *,
    ambient: AmbientSettings | None = None,
    watch_s: float | None = None,
) -> int:
    """Check sites, settings and devices of a collection, and report what it would do.

    Args:
        procedure: Its devices are connected.
        sampler: Of the sites.
        name: Of the object.
        touches: How many there would be.
        out: Folder of the touches; the plan's picture is drawn next to it.
        ambient: Of the free poses before it.
        watch_s: s, after which an arm whose computer stalls stops by itself; None where only the arm knows.

    Returns:
        The exit code.

    Raises:
        ValueError: The settings are beyond the arm's limits.
        DeviceError: A device does not do its part.
    """
    procedure.path.check_settings()
    sites = [sampler.site(number) for number in range(touches)]
    refused = _refused(procedure, sites)
    mesh = sampler.mesh
    checks = _device_checks(procedure)
    checks += [_Check("rig", False, doubt) for doubt in implausible(procedure.rig, mesh.vertices)]
    checks.append(_Check("sites", len(refused) < len(sites) / 2, f"{len(refused)} of {len(sites)} cannot be reached"))
    source = procedure.arm.features.source
    box = procedure.rig.limits.box + procedure.rig.T_world_base[:3, 3]
    path = out.with_name(f"{out.name}-plan.png")
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"{name}: {len(sites)} sites ({source} arm)"
    draw_plan(sampler, sites, set(refused), box=box, path=path, title=title)
    picture = out.with_name(f"{out.name}-rig.png")
    draw_rig(procedure.rig, mesh.vertices, mesh.faces, sites[0].T_w_t, path=picture, title=title)
    print(summary(procedure.rig))
    print("\n".join(energy_lines(procedure.path, watch_s)))
    print(f"picture   the rig with object, tool and camera is drawn in {picture}: does it look like the lab?")
    seconds = touch_seconds(procedure.path)
    print(f"plan      {len(sites)} touches of {name}, about {seconds:.0f} s each; drawn in {path}")
    for number, why in list(refused.items())[:SHOWN_REFUSALS]:
        print(f"          site {number}: {why}")
    if ambient is not None and ambient.poses:
        heights = [pose.tilted[2, 3] for pose in plan_free_poses(procedure.path, procedure.arm.state().T_b_t, ambient)]
        print(f"          {ambient.poses} free poses before, {min(heights):.3f} to {max(heights):.3f} m in the base")
    for check in checks:
        print(f"{'ok' if check.good else 'BAD':<9} {check.what}: {check.said}")
    print("nothing was moved" + ("" if source == "simulated" else "; the arm was taken and let go"))
    return 0 if all(check.good for check in checks) else 1


def touch_seconds(path: TouchPath) -> float:
    """Approximate duration of a touch.

    Args:
        path: How fast it is made.

    Returns:
        s.
    """
    settings = path.settings
    return (
        4 * settings.settle
        + (settings.prepare - settings.near) / settings.approach
        + settings.near / settings.press
        + settings.prepare / path.retreat_speed
        + 3 * TRANSFER_M / path.free_speed
    )


def energy_lines(path: TouchPath, watch_s: float | None) -> list[str]:
    """Sentences on the force of a collision and of a press.

    Args:
        path: Of the touches.
        watch_s: s, after which an arm whose computer stalls stops by itself; None where only the arm knows.

    Returns:
        Lines.
    """
    limits, settings, bounds = path.rig.limits, path.settings, path.press_bounds(watch_s)
    stiff = f"at {limits.stiffness / 1e3:g} N/mm"
    asked = f" ({1e3 * settings.speed:.0f} asked)" if path.free_speed < settings.speed else ""
    stall = f"{bounds.stall:.1f} N" if watch_s is not None else "what the arm's own watch allows"
    hit = limits.collision_force(path.free_speed, limits.trip_force)
    return [
        f"free      {1e3 * path.free_speed:.0f} mm/s{asked}: stopped at {limits.trip_force:.0f} N, a collision {stiff} "
        f"ends at {hit:.0f} N at the most, of {limits.force:g} N allowed",
        f"press     {1e3 * settings.press:g} mm/s: ends at {bounds.force:.1f} N at the most, {stiff}; a stall of this "
        f"computer adds {stall}, a skin that falls silent {bounds.silence:.1f} N, and no more than that",
    ]


def _refused(procedure: Procedure, sites: list[Site]) -> dict[int, str]:
    """Numbers of the sites that cannot be reached, and why."""
    refused = {}
    for site in sites:
        try:
            procedure.path.check(site)
        except UnreachableError as error:
            refused[site.number] = str(error)
    return refused


def _device_checks(procedure: Procedure) -> list[_Check]:
    """Checks of arm, skin and camera."""
    state = procedure.arm.state()
    skins = {procedure.skin.features.name: procedure.skin}
    skins |= {f"the skin {each.name}, {each.skin.features.name}": each.skin for each in procedure.carried}
    health = {name: check_skin(rest_samples(skin, procedure.clock)) for name, skin in skins.items()}
    view = procedure.camera.capture()
    measured = np.isfinite(view.depth)
    return [
        _Check(procedure.arm.features.name, state.safe, f"tool at {np.round(state.T_b_t[:3, 3], 3).tolist()} m"),
        *(_Check(name, not found.defects, found.summary) for name, found in health.items()),
        *(_Check(name, False, defect.sentence) for name, found in health.items() for defect in found.defects),
        _Check(
            procedure.camera.features.name,
            bool(measured.mean() > MIN_MEASURED_SHARE),
            f"{100 * measured.mean():.0f} % of the pixels measured"
            + (f", median {1e3 * np.nanmedian(view.depth):.0f} mm" if measured.any() else ""),
        ),
    ]


def check_camera(procedure: Procedure) -> None:
    """Refuse a camera that cannot see as near as the rig looks, or has another lens than the rig says.

    Args:
        procedure: Its camera is connected.

    Raises:
        ValueError: The camera measures nothing so near, or its lens is another.
    """
    camera, distance = procedure.camera.features, procedure.rig.looking_distance
    if math.isfinite(camera.nearest) and camera.nearest > distance:
        raise ValueError(
            f"{camera.name} measures nothing nearer than {1e3 * camera.nearest:.0f} mm, and the rig looks from "
            f"{1e3 * distance:.0f} mm; raise looking_distance or take another camera"
        )
    different = other_lens(procedure.rig.camera, procedure.camera.camera)
    if different and procedure.camera.features.source != "folder":
        raise ValueError(different)
