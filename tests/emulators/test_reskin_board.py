"""What an emulated board does with fields that are sent to it."""

import socket
import struct

import numpy as np
import pytest

from i2t.emulators.reskin_board import BoardSignal, Readings, _newest_field


def test_the_newest_field_is_used_and_a_field_of_another_size_ends_the_board():
    """A skin that shows no press would be pressed until the force stops the arm."""
    inbox, sender = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    inbox.setblocking(False)
    before = np.zeros(15)
    with inbox, sender:
        assert _newest_field(inbox, before) is before
        for value in (1.0, 2.0):
            sender.send(struct.pack("<15f", *[value] * 15))
        np.testing.assert_array_equal(_newest_field(inbox, before), 2.0)
        sender.send(struct.pack("<12f", *[1.0] * 12))
        with pytest.raises(SystemExit, match="a field has 12 values, and this board 15; name the same --board"):
            _newest_field(inbox, before)


def test_a_board_shows_its_presses_and_its_temperature():
    quiet, signal = Readings(noise=0.0, press=2.0, seed=0), BoardSignal()
    (rest, celsius), (pressed, _) = (quiet.at(now) for now in (0.0, signal.press_period / 4))
    change = pressed - rest - 2 * np.ravel(signal.press)
    assert (abs(change) <= np.tile(signal.steps, 5) + 1e-9).all()  # half a count each
    np.testing.assert_allclose(celsius, signal.temperature, atol=0.51 * signal.temperature_step)
    noisy = Readings(noise=1.0, press=0.0, seed=0)
    assert np.std([noisy.at(0.0)[1] for _ in range(200)]) == pytest.approx(signal.temperature_noise, rel=0.1)
