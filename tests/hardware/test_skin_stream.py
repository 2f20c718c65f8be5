"""Skins whose samples a thread receives: samples are of the present connection, or an error gives the reason."""

import threading
import time

import numpy as np
import pytest
from helpers.waiting import eventually

from i2t.errors import DeviceError, DeviceTimeoutError
from i2t.hardware.contract import refuse
from i2t.hardware.skin_stream import Measurement, StreamConfig, StreamedSkin

CHIPS = 2


def sample(ahead=0.0, values=3 * CHIPS):
    return Measurement(time.monotonic() + ahead, np.zeros(values), np.full(CHIPS, 24.0))


class Board(StreamedSkin):
    """A board whose `receive` is given by the test as a function of the number of the connection."""

    def __init__(self, receive):
        super().__init__("the board", CHIPS, rate=400.0)
        self.received, self.opened, self.closed = receive, 0, []

    def open_link(self):
        self.opened += 1
        return self.opened

    def receive(self, link):
        time.sleep(1e-3)
        return self.received(link)

    def close_link(self, link):
        self.closed.append(link)


def fail(error):
    raise error


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda link: fail(OSError(5, "gone")), r"the board is gone \(.*gone\); plug it in"),
        (lambda link: fail(SystemExit(3)), r"the board is gone \(3\)"),
        (lambda link: [sample(values=4)], "do not have 6 values"),
        (lambda link: [sample(ahead=100.0)], "sends samples with times in the future"),
    ],
)
def test_every_call_states_why_the_thread_ended(wrong, message):
    sent = []
    skin = Board(lambda link: sent.append(link) or ([sample()] if len(sent) < 3 else wrong(link)))
    skin.connect()
    eventually(lambda: skin.closed == [1])
    calls = (skin.latest, ()), (skin.read, (5,)), (skin.since, (skin.counters.samples,))
    refuse(DeviceError, [(*call, message) for call in calls])


def test_a_hung_old_thread_does_not_affect_the_new_connection():
    hangs, outcomes = threading.Event(), iter([lambda: [sample(), sample()], lambda: fail(OSError("late"))])

    def receive(link):
        if link == 3 or not hangs.is_set():
            return [sample()]
        time.sleep(0.3)
        return next(outcomes)()

    skin = Board(receive)
    skin.stream_config = StreamConfig(join_timeout=0.05)
    for _ in range(2):
        hangs.clear()
        skin.connect()
        hangs.set()
        time.sleep(0.02)  # the thread is in its long call
    before = skin.counters.samples
    skin.connect()
    assert skin.opened == 3
    skin.read(200)
    numbers = skin.since(before - 1).number
    assert (np.diff(numbers) == 1).all()
    eventually(lambda: sorted(skin.closed) == [1, 2])
    skin.close()


def test_a_failed_connection_leaves_no_port_open():
    silent = Board(lambda link: [])
    silent.stream_config = StreamConfig(first_sample_timeout=0.1)
    with pytest.raises(DeviceTimeoutError, match="has been silent"):
        silent.connect()
    assert silent.closed == [1]
    silent.open_link = lambda: fail(PermissionError(13, "denied"))
    refuse(DeviceError, [(silent.connect, (), r"the board is gone \(.*denied\)")])
    interrupted = Board(lambda link: [])
    interrupted.stream_config = silent.stream_config
    interrupted._check = lambda: fail(KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        interrupted.connect()
    assert interrupted.closed == [1]
