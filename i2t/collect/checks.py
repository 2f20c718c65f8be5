"""Checks before the first touch of a session. Each is a function `check(procedure) -> list[str]` that lists defects.

A session first runs the checks without motion, then the first looks and slow touches (`i2t.collect.first_touch`), and
ends at the first defect. It only prints a warning about noise. A dry run continues after a defect, unless a device
fails. Further results of the checks are printed.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeAlias

import numpy as np

from i2t.collect.first_touch import RigContradictedError, check_rig_by_touch
from i2t.collect.procedure import Procedure
from i2t.collect.site_plan import SiteSampler
from i2t.errors import DeviceError, printable
from i2t.hardware.rig_checks import compare_lens, implausible_values
from i2t.hardware.skin_health import check_skin, rest_samples

Check: TypeAlias = Callable[[Procedure], list[str]]


def motionless_checks(*, strict: bool) -> dict[str, Check]:
    """List the checks of camera and skins that every collection requires before anything moves.

    Args:
        strict: Whether a defect that only degrades readings, such as noise, fails the check; otherwise it is printed.

    Returns:
        The checks by their names.
    """
    return {"camera": _camera_fits, "skins": partial(_skins_healthy, strict=strict)}


def dry_run_checks(sampler: SiteSampler, count: int) -> dict[str, Check]:
    """List the checks of a dry run, during which nothing moves.

    Args:
        sampler: Source of the sites to touch.
        count: Number of sites to be touched.

    Returns:
        The checks by their names.
    """
    plans = {
        "rig": partial(_rig_plausible, sampler=sampler),
        "reach": partial(_sites_reached, sampler=sampler, count=count),
    }
    return {"arm": _arm_ready, "view": _view_measured, **motionless_checks(strict=True), **plans}


def touch_checks(sampler: SiteSampler) -> dict[str, Check]:
    """List the checks before a collection in which the camera looks at the object and the skin touches it slowly.

    Args:
        sampler: Source of the sites.

    Returns:
        The checks by their names.
    """
    return {"first touch": partial(_rig_touched, sampler=sampler)}


def run_checks(checks: Mapping[str, Check], procedure: Procedure) -> list[str]:
    """Run all checks of a collection and print their results.

    Args:
        checks: The checks by their names.
        procedure: The procedure, with connected devices.

    Returns:
        Sentences on all defects, with the names of the checks; empty if there is no defect.
    """
    wrong = []
    for name, check in checks.items():
        defects = [f"{name}: {sentence}" for sentence in check(procedure)]
        print("\n".join(printable(f"BAD       {defect}") for defect in defects) or f"ok        {name}")
        wrong += defects
    return wrong


def require_checks(checks: Mapping[str, Check], procedure: Procedure) -> None:
    """Run the checks of a collection, and raise an error at the first defect.

    Args:
        checks: The checks by their names.
        procedure: The procedure, with connected devices.

    Raises:
        DeviceError: If a check finds a defect; the message holds its name and the first defect.
    """
    for name, check in checks.items():
        defects = check(procedure)
        if defects:
            more = f" (and {len(defects) - 1} more)" if len(defects) > 1 else ""
            raise DeviceError(f"{name}: {defects[0]}{more}")


# Checks


def _arm_ready(procedure: Procedure) -> list[str]:
    """Check that the arm is not in a protective or emergency stop."""
    arm, state = procedure.arm, procedure.arm.state()
    print(f"{arm.features.name}: tool at {np.round(state.T_b_t[:3, 3], 3).tolist()} m")
    return [] if state.safe else [f"{arm.features.name} is in a protective or emergency stop; release it"]


def _view_measured(procedure: Procedure) -> list[str]:
    """Check that the camera measures more than a tenth of its pixels."""
    name, depth = procedure.camera.features.name, procedure.camera.capture().depth
    measured = np.isfinite(depth)
    median = f", median {1e3 * np.nanmedian(depth):.0f} mm" if measured.any() else ""
    coverage = f"{100 * measured.mean():.0f} % of the pixels measured{median}"
    print(f"{name}: {coverage}")
    return [] if measured.mean() > 0.1 else [f"{name} measures almost nothing, {coverage}; check whether it is covered"]


def _camera_fits(procedure: Procedure) -> list[str]:
    """Check that the camera measures at the looking distance, and has the lens of the rig."""
    camera, distance = procedure.camera.features, procedure.rig.looking_distance
    if math.isfinite(camera.nearest) and camera.nearest > distance:
        return [
            f"{camera.name} measures nothing nearer than {1e3 * camera.nearest:.0f} mm, and the rig looks from "
            f"{1e3 * distance:.0f} mm; raise looking_distance or take another camera"
        ]
    mismatch = compare_lens(procedure.rig.camera, procedure.camera.camera)
    return [mismatch] if mismatch else []


def _skins_healthy(procedure: Procedure, strict: bool) -> list[str]:
    """Check that no skin is dead, frozen or saturated at rest, or noisy. Raise DeviceError if one is silent."""
    defects = []
    for on_tool in procedure.skins:
        name = f"the skin {on_tool.name}, {on_tool.skin.features.name}" if on_tool.name else on_tool.skin.features.name
        health = check_skin(rest_samples(on_tool.skin, procedure.clock))
        print(printable(f"{name}: at rest {health.summary}"))
        for sentence, stops in health.defects:
            if stops or strict:
                defects.append(f"{name}: {sentence}")
            else:
                print(printable(f"{name}: {sentence}"))
    return defects


def _rig_plausible(procedure: Procedure, sampler: SiteSampler) -> list[str]:
    """Check the rig for values that are nearly always mistakes."""
    return implausible_values(procedure.rig, sampler.mesh.vertices)


def _sites_reached(procedure: Procedure, sampler: SiteSampler, count: int) -> list[str]:
    """Check that more than half of the planned sites can be reached."""
    sites = [sampler.site(number) for number in range(count)]
    refused = {site.number: why for site in sites if (why := procedure.path.explain_unreachable(site))}
    print(f"{len(refused)} of {len(sites)} cannot be reached")
    for number, why in list(refused.items())[:5]:
        print(f"          site {number}: {why}")
    return [] if len(refused) < len(sites) / 2 else [f"{len(refused)} of {len(sites)} sites cannot be reached"]


def _rig_touched(procedure: Procedure, sampler: SiteSampler) -> list[str]:
    """Check the rig by first looks and slow touches. Raise DeviceError if a device fails."""
    try:
        check_rig_by_touch(procedure, sampler)
    except RigContradictedError as error:
        return [str(error)]
    return []
