"""Dry run of a collection: check the sites and every device, and describe the collection, without any motion."""

from pathlib import Path

import numpy as np

from i2t.collect.arguments import CollectArgs
from i2t.collect.checks import dry_run_checks, run_checks
from i2t.collect.path import TouchPath
from i2t.collect.procedure import Procedure
from i2t.collect.site_plan import SiteSampler
from i2t.collect.touch import Site
from i2t.geometry import inverse
from i2t.hardware.collision import overrun_force
from i2t.hardware.limits import SAFETY
from i2t.hardware.rig import summary


def dry_run(procedure: Procedure, sampler: SiteSampler, args: CollectArgs) -> int:
    """Check sites, settings and devices of a collection without moving, and print a description of it.

    Args:
        procedure: The procedure, with connected devices.
        sampler: Source of the sites to touch.
        args: Arguments of the collection. A picture of the rig is drawn next to the folder of the touches.

    Returns:
        The exit code: 0 if no check found a defect, otherwise 1.

    Raises:
        ValueError: If the settings exceed the arm's limits.
        DeviceError: If a device fails.
    """
    path, arm = procedure.path, procedure.arm
    path.check_settings()
    print(summary(procedure.rig))
    print("\n".join(energy_lines(path, getattr(arm, "stall_s", None))))
    picture = args.out.with_name(f"{args.out.name}-rig.png")
    _draw_rig(procedure, sampler, sampler.site(0), picture)
    print(f"picture   the rig with object, tool and camera is drawn in {picture}: does it look like the lab?")
    wrong = run_checks(dry_run_checks(sampler, args.touches), procedure)
    print("nothing was moved" + ("" if arm.features.source == "simulated" else "; the arm was taken and let go"))
    return int(bool(wrong))


def energy_lines(path: TouchPath, stall_s: float | None) -> list[str]:
    """Describe the highest forces of a collision and of a press, as `i2t.hardware.collision` computes them.

    Args:
        path: Path of the touches.
        stall_s: Time (s) after which an arm stops by itself when its computer stalls; None if only the arm's own
            settings determine it.

    Returns:
        Lines of text on the motion in the air and on the press.
    """
    limits, settings = path.rig.limits, path.settings

    def extra(delay: float) -> float:
        """Compute the force (N) that a press gains when the command to stop is late (s)."""
        return overrun_force(
            settings.press, limits.stiffness, braking=SAFETY.braking_m_s2, delay=SAFETY.reaction_time_s + delay
        )

    stiff = f"at {limits.stiffness / 1e3:g} N/mm"
    requested = f" ({1e3 * settings.speed:.0f} requested)" if path.free_speed < settings.speed else ""
    stall = f"{extra(stall_s):.1f} N" if stall_s is not None else "what the arm's own watch allows"
    hit = limits.collision_force(path.free_speed, limits.trip_force)
    return [
        f"free      {1e3 * path.free_speed:.0f} mm/s{requested}: stopped at {limits.trip_force:.0f} N, a collision "
        f"{stiff} ends at {hit:.0f} N at most, of {limits.force:g} N allowed",
        f"press     {1e3 * settings.press:g} mm/s: ends at {settings.force + extra(0.0):.1f} N at most, {stiff}; a "
        f"stall of this computer adds {stall}, a skin that falls silent {extra(settings.silence):.1f} N, and no more "
        "than that",
    ]


def _draw_rig(procedure: Procedure, sampler: SiteSampler, site: Site, path: Path) -> None:
    """Draw base, box, object, and the tool with its camera at a site, for comparison with the lab by eye."""
    # Imported late: matplotlib takes a third of a second, and most collections draw no picture.
    from i2t.viz.rig_scene import RigScene, plot_rig
    from i2t.viz.style import save_figure

    rig = procedure.rig
    scene = RigScene(
        vertices=np.asarray(sampler.placed.vertices),
        faces=np.asarray(sampler.placed.faces),
        T_w_b=rig.T_world_base,
        T_w_t=np.asarray(site.T_w_t),
        T_t_f=inverse(rig.T_flange_tool),
        T_t_c=rig.T_tool_camera,
        box=rig.limits.box,
        looking_distance=rig.looking_distance,
        view_edges=(rig.camera.width / rig.camera.fx, rig.camera.height / rig.camera.fy),
    )
    save_figure(plot_rig(scene, f"the first of the sites ({procedure.arm.features.source} arm)"), path)
