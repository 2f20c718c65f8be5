"""What every skin must do, whoever made it."""

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from i2t.emulators.in_process import Lab, SimulatedSkin
from i2t.emulators.reskin_board import Readings, started
from i2t.emulators.scene import Flat
from i2t.errors import DeviceError, DeviceTimeoutError, NotConnectedError
from i2t.hardware.clock import Monotonic
from i2t.hardware.protocols import Skin
from i2t.hardware.reskin import recording
from i2t.hardware.reskin.driver import Replay, ReSkin
from i2t.hardware.reskin.frames import encode
from i2t.simulation import touches
from i2t.skin import boards

PATIENCE = 20.0  # s that a loaded machine may need


@pytest.fixture(params=["emulated", "replay", "simulated"])
def make(request, tmp_path) -> Iterator[Callable[[], Skin]]:
    """Skins of one kind that have not been connected."""
    if request.param == "emulated":
        with started() as (port, _):
            yield lambda: ReSkin(port)
        return
    if request.param == "simulated":
        lab = Lab(Flat(0.0, 1e4, np.zeros(15), touches.Errors(), boards.reskin_board()), Monotonic())
        yield lambda: SimulatedSkin(lab)
        return
    board = Readings(1.0, 0.0, None, 0)
    with recording.create(tmp_path / "skin") as file:
        for i in range(4000):
            recording.append(file, i / 400, encode(*board.at(0.0)))
    yield lambda: Replay(tmp_path / "skin")


def test_features_are_known_before_connecting(make, request):
    features = make().features
    assert len(features.channels) == len(set(features.channels)) == 15
    assert features.unit == "uT"
    assert features.rate == 400
    assert features.source in request.node.callspec.id


def test_it_is_a_skin_and_says_when_it_is_not_connected(make):
    skin = make()
    assert isinstance(skin, Skin)
    assert skin.counters.samples == 0
    for call in (skin.latest, lambda: skin.read(1), lambda: skin.since(-1)):
        with pytest.raises(NotConnectedError):
            call()
    skin.close()


def test_samples_are_whole_plausible_and_in_order(make):
    with make() as skin:
        called = time.monotonic()
        samples = skin.read(100, PATIENCE)
        assert samples.reading.shape == (100, 15)
        assert samples.temperature.shape == (100, 5)
        assert samples.number.tolist() == list(range(samples.number[0], samples.number[0] + 100))
        assert called < samples.time[0]
        assert samples.time[-1] <= time.monotonic()
        assert (np.diff(samples.time) >= 0).all()
        assert 10 < np.linalg.norm(samples.reading[:, :3].mean(axis=0)) < 200  # uT; the Earth has 25 to 65
        assert ((samples.temperature > 10) & (samples.temperature < 50)).all()
        assert skin.counters.samples >= 100
        assert skin.counters.loss == 0


def test_since_gives_every_sample_once(make):
    with make() as skin:
        newest, numbers = skin.latest(PATIENCE).number[-1], []
        first = newest + 1
        end = time.monotonic() + PATIENCE
        while len(numbers) < 100 and time.monotonic() < end:
            samples = skin.since(int(newest))
            numbers += samples.number.tolist()
            newest = numbers[-1] if numbers else newest
            time.sleep(0.01)
        assert numbers == list(range(first, first + len(numbers)))
        assert len(numbers) >= 100


def test_waiting_has_an_end(make):
    with make() as skin:
        begun = time.monotonic()
        with pytest.raises(DeviceTimeoutError):
            skin.read(2000, timeout=0.05)
        assert time.monotonic() - begun < PATIENCE
        with pytest.raises(ValueError, match="samples"):
            skin.read(0)


def test_it_can_be_closed_twice_and_connected_again(make):
    skin = make()
    with skin:
        skin.read(5, PATIENCE)
        before = skin.counters.samples
    skin.close()
    with pytest.raises(DeviceError):
        skin.read(1)
    with skin:
        assert skin.read(5, PATIENCE).number[0] >= before
        assert skin.counters.connects == 2
