"""Check of the rig against camera, arm and skin, before the first touch of a session.

    air       what the arm feels while it touches nothing and nothing has been zeroed: a payload that is wrong
    looks     the camera over some sites; near each the depth must be that of the mesh where the rig has it; and over
              one of them again with the tool turned, which tells a camera that is aside (`i2t.collect.turned_look`)
    touches   slow presses, as any other but with lighter limits and guarded from as far as box and arm allow: of the
              site that points up most, then of two sides with a tilted tool, which meets what is aside early or late;
              it must meet the object where the rig has it, and the skin must feel it

A pixel contradicts the rig if no surface within the tolerance of it, in any direction, has the depth that it should
have: what stands a little aside is still near, even if it is thin. A side is touched where the object ends in the
direction from which the tool comes, so that nothing else of it can be in the way of the tool. Presses along the tool's
axis do not tell where the skin is across it. The turned look does, unless T_tool_camera was measured with the wrong
T_flange_tool, so that both errors cancel.

What contradicts the rig is one sentence, and nothing else is touched. A camera that shows recorded views is not asked.

Frames: W world, B robot base, T tool, C camera; metres, newtons, microtesla.
"""

from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from i2t.collect.procedure import Procedure
from i2t.collect.recorder import EventLog
from i2t.collect.site_plan import SiteSampler
from i2t.collect.stopping import onset_distance, press_samples
from i2t.collect.touch import TOOL, Site, TouchFailedError, UnreachableError
from i2t.collect.turned_look import camera_aside, matching_shifts
from i2t.depth.camera import Camera, Distortion
from i2t.errors import DeviceError
from i2t.geometry import contact_frame, transform
from i2t.hardware.rig import Rig
from i2t.hardware.skin_health import press_defect
from i2t.objects.solids import Mesh
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.simulation.depth_camera import render_view
from i2t.simulation.sites import is_above_table
from i2t.types import Array

FELT_S, FELT_SAMPLES = 0.5, 200  # of which a reading is the mean, whichever is less
FIRST_SITES, FIRST_LOOKS, FIRST_SIDES = 32, 3, 2  # sites among which is chosen; looks; sides that are touched
LOOK_RADIUS_M = 40e-3  # around a site, in which depth is compared
DEPTH_TOLERANCE_M = 6e-3  # of where a pixel's surface is seen, at the least
CAMERA_STD_M = 1.5e-3  # of where the camera looks: it may be off by 1 mm, and by half a degree from 120 mm
STANDARD_DEVIATIONS = 3  # by which a right rig may be off
MAX_WRONG_SHARE, CLEARLY_WRONG_SHARE = 0.1, 0.3  # of the pixels of all looks; of a single look, at once
ASIDE_TOLERANCE_M = 4e-3  # of where the camera is across the tool's axis, at the least
ASIDE_TOLD_M = 4e-3  # by which what it is taken from may disagree; along other directions it is not told
TURNS_DEG = (180, 120, -120, 90, -90)  # of the tool for another look: the first that can be reached
MIN_SEEN_SHARE = 0.3  # of the object's pixels, that must have been measured
TOUCH_TOLERANCE_M = 4e-3  # of where the object is met, at the least
FELT_WITHIN_M = 1e-3  # past first contact, in which a press is felt
SIDE_TILTS_DEG, SIDE_TURN_DEG = (60.0, 45.0), 15  # of the tool at a side; between the sides that are tried
SIDE_EDGE_M = 0.5e-3  # within which several corners of a mesh are met at once
MOST_SIDES_COSINE = 0.5  # between the directions of both sides
LIGHT_FORCE_N = 3.0  # that ends the first touch: above what a UR's sensor errs in motion
FIRST_TOUCH_SPEED_M_S = 5e-3
MAX_PREPARE_M = 0.3  # before a site, as settings allow
# Felt in the air before anything is zeroed: more is a payload off by 0.3 kg. A UR5e's data sheet states an accuracy of
# 4 N and a precision of 3.5 N over its whole range; of an arm that stands in the air less is expected, not measured.
MAX_AIR_FORCE_N = 3.0

CHECK_CAMERA = "check T_tool_camera, T_flange_tool and the camera's lens, and register the object (python -m i2t.place)"


class RigContradictedError(DeviceError):
    """Camera, arm or skin contradict the rig."""


class SlowTouch(NamedTuple):
    """Slow touch of a site."""

    name: str
    site: Site
    tolerance: float  # m, within which it must meet the object
    procedure: Procedure  # whose settings make it slow


class FirstTouchPlan(NamedTuple):
    """Sites to look at, one of them again with the tool turned where it can be reached, and slow touches: of the site
    that points up most, then of up to two sides.
    """

    looks: tuple[Site, ...]
    pair: tuple[Site, ...]  # a site and the same turned; empty where none can be reached
    touches: tuple[SlowTouch, ...]


class Look(NamedTuple):
    """What a look tells."""

    wrong: float  # share of the object's pixels that contradict the rig
    missed: float  # share of those that would if there were no object
    shifts: Array  # (n, 3) m in W, that explain it
    R_w_t: Array  # (3, 3) of the tool


def plan_first_touch(procedure: Procedure, sampler: SiteSampler) -> FirstTouchPlan:
    """Choose a site that points up, others far from it, and two sides; nothing moves.

    A touch goes as far past its site as the placement may err, wherever box and arm allow that; that of the site that
    points up ends where a press of the collection would if they allow it nowhere.

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
    nearest = procedure.settings.overtravel
    slowed = ((i, _slowed(procedure, "top", sites[i], past)) for past in (None, nearest) for i in best_first)
    first, top = next(((i, each) for i, each in slowed if each is not None), (0, None))
    if top is None:
        raise UnreachableError(
            f"a slow touch, from {1e3 * procedure.settings.prepare:.0f} mm before a site to {1e3 * nearest:.0f} mm "
            f"past it, can be made at none of {len(sites)}; lower settings.prepare, or pass --skip-first-touch"
        )
    chosen = [first]
    while len(chosen) < min(FIRST_LOOKS, len(sites)):
        away = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(1)
        chosen.append(int(np.argmax(away)))
    looks = tuple(sites[i] for i in chosen)
    return FirstTouchPlan(looks, _pair(procedure, looks), (top, *_sides(procedure, sampler)))


def _pair(procedure: Procedure, looks: tuple[Site, ...]) -> tuple[Site, ...]:
    """A site, and the same with the tool turned as far as can be reached; empty where it cannot."""
    for turn in TURNS_DEG:
        T_t_turned = transform(Rotation.from_euler("z", turn, degrees=True).as_matrix(), np.zeros(3))
        for site in looks:
            turned = site._replace(T_w_t=site.T_w_t @ T_t_turned)
            if not procedure.path.why_not(turned):
                return site, turned
    return ()


def touch_tolerance(rig: Rig, site: Site) -> float:
    """Distance from its site within which a slow touch must meet the object.

    Args:
        rig: With the covariance of the object's pose.
        site: Where.

    Returns:
        m: three standard deviations of the object's place along the touch, at least 4 mm.
    """
    along = site.T_w_t[:3, 2]
    variance = float(along @ place_covariance(rig, site.T_w_t[:3, 3]) @ along)
    return max(TOUCH_TOLERANCE_M, STANDARD_DEVIATIONS * float(np.sqrt(variance)))


def place_covariance(rig: Rig, point: Array) -> np.ndarray:
    """Covariance of where a point of the object is, by what the rig says of the object's pose.

    Args:
        rig: With the covariance of that pose.
        point: (3,) m, in W.

    Returns:
        (3, 3) m^2, in W.
    """
    turned = rig.T_world_object[:3, :3]
    lever = (point - rig.T_world_object[:3, 3]) @ turned / TWIST_LEVER_M
    moved = turned @ np.hstack([np.eye(3), np.cross(np.eye(3), lever).T])
    return np.asarray(moved @ rig.object_covariance @ moved.T)


def _sides(procedure: Procedure, sampler: SiteSampler) -> list[SlowTouch]:
    """Slow touches of two sides from directions that are about perpendicular, or of one or none where no others can be
    reached: as tilted as possible, then where the object's place is known best.
    """
    rig = procedure.rig
    begin = np.degrees(np.arctan2(rig.T_world_object[1, 0], rig.T_world_object[0, 0]))
    turns = [(tilt, begin + turn) for tilt in SIDE_TILTS_DEG for turn in range(0, 360, SIDE_TURN_DEG)]
    ways = Rotation.from_euler("yz", turns, degrees=True).apply([0.0, 0.0, 1.0])
    tried = [_side(sampler.placed, way, rig.T_tool_camera) for way in ways]
    tried = [site for site in tried if is_above_table(site.T_w_t, sampler.limits)]
    tried.sort(key=lambda site: (round(-site.T_w_t[2, 2], 2), touch_tolerance(rig, site)))
    first = next(filter(None, (_slowed(procedure, "side", site) for site in tried)), None)
    if first is None:
        return []
    across = np.array([site.T_w_t[:2, 2] / np.linalg.norm(site.T_w_t[:2, 2]) for site in (first.site, *tried)])
    cosines = np.round(np.abs(across[1:] @ across[0]), 2)
    square = [tried[i] for i in np.argsort(cosines, kind="stable") if cosines[i] < MOST_SIDES_COSINE]
    second = next(filter(None, (_slowed(procedure, "side", site) for site in square)), None)
    return [first] if second is None else [first, second]


def _side(placed: Mesh, from_: Array, T_tool_camera: Array) -> Site:
    """Site where an object ends in a direction (3,). That side of the skin points up on which the camera is."""
    reach = placed.vertices @ from_
    point = placed.vertices[reach > reach.max() - SIDE_EDGE_M].mean(0)
    point += (reach.max() - point @ from_) * from_
    up = contact_frame(point, from_)[2, :2]
    quarters = round(2 / np.pi * float(np.arctan2(T_tool_camera[1, 3], T_tool_camera[0, 3])))
    return Site(0, contact_frame(point, from_, np.arctan2(up[1], up[0]) - quarters * np.pi / 2))


def _slowed(procedure: Procedure, name: str, site: Site, past: float | None = None) -> SlowTouch | None:
    """Slow touch of a site, which ends so far (m) past it, by default as far as its place may err and the skin gives:
    it is guarded from as high as box and arm allow, and presses from where others prepare. None where they allow none.
    """
    path, settings, limits = procedure.path, procedure.settings, procedure.rig.limits
    tolerance = touch_tolerance(procedure.rig, site)
    past = tolerance + FELT_WITHIN_M if past is None else past
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
        if not slowed.path.why_not(site, looks=False):
            return SlowTouch(name, site, tolerance, slowed)
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
    looks = [_look(procedure, sampler, site) for site in (*plan.looks, *plan.pair[1:])]
    wrong, missed = (float(np.mean(shares)) for shares in zip(*(look[:2] for look in looks), strict=True))
    if not wrong <= MAX_WRONG_SHARE:
        raise _seen_elsewhere("in the first looks", wrong, procedure, plan.looks[0])
    report(f"first looks: {100 * wrong:.0f} % of the object's pixels are not where the rig has them")
    if plan.pair:
        report(_compared(looks[plan.looks.index(plan.pair[0])], looks[-1]))
    else:
        report("first looks: none can be repeated with the tool turned, so that a TCP that is aside may go unnoticed")
    if not missed > MAX_WRONG_SHARE:
        report("first looks: they could not judge, as they would not miss the object; only the slow touches could")
    for touch in plan.touches:
        try:
            report(_touch(touch))
        except RigContradictedError:
            procedure.retreat()
            raise
        procedure.retreat()
    sides = len(plan.touches) - 1
    if sides < FIRST_SIDES:
        report(f"first touches: {sides} of {FIRST_SIDES} sides can be touched, so that what is aside may go unnoticed")


def depth_contradiction(
    depth: Array, expected: Array, on_object: Array, tolerance: float, radius: int
) -> tuple[float, float]:
    """Share of an object that is not seen where it should be.

    Args:
        depth: (h, w) m, as measured; NaN where nothing was.
        expected: (h, w) m, of the mesh where the rig has it.
        on_object: (h, w) which pixels show the object.
        tolerance: m, of depth.
        radius: Pixels, by which what is seen may be aside.

    Returns:
        The share of the object's pixels that were measured, and of those the share where what is measured is none of
        what is expected around, or what is expected none of what is measured around.
    """
    measured = on_object & np.isfinite(depth)
    if not measured.any():
        return 0.0, 1.0
    wrong = _unlike(depth, expected, tolerance, radius) | _unlike(expected, depth, tolerance, radius)
    return float(measured.sum() / on_object.sum()), float(wrong[measured].mean())


def _unlike(depth: Array, around: Array, tolerance: float, radius: int) -> np.ndarray:
    """Mask (h, w) of depths that lie outside the range of others around."""
    low = minimum_filter(np.where(np.isnan(around), np.inf, around), 2 * radius + 1)
    high = maximum_filter(np.where(np.isnan(around), -np.inf, around), 2 * radius + 1)
    return np.asarray(~((depth >= low - tolerance) & (depth <= high + tolerance)))


def expected_view(
    triangles: Array, site: Array, T_w_c: Array, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """View of an object that the camera should see around a site.

    Args:
        triangles: (n, 3 corners, 3) m, of the object in W.
        site: (3,) m, in W.
        T_w_c: (4, 4) of the camera.
        camera: Its size and lens, whose distortion is left out.

    Returns:
        Depth (h, w) m, which pixels (h, w) show the object within 40 mm of the site, and depth (h, w) m of the table.
    """
    pinhole = replace(camera, model=Distortion.NONE, coefficients=())
    depth, which = render_view(triangles, T_w_c, pinhole)
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones(depth.shape)], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        near = np.linalg.norm(depth[..., None] * rays - (site - T_w_c[:3, 3]) @ T_w_c[:3, :3], axis=-1) < LOOK_RADIUS_M
        table = -T_w_c[2, 3] / (rays @ T_w_c[2, :3])
    return depth, near & (which >= 0), np.where(table > 0, table, np.nan)


def _check_air(procedure: Procedure) -> None:
    state = procedure.arm.state()
    force = float(np.linalg.norm(state.wrench[:3]))
    if not (state.moving or force <= MAX_AIR_FORCE_N):
        raise RigContradictedError(
            f"the arm feels {force:.1f} N before anything is touched, as if {force / 9.81:.1f} kg were wrong: check "
            "tool.mass and tool.centre of the rig, or free the tool"
        )


def _look(procedure: Procedure, sampler: SiteSampler, site: Site) -> Look:
    """Look at a site; raises RigContradictedError."""
    procedure.move_above(procedure.path.poses(site)[0])
    procedure.clock.sleep(procedure.settings.settle)
    T_w_t = procedure.rig.T_world_base @ procedure.arm.state().T_b_t
    T_w_c = T_w_t @ procedure.rig.T_tool_camera
    view, camera = procedure.camera.capture(), procedure.camera.camera
    mesh, point = sampler.placed, site.T_w_t[:3, 3]
    expected, on_object, table = expected_view(mesh.vertices[mesh.faces], point, T_w_c, camera)
    if not on_object.any():
        raise RigContradictedError(f"the camera would not see site {site.number} at all; {CHECK_CAMERA}")
    tolerance = look_tolerance(procedure.rig, point)
    depth, middle = np.asarray(view.depth, float), float(np.median(expected[on_object]))
    within = tolerance, max(1, round(camera.fx * tolerance / middle))
    seen, wrong = depth_contradiction(depth, expected, on_object, *within)
    if not seen >= MIN_SEEN_SHARE:
        raise RigContradictedError(
            f"the camera measured {100 * seen:.0f} % of the pixels in which site {site.number} should be; is it "
            f"covered, shiny or too near? Else {CHECK_CAMERA}"
        )
    if not wrong <= CLEARLY_WRONG_SHARE:
        raise _seen_elsewhere(f"at site {site.number}", wrong, procedure, site)
    missed = depth_contradiction(table, expected, on_object, *within)[1]
    pixel = middle / camera.fx, middle / camera.fy
    shifts = matching_shifts(depth, np.fmin(expected, table), on_object, pixel, tolerance)
    return Look(wrong, missed, shifts @ T_w_c[:3, :3].T, T_w_t[:3, :3])


def _compared(first: Look, second: Look) -> str:
    """Compare a look with one for which the tool was turned; says what they tell, or raises RigContradictedError."""
    along, aside, unsure = camera_aside(first.shifts, second.shifts, (first.R_w_t, second.R_w_t))
    told = ~(unsure > ASIDE_TOLD_M)
    if not told.any():
        return "first looks: they could not tell whether the camera is aside"
    worst = int(np.argmax(np.abs(aside) * told))
    x, y = 1e3 * aside[worst] * along[worst]
    if not abs(aside[worst]) <= max(ASIDE_TOLERANCE_M, STANDARD_DEVIATIONS * CAMERA_STD_M):
        raise RigContradictedError(
            f"two looks at a site, with the tool turned in between, tell that the camera is off by {x:+.0f} and "
            f"{y:+.0f} mm along the tool's x and y; check T_flange_tool and T_tool_camera"
        )
    further = "" if told.all() else ", and maybe further in directions that they could not tell"
    return f"first looks: the camera is off by {x:+.1f} and {y:+.1f} mm along the tool's x and y{further}"


def look_tolerance(rig: Rig, point: Array) -> float:
    """Distance from where it should be, within which a look may see a point of the object.

    Args:
        rig: With the covariance of the object's pose.
        point: (3,) m, in W.

    Returns:
        m: three standard deviations of object and camera, at least 6 mm.
    """
    variance = np.linalg.eigvalsh(place_covariance(rig, point))[-1] + CAMERA_STD_M**2
    return max(DEPTH_TOLERANCE_M, STANDARD_DEVIATIONS * float(np.sqrt(variance)))


def _seen_elsewhere(where: str, share: float, procedure: Procedure, site: Site) -> RigContradictedError:
    tolerance = look_tolerance(procedure.rig, site.T_w_t[:3, 3])
    return RigContradictedError(
        f"{where} {100 * share:.0f} % of the object is seen more than {1e3 * tolerance:.0f} mm from where the rig has "
        f"it; {CHECK_CAMERA}"
    )


def _touch(touch: SlowTouch) -> str:
    """Touch a site slowly; says where it was met, or raises RigContradictedError."""
    name, site, tolerance, slow = touch
    settings, log = slow.settings, EventLog(BytesIO(), slow.clock)  # it is no touch of the set
    prepare = slow.path.poses(site)[1]
    slow.move_above(prepare)
    slow.clock.sleep(settings.settle)
    which, remedy = f"the slow touch of the {name}", "check T_flange_tool, T_world_base and T_world_object"
    try:
        slow.prepare(prepare, log)
    except TouchFailedError as error:
        raise RigContradictedError(f"{which}: {error}; {remedy}, and look what is in the way") from error
    press = slow.press(log)
    T_b_t, at_tool = press.states[-1].T_b_t, slow.skins[0]
    samples = press_samples(log, at_tool, press.period, T_b_t)
    into = onset_distance(*samples, press.ambient[TOOL], press.changes[TOOL])  # NaN where the skin felt too little
    late = press.result.distance - float(np.nan_to_num(into)) - settings.near
    if press.result.reason == "distance":
        raise RigContradictedError(
            f"{which} met nothing up to {1e3 * settings.overtravel:.0f} mm past where the rig has the object; {remedy}"
        )
    if not abs(late) <= tolerance:
        raise RigContradictedError(
            f"{which} met something {1e3 * abs(late):.0f} mm {'after' if late > 0 else 'before'} the object should "
            f"begin; {remedy}, and look what is in the way"
        )
    change, force = press.changes[TOOL], -float(press.states[-1].wrench[2])
    defect = press_defect(change, force)
    if defect:
        raise RigContradictedError(f"{slow.skins[0].skin.features.name}: {defect}")
    size = float(np.sqrt(np.nansum(change**2)))
    return f"{name}: met the object {1e3 * late:+.1f} mm from where the rig has it, {force:.1f} N, {size:.0f} uT"
