"""The procedure on a springy plane, on which all measurements are known in closed form."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import closed_form
from helpers.closed_form import DOWN, GAIN, HEIGHT, NOISY, listed, make, site
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from i2t.collect.settings import TouchSettings
from i2t.collect.stopping import StopCondition, onset_distance
from i2t.collect.touch import MissedContactError, SkinOnTool, TouchFailedError, UnreachableError
from i2t.emulators.in_process import SLOW_FIELD_S, TICK_S
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.contract import refuse
from i2t.hardware.protocols import ArmState, Samples
from i2t.hardware.rig import Rig
from i2t.skin import boards
from i2t.types import ReturnCode
from tests.faults.closed_form import MemoryLog

READINGS = len(GAIN)


class Memory:
    """Keeps touches in memory."""

    def __init__(self):
        self.saved, self.abandoned, self.log = [], [], MemoryLog()

    def begin(self, site, attempt):
        self.log = MemoryLog()
        return self.log

    def save(self, touched):
        self.saved.append(touched)

    def abandon(self, reason):
        self.abandoned.append(reason)


def pressed(*sites, **options):
    """The procedure, the outcomes of the sites, and the saved touches."""
    procedure, memory = make(**options), Memory()
    return procedure, list(procedure.run(listed(*(sites or (site(0),))), memory)), memory


def goals_of(procedure):
    """The poses to which the arm is sent."""
    goals, go = [], procedure.arm.go
    procedure.arm.go = lambda goal, *motion: goals.append(goal.copy()) or go(goal, *motion)
    return goals


def overshoot(settings, stiffness, latency=0.03, brake=2.0):
    """Force (N) of a press past its limit: k (v t + v^2 / 2 a), with t the latency, one look and the mean of ten
    samples.
    """
    late = latency + 7.5e-3 + 2.5e-3 * settings.averaged_samples
    return stiffness * (settings.press * late + settings.press**2 / 2 / brake)


def test_a_press_stops_by_the_skin_and_measures_the_spring_along_its_normal():
    settings = TouchSettings()
    for turned in (DOWN, Rotation.from_euler("x", 30, degrees=True).as_matrix() @ DOWN):
        procedure, (outcome,), memory = pressed(site(0, turned=turned))
        (touched,) = memory.saved
        assert outcome.code == touched.code == ReturnCode.SKIN
        enough = settings.skin_change / np.linalg.norm(GAIN)  # N
        assert enough < touched.force < enough + overshoot(settings, 10e3)
        np.testing.assert_allclose(touched.reading, touched.force * GAIN, rtol=1e-3)
        np.testing.assert_allclose(touched.travel, touched.force / 10e3, atol=5e-6)  # a line is exact on a spring
        along = (touched.T_w_t[:3, 3] - [0, 0, HEIGHT]) @ turned[:, 2]
        np.testing.assert_allclose(along, touched.force / 10e3, atol=1e-9)
        np.testing.assert_allclose(touched.T_w_t[:3, :3], turned, atol=1e-9)
        view_from = [0, 0, HEIGHT] - procedure.rig.looking_distance * turned[:, 2]
        np.testing.assert_allclose(touched.T_w_c[:3, 3], view_from, atol=1e-9)
        assert [text for _, text in memory.log.events[:4]] == ["look", "prepare", "ambient", "press"]
        assert len(memory.log.readings[""]) > 400 * settings.near / settings.press  # the whole press, at 400 Hz


def test_a_press_without_an_object_has_no_contact():
    procedure, (outcome,), memory = pressed(site(0, height=HEIGHT + 0.02))
    touched = memory.saved[0]
    assert outcome.code == ReturnCode.AIR
    assert np.isnan(touched.travel)
    np.testing.assert_allclose(touched.T_w_t[2, 3], HEIGHT + 0.02 - procedure.settings.overtravel, atol=1e-9)
    assert abs(touched.force) < 1e-9


def test_an_unexpected_contact_fails_and_is_repeated():
    procedure, memory = make(settings=TouchSettings(failures=2)), Memory()
    procedure.extract_patch = lambda *view: closed_form.extract_patch(*view, nearest=0.0)  # the camera does not see it
    with pytest.raises(DeviceError, match="2 sites in a row"):
        list(procedure.run(listed(*(site(i, height=HEIGHT - 0.01) for i in range(3))), memory))
    assert not memory.saved
    assert len(memory.abandoned) == 2 * 3
    assert all("was met" in reason for reason in memory.abandoned)
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.09  # it withdrew
    assert np.linalg.norm(procedure.arm.state().wrench[:3]) == 0


def test_the_camera_can_refuse_a_site():
    procedure = make()
    for seen, sentence in (({"nearest": -0.02}, "register"), ({"visible_share": 0.2}, "20 %")):
        procedure.extract_patch = partial(closed_form.extract_patch, **seen)
        refuse(TouchFailedError, [(procedure.touch, (site(0), MemoryLog()), sentence)])


def test_sites_outside_the_box_are_skipped_without_motion_or_failure():
    procedure, outcomes, _ = pressed(site(7, x=0.3), site(8), site(7, x=0.3), settings=TouchSettings(failures=1))
    assert [outcome.code for outcome in outcomes] == [ReturnCode.FAILED, ReturnCode.SKIN, ReturnCode.FAILED]
    assert [outcome.reachable for outcome in outcomes] == [False, True, False]
    assert "outside the box" in outcomes[0].reason
    with pytest.raises(UnreachableError, match="outside the box"):
        procedure.path.check(site(7, x=0.3))


def test_every_pose_stays_in_the_box_above_the_object_and_histories_hold_no_images():
    """This holds even if the transfer height is as high as the box allows."""
    procedure, memory = make(), Memory()
    procedure.top = procedure.rig.limits.upper[2] - procedure.settings.clearance
    goals, histories = goals_of(procedure), []
    sites = [site(0), site(1, 0.02, 0.03), site(2, -0.03, 0)]

    def choose(history):
        histories.append(list(history))
        return sites[len(history)] if len(history) < len(sites) else None

    list(procedure.run(choose, memory))
    assert all(procedure.rig.limits.contains(goal[:3, 3]) for goal in goals)
    across = np.linalg.norm(np.diff([goal[:2, 3] for goal in goals], axis=0), axis=1) > 1e-6
    heights = np.array([goal[2, 3] for goal in goals])
    np.testing.assert_allclose(heights[1:][across], procedure.top + procedure.settings.clearance)
    assert [len(history) for history in histories] == [0, 1, 2, 3]
    last = histories[-1][0].touch
    assert last.camera_view is None
    np.testing.assert_array_equal(last.reading, memory.saved[0].reading)


def test_a_skin_that_falls_silent_stops_the_press_and_is_connected_again():
    procedure, memory = make(), Memory()
    skin, calls = procedure.skins[0].skin, []
    since = skin.since

    def failing(number):
        calls.append(number)
        if len(calls) == 300:
            raise DeviceTimeoutError("the skin has been silent")
        return since(number)

    skin.since = failing
    (outcome,) = procedure.run(listed(site(0)), memory)
    assert outcome.code == ReturnCode.SKIN
    assert memory.abandoned == ["the skin has been silent"]
    assert memory.saved[0].attempt == 1


def test_an_unplugged_camera_is_reconnected_until_patience_ends():
    procedure, memory = make(settings=TouchSettings(patience=2.0)), Memory()
    procedure.camera.trouble = DeviceError("eye is gone")
    begun = procedure.clock.now()
    with pytest.raises(DeviceError, match="eye is gone"):
        list(procedure.run(listed(site(0)), memory))
    assert 2.0 < procedure.clock.now() - begun < 10.0
    assert procedure.camera.connects > 5
    assert memory.abandoned == ["eye is gone"]


@pytest.mark.parametrize("errors", [closed_form.QUIET, NOISY], ids=["frozen", "alive"])
def test_a_press_with_a_frozen_skin_fails(errors):
    """The frozen skin is a simulated one without noise that reports itself as emulated."""
    procedure = make(errors=errors, gain=np.zeros(READINGS))
    skin = procedure.skins[0].skin
    skin._features = skin.features._replace(source="emulated")
    if errors is NOISY:
        touched = procedure.touch(site(0), MemoryLog())
        assert touched.code == ReturnCode.WRENCH  # a skin that feels nothing leaves it to the force
        assert 0 < touched.force - procedure.settings.force < overshoot(procedure.settings, 10e3) < 2.0
        return
    with pytest.raises(DeviceError, match=r"did not change once in 48 samples: it is frozen"):
        procedure.touch(site(0), MemoryLog())


def stops(batches, board, ambient):
    """Whether the procedure's own stop condition stops a press on samples (looks, 10, channels), one batch for each
    look.
    """
    looks = iter(range(len(batches)))

    def samples(number):
        count = np.arange(10) + 10 * number
        return Samples(count, 2.5e-3 * count, batches[number], np.zeros((10, board.num_chips)))

    skin = SimpleNamespace(latest=lambda timeout: samples(0), since=lambda number: samples(next(looks)))
    condition = StopCondition(
        [SkinOnTool("", skin, board)], TouchSettings(), {"": ambient}, MemoryLog(), lambda state: None
    )
    state = ArmState(0.0, np.eye(4), np.zeros(6), np.zeros(6), np.zeros(6), True, True)
    return any(condition(state) is not None for _ in batches)


@pytest.mark.full
def test_noise_alone_crosses_the_limit_and_stops_no_press_in_a_thousand():
    """Pure noise of real size, 4000 s of it: a slow common field crosses the paper's limit, but differs nowhere. Only
    presses in which it does are replayed, sample by sample, through the stop condition: no other can be stopped.
    """
    rng = np.random.default_rng(0)
    noise, board, settings = NOISY.noise, boards.reskin_board(), TouchSettings()
    presses, looks, mean_of, channels = 1000, 160, settings.averaged_samples, board.num_readings
    kept = np.exp(-TICK_S * mean_of / SLOW_FIELD_S)
    size = np.sqrt(noise.common) * np.array([noise.xy, noise.xy, noise.z])
    white_sigma = noise.sigma(board.num_chips) * np.sqrt(1 - noise.common)
    crossed = stopped = 0
    for _ in range(presses):
        news = rng.standard_normal((looks, 3))
        start = kept * rng.standard_normal((1, 3))
        slow = size * lfilter([np.sqrt(1 - kept**2)], [1, -kept], news, axis=0, zi=start)[0]
        white = white_sigma * rng.standard_normal((looks, mean_of, channels))
        batches = board.to_board(np.repeat(slow[:, None], board.num_chips, axis=1))[:, None] + white
        change = batches.mean(axis=1) - batches[0].mean(axis=0)
        if (np.linalg.norm(change, axis=1) > settings.skin_change).any():
            crossed += 1
            stopped += stops(batches, board, batches[0].mean(axis=0))
    assert crossed > 0
    assert stopped == 0


def test_the_stop_condition_ignores_a_field_that_all_chips_share():
    board = boards.reskin_board()
    rest, ambient = np.zeros((3, 10, 15)), np.zeros(15)
    common = board.to_board(np.tile([0.0, 0.0, 40.0], (5, 1)))
    contact = np.zeros(15)
    contact[2] = 30.0
    for change, stopped in (
        (0, False),
        (common, False),
        (contact, True),
        (common + contact, True),
        (contact / 2, False),
    ):
        assert stops(rest + change, board, ambient) == stopped


def test_an_object_too_high_for_the_box_is_refused_and_nothing_moves():
    """A transfer height that the box does not allow is not replaced by a lower one."""
    procedure, memory = make(), Memory()
    procedure.top = procedure.rig.limits.upper[2] - procedure.settings.clearance + 0.001
    before = procedure.arm.state().T_b_t
    motions = [
        (lambda: list(procedure.run(listed(site(0)), memory)), ()),
        (procedure.path.check, (site(0),)),
        (procedure.retreat, ()),
        (procedure.move_above, procedure.path.poses(site(0))[:1]),
    ]
    refuse(UnreachableError, [(*motion, "raise the box") for motion in motions])
    np.testing.assert_array_equal(procedure.arm.state().T_b_t, before)
    assert not memory.log.events


@pytest.mark.parametrize(("bad", "sentence"), [
    *(({name: value}, "limit") for name, value in
      (("speed", 0.26), ("retreat", 0.3), ("acceleration", 0.6), ("force", 31.0), ("torque", 11.0), ("prepare", 0.2))),
    ({"approach": 0.1}, "approach is 0.1 m/s: a motion that is stopped at 8 N would end at 73 N"),
    ({"press": 0.05}, "press is 0.05 m/s"),
    ({"force": 29.9}, "above the rig's limit, 30 N"),
])  # fmt: skip
def test_settings_beyond_the_limits_are_refused_before_any_motion(bad, sentence):
    procedure = make(settings=TouchSettings(**bad), rig=Rig())
    begun = procedure.clock.now()
    with pytest.raises(ValueError, match=sentence):
        list(procedure.run(listed(site(0)), Memory()))
    assert procedure.clock.now() == begun


def test_a_press_without_contact_where_the_camera_sees_a_surface_ends_the_run():
    """An arm and a skin that measure nothing pass through what the camera sees."""
    procedure, memory = make(stiffness=1e-6, gain=np.zeros(READINGS)), Memory()
    with pytest.raises(MissedContactError, match=r"surface 6\.0 mm before its end"):
        list(procedure.run(listed(site(0), site(1)), memory))
    assert not memory.saved
    assert len(memory.abandoned) == 1 + procedure.settings.retries
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.09  # it has retreated


def test_a_tool_outside_its_box_is_not_moved():
    procedure = make()
    procedure.arm.lab.robot.position = np.array([0.4, 0.0, procedure.rig.limits.lower[2] - 0.05])
    with pytest.raises(DeviceError, match="outside its box"):
        procedure.retreat()
    assert not procedure.arm.state().moving


@pytest.mark.parametrize("tilt_deg", [30.0, 85.0, 120.0])
def test_at_the_edge_of_the_box_a_skin_is_lifted_if_it_faces_down_and_stays_if_it_faces_up(tilt_deg):
    """It gets no deeper into what it pressed, and the tool never leaves the box. Its axis is so far (degrees) from
    straight down, and the box ends behind it.
    """
    procedure = make(stiffness=100.0)
    robot, limits, goals = procedure.arm.lab.robot, procedure.rig.limits, goals_of(procedure)
    axis = np.array([-np.sin(np.radians(tilt_deg)), 0.0, -np.cos(np.radians(tilt_deg))])
    y = np.array([0.0, -1.0, 0.0])
    robot.rotation = np.stack([np.cross(y, axis), y, axis], axis=1)
    robot.position = np.array([limits.upper[0], 0.0, limits.lower[2] + 1e-3])
    start = procedure.arm.state().T_b_t
    if tilt_deg > 90:
        with pytest.raises(DeviceError, match=r"the skin faces up .* bring it back with the pendant"):
            procedure.retreat()
        np.testing.assert_array_equal(procedure.arm.state().T_b_t, start)
        return
    procedure.retreat()
    assert robot.position[2] >= procedure.path.transfer_height() - 1e-3
    along = [(goal[:3, 3] - start[:3, 3]) @ start[:3, 2] for goal in goals]
    assert all(np.diff([0.0, *along]) <= 1e-9)
    assert all(limits.contains(goal[:3, 3]) for goal in goals)


def test_onset_is_exact_for_a_line_and_a_fifth_short_for_a_ball():
    before = np.linspace(3e-3, 0, 800)
    sunk = np.maximum(0, 0.4e-3 - before)
    for power, short in ((1.0, 0.0), (1.5, 0.2)):
        rows = (sunk / 0.4e-3)[:, None] ** power * GAIN
        distance = onset_distance(rows, before, np.zeros(READINGS), GAIN)
        assert abs(distance - (1 - short) * 0.4e-3) < 0.02e-3 + 0.02 * short * 1e-3
    for rows in (0, 5):
        assert np.isnan(onset_distance(np.zeros((rows, READINGS)), np.zeros(rows), np.zeros(READINGS), GAIN))


@pytest.mark.full
def test_noise_of_real_size_leaves_depth_within_a_twentieth_of_a_millimetre():
    travels = []
    for seed in range(5):
        _, _, memory = pressed(errors=NOISY, seed=seed)
        touched = memory.saved[0]
        travels.append(touched.travel - (HEIGHT - touched.T_w_t[2, 3]))
    assert np.sqrt(np.mean(np.square(travels))) < 0.05e-3
