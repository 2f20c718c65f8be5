"""The report of faults, and each kind of fault tried once or twice."""

import json
import signal
import sys
from functools import partial
from typing import Any

import numpy as np
import pytest

from i2t.hardware.rig import Rig
from tests.faults import __main__ as command_line
from tests.faults import camera, data, motion, rig
from tests.faults import run as faults
from tests.faults.arguments import FAULT_SECTIONS
from tests.faults.table import Fault, Measure, judge


def fault(trial, *measures, count=4):
    return Fault("disk", "anything", trial, count, measures)


def test_a_goal_is_missed_by_a_bad_trial_a_bad_share_nan_or_too_few_trials():
    trials: list[dict[str, Any]] = [
        {"gained": 1.0, "lost": 1, "sent": 10, "said": "stopped"},
        {"gained": 3.0, "lost": 0, "sent": 90},
    ]

    def met(*measures, made=trials, count=2):
        return judge(fault(None, *measures), made, count).met

    assert met(Measure("gained", 3.0, "N")) is True
    assert met(Measure("gained", 2.9, "N")) is False
    assert met(Measure("lost", 0.01, of="sent")) is True
    assert met(Measure("lost", 0.009, of="sent")) is False
    assert met(Measure("gained", unit="N")) is None
    assert met(Measure("gained", 3.0), made=[*trials, {"gained": np.nan}], count=3) is False
    assert met(Measure("gained", 3.0), count=5) is False
    assert met(Measure("gained", 3.0), made=[], count=1) is False
    row = judge(fault(None, Measure("gained", 3.0, "N"), Measure("lost", 0.01, of="sent")), trials, 2)
    assert row.measured == 'gained median 2, worst 3 N; lost 0.01 of 100 sent; 1 x "stopped"'
    assert row.goal == "gained <= 3; lost <= 0.01"


def test_a_run_resumes_and_reports_whether_its_goals_were_met(tmp_path, monkeypatch, capsys):
    made = []

    def trial(number):
        made.append(number)
        if len(made) == 3:
            raise KeyboardInterrupt
        return None if number == 1 else {"value": number}

    monkeypatch.setattr(faults, "FAULTS", (fault(trial, Measure("value", 3)),))
    command = ["--sections", "disk", "--out", str(tmp_path)]
    assert command_line.main(command) == 130
    with (tmp_path / "trials" / "disk-anything.jsonl").open("a") as file:
        file.write('{"number": 9')  # as a kill leaves it
    assert command_line.main(command) == 0
    assert made == [0, 1, 2, 1, 2, 3]  # what could not be made is tried again, what is kept is not
    assert command_line.main([*command, "--preset", "debug"]) == 0
    assert len(made) == 6
    assert (
        "| disk | anything | 1 of 1 | value median 0, worst 0 | value <= 3 | met |"
        in (tmp_path / "report.md").read_text()
    )
    monkeypatch.setattr(faults, "FAULTS", (fault(trial, Measure("value", 2)),))
    assert command_line.main(command) == 1
    assert "MISSED" in (tmp_path / "report.md").read_text()
    assert json.loads((tmp_path / "metrics.json").read_text())["rows"][0]["met"] is False
    assert "1 goals missed" in capsys.readouterr().out


def test_every_section_has_faults_by_names_of_their_own():
    assert {each.section for each in faults.FAULTS} == set(FAULT_SECTIONS)
    assert len({(each.section, each.name) for each in faults.FAULTS}) == len(faults.FAULTS)


QUICK = [
    each for each in faults.FAULTS
    if each.section in ("disk", "presses")
    or each.name == "skin dies in a press, simulated"
]  # fmt: skip


@pytest.mark.full
@pytest.mark.parametrize("each", QUICK, ids=lambda each: f"{each.section}: {each.name}")
def test_faults_within_the_process_meet_their_goals(each):
    trials = [each.trial(number) for number in range(2)]
    if trials == [None, None]:
        pytest.skip("a disk can be made only by root")
    assert judge(each, trials, 2).met is True


@pytest.mark.full
def test_nothing_moves_after_a_failure_in_a_motion():
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    for harm in motion.BROKEN_LINKS.values():
        tried = (motion.break_in_motion(harm, number, 5.0) for number in range(4))
        found = next((each for each in tried if each is not None), None)  # a busy machine may end a motion before
        assert found is None or not (found["moved again"] or found["crashed"])
    stalled = motion.stalled_press(True, 1)
    assert stalled is None or not stalled["moved again"]


@pytest.mark.full
def test_presses_from_all_sides_are_judged_by_embree():
    scene = rig.object_lab("hexagon", Rig(), 0)[1]
    T_b_t = scene.T_b_o @ np.diag([1.0, -1.0, -1.0, 1.0])
    top = rig.rig_object("hexagon").vertices[:, 2].max()
    for away in (0.001, 0.0, -0.002):
        pose = T_b_t.copy()
        pose[:3, 3] = scene.T_b_o[:3, 3] + (top + away) * scene.T_b_o[:3, 2]
        assert abs(rig._through("hexagon", scene.T_b_o, pose) + away) < 1e-6
    pose[:3, 3] += 0.2 * scene.T_b_o[:3, 0]
    assert rig._through("hexagon", scene.T_b_o, pose) == -1.0


@pytest.mark.parametrize("number", [0, 4, 6, 7])  # changed bytes, a cut end, and PNGs that claim to be huge
def test_damaged_camera_files_are_refused_in_one_sentence_and_little_memory(number):
    found = camera.damaged_file(number)
    assert not found["wrong"]
    assert found["said"].endswith("refused")
    assert found["memory"] < camera.MOST_GB


@pytest.mark.full
@pytest.mark.parametrize("signals", [[signal.SIGKILL], [signal.SIGHUP], [signal.SIGINT, signal.SIGINT]])
def test_real_drivers_with_emulators_resume_after_a_kill(monkeypatch, signals):
    """`kill -9`, a closed terminal and an impatient Ctrl-C of a collection with real drivers; the next one makes the
    touches that are missing.
    """
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    if sys.platform != "linux":
        pytest.skip("needs the addresses 127.x.y.z, which only Linux gives without asking")
    monkeypatch.setattr(data, "WATCHDOG_HZ", "1")  # a machine that is busy with other tests is not a fault
    found = next(filter(None, map(partial(data.killed_collection, signals), range(4))))
    assert found["lost"] == found["unreadable"] == found["incomplete"] == found["rambling"] == 0
    assert found["stands after"] < 1.2
