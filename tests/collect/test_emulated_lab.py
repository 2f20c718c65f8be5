"""The command as a lab types it (`--arm ur --skin reskin --camera simulated`), with emulators started by hand."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from i2t import dataset
from i2t.collect import command
from i2t.depth.camera import Camera
from i2t.emulators import lab as emulated_lab
from i2t.emulators import ur_controller
from i2t.hardware.rig import Rig
from i2t.types import ReturnCode

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the addresses 127.x.y.z")

# The emulated board, the thread that hears it and the arm's process share the machine with the other tests: each may
# wait for a core longer than a lab's devices may be silent (0.1 s, 10 Hz and 0.15 s), which no claim here is about.
PATIENT = ["--state-timeout", "3", "--watchdog-rate", "0.5", "--settings.silence", "2", "--settings.hold", "2"]
ATTEMPTS = 20


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Emulators over a star that stands where it is believed, and a rig."""
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    path = tmp_path_factory.mktemp("lab")
    rig = replace(Rig(), camera=Camera(160, 90, 80.6, 80.5, 79.5, 44.5))
    rig.write(path / "lab.toml")
    host, link = ur_controller.loopback(202), path / "skin"
    options = ["--object", "star", "--no-pose-error", "--rig", str(path / "lab.toml")]
    with emulated_lab.started("--host", host, "--link", str(link), *options):
        yield path, ["--arm", "ur", "--host", host, "--rig", str(path / "lab.toml"), "--object", "star",
                     "--camera", "simulated", "--no-pose-error", "--touches", "1", *PATIENT]  # fmt: skip


def collected(words: list[str]) -> bool:
    """Whether touches are collected; a session that a starved device has ended goes on with the same command."""
    return any(command.main(words) == 0 for _ in range(ATTEMPTS))


@pytest.mark.full
def test_an_arm_by_its_address_a_skin_by_its_port_and_a_simulated_camera(lab, capsys):
    path, options = lab
    out = path / "touched"
    assert collected(["--out", str(out), "--skin", "reskin", "--port", str(path / "skin"), *options])
    assert "SIMULATED: no real device takes part" in capsys.readouterr().out  # a pseudo-terminal is no lab
    made = dataset.load_dataset(out)
    assert made.source == "simulated"
    assert made.meta["arm serial number"] == "20200000001"  # as the controller's dashboard tells it
    touches = made.touches
    assert touches.code[0] in (ReturnCode.SKIN, ReturnCode.WRENCH)
    assert np.linalg.norm(touches.reading[0]) > 10
    assert 0.026 < touches.T_w_t[0, 2, 3] < 0.0305  # the star's flat top, less what skin, arm and mount give
    seen = touches.patch[0][np.isfinite(touches.patch[0])]
    assert np.abs(np.median(seen)) < 1e-3  # the view shows the site where the arm went
