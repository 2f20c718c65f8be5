"""Checks before the first touch of a session: each is a function `check(procedure) -> list[str]` of what is wrong.

A session runs those with which nothing moves, then the first looks and slow touches (`i2t.collect.first_touch`), and
ends at the first sentence; of noise it only speaks. A dry run goes on, unless a device fails. What else a check finds
is printed.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeAlias

import numpy as np

from i2t.collect.first_touch import RigContradictedError, first_touch
from i2t.collect.procedure import Procedure
from i2t.collect.site_plan import SiteSampler
from i2t.errors import DeviceError, printable
from i2t.hardware.rig_checks import implausible, other_lens
from i2t.hardware.skin_health import check_skin, rest_samples

Check: TypeAlias = Callable[[Procedure], list[str]]

MIN_MEASURED_SHARE = 0.1  # of a view's pixels
SHOWN_REFUSALS = 5


def still_checks(*, strict: bool) -> dict[str, Check]:
    """Checks by their names, with which nothing moves, and without which no session starts.

    Args:
        strict: Whether what only makes readings worse, as noise, is wrong too; else it is printed.

    Returns:
        The checks.
    """
    return {"camera": _camera_fits, "skins": partial(_skins_healthy, strict=strict)}


def dry_checks(sampler: SiteSampler, count: int) -> dict[str, Check]:
    """Checks of a dry run by their names.

    Args:
        sampler: Of the sites.
        count: How many are to be touched.

    Returns:
        All with which nothing moves.
    """
    plans = {
        "rig": partial(_rig_plausible, sampler=sampler),
        "reach": partial(_sites_reached, sampler=sampler, count=count),
    }
    return {"arm": _arm_ready, "view": _view_measured, **still_checks(strict=True), **plans}


def touch_checks(sampler: SiteSampler) -> dict[str, Check]:
    """Checks by their names, that look and touch slowly.

    Args:
        sampler: Of the sites.

    Returns:
        The checks.
    """
    return {"first touch": partial(_rig_touched, sampler=sampler)}


def run_checks(checks: Mapping[str, Check], procedure: Procedure) -> list[str]:
    """Run all checks, and print what they find.

    Args:
        checks: By their names.
        procedure: Its devices are connected.

    Returns:
        What is wrong, with the names.
    """
    wrong = []
    for name, check in checks.items():
        found = [f"{name}: {sentence}" for sentence in check(procedure)]
        print("\n".join(printable(f"BAD       {each}") for each in found) or f"ok        {name}")
        wrong += found
    return wrong


def require_checks(checks: Mapping[str, Check], procedure: Procedure) -> None:
    """Run checks up to the first that finds something.

    Args:
        checks: By their names.
        procedure: Its devices are connected.

    Raises:
        DeviceError: What it found, with its name.
    """
    for name, check in checks.items():
        found = check(procedure)
        if found:
            more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
            raise DeviceError(f"{name}: {found[0]}{more}")


# Checks


def _arm_ready(procedure: Procedure) -> list[str]:
    """Find an arm in a protective or emergency stop."""
    arm, state = procedure.arm, procedure.arm.state()
    print(f"{arm.features.name}: tool at {np.round(state.T_b_t[:3, 3], 3).tolist()} m")
    return [] if state.safe else [f"{arm.features.name} is in a protective or emergency stop; release it"]


def _view_measured(procedure: Procedure) -> list[str]:
    """Find a camera that measures hardly anything."""
    name, depth = procedure.camera.features.name, procedure.camera.capture().depth
    measured = np.isfinite(depth)
    median = f", median {1e3 * np.nanmedian(depth):.0f} mm" if measured.any() else ""
    seen = f"{100 * measured.mean():.0f} % of the pixels measured{median}"
    print(f"{name}: {seen}")
    return [] if measured.mean() > MIN_MEASURED_SHARE else [f"{name} sees hardly anything, {seen}; is it covered?"]


def _camera_fits(procedure: Procedure) -> list[str]:
    """Find a camera that cannot see as near as the rig looks, or has another lens than the rig says."""
    camera, distance = procedure.camera.features, procedure.rig.looking_distance
    if math.isfinite(camera.nearest) and camera.nearest > distance:
        return [
            f"{camera.name} measures nothing nearer than {1e3 * camera.nearest:.0f} mm, and the rig looks from "
            f"{1e3 * distance:.0f} mm; raise looking_distance or take another camera"
        ]
    different = other_lens(procedure.rig.camera, procedure.camera.camera)
    return [different] if different else []


def _skins_healthy(procedure: Procedure, strict: bool) -> list[str]:
    """Find skins that are dead, frozen or saturated at rest, or noisy; raises DeviceError for one that is silent."""
    found = []
    for each in procedure.skins:
        name = f"the skin {each.name}, {each.skin.features.name}" if each.name else each.skin.features.name
        health = check_skin(rest_samples(each.skin, procedure.clock))
        print(printable(f"{name}: at rest {health.summary}"))
        for sentence, stops in health.defects:
            if stops or strict:
                found.append(f"{name}: {sentence}")
            else:
                print(printable(f"{name}: {sentence}"))
    return found


def _rig_plausible(procedure: Procedure, sampler: SiteSampler) -> list[str]:
    """Find values of the rig that are nearly always mistakes."""
    return implausible(procedure.rig, sampler.mesh.vertices)


def _sites_reached(procedure: Procedure, sampler: SiteSampler, count: int) -> list[str]:
    """Find a plan of which half of the sites cannot be reached."""
    sites = [sampler.site(number) for number in range(count)]
    refused = {site.number: why for site in sites if (why := procedure.path.why_not(site))}
    print(f"{len(refused)} of {len(sites)} cannot be reached")
    for number, why in list(refused.items())[:SHOWN_REFUSALS]:
        print(f"          site {number}: {why}")
    return [] if len(refused) < len(sites) / 2 else [f"{len(refused)} of {len(sites)} sites cannot be reached"]


def _rig_touched(procedure: Procedure, sampler: SiteSampler) -> list[str]:
    """Find what camera, arm and skin contradict in the rig; raises DeviceError where a device fails."""
    try:
        first_touch(procedure, sampler)
    except RigContradictedError as error:
        return [str(error)]
    return []
