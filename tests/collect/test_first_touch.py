"""The first looks and slow touches accept a correct rig and contradict a wrong one in one sentence."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from helpers.closed_form import GAIN, HEIGHT, make, site
from scipy.spatial.transform import Rotation

from i2t.collect import first_touch as module
from i2t.collect.first_touch import (
    Look,
    RigContradictedError,
    check_rig_by_touch,
    depth_contradiction,
    plan_first_touch,
)
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import UnreachableError
from i2t.hardware.rig import Rig
from i2t.objects.solids import Mesh
from i2t.simulation.site_limits import SiteLimits
from tests.faults.rig import right_rig_refused, try_mistake, try_rig
from tests.faults.rig_mistakes import MISTAKES, WRONG_RIGS, right_rig

QUICK = TouchSettings(prepare=0.015, clearance=0.03, approach=0.04, settle=0.02)


class Block:
    """A sampler of sites on a block as high as the plane; its sides cannot be reached, like those of a plane."""

    limits = SiteLimits(clearance=0.1)

    def __init__(self, height=HEIGHT):
        self.top = self.height = height
        box = trimesh.creation.box(bounds=[[-0.03, -0.03, 0.0], [0.03, 0.03, height]])
        self.placed = Mesh(np.array(box.vertices), np.array(box.faces))

    def site(self, number):
        return site(number, x=2e-3 * (number % 5 - 2), y=2e-3 * (number // 5 % 5 - 2), height=self.height)


def _looked(site, missed):
    """A look at a site that contradicts nothing and shows no shift."""
    shifts = 12e-3 * np.array([[x, y, 0.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    return Look(0.0, missed, shifts, site.T_w_t[:3, :3])


def test_a_right_rig_passes_with_a_report():
    procedure, sentences = make(settings=QUICK), []
    check_rig_by_touch(procedure, Block(), sentences.append)
    assert "0 % of the object's pixels" in sentences[0]
    assert [line.split(": met the object ")[0] for line in sentences[1:]] == [
        "first looks: the lateral offset of the camera could not be measured",
        "top",
        "first touches: 0 of 2 sides can be touched; a lateral error may go unnoticed",
    ]
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.029  # it has retreated


@pytest.mark.parametrize("off", [0.010, -0.010])
def test_a_displaced_view_is_refused_before_anything_is_touched(off):
    procedure = make(settings=QUICK)
    # The eye always sees something at 104 mm, so that the view is judged where the rig looks from.
    procedure.rig.__dict__["looking_distance"] = 0.104 + off
    with pytest.raises(RigContradictedError, match="is seen more than 6 mm from where the rig has it"):
        check_rig_by_touch(procedure, Block(HEIGHT + off))


@pytest.mark.parametrize(("off", "gain", "sentence"), [
    (0.010, GAIN, "met nothing up to 5 mm past"),
    (-0.018, GAIN, "something was met 16 mm before"),
    (0.0, 0 * GAIN, r"a press of \d\.\d N changed its reading by 0\.0 uT"),
])  # fmt: skip
def test_a_displaced_or_undetected_contact_is_refused_and_the_tool_retreats(monkeypatch, off, gain, sentence):
    procedure, sampler = make(gain=gain, settings=QUICK), Block()
    monkeypatch.setattr(module, "_look", lambda *given: _looked(given[-1], 1.0))
    sampler.height = HEIGHT + off
    with pytest.raises(RigContradictedError, match=sentence):
        check_rig_by_touch(procedure, sampler, str)
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.029


def test_a_wrong_payload_and_unreachable_sites_are_refused_before_any_motion():
    procedure, sampler = make(settings=QUICK), Block()
    begun = procedure.clock.now()
    sampler.height = 2.0
    with pytest.raises(UnreachableError, match="none of 32 sites"):
        check_rig_by_touch(procedure, sampler)
    procedure.arm.lab.robot.external_wrench = np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])
    with pytest.raises(RigContradictedError, match=r"9\.8 N before anything is touched, as if 1\.0 kg of payload"):
        check_rig_by_touch(procedure, Block())
    limits = replace(procedure.rig.limits, approach_distance=QUICK.prepare + 1e-3)
    procedure.rig = replace(procedure.rig, limits=limits)
    with pytest.raises(UnreachableError, match=r"at none of 32; lower settings.prepare, or pass --skip-first-touch"):
        plan_first_touch(procedure, Block())
    assert procedure.clock.now() == begun


def _unsure():
    """A procedure whose rig gives its object's position with an error of 5 mm."""
    procedure = make(settings=QUICK)
    covariance = np.diag(np.r_[np.full(3, 5e-3**2), np.full(3, 1e-8)])
    procedure.rig = replace(procedure.rig, object_covariance=covariance)
    return procedure


def _slow_settings(procedure, sampler):
    return plan_first_touch(procedure, sampler).touches[0].procedure.settings


def test_the_slow_touch_goes_as_far_as_the_object_s_position_is_uncertain():
    procedure, sampler = _unsure(), Block()
    assert _slow_settings(procedure, sampler).overtravel == pytest.approx(16e-3, abs=1e-5)
    sampler.height = HEIGHT + 0.012  # the plane is met 12 mm past where the sites are
    sentence = module._touch(plan_first_touch(procedure, sampler).touches[0])
    late = float(re.search(r"met the object ([+-][\d.]+) mm", sentence)[1])
    assert late == pytest.approx(12, abs=0.1)  # what the skin gives until it is felt is left out


def test_the_slow_touch_stays_within_reach():
    """An arm that plans checks both ends of the line; if it forbids them, the touch begins and ends nearer."""
    procedure = _unsure()
    lowest, highest, asked = HEIGHT - 7e-3, HEIGHT + 16e-3, []

    def too_low(goals):
        asked.extend(goal[2, 3] for goal in goals)
        return "too low" if min(goal[2, 3] for goal in goals) < lowest else ""

    procedure.arm.why_unreachable = too_low
    slow = _slow_settings(procedure, Block())
    assert slow.overtravel == QUICK.overtravel
    assert min(asked) == pytest.approx(HEIGHT - 16e-3, abs=1e-5)
    assert slow.prepare > highest - HEIGHT
    # Not to the place above that where it prepares: it begins at the latter.
    procedure.arm.why_unreachable = lambda goals: "turned" if goals[-2][2, 3] > highest else ""
    slow = _slow_settings(procedure, Block())
    assert slow.overtravel == pytest.approx(16e-3, abs=1e-5)
    assert slow.prepare == QUICK.prepare
    # Nor where the box ends in the object.
    procedure.arm.why_unreachable = lambda goals: ""
    limits = procedure.rig.limits
    shallow = replace(limits, lower=(*limits.lower[:2], HEIGHT - 8e-3))
    procedure.rig = replace(procedure.rig, limits=shallow)
    assert _slow_settings(procedure, Block()).overtravel == QUICK.overtravel


def _turn(pair):
    """Degrees by which the tool turns about its own axis between a site and the turned site."""
    site, turned = (pose.T_w_t for pose in pair)
    np.testing.assert_allclose(site[:3, 2:], turned[:3, 2:], atol=1e-12)
    return Rotation.from_matrix(site[:3, :3].T @ turned[:3, :3]).as_euler("zyx", degrees=True)[0]


def test_one_look_is_repeated_with_the_largest_reachable_turn():
    procedure, sampler = make(settings=QUICK), Block()
    plan = plan_first_touch(procedure, sampler)
    assert plan.pair[0] is plan.looks[0]
    assert abs(_turn(plan.pair)) == pytest.approx(180)
    # The tool's x points along W's x at the sites; it may not point away from it, then not anywhere else.
    procedure.arm.why_unreachable = lambda goals: "wound up" if goals[0][0, 0] < -0.6 else ""
    assert _turn(plan_first_touch(procedure, sampler).pair) == pytest.approx(120)
    procedure.arm.why_unreachable = lambda goals: "wound up" if goals[0][0, 0] < 0.6 else ""
    assert plan_first_touch(procedure, sampler).pair == ()
    sentences = []
    check_rig_by_touch(procedure, sampler, sentences.append)
    assert "none can be repeated with the tool turned" in sentences[1]


@pytest.mark.parametrize(("off", "unsure", "sentence"), [
    (4.4e-3, 0.0, r"the camera is off by [+-]0\.0 and \+4\.4 mm along .* within the tolerance of 4\.5 mm$"),
    (-4.6e-3, 3.9e-3, "refused"),
    (9e-3, 12e-3, "possibly further in directions that could not be measured"),
    (np.nan, 0.0, "refused"),
])  # fmt: skip
def test_an_offset_of_the_camera_is_separated_from_one_of_the_object(off, unsure, sentence):
    moved, turns = np.array([9e-3, 2e-3, 0.0]), (np.eye(3), np.diag([-1.0, -1.0, 1.0]))
    aside = np.array([[0.0, off - unsure, 0.0], [0.0, off + unsure, 0.0]])
    looks = [Look(0.0, 1.0, moved - aside @ turn.T, turn) for turn in turns]
    if sentence == "refused":
        with pytest.raises(RigContradictedError, match="check T_flange_tool and T_tool_camera"):
            module._compare_looks(*looks)
    else:
        assert re.search(sentence, module._compare_looks(*looks))


def test_sides_are_touched_from_perpendicular_directions_with_the_camera_above():
    procedure, sampler = make(settings=QUICK), Block()
    sampler.limits = SiteLimits()
    procedure.rig = replace(procedure.rig, T_tool_camera=right_rig().T_tool_camera)
    top, *sides = plan_first_touch(procedure, sampler).touches
    assert top.name == "top"
    axes = np.array([side.site.T_w_t[:3, 2] for side in sides])
    assert axes[:, 2] == pytest.approx([-0.5, -0.5])
    assert axes[0, :2] @ axes[1, :2] == pytest.approx(0.0, abs=1e-6)
    for side in sides:  # the object begins at the face of the skin, and nothing of it is before
        ahead = (sampler.placed.vertices - side.site.T_w_t[:3, 3]) @ side.site.T_w_t[:3, 2]
        assert ahead.min() == pytest.approx(0.0, abs=1e-9)
        assert (side.site.T_w_t @ procedure.rig.T_tool_camera)[2, 3] > side.site.T_w_t[2, 3] + 0.06


def test_a_flat_object_has_no_sides_and_its_looks_prove_nothing(monkeypatch):
    procedure, sampler, sentences = make(settings=QUICK), Block(), []
    flat = Mesh(sampler.placed.vertices * np.array([1.0, 1.0, 0.1]), sampler.placed.faces)
    sampler.limits, sampler.placed = SiteLimits(), flat
    monkeypatch.setattr(module, "_look", lambda *given: _looked(given[-1], 0.0))
    check_rig_by_touch(procedure, sampler, sentences.append)
    assert "are inconclusive" in sentences[2]
    assert "0 of 2 sides can be touched" in sentences[-1]


def test_the_covariance_of_a_point_follows_from_that_of_the_pose():
    far = np.array([0.1, 0.0, 0.0])
    turned = np.array([0.0, 0.1 * np.radians(1), 0.1 * np.radians(1)])
    np.testing.assert_allclose(module.place_covariance(Rig(), far), np.diag(1e-6 + turned**2), atol=1e-12)
    assert module.look_tolerance(Rig(), np.zeros(3)) == 6e-3
    assert module.look_tolerance(Rig(), far) == pytest.approx(3 * np.sqrt(1e-6 + 1.5e-3**2 + turned[1] ** 2))


def test_the_expected_view_is_the_block_s_top_above_the_table():
    mesh, camera = Block().placed, right_rig().camera
    T_w_c = np.diag([1.0, -1.0, -1.0, 1.0])
    T_w_c[2, 3] = HEIGHT + 0.1
    view = module.expected_view(mesh.vertices[mesh.faces], np.array([0.0, 0.0, HEIGHT]), T_w_c, camera)
    depth, on_object, table = view
    np.testing.assert_allclose(depth[on_object], 0.1)
    np.testing.assert_allclose(table, HEIGHT + 0.1)
    radius = np.sqrt(on_object.sum() * 0.1**2 / camera.fx / camera.fy)
    assert 0.05 < radius < 0.061  # a square of 60 mm without its corners, which are 42 mm away
    within = 6e-3, 3
    assert depth_contradiction(depth, depth, on_object, *within) == (1.0, 0.0)
    assert depth_contradiction(np.full_like(depth, np.nan), depth, on_object, *within) == (0.0, 1.0)
    assert depth_contradiction(depth + 0.01, depth, on_object, *within) == (1.0, 1.0)
    assert depth_contradiction(table, depth, on_object, *within) == (1.0, 1.0)


@pytest.mark.parametrize(("aside", "wrong"), [(0, 0.0), (6, 0.0), (8, 1.0)])
def test_a_thin_wall_is_displaced_by_at_most_the_radius(aside, wrong):
    expected = np.full((20, 60), 0.16)
    expected[:, 30:33] = 0.1
    seen = np.roll(expected, aside, axis=1)
    seen[5:9] = np.nan  # a hole
    fractions = depth_contradiction(seen, expected, expected < 0.15, 6e-3, 5)
    assert fractions == (0.8, pytest.approx(wrong, abs=0.34 * (aside == 6)))


@pytest.mark.full
@pytest.mark.parametrize("number", [6, 8, 12])
def test_right_rigs_over_thin_small_and_shiny_objects_pass(number):
    assert not right_rig_refused(number)["refused"]


@pytest.mark.full
@pytest.mark.parametrize(("what", "place", "sentence"), [
    *(("object 7 mm aside", place, "slow touch of the side met") for place in (0, 1)),
    *(("TCP 7 mm aside", place, "two looks at a site") for place in (0, 2)),
])  # fmt: skip
def test_a_displaced_object_is_found_at_a_side_and_a_displaced_tcp_by_the_rotated_look(what, place, sentence):
    aside = [wrong for wrong in WRONG_RIGS if what in wrong[0].name]
    assert sentence in try_mistake(*aside[place]).sentence


@pytest.mark.full
def test_nine_of_ten_plausible_mistakes_are_refused_or_shown_and_right_rigs_pass():
    """A sixth of the list is tried, in labs with the usual errors."""
    tried = MISTAKES[1::6]
    accepted = [mistake.name for mistake in tried if try_mistake(mistake, "star").where == "accepted"]
    assert len(accepted) <= len(tried) * 5 / 53
    assert "TCP 50 mm too long" not in accepted
    assert [try_rig(right_rig(), name).where for name in ("star", "hammer")] == ["accepted", "accepted"]
