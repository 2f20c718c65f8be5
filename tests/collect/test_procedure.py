"""The procedure on a springy plane, where everything that it should measure is known in closed form."""

import subprocess
import sys

import numpy as np
import pytest
from helpers import closed_form
from helpers.closed_form import DOWN, GAIN, HEIGHT, NOISY, make, site
from scipy.spatial.transform import Rotation

from i2t.collect.procedure import Failed, Outcome, Settings, Unreachable
from i2t.collect.stopping import onset, unevenness
from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.skin import boards
from i2t.types import READINGS, ReturnCode


class Memory:
    """Keeps touches in memory."""

    def __init__(self):
        self.kept, self.abandoned, self.events, self.rows, self.states = [], [], [], [], []

    def begin(self, site, attempt):
        self.events = []
        return self

    def keep(self, touched):
        self.kept.append(touched)

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
    late = latency + 7.5e-3 + 2.5e-3 * settings.mean_of
    return stiffness * (settings.press * late + settings.press**2 / 2 / brake)


def test_a_press_stops_by_the_skin_and_measures_the_spring():
    procedure, memory = make(), Memory()
    settings = procedure.settings
    (outcome,) = procedure.run(listed(site(0)), memory)
    touched = memory.kept[0]
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


@pytest.mark.parametrize(("stiffness", "press"), [(2e3, 2e-3), (10e3, 2e-3), (10e3, 4e-3), (20e3, 1e-3)])
def test_a_skin_that_feels_nothing_leaves_it_to_the_force(stiffness, press):
    settings = Settings(press=press)
    procedure, memory = make(stiffness, gain=np.zeros(READINGS), settings=settings), Memory()
    (outcome,) = procedure.run(listed(site(0)), memory)
    assert outcome.code == ReturnCode.WRENCH
    assert outcome.reason == "force"
    assert settings.force < memory.kept[0].force < settings.force + overshoot(settings, stiffness)


def test_defaults_keep_within_two_newtons_of_the_limit():
    assert overshoot(Settings(), 10e3) < 2.0


def test_air_is_met_where_nothing_is():
    procedure, memory = make(), Memory()
    (outcome,) = procedure.run(listed(site(0, height=HEIGHT + 0.02)), memory)
    touched = memory.kept[0]
    assert outcome.code == ReturnCode.AIR
    assert np.isnan(touched.depth)
    np.testing.assert_allclose(touched.T_w_t[2, 3], HEIGHT + 0.02 - procedure.settings.past_goal, atol=1e-9)
    assert abs(touched.force) < 1e-9


def test_a_press_on_a_slope_goes_along_its_normal():
    turned = Rotation.from_euler("x", 30, degrees=True).as_matrix() @ DOWN
    procedure, memory = make(), Memory()
    list(procedure.run(listed(site(0, turned=turned)), memory))
    touched = memory.kept[0]
    along = (touched.T_w_t[:3, 3] - [0, 0, HEIGHT]) @ turned[:, 2]
    np.testing.assert_allclose(along, touched.force / 10e3, atol=1e-9)
    np.testing.assert_allclose(touched.T_w_t[:3, :3], turned, atol=1e-9)


def test_what_was_not_expected_fails_and_is_tried_again():
    procedure, memory = make(), Memory()
    procedure.settings = Settings(failures=2)
    procedure.cut = lambda *view: closed_form.cut(*view, nearest=0.0)  # the camera does not see it
    with pytest.raises(DeviceError, match="2 sites in a row"):
        list(procedure.run(listed(*(site(i, height=HEIGHT - 0.01) for i in range(3))), memory))
    assert not memory.kept
    assert len(memory.abandoned) == 2 * 3
    assert all("was met" in reason for reason in memory.abandoned)
    assert procedure.arm.state().T_b_t[2, 3] > HEIGHT + 0.09  # it withdrew
    assert np.linalg.norm(procedure.arm.state().wrench[:3]) == 0


def test_the_camera_can_refuse_a_site():
    procedure, memory = make(), Memory()
    for seen, said in (({"nearest": -0.02}, "register"), ({"share": 0.2}, "20 %")):
        procedure.cut = lambda *view, seen=seen: closed_form.cut(*view, **seen)
        with pytest.raises(Failed, match=said):
            procedure.touch(site(0), memory)


def test_places_outside_the_box_are_remembered_and_cost_no_motion():
    procedure, memory = make(), Memory()
    procedure.settings = Settings(failures=1)
    begun = procedure.clock.now()
    outcomes = list(procedure.run(listed(site(7, x=0.3), site(8), site(7, x=0.3)), memory))
    assert [outcome.code for outcome in outcomes] == [ReturnCode.FAILED, ReturnCode.SKIN, ReturnCode.FAILED]
    assert list(procedure.unreachable) == [7]
    assert "outside the box" in procedure.unreachable[7]
    assert begun < procedure.clock.now()
    with pytest.raises(Unreachable):
        procedure.check(site(7))


def test_every_pose_on_the_way_stays_in_the_box_and_above_the_object():
    procedure, memory = make(), Memory()
    seen = []
    go = procedure.arm.go
    procedure.arm.go = lambda goal, *how: seen.append(goal) or go(goal, *how)
    list(procedure.run(listed(*(site(i, x, y) for i, (x, y) in enumerate([(0, 0), (0.02, 0.03), (-0.03, 0)]))), memory))
    assert len(memory.kept) == 3
    for goal in seen:
        assert procedure.rig.limits.hold(goal[:3, 3])
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
    assert memory.kept[0].attempt == 1


def test_a_camera_that_is_unplugged_is_waited_for_and_then_a_person_is_asked():
    procedure, memory = make(settings=Settings(patience=2.0)), Memory()
    procedure.camera.trouble = DeviceError("eye is gone")
    begun = procedure.clock.now()
    with pytest.raises(DeviceError, match="eye is gone"):
        list(procedure.run(listed(site(0)), memory))
    assert 2.0 < procedure.clock.now() - begun < 10.0
    assert procedure.camera.connects > 5
    assert memory.abandoned == ["eye is gone"]


def test_noise_alone_seldom_stops_a_press_and_never_within_a_thousand():
    """Pure noise of real size, 4000 s of it: a slow common field crosses the paper's limit, but differs nowhere."""
    from i2t.emulators.in_process import SLOW, TICK

    rng = np.random.default_rng(0)
    noise, board, settings = NOISY.noise, boards.reskin_board(), Settings()
    presses, n = 1000, 1600  # of four seconds
    kept = np.exp(-TICK * settings.mean_of / SLOW)
    size = np.sqrt(noise.common) * np.array([noise.xy, noise.xy, noise.z])
    slow = size * rng.standard_normal((presses, 3))
    crossed, stopped = np.zeros((2, presses), bool)
    ambient = None
    for _ in range(n // settings.mean_of):
        slow = kept * slow + np.sqrt(1 - kept**2) * size * rng.standard_normal((presses, 3))
        white = noise.sigma(5) * np.sqrt((1 - noise.common) / settings.mean_of) * rng.standard_normal((presses, READINGS))
        mean = board.to_board(np.repeat(slow[:, None], 5, axis=1)) + white
        ambient = mean if ambient is None else ambient
        change = mean - ambient
        over = np.linalg.norm(change, axis=1) > settings.skin_change
        crossed = crossed | over
        for i in np.flatnonzero(over):
            stopped[i] |= np.linalg.norm(unevenness(change[i], board)) > settings.uneven * settings.skin_change
    assert crossed.sum() > 0
    assert stopped.sum() == 0


def test_a_uniform_field_is_no_touch():
    board = boards.reskin_board()
    change = board.to_board(np.tile([10.0, -20.0, 30.0], (5, 1)))
    np.testing.assert_allclose(unevenness(change, board), 0, atol=1e-5)
    assert np.linalg.norm(unevenness(GAIN, board)) > 10


def test_onset_is_exact_for_a_line_and_a_fifth_short_for_a_ball():
    before = np.linspace(3e-3, 0, 800)
    sunk = np.maximum(0, 0.4e-3 - before)
    for power, short in ((1.0, 0.0), (1.5, 0.2)):
        rows = (sunk / 0.4e-3)[:, None] ** power * GAIN
        found = onset(rows, before, np.zeros(READINGS), GAIN)
        assert abs(found - (1 - short) * 0.4e-3) < 0.02e-3 + 0.02 * short * 1e-3
    assert np.isnan(onset(np.zeros((0, READINGS)), np.zeros(0), np.zeros(READINGS), GAIN))
    assert np.isnan(onset(np.zeros((5, READINGS)), np.zeros(5), np.zeros(READINGS), GAIN))


def test_noise_of_real_size_leaves_depth_within_a_twentieth_of_a_millimetre():
    depths = []
    for seed in range(5):
        procedure, memory = make(errors=NOISY, seed=seed), Memory()
        list(procedure.run(listed(site(0)), memory))
        touched = memory.kept[0]
        depths.append(touched.depth - (HEIGHT - touched.T_w_t[2, 3]))
    assert np.sqrt(np.mean(np.square(depths))) < 0.05e-3


def test_history_tells_the_chooser_all_but_images():
    procedure, memory = make(), Memory()
    told = []

    def choose(history):
        told.append(list(history))
        return site(len(history)) if len(history) < 2 else None

    list(procedure.run(choose, memory))
    assert [len(history) for history in told] == [0, 1, 2]
    last = told[-1][0]
    assert isinstance(last, Outcome)
    assert last.touched.view is None
    np.testing.assert_array_equal(last.touched.reading, memory.kept[0].reading)


@pytest.mark.parametrize("bad", [{"press": 0.0}, {"near": 0.05}, {"force": float("nan")}, {"retries": -1}])
def test_settings_that_make_no_sense_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Settings(**bad)


def test_the_procedure_and_the_recorder_need_no_jax():
    code = "import sys, i2t.collect.procedure, i2t.collect.recorder\nassert 'jax' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
