"""Requirements of every arm, skin and camera, as tests that a third party's pytest runs too.

    from i2t.hardware.contract import SkinContract

    class TestAcmeSkin(SkinContract):
        make_device = staticmethod(lambda: AcmeSkin(DeviceSetup(Rig())))

A class says what is to be expected by its attributes, and how well its device keeps to it. Tests that must touch
something are left out where no `floor` is given. On a real arm the tests move it by 50 mm about `home`: look at them
before.
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

TEST_PATIENCE_S = 20.0  # that a loaded machine may need
TEST_STATE_TIMEOUT_S = 3.0
MIN_STATE_RATE_HZ = 100
SOURCES = ("real", "emulated", "simulated", "replay")


class _Contract:
    """A contract of the devices that `make_device` builds, or of those that an overridden fixture `make` gives."""

    make_device: Callable[[], Any]  # builds a device, without connecting it

    @pytest.fixture
    def make(self) -> Callable[[], Any]:
        """Builds devices for one test."""
        return self.make_device


class ArmContract(_Contract):
    """Requirements of every guarded arm; it stands at `home` before each test."""

    limits: MotionLimits  # of the arm
    home: Array  # (4, 4) T_b_t, tool pointing down, 50 mm inside the box on all sides
    floor: float | None = None  # m, height of a springy plane, 20 to 60 mm below home
    stiffness: float = 5e3  # N/m, of that plane
    pose_tolerance: float = 1e-3  # m, and of a rotation's elements
    force_tolerance: float = 2.0  # N and Nm, of what is felt at rest
    speed_tolerance: float = 0.1  # of the speed that was asked

    def pose(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Array:
        """A pose next to home.

        Args:
            x: m from home, along the base's x axis.
            y: m along y.
            z: m along z.

        Returns:
            (4, 4) T_b_t.
        """
        pose = np.array(self.home, float)
        pose[:3, 3] += x, y, z
        return pose

    def test_features_are_known_before_connecting_and_nothing_else_works(self, make: Callable[[], GuardedArm]) -> None:
        """Box, speed and acceleration are those of the limits; `close` raises nothing."""
        arm, limits = make(), self.limits
        assert isinstance(arm, GuardedArm)
        _, source, rate, box, *bounds = arm.features
        assert (source in SOURCES, rate >= MIN_STATE_RATE_HZ) == (True, True)
        assert [*np.ravel(box), *bounds] == [*limits.lower, *limits.upper, limits.speed, limits.acceleration]
        refuse(NotConnectedError, [(arm.state, (), ""), (arm.move, (self.home, 0.1, 0.5), "")])
        arm.close()

    def test_it_moves_where_it_is_told_as_fast_as_it_may_and_nowhere_else(self, make: Callable[[], GuardedArm]) -> None:
        """`move` returns at once, and what is beyond the limits, or no number, is refused before anything moves."""
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
            before = arm.state(TEST_STATE_TIMEOUT_S)
            assert (before.safe, before.moving, before.velocity.shape, before.wrench.shape) == (True, False, (6,), (6,))
            np.testing.assert_allclose(before.T_b_t, self.home, atol=self.pose_tolerance)
            np.testing.assert_allclose(arm.move(goal, 0.1, 0.5), goal, atol=self.pose_tolerance)
            assert arm.state(TEST_STATE_TIMEOUT_S).moving
            after, fastest = at_rest(arm)
            np.testing.assert_allclose(after.T_b_t, goal, atol=self.pose_tolerance)
            assert 0 < fastest <= 0.1 * (1 + self.speed_tolerance)
            assert before.time < after.time <= time.monotonic()
            arm.go(self.home, 0.2, 0.5)

    def test_it_stops_from_another_thread_or_when_closed_and_can_go_on(self, make: Callable[[], GuardedArm]) -> None:
        """`stop` returns when the arm stands; `close` may be called twice."""
        arm = make()
        with arm:
            arm.move(self.pose(y=0.05), 0.02, 0.5)
            thread = threading.Thread(target=arm.stop, args=(5.0,))
            thread.start()
            thread.join(TEST_PATIENCE_S)
            stood = arm.state(TEST_STATE_TIMEOUT_S)
            assert not stood.moving
            arm.move(self.pose(y=0.05), 0.02, 0.5)
        arm.close()
        refuse(DeviceError, [(arm.state, (), "")])
        with arm:
            now = at_rest(arm)[0].T_b_t[1, 3]
            assert stood.T_b_t[1, 3] - self.pose_tolerance <= now < self.home[1, 3] + 0.045
            np.testing.assert_allclose(arm.go(self.home, 0.2, 0.5).T_b_t, self.home, atol=self.pose_tolerance)

    def test_an_approach_ends_where_something_says_stop(self, make: Callable[[], GuardedArm]) -> None:
        """Force (of a spring, from zero), a stop condition, the distance, or an error in the condition."""
        if self.floor is None:
            pytest.skip("there is nothing to touch: give the height of a floor")
        floor, start = self.floor, self.pose(z=self.floor + 0.01 - self.home[2, 3])
        with make() as arm:
            arm.move(start, 0.1, 0.5)
            refuse(DeviceError, [(arm.zero_wrench, (1.0,), "zeroed only while")])
            at_rest(arm)
            arm.zero_wrench(TEST_STATE_TIMEOUT_S)
            np.testing.assert_allclose(arm.state(TEST_STATE_TIMEOUT_S).wrench, 0, atol=self.force_tolerance)
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
            assert not arm.state(TEST_STATE_TIMEOUT_S).moving
            arm.go(self.home, 0.1, 0.5)


class SkinContract(_Contract):
    """Requirements of every skin; the Earth's field is all that it need measure."""

    rate: float = 400.0  # Hz, nominal
    has_temperature: bool = True

    def test_features_are_known_before_connecting_and_nothing_else_works(self, make: Callable[[], Skin]) -> None:
        """Three channels for each chip, each with a name of its own; `close` raises nothing."""
        skin = make()
        assert isinstance(skin, Skin)
        _, source, channels, unit, rate = skin.features
        assert (len(channels) % 3, len(set(channels)), unit, rate) == (0, len(channels), "uT", self.rate)
        assert (source in SOURCES, skin.counters.samples) == (True, 0)
        refuse(NotConnectedError, [(skin.latest, (), ""), (skin.read, (1,), ""), (skin.since, (-1,), "")])
        skin.close()

    def test_samples_are_whole_plausible_and_in_order(self, make: Callable[[], Skin]) -> None:
        """Every sample comes once, measured after the call, in microtesla; `since` leaves none out."""
        with make() as skin:
            called, newest, channels = time.monotonic(), int(skin.latest(TEST_PATIENCE_S).number[-1]), skin.features[2]
            number, times, reading, temperature = skin.read(100, TEST_PATIENCE_S)
            assert (reading.shape, temperature.shape) == ((100, len(channels)), (100, len(channels) // 3))
            assert called < times[0] <= times[-1] <= time.monotonic()
            assert (np.diff(number) == 1).all()
            assert (np.diff(times) >= 0).all()
            assert 10 < np.linalg.norm(reading[:, :3].mean(axis=0)) < 200  # uT; the Earth has 25 to 65
            assert not self.has_temperature or ((temperature > 10) & (temperature < 50)).all()
            assert skin.since(newest).number[:100].tolist() == list(range(newest + 1, newest + 101))
            assert (skin.counters.samples >= 100, skin.counters.loss) == (True, 0)

    def test_waiting_has_an_end_and_numbers_go_on_after_a_reconnection(self, make: Callable[[], Skin]) -> None:
        """What does not come in time is an error, and what cannot be asked for."""
        skin = make()
        with skin:
            refuse(DeviceTimeoutError, [(skin.read, (2000, 0.05), "")])
            refuse(ValueError, [(skin.read, (0,), "samples")])
            before = skin.counters.samples
        skin.close()
        refuse(DeviceError, [(skin.read, (1,), "")])
        with skin:
            assert skin.read(5, TEST_PATIENCE_S).number[0] >= before
            assert skin.counters.connects == 2


class CameraContract(_Contract):
    """Requirements of every depth camera; something lies 90 to 200 mm before it."""

    depth_range: tuple[float, float] = (0.09, 0.2)  # m, of what it looks at
    min_measured_share: float = 0.9  # of the pixels

    def test_views_are_whole_in_metres_and_in_order(self, make: Callable[[], DepthCamera]) -> None:
        """Depth in metres with NaN for holes, and colours of the same pixels; again after it was closed."""
        camera, (low, high) = make(), self.depth_range
        assert (camera.features.source in SOURCES, camera.features.rate > 1) == (True, True)
        assert not camera.features.nearest >= high  # NaN where only the device knows it
        for _ in range(2):
            refuse(NotConnectedError, [(camera.capture, (), "")])
            with camera:
                assert isinstance(camera, DepthCamera)
                shape, before = (camera.camera.height, camera.camera.width), time.monotonic()
                for _ in range(2):
                    when, depth, colour = camera.capture(TEST_PATIENCE_S)
                    assert before < when <= time.monotonic()
                    before, measured = when, np.isfinite(depth)
                    assert (depth.shape, depth.dtype) == (shape, np.float32)
                    assert self.min_measured_share < measured.mean() <= 1
                    assert low < depth[measured].min() <= depth[measured].max() < high
                    assert colour is None or (colour.shape, colour.dtype) == ((*shape, 3), np.uint8)
            camera.close()


def refuse(error: type[Exception], calls: Sequence[tuple[Callable[..., Any], Sequence[Any], str]]) -> None:
    """Require that each call ends with an error.

    Args:
        error: Its type.
        calls: A function, its arguments, and what the error says.
    """
    for call, arguments, why in calls:
        with pytest.raises(error, match=why or None):
            call(*arguments)


def at_rest(arm: GuardedArm) -> tuple[ArmState, float]:
    """Wait until an arm stands.

    Args:
        arm: Connected.

    Returns:
        Its state at rest, and the greatest speed on the way (m/s).
    """
    fastest, end = 0.0, time.monotonic() + TEST_PATIENCE_S
    while True:
        state = arm.state(TEST_STATE_TIMEOUT_S)
        fastest = max(fastest, float(np.linalg.norm(state.velocity[:3])))
        if not state.moving:
            return state, fastest
        assert time.monotonic() < end
        time.sleep(0.005)
