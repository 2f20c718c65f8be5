"""Emulators in processes of their own."""

import os
import sys

import pytest

from i2t.emulators.processes import run_emulator


@pytest.mark.skipif(sys.platform != "linux", reason="needs pseudo-terminals and sessions")
def test_ctrl_c_in_the_terminal_does_not_reach_an_emulator_which_ends_with_its_block():
    with run_emulator("i2t.emulators.reskin_board") as (port, process):
        assert os.path.exists(port)
        assert os.getsid(process.pid) == process.pid != os.getsid(0)
    assert process.poll() is not None
