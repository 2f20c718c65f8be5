"""The simulated lab against closed forms, against the renderer, and against the physics that it tabulates."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.closed_form import DOWN, GAIN, HEIGHT, NOISY, QUIET, WALL
from helpers.spring_plane import SpringPlane
from scipy.spatial.transform import Rotation

from i2t.depth.camera import Camera
from i2t.emulators.in_process import TICK_S, SimulatedArm, SimulatedLab, SimulatedSkin, SkinInLab, VirtualClock
from i2t.emulators.scene import TABULATED_LOADS_N, ObjectScene, SkinContactModel, _meet
from i2t.geometry import transform
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.rig import Rig
from i2t.objects import catalogue
from i2t.simulation.depth_camera import render_view
from i2t.skin import boards
from i2t.skin.pad import nominal_pad

LENS = Camera(80, 60, 60.0, 61.0, 39.5, 29.5)
BOX = MotionLimits((0.2, -0.3, 0.0), (0.6, 0.3, 0.5))


@pytest.fixture(scope="module")
def scene():
    rig = Rig()
    pad = jax.jit(nominal_pad)()
    return ObjectScene(catalogue.make_object("dome").mesh, rig.T_base_world @ rig.T_world_object, pad, QUIET)


def pose(x, y, z, turned=DOWN):
    return transform(turned, np.array([x, y, z]))


def lab(errors=QUIET):
    return SimulatedLab(SpringPlane(HEIGHT, 10e3, GAIN, errors, boards.reskin_board()), VirtualClock(WALL))


@pytest.mark.full
def test_a_line_over_a_dome_follows_the_physics_between_its_loads(scene):
    """Down on a half ball of 30 mm: where it begins, and travel and reading at loads that are not tabulated. Between
    loads that grow by 1.85, straight pieces of a force that grows as travel to the power 1.5 are off by up to 4 %.
    """
    start = pose(0.4, 0.0, 0.07)
    line = scene.line_ahead(start)
    np.testing.assert_allclose(line.first, 0.07 - 0.03, atol=0.05e-3)  # chords of the mesh and cells of the grid
    T_o_t = jnp.asarray(np.linalg.inv(scene.T_b_o) @ start, jnp.float32)
    loads = TABULATED_LOADS_N * np.sqrt(TABULATED_LOADS_N[1] / TABULATED_LOADS_N[0])
    _, sunk, _, readings = _meet(scene._surface, T_o_t, scene.pad, jnp.asarray(loads, jnp.float32))
    for i in range(3, 11):
        force, centre, reading = line.contact_at(line.first + float(sunk[i]) + loads[i] / scene.stiffness)
        np.testing.assert_allclose(force, loads[i], rtol=0.05)
        np.testing.assert_allclose(reading, readings[i], atol=0.08 * np.linalg.norm(readings[i]))
        np.testing.assert_allclose(centre, 0, atol=0.1e-3)
    # A softer mount sinks by force through stiffness.
    hard, scene.stiffness = scene.stiffness, 2e3
    try:
        soft = scene.line_ahead(start)
    finally:
        scene.stiffness = hard
    np.testing.assert_allclose(soft.past_contact - line.past_contact, line.force * (1 / 2e3 - 1 / hard), atol=1e-9)


def stand(model, x, z, turned=DOWN):
    """Let a tool stand where it meets nothing."""
    for _ in range(10):
        assert not model(np.array([x, 0.0, z]), turned).any()


@pytest.mark.full
def test_there_is_no_contact_next_to_the_object_or_off_the_line(scene):
    line = scene.line_ahead(pose(0.5, 0.0, 0.07))
    assert line.first == np.inf
    assert line.contact_at(0.1)[0] == 0.0
    assert line.distance_along(np.array([0.5, 0.0, 0.05]), DOWN) == pytest.approx(0.02)
    assert line.distance_along(np.array([0.501, 0.0, 0.05]), DOWN) is None
    feeler = SkinContactModel(scene)
    for x in np.linspace(0.35, 0.45, 20):  # through the object, but never standing
        assert not feeler(np.array([x, 0.0, 0.01]), DOWN).any()


@pytest.mark.full
def test_contact_is_found_at_successive_poses_of_the_tool(scene):
    """On one line, of which 120 mm are known: from 130 mm above the object, then from 40 mm; and sideways, 10 mm above
    the table, first past the object and then in front of it.
    """
    model = SkinContactModel(scene)
    stand(model, 0.4, 0.16)
    stand(model, 0.4, 0.07)
    assert model(np.array([0.4, 0.0, 0.0297]), DOWN)[2] > 0.3
    model, sideways = (
        SkinContactModel(scene),
        np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    )  # tool z along the base's x
    stand(model, 0.46, 0.01, sideways)
    stand(model, 0.33, 0.01, sideways)
    assert np.linalg.norm(model(np.array([0.3725, 0.0, 0.01]), sideways)[:3]) > 0.3


@pytest.mark.full
def test_a_contact_model_in_a_thread_gives_the_same_contacts(scene):
    waits, threaded = SkinContactModel(scene), SkinContactModel(scene, wait=False)
    for model in (waits, threaded):
        stand(model, 0.4, 0.07)
    assert threaded._pending is not None
    threaded._pending.result()
    at = np.array([0.4, 0.0, 0.0297])
    np.testing.assert_allclose(threaded(at, DOWN), waits(at, DOWN), rtol=1e-5, atol=1e-7)
    assert waits(at, DOWN)[2] > 0.3
    np.testing.assert_allclose(threaded.reading, waits.reading, rtol=1e-4, atol=1e-4)


@pytest.mark.full
def test_force_off_the_middle_gives_a_torque(scene):
    """On the dome beside its top the contact lies off the tool's middle: torque is place x force."""
    feeler = SkinContactModel(scene)
    stand(feeler, 0.405, 0.07)
    wrench = feeler(np.array([0.405, 0.0, 0.029]), DOWN)
    assert wrench[2] > 0.3
    np.testing.assert_allclose(wrench[:2], 0, atol=1e-9)
    np.testing.assert_allclose(np.cross([-0.005, 0.0, 0.0], wrench[:3]), wrench[3:], atol=0.1 * wrench[2] * 5e-3)


def test_a_view_of_a_plane_follows_its_equation():
    """Any plane, any pose: every pixel that sees it measures where its ray meets it."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        turned = Rotation.from_rotvec(rng.normal(0, 0.15, 3)).as_matrix() @ DOWN
        T = pose(*rng.uniform(-0.05, 0.05, 2), 0.2, turned)
        corners = np.array([[-0.3, -0.25, 0], [0.3, -0.25, 0.05], [0, 0.3, -0.05]])
        depth, which = render_view(corners[None], T, LENS)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        v, u = np.indices(depth.shape)
        rays = np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones(depth.shape)], -1) @ T[:3, :3].T
        expected = (normal @ (corners[0] - T[:3, 3])) / (rays @ normal)
        assert (which == 0).mean() > 0.5
        np.testing.assert_allclose(depth[which == 0], expected[which == 0], rtol=1e-9)


def test_the_nearer_of_two_surfaces_is_seen_and_a_bent_lens_is_refused():
    near = np.array([[-0.01, -0.01, 0.1], [0.01, -0.01, 0.1], [0, 0.02, 0.1]])
    far = near * [40, 40, 1] - [0, 0, 0.1]
    for triangles in (np.stack([near, far]), np.stack([far, near])):
        depth, _ = render_view(triangles, pose(0, 0, 0.2), LENS)
        assert depth[30, 40] == pytest.approx(0.1)
        assert depth[10, 10] == pytest.approx(0.2)
    with pytest.raises(ValueError, match="lens"):
        render_view(near[None], pose(0, 0, 0.2), Camera(8, 8, 5.0, 5.0, 4.0, 4.0, "brown_conrady", (1.0,)))


def test_noise_at_rest_has_the_size_that_real_boards_have():
    inside = lab(NOISY)
    with SimulatedSkin(inside) as skin:
        samples = skin.read(4000)
    np.testing.assert_allclose(np.diff(samples.time), TICK_S, rtol=1e-6)
    # A slow field of a quarter of the variance is seen ten times over: one part in six of its size is not.
    spread = samples.reading.reshape(-1, 5, 3).std(axis=0).mean(axis=0)
    np.testing.assert_allclose(spread, [3.1, 3.1, 4.6], rtol=0.15)
    steps = samples.reading.reshape(-1, 5, 3) / [0.150, 0.150, 0.242]
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


def test_a_sample_is_the_nearest_count_of_the_converter():
    skin = SkinInLab(SpringPlane(HEIGHT, 10e3, GAIN, NOISY, boards.reskin_board()))
    skin.recording, skin._noise = True, [(np.zeros(15), np.zeros(5))]
    skin.measure(0.0, np.eye(3))
    exact = skin.contact_model.reading_at_rest(np.eye(3)) + skin.contact_model.reading
    assert (abs(skin.samples[0][2] - exact) <= np.tile([0.0751, 0.0751, 0.1211], 5)).all()


def test_a_late_arm_overshoots_by_its_latency():
    for latency in (0.0, 0.05):
        inside = lab()
        with SimulatedArm(inside, BOX, latency) as arm:
            arm.go(pose(0.4, 0.0, 0.035), 0.1, 0.5)
            inside.clock.sleep(0.05)
            pressed = arm.approach(0.02, 0.004, None, 8.0, 8.0, 0.2)
        late = latency + 3 * TICK_S  # it looks every third tick
        force = -pressed.state.wrench[2]
        assert pressed.reason == "force"
        assert 8.0 + 10e3 * 0.004 * latency <= force < 8.0 + 10e3 * (0.004 * (late + TICK_S) + 0.004**2 / 4) + 0.05


def test_an_arm_feels_contact_even_after_a_short_standstill():
    inside = lab()
    with SimulatedArm(inside, BOX) as arm:
        arm.go(pose(0.4, 0.0, 0.05))
        assert inside.skins[0].contact_model._line is None
        arm.go(pose(0.4, 0.0, HEIGHT - 0.5e-3), 0.05)
        np.testing.assert_allclose(arm.state().wrench, [0, 0, -5, 0, 0, 0], atol=1e-6)
