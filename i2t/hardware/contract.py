"""Requirements of every arm, skin and camera, as tests that other packages can run with pytest too.

    from i2t.hardware.contract import SkinContract

    class TestAcmeSkin(SkinContract):
        make_device = staticmethod(lambda: AcmeSkin(DeviceSetup(Rig())))

The attributes of a class are the expectations and the tolerances of its device. Tests that must touch something are
skipped without a `floor`.

WARNING: The tests move a real arm by 50 mm about `home`. Read them first.
"""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.motion_limits import MotionLimits
from i2t.hardware.protocols import ArmState, DepthCamera, GuardedArm, Skin
from i2t.types import Array


class _Contract:
    """Requirements of the devices that `make_device` builds, or that an overridden fixture `make` builds."""

    make_device: Callable[[], Any]  # builds a device without connecting it
    sources: tuple[str, ...] = ("real", "emulated", "simulated", "replay")
    patience: float = 20.0  # s, waiting time that a busy machine may need
    state_timeout: float = 3.0  # s, maximum age of a state

    @pytest.fixture
    def make(self) -> Callable[[], Any]:
        """Return the function that builds the device without connecting it."""
        return self.make_device


class ArmContract(_Contract):
    """Tests that the driver of every guarded arm must pass, with the arm's limits, home pose and tolerances.

    The arm stands at `home` before each test.
    """

    limits: MotionLimits
    home: Array  # (4, 4) T_b_t, with the tool pointing down, 50 mm inside the box on all sides
    floor: float | None = None  # m, height of a springy plane, 20 to 60 mm below home
    stiffness: float = 5e3  # N/m, stiffness of the springy plane
    pose_tolerance: float = 1e-3  # tolerance of a pose: m, and the same number for a rotation's elements
    force_tolerance: float = 2.0  # N and Nm, tolerance of the wrench at rest
    speed_tolerance: float = 0.1  # tolerance of a speed, as a share of the requested one

    def pose(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
        """Calculate a pose of the tool near the arm's home pose.

        Args:
            x: Shift from home along the base's x axis, m.
            y: Shift from home along the base's y axis, m.
            z: Shift from home along the base's z axis, m.

        Returns:
            (4, 4) T_b_t, m.
        """
        pose = np.array(self.home, float)
        pose[:3, 3] += x, y, z
        return pose

    def test_only_features_work_before_connecting(self, make: Callable[[], GuardedArm]) -> None:
        """Before connecting, only features are available, which match the limits; `close` never raises."""
        arm, limits = make(), self.limits
        assert isinstance(arm, GuardedArm)
        _, source, rate, box, *bounds = arm.features
        assert (source in self.sources, rate >= 100) == (True, True)
        assert [*np.ravel(box), *bounds] == [*limits.lower, *limits.upper, limits.speed, limits.acceleration]
        refuse(NotConnectedError, [(arm.state, (), ""), (arm.move, (self.home, 0.1, 0.5), "")])
        arm.close()

    def test_motions_reach_their_goal_within_the_speed_limit_and_bad_goals_are_refused(
        self, make: Callable[[], GuardedArm]
    ) -> None:
        """`move` returns at once and reaches its goal; goals beyond limits or not finite are refused before motion."""
        goal, limits = self.pose(0.02, 0.03, 0.02), self.limits
        motions = [
            (self.pose(z=limits.lower[2] - 0.05 - self.home[2, 3]), 0.1, 0.5, "outside the box"),
            (self.pose(x=np.nan), 0.1, 0.5, "finite"),
            (self.home * 2, 0.1, 0.5, "transform|rotation"),
            (goal, limits.speed + 0.05, 0.5, "speed"),
            (goal, np.nan, 0.5, "speed"),
            (goal, 0.1, limits.acceleration + 0.1, "acceleration"),
        ]
        with make() as arm:
            refuse(ValueError, [(move, motion, why) for *motion, why in motions for move in (arm.move, arm.go)])
            refuse(ValueError, [(arm.approach, (2 * limits.approach_distance, 0.02), "distance")])
            refuse(ValueError, [(arm.approach, (0.02, 0.02, None, np.nan), "force")])
            before = arm.state(self.state_timeout)
            assert (before.safe, before.moving, before.velocity.shape, before.wrench.shape) == (True, False, (6,), (6,))
            np.testing.assert_allclose(before.T_b_t, self.home, atol=self.pose_tolerance)
            np.testing.assert_allclose(arm.move(goal, 0.1, 0.5), goal, atol=self.pose_tolerance)
            assert arm.state(self.state_timeout).moving
            after, fastest = at_rest(arm, self.state_timeout, self.patience)
            np.testing.assert_allclose(after.T_b_t, goal, atol=self.pose_tolerance)
            assert 0 < fastest <= 0.1 * (1 + self.speed_tolerance)
            assert before.time < after.time <= time.monotonic()
            arm.go(self.home, 0.2, 0.5)

    def test_it_stops_from_another_thread_and_on_close_and_can_move_again(self, make: Callable[[], GuardedArm]) -> None:
        """`stop` from another thread returns when the arm stands; `close` stops too, and may be called twice."""
        arm = make()
        with arm:
            arm.move(self.pose(y=0.05), 0.02, 0.5)
            thread = threading.Thread(target=arm.stop, args=(5.0,))
            thread.start()
            thread.join(self.patience)
            stood = arm.state(self.state_timeout)
            assert not stood.moving
            arm.move(self.pose(y=0.05), 0.02, 0.5)
        arm.close()
        refuse(DeviceError, [(arm.state, (), "")])
        with arm:
            now = at_rest(arm, self.state_timeout, self.patience)[0].T_b_t[1, 3]
            assert stood.T_b_t[1, 3] - self.pose_tolerance <= now < self.home[1, 3] + 0.045
            np.testing.assert_allclose(arm.go(self.home, 0.2, 0.5).T_b_t, self.home, atol=self.pose_tolerance)

    def test_an_approach_ends_at_a_force_a_stop_condition_or_its_distance(self, make: Callable[[], GuardedArm]) -> None:
        """An approach ends at a force (of a spring, from zero), a stop condition, the distance, or an error."""
        if self.floor is None:
            pytest.skip("the arm cannot touch anything: give the height of a floor")
        floor, start = self.floor, self.pose(z=self.floor + 0.01 - self.home[2, 3])
        with make() as arm:
            arm.move(start, 0.1, 0.5)
            refuse(DeviceError, [(arm.zero_wrench, (1.0,), "zeroed only while")])
            at_rest(arm, self.state_timeout, self.patience)
            arm.zero_wrench(self.state_timeout)
            np.testing.assert_allclose(arm.state(self.state_timeout).wrench, 0, atol=self.force_tolerance)
            done = arm.approach(0.03, 0.02, force=4.0)
            assert (done.reason, done.answer, done.state.moving) == ("force", None, False)
            pushed = [0, 0, -self.stiffness * (floor - done.state.T_b_t[2, 3]), 0, 0, 0]
            np.testing.assert_allclose(done.state.wrench, pushed, atol=self.force_tolerance)
            assert 4.0 < np.linalg.norm(done.trigger.wrench[:3]) <= -pushed[2] + self.force_tolerance
            arm.go(start, 0.1, 0.5)
            done = arm.approach(0.03, 0.02, lambda state: state.T_b_t[2, 3] < floor + 0.006 and "skin", 4.0)
            assert (done.reason, done.answer) == ("condition", "skin")
            arm.go(start, 0.1, 0.5)
            done = arm.approach(0.005, 0.02, lambda state: None)
            assert (done.reason, done.answer) == ("distance", None)
            assert abs(done.distance - 0.005) <= self.pose_tolerance
            refuse(ZeroDivisionError, [(arm.approach, (0.03, 0.002, lambda state: 1 / 0), "")])
            assert not arm.state(self.state_timeout).moving
            arm.go(self.home, 0.1, 0.5)


class SkinContract(_Contract):
    """Tests, with its nominal rate (Hz), that every skin's driver must pass; a skin in the Earth's field suffices."""

    rate: float = 400.0  # Hz, nominal rate of the samples
    has_temperature: bool = True

    def test_only_features_work_before_connecting(self, make: Callable[[], Skin]) -> None:
        """Before connecting, only features are available, with three named channels per chip; `close` never raises."""
        skin = make()
        assert isinstance(skin, Skin)
        _, source, channels, unit, rate = skin.features
        assert (len(channels) % 3, len(set(channels)), unit, rate) == (0, len(channels), "uT", self.rate)
        assert (source in self.sources, skin.counters.samples) == (True, 0)
        refuse(NotConnectedError, [(skin.latest, (), ""), (skin.read, (1,), ""), (skin.since, (-1,), "")])
        skin.close()

    def test_samples_are_whole_plausible_and_in_order(self, make: Callable[[], Skin]) -> None:
        """Every sample arrives once, measured after the call, in microtesla; `since` omits none."""
        with make() as skin:
            called, newest, channels = time.monotonic(), int(skin.latest(self.patience).number[-1]), skin.features[2]
            number, times, reading, temperature = skin.read(100, self.patience)
            assert (reading.shape, temperature.shape) == ((100, len(channels)), (100, len(channels) // 3))
            assert called < times[0] <= times[-1] <= time.monotonic()
            assert (np.diff(number) == 1).all()
            assert (np.diff(times) >= 0).all()
            assert 10 < np.linalg.norm(reading[:, :3].mean(axis=0)) < 200  # uT; the Earth has 25 to 65
            assert not self.has_temperature or ((temperature > 10) & (temperature < 50)).all()
            assert skin.since(newest).number[:100].tolist() == list(range(newest + 1, newest + 101))
            assert (skin.counters.samples >= 100, skin.counters.loss) == (True, 0)

    def test_waiting_times_out_and_sample_numbers_continue_after_a_reconnection(self, make: Callable[[], Skin]) -> None:
        """Late samples and impossible requests raise; numbers continue after a reconnection."""
        skin = make()
        with skin:
            refuse(DeviceTimeoutError, [(skin.read, (2000, 0.05), "")])
            refuse(ValueError, [(skin.read, (0,), "samples")])
            before = skin.counters.samples
        skin.close()
        refuse(DeviceError, [(skin.read, (1,), "")])
        with skin:
            assert skin.read(5, self.patience).number[0] >= before
            assert skin.counters.connects == 2


class CameraContract(_Contract):
    """Tests that the driver of every depth camera must pass; an object is 90 to 200 mm in front of the camera."""

    depth_range: tuple[float, float] = (0.09, 0.2)  # m, distance of the object
    min_measured_share: float = 0.9  # smallest share of the pixels that must be measured

    def test_views_are_whole_in_metres_and_in_order(self, make: Callable[[], DepthCamera]) -> None:
        """Depth is in metres with NaN for holes, colours are of the same pixels; also after the camera was closed."""
        camera, (low, high) = make(), self.depth_range
        assert (camera.features.source in self.sources, camera.features.rate > 1) == (True, True)
        assert not camera.features.nearest >= high  # NaN if only the device knows it
        for _ in range(2):
            refuse(NotConnectedError, [(camera.capture, (), "")])
            with camera:
                assert isinstance(camera, DepthCamera)
                shape, before = (camera.camera.height, camera.camera.width), time.monotonic()
                for _ in range(2):
                    when, depth, colour = camera.capture(self.patience)
                    assert before < when <= time.monotonic()
                    before, measured = when, np.isfinite(depth)
                    assert (depth.shape, depth.dtype) == (shape, np.float32)
                    assert self.min_measured_share < measured.mean() <= 1
                    assert low < depth[measured].min() <= depth[measured].max() < high
                    assert colour is None or (colour.shape, colour.dtype) == ((*shape, 3), np.uint8)
            camera.close()


def refuse(error: type[Exception], calls: Sequence[tuple[Callable[..., Any], Sequence[Any], str]]) -> None:
    """Assert in a test that each call raises an error with a given message.

    Args:
        error: Type of the error.
        calls: Functions, with their arguments and a pattern for the message of the error.
    """
    for call, arguments, why in calls:
        with pytest.raises(error, match=why or None):
            call(*arguments)


def at_rest(arm: GuardedArm, state_timeout: float, patience: float) -> tuple[ArmState, float]:
    """Wait until a moving arm stands, and measure its highest speed meanwhile.

    Args:
        arm: Connected arm.
        state_timeout: Maximum age of a state, s.
        patience: Maximum wait, s.

    Returns:
        The state at rest, and the tool's highest speed (m/s) during the wait.
    """
    fastest, end = 0.0, time.monotonic() + patience
    while True:
        state = arm.state(state_timeout)
        fastest = max(fastest, float(np.linalg.norm(state.velocity[:3])))
        if not state.moving:
            return state, fastest
        assert time.monotonic() < end
        time.sleep(0.005)
