"""The procedure on a springy plane, where everything that it should measure is known in closed form."""

import subprocess
import sys
from dataclasses import fields

import numpy as np
import pytest
from helpers import closed_form
from helpers.closed_form import DOWN, GAIN, HEIGHT, NOISY, make, names, site
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from i2t import dataset
from i2t.collect.recorder import Recorder
from i2t.collect.settings import SETTING_RANGES, TouchSettings
from i2t.collect.stopping import SkinStopCondition, StopRule, nonuniform_field, onset_distance
from i2t.collect.touch import MissedContactError, SiteOutcome, TouchFailedError, UnreachableError
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.protocols import ArmState, Samples
from i2t.skin import boards
from i2t.types import ReturnCode

READINGS = len(GAIN)


class Memory:
    """Keeps touches in memory."""

    def __init__(self):
        self.saved, self.abandoned, self.events, self.rows, self.states = [], [], [], [], []

    def begin(self, site, attempt):
        self.events = []
        return self

    def save(self, touched):
        self.saved.append(touched)

    def abandon(self, reason):
        self.abandoned.append(reason)

    def samples(self, samples):
        self.rows.extend(zip(samples.number.tolist(), samples.time.tolist(), strict=True))

    def state(self, state):
        self.states.append(state)

    def event(self, text):
        self.events.append(text)


def listed(*sites):
    """Chooses these sites."""
    return lambda history: sites[len(history)] if len(history) < len(sites) else None


def overshoot(settings, stiffness, latency=0.03, brake=2.0):
    """N that a press runs past its limit: k (v t + v^2 / 2 a), t the latency, one look and the mean of ten samples."""
    late = latency + 7.5e-3 + 2.5e-3 * settings.averaged_samples
    return stiffness * (settings.press * late + settings.press**2 / 2 / brake)


@pytest.mark.full
def test_a_press_stops_by_the_skin_and_measures_the_spring():
    procedure, memory = make(), Memory()
    settings = procedure.settings
    (outcome,) = procedure.run(listed(site(0)), memory)
    touched = memory.saved[0]
    assert outcome.code == touched.code == ReturnCode.SKIN
    enough = settings.skin_change / np.linalg.norm(GAIN)  # N
    assert enough < touched.force < enough + overshoot(settings, 10e3)
    np.testing.assert_allclose(touched.reading, touched.force * GAIN, rtol=1e-3)
    np.testing.assert_allclose(touched.depth, touched.force / 10e3, atol=5e-6)  # a line is exact on a spring
    np.testing.assert_allclose(HEIGHT - touched.T_w_t[2, 3], touched.force / 10e3, atol=1e-9)
    np.testing.assert_allclose(touched.seen.nearest, -touched.force / 10e3, atol=1e-9)
    np.testing.assert_allclose(touched.T_w_c[2, 3], HEIGHT + procedure.rig.looking_distance, atol=1e-9)
    assert memory.events[:4] == ["look", "prepare", "ambient", "press"]
    numbers = sorted({number for number, _ in memory.rows})
    assert len(numbers) > 400 * settings.near / settings.press  # the whole press, at 400 Hz


@pytest.mark.full
@pytest.mark.parametrize(("stiffness", "press"), [(2e3, 2e-3), (10e3, 2e-3), (10e3, 4e-3), (20e3, 1e-3)])
def test_a_skin_that_feels_nothing_leaves_it_to_the_force(stiffness, press):
    settings = TouchSettings(press=press)
    procedure, memory = make(stiffness, gain=np.zeros(READINGS), settings=settings), Memory()
    (outcome,) = procedure.run(listed(site(0)), memory)
    assert outcome.code == ReturnCode.WRENCH
    assert outcome.reason == "force"
    assert settings.force < memory.saved[0].force < settings.force + overshoot(settings, stiffness)


def test_defaults_keep_within_two_newtons_of_the_limit():
    assert overshoot(TouchSettings(), 10e3) < 2.0


@pytest.mark.full
def test_air_is_met_where_nothing_is():
    procedure, memory = make(), Memory()
    (outcome,) = procedure.run(listed(site(0, height=HEIGHT + 0.02)), memory)
    touched = memory.saved[0]
    assert outcome.code == ReturnCode.AIR
    assert np.isnan(touched.depth)
    np.testing.assert_allclose(touched.T_w_t[2, 3], HEIGHT + 0.02 - procedure.settings.overtravel, atol=1e-9)
    assert abs(touched.force) < 1e-9


def test_a_press_on_a_slope_goes_along_its_normal():
    turned = Rotation.from_euler("x", 30, degrees=True).as_matrix() @ DOWN
    procedure, memory = make(), Memory()
    list(procedure.run(listed(site(0, turned=turned)), memory))
    touched = memory.saved[0]
    along = (touched.T_w_t[:3, 3] - [0, 0, HEIGHT]) @ turned[:, 2]
    np.testing.assert_allclose(along, touched.force / 10e3, atol=1e-9)
    np.testing.assert_allclose(touched.T_w_t[:3, :3], turned, atol=1e-9)


def test_what_was_not_expected_fails_and_is_tried_again():
    procedure, memory = make(), Memory()
    procedure.settings = TouchSettings(failures=2)
    procedure.extract_patch = lambda *view: closed_form.extract_patch(*view, nearest=0.0)  # the camera does not see it
    with pytest.raises(DeviceError, match="2 sites in a row"):
        list(procedure.run(listed(*(site(i, height=HEIGHT - 0.01) for i in range(3))), memory))
    assert not memory.saved
    assert len(memory.abandoned) == 2 * 3
    assert all("was met" in reason for reason in memory.abandoned)
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.09  # it withdrew
    assert np.linalg.norm(procedure.arm.state().wrench[:3]) == 0


def test_the_camera_can_refuse_a_site():
    procedure, memory = make(), Memory()
    for seen, said in (({"nearest": -0.02}, "register"), ({"visible_share": 0.2}, "20 %")):
        procedure.extract_patch = lambda *view, seen=seen: closed_form.extract_patch(*view, **seen)
        with pytest.raises(TouchFailedError, match=said):
            procedure.touch(site(0), memory)


@pytest.mark.full
def test_places_outside_the_box_are_remembered_and_cost_no_motion():
    procedure, memory = make(), Memory()
    procedure.settings = TouchSettings(failures=1)
    begun = procedure.clock.now()
    outcomes = list(procedure.run(listed(site(7, x=0.3), site(8), site(7, x=0.3)), memory))
    assert [outcome.code for outcome in outcomes] == [ReturnCode.FAILED, ReturnCode.SKIN, ReturnCode.FAILED]
    assert list(procedure.unreachable) == [7]
    assert "outside the box" in procedure.unreachable[7]
    assert begun < procedure.clock.now()
    with pytest.raises(UnreachableError):
        procedure.path.check(site(7))


@pytest.mark.full
def test_every_pose_on_the_way_stays_in_the_box_and_above_the_object():
    procedure, memory = make(), Memory()
    seen = []
    go = procedure.arm.go
    procedure.arm.go = lambda goal, *how: seen.append(goal) or go(goal, *how)
    list(procedure.run(listed(*(site(i, x, y) for i, (x, y) in enumerate([(0, 0), (0.02, 0.03), (-0.03, 0)]))), memory))
    assert len(memory.saved) == 3
    for goal in seen:
        assert procedure.rig.limits.contains(goal[:3, 3])
    steps = np.diff([goal[:3, 3] for goal in seen], axis=0)
    across = np.linalg.norm(steps[:, :2], axis=1) > 1e-6
    heights = np.array([goal[2, 3] for goal in seen])
    assert (heights[1:][across] >= HEIGHT + procedure.settings.clearance - 1e-9).all()


def test_a_skin_that_falls_silent_stops_the_press_and_is_connected_again():
    procedure, memory = make(), Memory()
    skin, recording = procedure.skin, procedure.skin.since
    calls = []

    def failing(number):
        calls.append(number)
        if len(calls) == 300:
            raise DeviceTimeoutError("the skin has been silent")
        return recording(number)

    skin.since = failing
    (outcome,) = procedure.run(listed(site(0)), memory)
    assert outcome.code == ReturnCode.SKIN
    assert memory.abandoned == ["the skin has been silent"]
    assert memory.saved[0].attempt == 1


def test_a_camera_that_is_unplugged_is_waited_for_and_then_a_person_is_asked():
    procedure, memory = make(settings=TouchSettings(patience=2.0)), Memory()
    procedure.camera.trouble = DeviceError("eye is gone")
    begun = procedure.clock.now()
    with pytest.raises(DeviceError, match="eye is gone"):
        list(procedure.run(listed(site(0)), memory))
    assert 2.0 < procedure.clock.now() - begun < 10.0
    assert procedure.camera.connects > 5
    assert memory.abandoned == ["eye is gone"]


class Batches:
    """A skin that gives its samples ten at a time, one batch for each look."""

    features = counters = connect = close = read = __enter__ = __exit__ = print  # never called

    def __init__(self, batches):
        self.batches, self.given = batches, 0

    def _samples(self, number):
        rows = self.batches[number]
        count = np.arange(len(rows)) + number * len(rows)
        return Samples(count, 2.5e-3 * count, rows, np.zeros((len(rows), rows.shape[1] // 3)))

    def latest(self, timeout=0.4):
        return self._samples(0)

    def since(self, number):
        self.given += 1
        return self._samples(self.given - 1)


def stops(batches, board, ambient):
    """Whether the procedure's own stop condition stops a press on these batches of samples (looks, 10, channels)."""
    settings, skin = TouchSettings(), Batches(batches)
    rule = StopRule(settings.skin_change, settings.nonuniform_share, settings.averaged_samples, settings.silence)
    condition = SkinStopCondition(skin, board, rule, ambient, Memory())
    state = ArmState(0.0, np.eye(4), np.zeros(6), np.zeros(6), np.zeros(6), True, True)
    return any(condition(state) is not None for _ in batches)


def test_noise_alone_crosses_the_limit_and_stops_no_press_in_a_thousand():
    """Pure noise of real size, 4000 s of it: a slow common field crosses the paper's limit, but differs nowhere. Only
    presses in which it does are replayed, sample by sample, through the stop condition: no other can be stopped.
    """
    from i2t.emulators.in_process import SLOW_FIELD_S, TICK_S

    rng = np.random.default_rng(0)
    noise, board, settings = NOISY.noise, boards.reskin_board(), TouchSettings()
    presses, looks, mean_of, channels = 1000, 160, settings.averaged_samples, board.num_readings
    kept = np.exp(-TICK_S * mean_of / SLOW_FIELD_S)
    size = np.sqrt(noise.common) * np.array([noise.xy, noise.xy, noise.z])
    crossed = stopped = 0
    for _ in range(presses):
        news = rng.standard_normal((looks, 3))
        slow = (
            size * lfilter([np.sqrt(1 - kept**2)], [1, -kept], news, axis=0, zi=kept * rng.standard_normal((1, 3)))[0]
        )
        white = (
            noise.sigma(board.num_chips) * np.sqrt(1 - noise.common) * rng.standard_normal((looks, mean_of, channels))
        )
        batches = board.to_board(np.repeat(slow[:, None], board.num_chips, axis=1))[:, None] + white
        change = batches.mean(axis=1) - batches[0].mean(axis=0)
        if (np.linalg.norm(change, axis=1) > settings.skin_change).any():
            crossed += 1
            stopped += stops(batches, board, batches[0].mean(axis=0))
    assert crossed > 0
    assert stopped == 0


def test_the_stop_condition_stops_on_what_differs_and_not_on_what_all_chips_see():
    board = boards.reskin_board()
    rest, ambient = np.zeros((3, 10, 15)), np.zeros(15)
    common = board.to_board(np.tile([0.0, 0.0, 40.0], (5, 1)))
    contact = np.zeros(15)
    contact[2] = 30.0
    assert not stops(rest, board, ambient)
    assert not stops(rest + common, board, ambient)
    assert stops(rest + contact, board, ambient)
    assert stops(rest + common + contact, board, ambient)
    assert not stops(rest + 0.5 * contact, board, ambient)


@pytest.mark.full
@pytest.mark.parametrize("board", [boards.grid_board(2, 2), boards.grid_board(4, 4)])
def test_any_board_presses_and_is_written_and_read_back(tmp_path, board):
    procedure = make(gain=np.linspace(-9, 12, board.num_readings), board=board)
    with Recorder(tmp_path, names(procedure), procedure.clock) as recording:
        (outcome,) = procedure.run(listed(site(0)), recording)
    assert outcome.code == ReturnCode.SKIN
    record = dataset.read_touch(recording.saved[0])
    np.testing.assert_allclose(record.touch.touches.reading[0], outcome.touch.reading, rtol=1e-6)
    assert record.touch.touches.reading.shape == (1, board.num_readings)
    assert record.series["tactile"].values.shape[1] == board.num_readings
    assert record.series["temperature"].values.shape[1] == board.num_chips
    np.testing.assert_allclose(record.touch.board.chips, board.chips)


def test_an_object_too_high_for_the_box_is_refused_and_nothing_moves():
    """A way across at a height that the box does not allow is not made at a lower one."""
    procedure, memory = make(), Memory()
    procedure.top = procedure.rig.limits.upper[2] - procedure.settings.clearance + 0.001
    before = procedure.arm.state().T_b_t
    with pytest.raises(UnreachableError, match="raise the box"):
        list(procedure.run(listed(site(0)), memory))
    with pytest.raises(UnreachableError, match="raise the box"):
        procedure.path.check(site(0))
    for motion in (procedure.retreat, lambda: procedure.move_above(procedure.path.poses(site(0))[0])):
        with pytest.raises(UnreachableError, match="raise the box"):
            motion()
    np.testing.assert_array_equal(procedure.arm.state().T_b_t, before)
    assert not memory.events


def test_the_way_across_is_never_lower_than_the_clearance():
    procedure, memory = make(), Memory()
    procedure.top = procedure.rig.limits.upper[2] - procedure.settings.clearance
    goals, go = [], procedure.arm.go
    procedure.arm.go = lambda goal, *how: goals.append(goal) or go(goal, *how)
    list(procedure.run(listed(site(0), site(1, x=0.02)), memory))
    heights = np.array([goal[2, 3] for goal in goals])
    across = np.linalg.norm(np.diff([goal[:2, 3] for goal in goals], axis=0), axis=1) > 1e-6
    np.testing.assert_allclose(heights[1:][across], procedure.top + procedure.settings.clearance)


@pytest.mark.parametrize(
    "bad",
    [{"speed": 0.26}, {"retreat": 0.3}, {"acceleration": 0.6}, {"force": 31.0}, {"torque": 11.0}, {"prepare": 0.2}],
)
def test_settings_beyond_the_limits_are_refused_before_anything_moves(bad):
    procedure, memory = make(settings=TouchSettings(**bad)), Memory()
    begun = procedure.clock.now()
    with pytest.raises(ValueError, match="limit"):
        list(procedure.run(listed(site(0)), memory))
    assert procedure.clock.now() == begun


def test_air_that_the_camera_contradicts_is_no_touch_and_ends_the_run():
    """An arm and a skin that feel nothing go through what the camera sees."""
    procedure, memory = make(stiffness=1e-6, gain=np.zeros(READINGS)), Memory()
    with pytest.raises(MissedContactError, match=r"surface 6\.0 mm before its end"):
        list(procedure.run(listed(site(0), site(1)), memory))
    assert not memory.saved
    assert len(memory.abandoned) == 1 + procedure.settings.retries
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.09  # it has retreated


def test_a_tool_outside_its_box_is_not_moved():
    procedure = make()
    inside = procedure.arm.lab.robot
    inside.position = np.array([0.4, 0.0, procedure.rig.limits.lower[2] - 0.05])
    with pytest.raises(DeviceError, match="outside its box"):
        procedure.retreat()
    assert not procedure.arm.state().moving


@pytest.mark.parametrize("tilt_deg", [30.0, 85.0])
def test_where_the_box_forbids_going_back_a_skin_that_faces_down_is_lifted(tilt_deg):
    """It gets no deeper into what it pressed, and the tool never leaves the box."""
    procedure = make()
    robot, goals = procedure.arm.lab.robot, []
    start = _at_the_upper_edge(procedure, tilt_deg)
    go = procedure.arm.go
    procedure.arm.go = lambda goal, *how: goals.append(goal.copy()) or go(goal, *how)
    procedure.retreat()
    assert robot.position[2] >= procedure.path.transfer_height() - 1e-3
    along = [(goal[:3, 3] - start[:3, 3]) @ start[:3, 2] for goal in goals]
    assert all(np.diff([0.0, *along]) <= 1e-9)
    assert all(procedure.rig.limits.contains(goal[:3, 3]) for goal in goals)


def test_where_the_box_forbids_going_back_a_skin_that_faces_up_is_left_to_a_person():
    procedure = make()
    start = _at_the_upper_edge(procedure, 120.0)
    with pytest.raises(DeviceError, match=r"the skin faces up .* bring it back with the pendant"):
        procedure.retreat()
    np.testing.assert_array_equal(procedure.arm.state().T_b_t, start)


def _at_the_upper_edge(procedure, tilt_deg):
    """T_b_t (4, 4), m, of a tool put where the box ends behind it, its axis so far (degrees) from straight down."""
    robot, limits = procedure.arm.lab.robot, procedure.rig.limits
    axis = np.array([-np.sin(np.radians(tilt_deg)), 0.0, -np.cos(np.radians(tilt_deg))])
    y = np.array([0.0, -1.0, 0.0])
    robot.rotation = np.stack([np.cross(y, axis), y, axis], axis=1)
    robot.position = np.array([limits.upper[0], 0.0, limits.lower[2] + 1e-3])
    return procedure.arm.state().T_b_t


def test_a_uniform_field_is_no_touch():
    board = boards.reskin_board()
    change = board.to_board(np.tile([10.0, -20.0, 30.0], (board.num_chips, 1)))
    np.testing.assert_allclose(nonuniform_field(change, board), 0, atol=1e-5)
    assert np.linalg.norm(nonuniform_field(GAIN, board)) > 10


def test_onset_is_exact_for_a_line_and_a_fifth_short_for_a_ball():
    before = np.linspace(3e-3, 0, 800)
    sunk = np.maximum(0, 0.4e-3 - before)
    for power, short in ((1.0, 0.0), (1.5, 0.2)):
        rows = (sunk / 0.4e-3)[:, None] ** power * GAIN
        found = onset_distance(rows, before, np.zeros(READINGS), GAIN)
        assert abs(found - (1 - short) * 0.4e-3) < 0.02e-3 + 0.02 * short * 1e-3
    assert np.isnan(onset_distance(np.zeros((0, READINGS)), np.zeros(0), np.zeros(READINGS), GAIN))
    assert np.isnan(onset_distance(np.zeros((5, READINGS)), np.zeros(5), np.zeros(READINGS), GAIN))


@pytest.mark.full
def test_noise_of_real_size_leaves_depth_within_a_twentieth_of_a_millimetre():
    depths = []
    for seed in range(5):
        procedure, memory = make(errors=NOISY, seed=seed), Memory()
        list(procedure.run(listed(site(0)), memory))
        touched = memory.saved[0]
        depths.append(touched.depth - (HEIGHT - touched.T_w_t[2, 3]))
    assert np.sqrt(np.mean(np.square(depths))) < 0.05e-3


@pytest.mark.full
def test_history_tells_the_chooser_all_but_images():
    procedure, memory = make(), Memory()
    histories = []

    def choose(history):
        histories.append(list(history))
        return site(len(history)) if len(history) < 2 else None

    list(procedure.run(choose, memory))
    assert [len(history) for history in histories] == [0, 1, 2]
    last = histories[-1][0]
    assert isinstance(last, SiteOutcome)
    assert last.touch.view is None
    np.testing.assert_array_equal(last.touch.reading, memory.saved[0].reading)


@pytest.mark.parametrize("name", SETTING_RANGES)
def test_a_setting_that_makes_no_sense_is_refused(name):
    least, most, _ = SETTING_RANGES[name]
    kind = type(getattr(TouchSettings, name))
    for bad in (-5, least - 1, 2 * most + 1, 1000 * most, *([] if kind is int else [float("nan"), float("inf")])):
        with pytest.raises(ValueError, match=rf"settings\.{name} is "):
            TouchSettings(**{name: kind(bad)})
    TouchSettings(**{name: getattr(TouchSettings, name)})


def test_every_setting_has_a_range_and_some_exclude_each_other():
    assert set(SETTING_RANGES) == {each.name for each in fields(TouchSettings)}
    with pytest.raises(ValueError, match=r"settings\.near"):
        TouchSettings(near=0.05, prepare=0.04)


@pytest.mark.full
def test_the_procedure_and_the_recorder_need_no_jax():
    code = "import sys, i2t.collect.procedure, i2t.collect.recorder\nassert 'jax' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
