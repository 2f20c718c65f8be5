"""Check of the rig against camera, arm and skin, before the first touch of a session.

    air       The arm's force in the air, before anything is zeroed. It shows a wrong payload.
    looks     The camera looks at some sites. Near each, the depth must be that of the mesh at its pose in the rig. One
              look is repeated with the tool turned, which shows a lateral offset of the camera
              (`i2t.collect.camera_offset`).
    touches   Slow presses with lighter limits than other presses, guarded from as far as box and arm allow: one of the
              site that points up most, then two of sides, with a tilted tool, which meets a displaced object early or
              late. Each must meet the object at its pose in the rig, and the skin must feel it.

A pixel contradicts the rig if no surface within the tolerance of it, in any direction, has the expected depth. A
slightly displaced surface is therefore accepted, even if it is thin. A side is touched where the object ends in the
direction from which the tool comes, so that no other part of the object is in the tool's way. Presses along the tool's
axis do not show an offset of the skin across it. The repeated look does, unless T_tool_camera was measured with the
wrong T_flange_tool, so that both errors cancel.

A contradiction of the rig is reported in one sentence, and nothing else is touched. The check is skipped for a camera
that shows recorded views.

Frames: W world, B robot base, T tool, C camera; metres, newtons, microtesla.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from io import BytesIO
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter
from scipy.spatial.transform import Rotation

from i2t.collect.camera_offset import lateral_offset, matching_shifts
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import EventLog
from i2t.collect.site_plan import SiteSampler
from i2t.collect.stopping import onset_distance, press_samples
from i2t.collect.touch import TOOL, Site, TouchFailedError, UnreachableError
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

# Remedy if the camera's depth contradicts the object's registered pose.
CHECK_CAMERA_ADVICE = "check T_tool_camera, T_flange_tool and the camera's lens, and register the object (i2t place)"


@dataclass(frozen=True)
class FirstTouchConfig:
    """Options of the looks and slow touches that check a rig before the first press: their number, the choice of sites,
    tolerances (m), force (N) and speed (m/s).
    """

    num_candidates: int = 32  # number of candidate sites for the first looks and touches
    num_looks: int = 3
    num_sides: int = 2
    num_standard_deviations: float = 3.0  # largest deviation of a correct rig, in standard deviations
    # Looks.
    look_radius: float = 40e-3  # m, radius around a site within which depth is compared
    min_depth_tolerance: float = 6e-3  # m, smallest tolerance of a depth
    # Standard deviation (m) of the camera's line of sight: 1 mm of position, and half a degree seen from 120 mm.
    camera_std: float = 1.5e-3
    # largest fraction of pixels, over all looks together, that may contradict the rig
    max_wrong_pixel_fraction: float = 0.1
    # largest fraction of pixels of a single look that may contradict the rig
    max_wrong_pixel_fraction_of_look: float = 0.3
    min_measured_pixel_fraction: float = 0.3  # smallest fraction of the object's pixels that must have a depth
    min_offset_tolerance: float = 4e-3  # m, smallest tolerance of the camera's lateral offset
    # m, largest uncertainty of the lateral offset along a direction; beyond it the offset is unknown
    max_offset_uncertainty: float = 4e-3
    # Turns of the tool for the repeated look; the first that can be reached is used.
    turns_deg: tuple[float, ...] = (180, 120, -120, 90, -90)
    # Slow touches.
    min_touch_tolerance: float = 4e-3  # m, smallest tolerance of the contact's position
    max_onset_travel: float = 1e-3  # m past first contact, travel within which a press must be detected
    # tilts (degrees) of the tool for a touch of a side, tried in this order
    side_tilts_deg: tuple[float, ...] = (60.0, 45.0)
    side_step_deg: int = 15  # angle (degrees) between successive sides that are tried
    side_edge: float = 0.5e-3  # m, distance within which several corners of a mesh are touched at once
    max_side_cosine: float = 0.5  # largest cosine of the angle between the directions of two sides
    # duration (s) of the samples that are averaged into a reading, of which there are at most `max_samples`
    averaging_s: float = 0.5
    max_samples: int = 200
    force: float = 3.0  # N, force that ends a slow touch, above the error of a UR's sensor in motion
    speed: float = 5e-3  # m/s, speed of a slow touch
    # m before a site, largest distance at which a slow touch may start: the limit of `TouchSettings.prepare`
    max_prepare: float = 0.3
    # N in the air before the sensor is zeroed; a larger force is a payload that is wrong by 0.3 kg. A UR5e's data sheet
    # states an accuracy of 4 N and a precision of 3.5 N over its whole range. An arm that stands still in the air is
    # expected to be better; that was not measured.
    max_air_force: float = 3.0


_FIRST_TOUCH = FirstTouchConfig()  # choice and tolerances of the first looks and slow touches of a session


class RigContradictedError(DeviceError):
    """What the camera, arm or skin measured contradicts the poses in the rig."""


class SlowTouch(NamedTuple):
    """A planned slow touch that checks the rig: its site, the distance (m) from the site within which the tool must
    meet the object, and the procedure with slow settings.
    """

    name: str
    site: Site
    tolerance: float  # m, distance from the site within which the tool must meet the object
    procedure: Procedure  # procedure whose settings are those of slow touches


class FirstTouchPlan(NamedTuple):
    """Sites to look at and touch slowly to check a rig. The site that points up most is touched first, then up to two
    sides. One site is looked at again with the tool turned about its axis, if that pose can be reached.
    """

    looks: tuple[Site, ...]
    pair: tuple[Site, ...]  # a site, and the same site with the tool turned; empty if none can be reached
    touches: tuple[SlowTouch, ...]


class Look(NamedTuple):
    """Comparison of one depth view of an object with the view that the rig predicts: fractions of contradicting pixels,
    and the shifts (m) of the expected view that explain the measured one.
    """

    wrong: float  # fraction of the object's pixels that contradict the rig
    missed: float  # fraction of the object's pixels that would contradict the rig if there were no object
    shifts: Array  # (n, 3) m, shifts in W of the expected view that explain the measured view
    R_w_t: Array  # (3, 3) rotation of the tool in W


def plan_first_touch(procedure: Procedure, sampler: SiteSampler) -> FirstTouchPlan:
    """Choose the sites to look at and touch slowly: one that points up, others far from it, and two sides.

    A touch goes as far past its site as the object's position is uncertain, if the arm's box and reach allow that. If
    they do not for any site that points up, that touch ends where a press of the collection would.

    Args:
        procedure: The touch procedure, whose path determines which sites can be reached.
        sampler: Source of the sites to touch.

    Returns:
        The looks and slow touches, in their order.

    Raises:
        UnreachableError: If no site can be reached, or touched slowly in one motion.
    """
    path, candidates = procedure.path, [sampler.site(number) for number in range(_FIRST_TOUCH.num_candidates)]
    refused = [path.explain_unreachable(site) for site in candidates]
    sites = [site for site, why in zip(candidates, refused, strict=True) if not why]
    if not sites:
        raise UnreachableError(
            f"none of {_FIRST_TOUCH.num_candidates} sites can be reached, the last not because {refused[-1]}"
        )
    places = np.array([site.T_w_t[:3, 3] for site in sites])
    up = np.array([-site.T_w_t[2, 2] for site in sites])
    centre = places[:, :2].mean(0)
    best_first = np.argsort(-(np.round(up, 2) - np.linalg.norm(places[:, :2] - centre, axis=1)), kind="stable")
    nearest = procedure.settings.overtravel
    touches = ((i, _plan_slow_touch(procedure, "top", sites[i], past)) for past in (None, nearest) for i in best_first)
    first, top = next(((i, touch) for i, touch in touches if touch is not None), (0, None))
    if top is None:
        raise UnreachableError(
            f"a slow touch, from {1e3 * procedure.settings.prepare:.0f} mm before a site to {1e3 * nearest:.0f} mm "
            f"past it, can be made at none of {len(sites)}; lower settings.prepare, or pass --skip-first-touch"
        )
    chosen = [first]
    while len(chosen) < min(_FIRST_TOUCH.num_looks, len(sites)):
        distances = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(1)
        chosen.append(int(np.argmax(distances)))
    looks = tuple(sites[i] for i in chosen)
    return FirstTouchPlan(looks, _turned_pair(procedure, looks), (top, *_sides(procedure, sampler)))


def _turned_pair(procedure: Procedure, looks: tuple[Site, ...]) -> tuple[Site, ...]:
    """Choose a site and the same with the tool turned by the first of the angles that can be reached, if any."""
    for turn in _FIRST_TOUCH.turns_deg:
        T_t_turned = transform(Rotation.from_euler("z", turn, degrees=True).as_matrix(), np.zeros(3))
        for site in looks:
            turned = site._replace(T_w_t=site.T_w_t @ T_t_turned)
            if not procedure.path.explain_unreachable(turned):
                return site, turned
    return ()


def touch_tolerance(rig: Rig, site: Site) -> float:
    """Compute the distance from a site within which a slow touch of it must meet the object.

    Args:
        rig: The rig, with the covariance of the object's pose.
        site: The site that is touched.

    Returns:
        Distance (m): three standard deviations of the object's position along the touch, and at least 4 mm.
    """
    along = site.T_w_t[:3, 2]
    variance = float(along @ place_covariance(rig, site.T_w_t[:3, 3]) @ along)
    return max(_FIRST_TOUCH.min_touch_tolerance, _FIRST_TOUCH.num_standard_deviations * float(np.sqrt(variance)))


def place_covariance(rig: Rig, point: Array) -> np.ndarray:
    """Compute the covariance of the position of a point on the object from the rig's covariance of the object's pose.

    Args:
        rig: The rig, with that covariance.
        point: Position (m) of the point in W.

    Returns:
        `(3, 3)` covariance (m^2) in W.
    """
    turned = rig.T_world_object[:3, :3]
    lever = (point - rig.T_world_object[:3, 3]) @ turned / TWIST_LEVER_M
    moved = turned @ np.hstack([np.eye(3), np.cross(np.eye(3), lever).T])
    return np.asarray(moved @ rig.object_covariance @ moved.T)


def _sides(procedure: Procedure, sampler: SiteSampler) -> list[SlowTouch]:
    """Plan slow touches of two sides whose directions are about perpendicular, or of one or none if no others can be
    reached.

    The most tilted sides come first, and among these the ones where the object's position is least uncertain.
    """
    rig = procedure.rig
    yaw = np.degrees(np.arctan2(rig.T_world_object[1, 0], rig.T_world_object[0, 0]))
    turns = [
        (tilt, yaw + turn) for tilt in _FIRST_TOUCH.side_tilts_deg for turn in range(0, 360, _FIRST_TOUCH.side_step_deg)
    ]
    directions = Rotation.from_euler("yz", turns, degrees=True).apply([0.0, 0.0, 1.0])
    sites = [_side(sampler.placed, direction, rig.T_tool_camera) for direction in directions]
    sites = [site for site in sites if is_above_table(site.T_w_t, sampler.limits)]
    sites.sort(key=lambda site: (round(-site.T_w_t[2, 2], 2), touch_tolerance(rig, site)))
    first = next(filter(None, (_plan_slow_touch(procedure, "side", site) for site in sites)), None)
    if first is None:
        return []
    across = np.array([site.T_w_t[:2, 2] / np.linalg.norm(site.T_w_t[:2, 2]) for site in (first.site, *sites)])
    cosines = np.round(np.abs(across[1:] @ across[0]), 2)
    perpendicular = [sites[i] for i in np.argsort(cosines, kind="stable") if cosines[i] < _FIRST_TOUCH.max_side_cosine]
    second = next(filter(None, (_plan_slow_touch(procedure, "side", site) for site in perpendicular)), None)
    return [first] if second is None else [first, second]


def _side(placed: Mesh, from_: Array, T_tool_camera: Array) -> Site:
    """Find the site where an object ends in a direction (3,). The skin is rolled so that its camera is on the upper
    side.
    """
    reach = placed.vertices @ from_
    point = placed.vertices[reach > reach.max() - _FIRST_TOUCH.side_edge].mean(0)
    point += (reach.max() - point @ from_) * from_
    up = contact_frame(point, from_)[2, :2]
    quarters = round(2 / np.pi * float(np.arctan2(T_tool_camera[1, 3], T_tool_camera[0, 3])))
    return Site(0, contact_frame(point, from_, np.arctan2(up[1], up[0]) - quarters * np.pi / 2))


def _plan_slow_touch(procedure: Procedure, name: str, site: Site, past: float | None = None) -> SlowTouch | None:
    """Plan a slow touch of a site that ends at a distance (m) past it, or return None if box and arm allow none.

    By default it ends as far past the site as its position is uncertain and the skin yields. It is guarded from as high
    as box and arm allow, and presses from the pose at which other touches prepare.
    """
    path, settings, limits = procedure.path, procedure.settings, procedure.rig.limits
    tolerance = touch_tolerance(procedure.rig, site)
    past = tolerance + _FIRST_TOUCH.max_onset_travel if past is None else past
    if not settings.prepare + past <= limits.approach_distance:
        return None
    prepare = path.poses(site)[1]
    upright = max(-float(prepare[2, 2]), 0.1)  # cosine of the tool's tilt
    room = min((path.transfer_height() - prepare[2, 3]) / upright, limits.approach_distance, _FIRST_TOUCH.max_prepare)
    count = int(
        np.clip(
            _FIRST_TOUCH.averaging_s * procedure.skins[0].skin.features.rate, settings.ambient, _FIRST_TOUCH.max_samples
        )
    )
    for part in (1.0, 0.5, 0.0):
        slow = replace(
            settings,
            prepare=min(settings.prepare + part * max(room, 0.0), _FIRST_TOUCH.max_prepare),
            near=settings.prepare,
            overtravel=past,
            press=min(_FIRST_TOUCH.speed, settings.approach),
            force=_FIRST_TOUCH.force,
            ambient=count,
            contact=count,
        )
        slowed = replace(procedure, settings=slow)
        if not slowed.path.explain_unreachable(site, looks=False):
            return SlowTouch(name, site, tolerance, slowed)
    return None


def check_rig_by_touch(procedure: Procedure, sampler: SiteSampler, report: Callable[[str], None] = print) -> None:
    """Check the rig by looking at some sites and touching up to three slowly; the tool ends above everything.

    Args:
        procedure: The touch procedure, with connected devices.
        sampler: Source of the sites to touch.
        report: Function that receives each result as a sentence.

    Raises:
        RigContradictedError: If camera, arm or skin contradict the rig, or the skin feels nothing.
        DeviceError: If a device fails.
        ValueError: If the settings exceed the arm's limits; nothing has moved then.
    """
    procedure.path.check_settings()
    plan = plan_first_touch(procedure, sampler)
    _check_air(procedure)
    procedure.retreat()
    looks = [_look(procedure, sampler, site) for site in (*plan.looks, *plan.pair[1:])]
    wrong, missed = (float(np.mean(shares)) for shares in zip(*(look[:2] for look in looks), strict=True))
    if not wrong <= _FIRST_TOUCH.max_wrong_pixel_fraction:
        raise _displaced_error("in the first looks", wrong, procedure, plan.looks[0])
    report(f"first looks: {100 * wrong:.0f} % of the object's pixels are not at their place in the rig")
    if plan.pair:
        report(_compare_looks(looks[plan.looks.index(plan.pair[0])], looks[-1]))
    else:
        report("first looks: none can be repeated with the tool turned; a lateral error of the TCP may go unnoticed")
    if not missed > _FIRST_TOUCH.max_wrong_pixel_fraction:
        report(
            "first looks: they are inconclusive, because they would look alike without the object; the slow touches "
            "decide"
        )
    for touch in plan.touches:
        try:
            report(_touch(touch))
        except RigContradictedError:
            procedure.retreat()
            raise
        procedure.retreat()
    sides = len(plan.touches) - 1
    if sides < _FIRST_TOUCH.num_sides:
        report(
            f"first touches: {sides} of {_FIRST_TOUCH.num_sides} sides can be touched; a lateral error may go unnoticed"
        )


def depth_contradiction(
    depth: Array, expected: Array, on_object: Array, tolerance: float, radius: int
) -> tuple[float, float]:
    """Compute the fraction of an object that a depth image does not show where it should be.

    Args:
        depth: `(h, w)` measured depth (m); NaN where nothing was measured.
        expected: `(h, w)` depth (m) of the mesh at its pose in the rig.
        on_object: `(h, w)` mask of the pixels that show the object.
        tolerance: Largest difference (m) of depth that is no contradiction.
        radius: Number of pixels by which a surface may be displaced in the image.

    Returns:
        Fraction of the object's pixels that were measured, and the fraction of these that contradict: the measured
        depth is outside the range of the expected depths around it, or the expected depth outside that of the measured
        ones.
    """
    measured = on_object & np.isfinite(depth)
    if not measured.any():
        return 0.0, 1.0
    wrong = _out_of_range(depth, expected, tolerance, radius) | _out_of_range(expected, depth, tolerance, radius)
    return float(measured.sum() / on_object.sum()), float(wrong[measured].mean())


def _out_of_range(depth: Array, around: Array, tolerance: float, radius: int) -> np.ndarray:
    """Compute the mask (h, w) of depths outside the range of the other depths around them."""
    low = minimum_filter(np.where(np.isnan(around), np.inf, around), 2 * radius + 1)
    high = maximum_filter(np.where(np.isnan(around), -np.inf, around), 2 * radius + 1)
    return np.asarray(~((depth >= low - tolerance) & (depth <= high + tolerance)))


def expected_view(
    triangles: Array, site: Array, T_w_c: Array, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render the view of an object that the camera should see around a site.

    Args:
        triangles: `(n, 3 corners, 3)` triangles (m) of the object in W.
        site: `(3,)` position (m) of the site in W.
        T_w_c: `(4, 4)` pose of the camera in W.
        camera: Image size and lens of the camera; its distortion is ignored.

    Returns:
        `(h, w)` depth (m), `(h, w)` mask of the pixels that show the object within 40 mm of the site, and `(h, w)`
        depth (m) of the table, also where the object hides it; NaN above the horizon.
    """
    pinhole = replace(camera, model=Distortion.NONE, coefficients=())
    depth, which = render_view(triangles, T_w_c, pinhole)
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    rays = np.stack([*np.meshgrid(x, y), np.ones(depth.shape)], axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        near = (
            np.linalg.norm(depth[..., None] * rays - (site - T_w_c[:3, 3]) @ T_w_c[:3, :3], axis=-1)
            < _FIRST_TOUCH.look_radius
        )
        table = -T_w_c[2, 3] / (rays @ T_w_c[2, :3])
    return depth, near & (which >= 0), np.where(table > 0, table, np.nan)


def _check_air(procedure: Procedure) -> None:
    state = procedure.arm.state()
    force = float(np.linalg.norm(state.wrench[:3]))
    if not (state.moving or force <= _FIRST_TOUCH.max_air_force):
        raise RigContradictedError(
            f"the arm measures {force:.1f} N before anything is touched, as if {force / 9.81:.1f} kg of payload "
            "were missing or too much: check tool.mass and tool.centre of the rig, or free the tool"
        )


def _look(procedure: Procedure, sampler: SiteSampler, site: Site) -> Look:
    """Look at a site. Raise RigContradictedError if the view contradicts the rig."""
    procedure.move_above(procedure.path.poses(site)[0])
    procedure.clock.sleep(procedure.settings.settle)
    T_w_t = procedure.rig.T_world_base @ procedure.arm.state().T_b_t
    T_w_c = T_w_t @ procedure.rig.T_tool_camera
    view, camera = procedure.camera.capture(), procedure.camera.camera
    mesh, point = sampler.placed, site.T_w_t[:3, 3]
    expected, on_object, table = expected_view(mesh.vertices[mesh.faces], point, T_w_c, camera)
    if not on_object.any():
        raise RigContradictedError(f"the camera would not see site {site.number} at all; {CHECK_CAMERA_ADVICE}")
    tolerance = look_tolerance(procedure.rig, point)
    depth, middle = np.asarray(view.depth, float), float(np.median(expected[on_object]))
    within = tolerance, max(1, round(camera.fx * tolerance / middle))
    seen, wrong = depth_contradiction(depth, expected, on_object, *within)
    if not seen >= _FIRST_TOUCH.min_measured_pixel_fraction:
        raise RigContradictedError(
            f"the camera measured {100 * seen:.0f} % of the pixels where site {site.number} should be; check whether "
            f"it is covered, shiny or too near, and {CHECK_CAMERA_ADVICE}"
        )
    if not wrong <= _FIRST_TOUCH.max_wrong_pixel_fraction_of_look:
        raise _displaced_error(f"at site {site.number}", wrong, procedure, site)
    missed = depth_contradiction(table, expected, on_object, *within)[1]
    pixel = middle / camera.fx, middle / camera.fy
    shifts = matching_shifts(depth, np.fmin(expected, table), on_object, pixel, tolerance)
    return Look(wrong, missed, shifts @ T_w_c[:3, :3].T, T_w_t[:3, :3])


def _compare_looks(first: Look, second: Look) -> str:
    """Compare a look with one for which the tool was turned. Return a sentence, or raise RigContradictedError."""
    along, offset, uncertainty = lateral_offset(first.shifts, second.shifts, (first.R_w_t, second.R_w_t))
    measured = ~(uncertainty > _FIRST_TOUCH.max_offset_uncertainty)
    if not measured.any():
        return "first looks: the lateral offset of the camera could not be measured"
    worst = int(np.argmax(np.abs(offset) * measured))
    x, y = 1e3 * offset[worst] * along[worst]
    tolerance = max(_FIRST_TOUCH.min_offset_tolerance, _FIRST_TOUCH.num_standard_deviations * _FIRST_TOUCH.camera_std)
    if not abs(offset[worst]) <= tolerance:
        raise RigContradictedError(
            f"two looks at a site, with the tool turned in between, show that the camera is off by {x:+.0f} and "
            f"{y:+.0f} mm along the tool's x and y; check T_flange_tool and T_tool_camera"
        )
    further = "" if measured.all() else ", and possibly further in directions that could not be measured"
    return (
        f"first looks: the camera is off by {x:+.1f} and {y:+.1f} mm along the tool's x and y, within the tolerance of "
        f"{1e3 * tolerance:.1f} mm{further}"
    )


def look_tolerance(rig: Rig, point: Array) -> float:
    """Compute how far from its expected position the camera may see a point of the object.

    Args:
        rig: The rig, with the covariance of the object's pose.
        point: `(3,)` position (m) of the point in W.

    Returns:
        Distance (m): three standard deviations of object and camera together, and at least 6 mm.
    """
    variance = np.linalg.eigvalsh(place_covariance(rig, point))[-1] + _FIRST_TOUCH.camera_std**2
    return max(_FIRST_TOUCH.min_depth_tolerance, _FIRST_TOUCH.num_standard_deviations * float(np.sqrt(variance)))


def _displaced_error(where: str, share: float, procedure: Procedure, site: Site) -> RigContradictedError:
    tolerance = look_tolerance(procedure.rig, site.T_w_t[:3, 3])
    return RigContradictedError(
        f"{where} {100 * share:.0f} % of the object is seen more than {1e3 * tolerance:.0f} mm from where the rig has "
        f"it; {CHECK_CAMERA_ADVICE}"
    )


def _touch(touch: SlowTouch) -> str:
    """Touch a site slowly. Return a sentence on where it was met, or raise RigContradictedError."""
    name, site, tolerance, slow = touch
    settings = slow.settings
    log = EventLog(BytesIO(), slow.clock)  # in memory, because the touch is not part of the data set
    prepare = slow.path.poses(site)[1]
    slow.move_above(prepare)
    slow.clock.sleep(settings.settle)
    which, remedy = f"the slow touch of the {name}", "check T_flange_tool, T_world_base and T_world_object"
    try:
        slow.prepare(prepare, log)
    except TouchFailedError as error:
        raise RigContradictedError(f"{which}: {error}; {remedy}, and look for obstacles") from error
    press = slow.press(log)
    T_b_t, at_tool = press.states[-1].T_b_t, slow.skins[0]
    samples = press_samples(log, at_tool, press.period, T_b_t)
    into = onset_distance(*samples, press.ambient[TOOL], press.changes[TOOL])  # NaN where the skin felt too little
    offset = press.result.distance - float(np.nan_to_num(into)) - settings.near
    if press.result.reason == "distance":
        raise RigContradictedError(
            f"{which} met nothing up to {1e3 * settings.overtravel:.0f} mm past the object's surface in the rig; "
            f"{remedy}"
        )
    if not abs(offset) <= tolerance:
        raise RigContradictedError(
            f"{which} met something {1e3 * abs(offset):.0f} mm {'after' if offset > 0 else 'before'} the object's "
            f"surface in the rig; {remedy}, and look for obstacles"
        )
    change, force = press.changes[TOOL], -float(press.states[-1].wrench[2])
    defect = press_defect(change, force)
    if defect:
        raise RigContradictedError(f"{slow.skins[0].skin.features.name}: {defect}")
    size = float(np.sqrt(np.nansum(change**2)))
    return (
        f"{name}: met the object {1e3 * offset:+.1f} mm from its pose in the rig, within the tolerance of "
        f"{1e3 * tolerance:.1f} mm, at {force:.1f} N and {size:.0f} uT"
    )
