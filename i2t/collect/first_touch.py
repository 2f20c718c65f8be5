"""Check of the rig against camera, arm and skin, before the first touch of a session.

    air       what the arm feels while it touches nothing and nothing has been zeroed: a payload that is wrong
    looks     the camera over some sites; near each the depth must be that of the mesh where the rig has it
    touch     a slow press of the site that points up most, as any other but with lighter limits and guarded all the way
              down from the way across: the tool must meet the object where the rig has it, and the skin must feel it

What contradicts the rig is one sentence, and nothing else is touched. A camera that shows recorded views is not asked.

Frames: W world, B robot base, T tool, C camera; metres, newtons, microtesla.
"""

from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from i2t.collect.procedure import Procedure
from i2t.collect.recorder import EventLog
from i2t.collect.site_plan import SiteSampler
from i2t.collect.touch import TOOL, Site, TouchFailedError, UnreachableError
from i2t.depth.camera import Camera, Distortion
from i2t.errors import DeviceError
from i2t.hardware.skin_health import press_defect
from i2t.simulation.depth_camera import render_view
from i2t.types import Array

FELT_S, FELT_SAMPLES = 0.5, 200  # of which a reading is the mean, whichever is less
FIRST_SITES, FIRST_LOOKS = 32, 3  # sites among which those are chosen, and how many are looked at
LOOK_RADIUS_M = 40e-3  # around a site, in which depth is compared
DEPTH_TOLERANCE_M = 6e-3  # of a pixel's depth: placement and camera 1 mm and a degree off, and a sloping surface
FIRST_EDGE_M = 3e-3  # from an edge of the object, in which depth is not compared: it is seen as far aside
MAX_WRONG_SHARE, CLEARLY_WRONG_SHARE = 0.3, 0.6  # of the pixels of all looks; of a single look, at once
MIN_SEEN_SHARE = 0.3  # of the object's pixels, that must have been measured
TOUCH_TOLERANCE_M = 4e-3  # of where the object is met; with a placement that is stated worse, three times its error
LIGHT_FORCE_N = 3.0  # that ends the first touch: above what a UR's sensor errs in motion
FIRST_TOUCH_SPEED_M_S = 5e-3
MAX_PREPARE_M = 0.3  # before a site, as settings allow
MAX_AIR_FORCE_N = 6.0  # felt in the air before anything is zeroed: more is a payload off by 0.6 kg

CHECK_CAMERA = "check T_tool_camera, T_flange_tool and the camera's lens, and register the object (python -m i2t.place)"


class RigContradictedError(DeviceError):
    """Camera, arm or skin contradict the rig."""


class FirstTouchPlan(NamedTuple):
    """Sites to look at, of which the first is touched, and the procedure whose settings make that touch a slow one."""

    looks: tuple[Site, ...]
    slow: Procedure


def plan_first_touch(procedure: Procedure, sampler: SiteSampler) -> FirstTouchPlan:
    """Choose a site that points up, and others far from it; nothing moves.

    The touch goes as far past its site as the placement may err, wherever box and arm allow that at any site; else it
    ends where a press of the collection would.

    Args:
        procedure: Its path says which sites can be reached.
        sampler: Of the sites.

    Returns:
        The plan.

    Raises:
        UnreachableError: No site can be reached, or touched slowly in one motion.
    """
    path, tried = procedure.path, [sampler.site(number) for number in range(FIRST_SITES)]
    refused = [path.why_not(site) for site in tried]
    sites = [site for site, why in zip(tried, refused, strict=True) if not why]
    if not sites:
        raise UnreachableError(f"none of {FIRST_SITES} sites can be reached, the last not because {refused[-1]}")
    places = np.array([site.T_w_t[:3, 3] for site in sites])
    up = np.array([-site.T_w_t[2, 2] for site in sites])
    middle = places[:, :2].mean(0)
    best_first = np.argsort(-(np.round(up, 2) - np.linalg.norm(places[:, :2] - middle, axis=1)), kind="stable")
    pasts = (touch_tolerance(procedure), procedure.settings.overtravel)
    slowed = ((i, _slowed(procedure, sites[i], past)) for past in dict.fromkeys(pasts) for i in best_first)
    first, slow = next(((i, each) for i, each in slowed if each is not None), (0, None))
    if slow is None:
        raise UnreachableError(
            f"a slow touch, from {1e3 * procedure.settings.prepare:.0f} mm before a site to {1e3 * pasts[1]:.0f} mm "
            f"past it, can be made at none of {len(sites)}; lower settings.prepare, or pass --skip-first-touch"
        )
    chosen = [first]
    while len(chosen) < min(FIRST_LOOKS, len(sites)):
        away = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(1)
        chosen.append(int(np.argmax(away)))
    return FirstTouchPlan(tuple(sites[i] for i in chosen), slow)


def touch_tolerance(procedure: Procedure) -> float:
    """Distance from its site within which the first touch may meet the object.

    Args:
        procedure: Its rig says how well the object's place is known.

    Returns:
        m: three standard deviations of the object's position, at least 4 mm.
    """
    variances = np.diagonal(procedure.rig.object_covariance)[:3]
    return max(TOUCH_TOLERANCE_M, 3 * float(np.sqrt(variances.max())))


def _slowed(procedure: Procedure, site: Site, past: float) -> Procedure | None:
    """The procedure with settings of a slow touch of a site, which ends so far (m) past it: it is guarded from as high
    as box and arm allow, and presses from where others prepare. None where they allow none.
    """
    path, settings, limits = procedure.path, procedure.settings, procedure.rig.limits
    if not settings.prepare + past <= limits.approach_distance:
        return None
    prepare = path.poses(site)[1]
    up = max(-float(prepare[2, 2]), 0.1)  # cosine of the tool's tilt
    room = min((path.transfer_height() - prepare[2, 3]) / up, limits.approach_distance, MAX_PREPARE_M)
    count = int(np.clip(FELT_S * procedure.skins[0].skin.features.rate, settings.ambient, FELT_SAMPLES))
    for part in (1.0, 0.5, 0.0):
        slow = replace(
            settings,
            prepare=min(settings.prepare + part * max(room, 0.0), MAX_PREPARE_M),
            near=settings.prepare,
            overtravel=past,
            press=min(FIRST_TOUCH_SPEED_M_S, settings.approach),
            force=LIGHT_FORCE_N,
            ambient=count,
            contact=count,
        )
        slowed = replace(procedure, settings=slow)
        if not slowed.path.why_not(site):
            return slowed
    return None


def first_touch(procedure: Procedure, sampler: SiteSampler, report: Callable[[str], None] = print) -> None:
    """Look at some sites and touch one slowly; the tool ends above everything.

    Args:
        procedure: Its devices are connected.
        sampler: Of the sites.
        report: Hears what was found.

    Raises:
        RigContradictedError: Camera, arm or skin contradict the rig, or the skin feels nothing.
        DeviceError: A device fails.
        ValueError: The settings are beyond the arm's limits; nothing has moved.
    """
    procedure.path.check_settings()
    plan = plan_first_touch(procedure, sampler)
    _check_air(procedure)
    procedure.retreat()
    share = float(np.mean([_look(procedure, sampler, site) for site in plan.looks]))
    if share > MAX_WRONG_SHARE:
        raise _seen_elsewhere("in the first looks", share)
    report(f"first looks: {100 * share:.0f} % of the object's pixels are not where the rig has them")
    try:
        report(_touch(plan.slow, plan.looks[0]))
    except RigContradictedError:
        procedure.retreat()
        raise
    procedure.retreat()


def depth_contradiction(depth: Array, expected: Array, on_object: Array) -> tuple[float, float]:
    """Share of an object that is not seen where it should be.

    Args:
        depth: (h, w) m, as measured; NaN where nothing was.
        expected: (h, w) m, of the mesh where the rig has it.
        on_object: (h, w) which pixels show the object.

    Returns:
        The share of the object's pixels that were measured, and of those the share that is further off than the
        tolerance.
    """
    measured = on_object & np.isfinite(depth)
    if not measured.any():
        return 0.0, 1.0
    wrong = np.abs(depth[measured] - expected[measured]) > DEPTH_TOLERANCE_M
    return float(measured.sum() / on_object.sum()), float(wrong.mean())


def expected_view(triangles: Array, site: Array, T_w_c: Array, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """View of an object that the camera should see around a site.

    Args:
        triangles: (n, 3 corners, 3) m, of the object in W.
        site: (3,) m, in W.
        T_w_c: (4, 4) of the camera.
        camera: Its size and lens, whose distortion is left out.

    Returns:
        Depth (h, w) m, and which pixels (h, w) show the object within 40 mm of the site, and not near its edges.
    """
    pinhole = replace(camera, model=Distortion.NONE, coefficients=())
    depth, which = render_view(triangles, T_w_c, pinhole)
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    with np.errstate(invalid="ignore"):
        points = depth[..., None] * np.stack([*np.meshgrid(x, y), np.ones(depth.shape)], axis=-1)
        near = np.linalg.norm(points - (site - T_w_c[:3, 3]) @ T_w_c[:3, :3], axis=-1) < LOOK_RADIUS_M
    on_object = near & (which >= 0)
    far_from_edges = on_object & ~_edges(depth, site, T_w_c, camera)
    return depth, far_from_edges if far_from_edges.any() else on_object


def _edges(depth: Array, site: Array, T_w_c: Array, camera: Camera) -> np.ndarray:
    """Mask (h, w) of pixels so near an edge that they may show what is next to it."""
    away = max(float((site - T_w_c[:3, 3]) @ T_w_c[:3, 2]), 1e-3)
    size = 2 * max(1, round(camera.fx * FIRST_EDGE_M / away)) + 1
    known = np.where(np.isfinite(depth), depth, 10.0)
    return np.asarray(maximum_filter(known, size) - minimum_filter(known, size) > DEPTH_TOLERANCE_M)


def _check_air(procedure: Procedure) -> None:
    state = procedure.arm.state()
    force = float(np.linalg.norm(state.wrench[:3]))
    if not state.moving and force > MAX_AIR_FORCE_N:
        raise RigContradictedError(
            f"the arm feels {force:.1f} N before anything is touched, as if {force / 9.81:.1f} kg were wrong: check "
            "tool.mass and tool.centre of the rig, or free the tool"
        )


def _look(procedure: Procedure, sampler: SiteSampler, site: Site) -> float:
    """Share of the object's pixels that contradict the rig; raises RigContradictedError."""
    procedure.move_above(procedure.path.poses(site)[0])
    procedure.clock.sleep(procedure.settings.settle)
    T_w_c = procedure.rig.T_world_base @ procedure.arm.state().T_b_t @ procedure.rig.T_tool_camera
    view, camera = procedure.camera.capture(), procedure.camera.camera
    mesh = sampler.placed
    expected, on_object = expected_view(mesh.vertices[mesh.faces], site.T_w_t[:3, 3], T_w_c, camera)
    if not on_object.any():
        raise RigContradictedError(f"the camera would not see site {site.number} at all; {CHECK_CAMERA}")
    seen, wrong = depth_contradiction(np.asarray(view.depth, float), expected, on_object)
    if seen < MIN_SEEN_SHARE:
        raise RigContradictedError(
            f"the camera measured {100 * seen:.0f} % of the pixels in which site {site.number} should be; is it "
            f"covered, shiny or too near? Else {CHECK_CAMERA}"
        )
    if wrong > CLEARLY_WRONG_SHARE:
        raise _seen_elsewhere(f"at site {site.number}", wrong)
    return wrong


def _seen_elsewhere(where: str, share: float) -> RigContradictedError:
    return RigContradictedError(
        f"{where} {100 * share:.0f} % of the object is seen more than {1e3 * DEPTH_TOLERANCE_M:g} mm from where the "
        f"rig has it; {CHECK_CAMERA}"
    )


def _touch(slow: Procedure, site: Site) -> str:
    """Touch a site slowly; says where it was met, or raises RigContradictedError."""
    settings, tolerance = slow.settings, touch_tolerance(slow)
    log = EventLog(BytesIO(), slow.clock)  # it is no touch of the set
    prepare = slow.path.poses(site)[1]
    slow.move_above(prepare)
    slow.clock.sleep(settings.settle)
    remedy = "check T_flange_tool, T_world_base and T_world_object"
    try:
        slow.prepare(prepare, log)
    except TouchFailedError as error:
        raise RigContradictedError(f"the first slow touch: {error}; {remedy}, and look what is in the way") from error
    press = slow.press(log)
    late = press.result.distance - settings.near
    if press.result.reason == "distance":
        raise RigContradictedError(
            f"the first slow touch met nothing up to {1e3 * settings.overtravel:.0f} mm past where the rig has the "
            f"object; {remedy}"
        )
    if not abs(late) <= tolerance:
        raise RigContradictedError(
            f"the first slow touch met something {-1e3 * late:.0f} mm before the object should begin; {remedy}, and "
            "look what is in the way"
        )
    change, force = press.changes[TOOL], -float(press.states[-1].wrench[2])
    defect = press_defect(change, force)
    if defect:
        raise RigContradictedError(f"{slow.skins[0].skin.features.name}: {defect}")
    size = float(np.sqrt(np.nansum(change**2)))
    return f"first touch: met the object {1e3 * late:+.1f} mm from where the rig has it, {force:.1f} N, {size:.0f} uT"
