"""The report of faults on its debug preset, and real drivers with emulators, killed once."""

import json
import os
import subprocess
import sys
import time

import numpy as np
import pytest

from experiments.faults import __main__ as command_line
from experiments.faults import arm, links, sites, stalls
from experiments.faults import run as faults
from experiments.faults.rows import FaultRow
from i2t import dataset
from i2t.collect.recorder import INTERRUPTED, site_number_of, touches_in
from i2t.emulators import reskin_board, ur_controller
from i2t.types import ReturnCode


@pytest.mark.full
def test_the_report_of_disks_and_cameras_that_fail_says_whether_its_goals_were_met(tmp_path, capsys, monkeypatch):
    words = ["--preset", "debug", "--sections", "disk", "--out", str(tmp_path / "faults")]
    assert command_line.main(words) == 0
    rows = json.loads((tmp_path / "faults" / "metrics.json").read_text())["rows"]
    assert [row["section"] for row in rows] == 4 * ["disk"]
    assert all(row["met"] in (True, None) for row in rows)
    report = tmp_path / "faults" / "report.md"
    assert "| disk | camera unplugged | 1 times | 0 of 2 acknowledged" in report.read_text()
    assert "0 goals missed" in capsys.readouterr().out
    monkeypatch.setitem(faults.SECTIONS, "disk", lambda sizes: [FaultRow("disk", "what", "once", "3", "0", False)])
    assert command_line.main([*words[2:-1], str(tmp_path / "missed")]) == 1
    assert "MISSED" in (tmp_path / "missed" / "report.md").read_text()


def test_a_run_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    made = []

    def section(sizes, trials):
        def trial(number):
            made.append(number)
            if len(made) == 3:
                raise KeyboardInterrupt
            return None if number == 1 else {"value": number}

        return [FaultRow("rig", "what", str(len(trials.run(4, trial))), "", "", True)]

    monkeypatch.setitem(faults.TRIAL_SECTIONS, "rig", section)
    command = ["--sections", "rig", "--out", str(tmp_path)]
    assert command_line.main(command) == 130
    with (tmp_path / "trials" / "rig.jsonl").open("a") as file:
        file.write('{"number": 9')  # as a kill leaves it
    assert command_line.main(command) == 0
    assert made == [0, 1, 2, 1, 2, 3]  # what could not be made is tried again, what is kept is not
    assert command_line.main(command) == 0
    assert len(made) == 6
    assert command_line.main([*command, "--again"]) == 0
    assert made[6:] == [0, 1, 2, 3]


@pytest.mark.full
def test_links_and_stalls_of_a_debug_run(tmp_path):
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    (kind,) = {links._trial(0, "lost control connection")["moved"]}
    assert kind is False
    stalled = stalls._stall(1)
    if stalled["pressed"]:  # a busy machine may end the press before
        assert not stalled["moved"]
    died, ended = stalls._dying_skin(0)
    assert 1.0 <= died < ended < died + 3.9


@pytest.mark.full
def test_presses_from_all_sides_are_judged_by_embree():
    scene = sites._lab("hexagon", 0)[1]
    T_b_t = scene.T_b_o @ np.diag([1.0, -1.0, -1.0, 1.0])
    top = sites._mesh("hexagon").vertices[:, 2].max()
    for away in (0.001, 0.0, -0.002):
        pose = T_b_t.copy()
        pose[:3, 3] = scene.T_b_o[:3, 3] + (top + away) * scene.T_b_o[:3, 2]
        assert abs(sites._through("hexagon", scene.T_b_o, pose) + away) < 1e-6
    pose[:3, 3] += 0.2 * scene.T_b_o[:3, 0]
    assert sites._through("hexagon", scene.T_b_o, pose) == -1.0


@pytest.mark.full
def test_real_drivers_collect_with_emulators_are_killed_and_go_on(tmp_path):
    """A springy plane, and a skin that feels nothing of it: presses end by force. `kill -9` in the second touch."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    if sys.platform != "linux":
        pytest.skip("needs the addresses 127.x.y.z, which only Linux gives without asking")
    host, out = ur_controller.loopback(97), tmp_path / "set"
    with (
        ur_controller.process(host, "--plane", "0.03", "--stiffness", "5000"),
        reskin_board.started() as (port, _),
    ):
        command = [sys.executable, "-m", "experiments.faults.worker", host, port, str(out)]
        with subprocess.Popen([*command, "100", "1"], stdout=subprocess.PIPE, text=True) as first:
            assert first.stdout.readline() == "begun\n"
            acknowledged = first.stdout.readline().strip()
            while not (out / ".under-way").exists():
                assert first.poll() is None
                time.sleep(0.01)
            first.kill()
        assert acknowledged in [path.name for path in touches_in(out)]
        deadline = time.monotonic() + 10.0
        while arm.status(host)["moving"] or arm.status(host)["runtime"] == 2:  # the watchdog ends its program
            assert time.monotonic() < deadline
            time.sleep(0.05)
        wanted = len(touches_in(out)) + 1
        again = [*command, str(wanted), "1"]  # and again, where a device that waited for a core has ended the session
        assert any(subprocess.run(again, env=os.environ, timeout=240, check=False).returncode == 0 for _ in range(3))
    data = dataset.load_dataset(out)
    assert len(data) == wanted
    assert sorted(site_number_of(path) for path in touches_in(out)) == list(range(wanted))
    assert list((out / INTERRUPTED).glob("*.raw"))
    assert (data.touches.code == ReturnCode.WRENCH).all()
    assert ((data.touches.force > 7.9) & (data.touches.force < 8.0 + 5e3 * 4e-3 * 1.0)).all()  # 1 s late at the most
    np.testing.assert_allclose(0.03 - data.touches.T_w_t[:, 2, 3], data.touches.force / 5e3, atol=2e-5)
