"""Requirements of every arm, skin and camera, as tests that a third party's pytest runs too.

    from i2t.hardware.contract import SkinContract

    class TestAcmeSkin(SkinContract):
        make_device = staticmethod(lambda: AcmeSkin(DeviceSetup(Rig())))

A class says what is to be expected by its attributes. Tests that must touch something are left out where no `floor` is
given. On a real arm the tests move it by 50 mm about `home`: look at them before.
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.limits import MotionLimits
from i2t.hardware.protocols import ArmState, DepthCamera, GuardedArm, Skin
from i2t.types import Array

TEST_PATIENCE_S = 20.0  # that a loaded machine may need
TEST_STATE_TIMEOUT_S = 3.0
MIN_STATE_RATE_HZ = 100
SOURCES = ("real", "emulated", "simulated", "replay", "folder")


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
        name, source, rate, box, *bounds = arm.features
        assert (bool(name), source in SOURCES, rate >= MIN_STATE_RATE_HZ) == (True, True, True)
        assert [*np.ravel(box), *bounds] == [*limits.lower, *limits.upper, limits.speed, limits.acceleration]
        for call in (lambda: arm.state(TEST_STATE_TIMEOUT_S), lambda: arm.move(self.home, 0.1, 0.5)):
            with pytest.raises(NotConnectedError):
                call()
        arm.close()

    def test_it_moves_where_it_is_told_as_fast_as_it_may_and_nowhere_else(self, make: Callable[[], GuardedArm]) -> None:
        """`move` returns at once, and what is beyond the limits, or no number, is refused before anything moves."""
        goal, limits = self.pose(0.02, 0.03, 0.02), self.limits
        refused = [
            (self.pose(z=limits.lower[2] - 0.05 - self.home[2, 3]), 0.1, 0.5, "outside the box"),
            (self.pose(x=np.nan), 0.1, 0.5, "finite"),
            (self.home * 2, 0.1, 0.5, "transform|rotation"),
            (goal, limits.speed + 0.05, 0.5, "speed"),
            (goal, np.nan, 0.5, "speed"),
            (goal, 0.1, limits.acceleration + 0.1, "acceleration"),
        ]
        with make() as arm:
            for *motion, why in refused:
                for move in (arm.move, arm.go):
                    with pytest.raises(ValueError, match=why):
                        move(*motion)
            for distance, force, why in ((2 * limits.approach_distance, 1.0, "distance"), (0.02, np.nan, "force")):
                with pytest.raises(ValueError, match=why):
                    arm.approach(distance, 0.02, force=force)
            before = arm.state(TEST_STATE_TIMEOUT_S)
            assert (before.safe, before.moving) == (True, False)
            np.testing.assert_allclose(before.T_b_t, self.home, atol=1e-6)
            assert before.velocity.shape == before.wrench.shape == (6,)
            np.testing.assert_allclose(arm.move(goal, 0.1, 0.5), goal, atol=1e-9)
            assert arm.state(TEST_STATE_TIMEOUT_S).moving
            after, fastest = at_rest(arm)
            np.testing.assert_allclose(after.T_b_t, goal, atol=1e-6)
            assert 0 < fastest <= 0.1 * (1 + 1e-6)
            assert before.time < after.time <= time.monotonic()
            arm.go(self.home, 0.2, 0.5)

    def test_it_stops_from_another_thread_or_when_closed_and_can_go_on(self, make: Callable[[], GuardedArm]) -> None:
        """`stop` returns when the arm stands; `close` may be called twice."""
        arm = make()
        with arm:
            arm.move(self.pose(y=0.05), 0.02, 0.5)
            with ThreadPoolExecutor() as others:
                others.submit(arm.stop, 5.0).result(TEST_PATIENCE_S)
            stood = arm.state(TEST_STATE_TIMEOUT_S)
            assert not stood.moving
            arm.move(self.pose(y=0.05), 0.02, 0.5)
        arm.close()
        with pytest.raises(DeviceError):
            arm.state(TEST_STATE_TIMEOUT_S)
        with arm:
            assert stood.T_b_t[1, 3] <= at_rest(arm)[0].T_b_t[1, 3] < self.home[1, 3] + 0.045
            arm.move(self.home, 0.2, 0.5)
            np.testing.assert_allclose(at_rest(arm)[0].T_b_t, self.home, atol=1e-6)

    def test_an_approach_ends_where_something_says_stop(self, make: Callable[[], GuardedArm]) -> None:
        """Force (of a spring, from zero), a stop condition, the distance, or an error in the condition."""
        if self.floor is None:
            pytest.skip("there is nothing to touch: give the height of a floor")
        floor, start = self.floor, self.pose(z=self.floor + 0.01 - self.home[2, 3])
        with make() as arm:
            arm.move(start, 0.1, 0.5)
            with pytest.raises(DeviceError, match="zeroed only while"):
                arm.zero_wrench(1.0)
            at_rest(arm)
            arm.zero_wrench(TEST_STATE_TIMEOUT_S)
            np.testing.assert_allclose(arm.state(TEST_STATE_TIMEOUT_S).wrench, 0, atol=1e-9)
            done = arm.approach(0.03, 0.02, force=4.0)
            assert (done.reason, done.answer, done.state.moving) == ("force", None, False)
            pushed = [0, 0, -self.stiffness * (floor - done.state.T_b_t[2, 3]), 0, 0, 0]
            np.testing.assert_allclose(done.state.wrench, pushed, atol=1e-3)
            assert 4.0 < np.linalg.norm(done.trigger.wrench[:3]) <= -pushed[2] + 1e-9
            arm.go(start, 0.1, 0.5)
            done = arm.approach(0.03, 0.02, lambda state: state.T_b_t[2, 3] < floor + 0.006 and "skin", 4.0)
            assert (done.reason, done.answer) == ("condition", "skin")
            arm.go(start, 0.1, 0.5)
            done = arm.approach(0.005, 0.02, lambda state: None)
            assert (done.reason, done.answer, round(done.distance, 5)) == ("distance", None, 0.005)
            with pytest.raises(ZeroDivisionError):
                arm.approach(0.03, 0.002, lambda state: 1 / 0)
            assert not arm.state(TEST_STATE_TIMEOUT_S).moving
            arm.go(self.home, 0.1, 0.5)


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


class SkinContract(_Contract):
    """Requirements of every skin; the Earth's field is all that it need measure."""

    rate: float = 400.0  # Hz, nominal
    has_temperature: bool = True

    def test_features_are_known_before_connecting_and_nothing_else_works(self, make: Callable[[], Skin]) -> None:
        """Three channels for each chip, each with a name of its own; `close` raises nothing."""
        skin = make()
        assert isinstance(skin, Skin)
        _, source, channels, unit, rate = skin.features
        assert (len(set(channels)) % 3, unit, rate, source in SOURCES) == (0, "uT", self.rate, True)
        assert (len(channels), skin.counters.samples) == (len(set(channels)), 0)
        for call in (skin.latest, lambda: skin.read(1), lambda: skin.since(-1)):
            with pytest.raises(NotConnectedError):
                call()
        skin.close()

    def test_samples_are_whole_plausible_and_in_order(self, make: Callable[[], Skin]) -> None:
        """Every sample comes once, measured after the call, in microtesla; `since` leaves none out."""
        with make() as skin:
            channels = len(skin.features.channels)
            called, newest = time.monotonic(), int(skin.latest(TEST_PATIENCE_S).number[-1])
            samples = skin.read(100, TEST_PATIENCE_S)
            assert samples.reading.shape == (100, channels)
            assert samples.temperature.shape == (100, channels // 3)
            assert (np.diff(samples.number) == 1).all()
            assert called < samples.time[0] <= samples.time[-1] <= time.monotonic()
            assert (np.diff(samples.time) >= 0).all()
            assert 10 < np.linalg.norm(samples.reading[:, :3].mean(axis=0)) < 200  # uT; the Earth has 25 to 65
            if self.has_temperature:
                assert ((samples.temperature > 10) & (samples.temperature < 50)).all()
            assert skin.since(newest).number[:100].tolist() == list(range(newest + 1, newest + 101))
            assert skin.counters.samples >= 100
            assert skin.counters.loss == 0

    def test_waiting_has_an_end_and_closing_too(self, make: Callable[[], Skin]) -> None:
        """What does not come in time is an error; sample numbers go on after a reconnection."""
        skin = make()
        with skin:
            with pytest.raises(DeviceTimeoutError):
                skin.read(2000, timeout=0.05)
            with pytest.raises(ValueError, match="samples"):
                skin.read(0)
            before = skin.counters.samples
        skin.close()
        with pytest.raises(DeviceError):
            skin.read(1)
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
            with pytest.raises(NotConnectedError):
                camera.capture()
            with camera:
                assert isinstance(camera, DepthCamera)
                shape, before = (camera.camera.height, camera.camera.width), time.monotonic()
                for _ in range(2):
                    view = camera.capture(TEST_PATIENCE_S)
                    assert before < view.time <= time.monotonic()
                    before, measured = view.time, np.isfinite(view.depth)
                    assert (view.depth.shape, view.depth.dtype) == (shape, np.float32)
                    assert self.min_measured_share < measured.mean() <= 1
                    assert low < view.depth[measured].min() <= view.depth[measured].max() < high
                    if view.colour is not None:
                        assert (view.colour.shape, view.colour.dtype) == ((*shape, 3), np.uint8)
            camera.close()
