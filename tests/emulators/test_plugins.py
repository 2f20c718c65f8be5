"""Timeouts of emulated arms: longer than a real arm's, on this machine only, with a remedy for a busy computer."""

import pytest

from i2t.emulators.plugins import emulated_arm
from i2t.hardware.drivers import ur
from i2t.hardware.limits import SAFETY, range_of
from i2t.hardware.plugins import DeviceSetup
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import EMULATED_WATCH

pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")

HERE, ELSEWHERE = "127.0.0.9", "192.0.2.1"
REAL = {"state_timeout": SAFETY.state_timeout_s, "watchdog_rate": SAFETY.watchdog_rate_hz}


def watch_of(plugin, address, **given):
    arm = plugin.make(DeviceSetup(Rig(), address=address, watch=given))
    return {"state_timeout": arm.state_timeout, "watchdog_rate": arm.connection.watchdog_rate}


def test_an_emulated_arm_on_this_machine_has_longer_timeouts_which_options_replace():
    assert watch_of(emulated_arm, HERE) == EMULATED_WATCH
    assert watch_of(emulated_arm, HERE, state_timeout=0.2) == {**EMULATED_WATCH, "state_timeout": 0.2}
    for name, value in EMULATED_WATCH.items():
        low, high, _ = range_of(name)
        assert low <= value <= high


def test_a_real_arm_keeps_its_safety_limits_whatever_it_is_called():
    assert REAL == {"state_timeout": 0.1, "watchdog_rate": 10.0}
    assert watch_of(ur, ELSEWHERE) == watch_of(ur, HERE) == watch_of(emulated_arm, ELSEWHERE) == REAL


def late(plugin, address, **given):
    return plugin.make(DeviceSetup(Rig(), address=address, watch=given)).connection._silence(3.0)


def test_late_states_of_an_emulated_arm_have_a_remedy_on_this_computer():
    busy = "this computer is too busy: close other programs"
    assert late(emulated_arm, HERE).endswith(f"{busy}.")  # the options are its defaults already
    options = ", or allow more time with --state-timeout 2 --watchdog-rate 0.5."
    assert late(emulated_arm, HERE, state_timeout=0.5).endswith(busy + options)
    assert late(ur, HERE).endswith(busy + options)
    assert late(emulated_arm, ELSEWHERE).endswith("for 3.00 s: a stop was sent to the arm.")
