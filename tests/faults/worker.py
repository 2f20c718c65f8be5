"""A collection that starts quickly, to be killed: the drivers, the procedure and the recorder of `i2t.collect.session`,
with a camera and a patch in closed form.

    python -m tests.faults.worker HOST PORT FOLDER TOUCHES [WATCHDOG]

prints the name of each touch once it is kept.
"""

import sys
from dataclasses import replace
from pathlib import Path

from i2t.cli.exit_codes import exit_code_of
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import Recorder, list_touches, site_number_of
from i2t.collect.settings import TouchSettings
from i2t.collect.touch import TOOL, SkinOnTool
from i2t.depth.camera import Camera
from i2t.emulators.in_process import SimulatedCamera
from i2t.hardware.clock import MonotonicClock
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.rig import Rig
from i2t.hardware.ur.driver import UrArm
from tests.faults.closed_form import BOARD, HEIGHT_M, make_scene, plane_patch, session_info, site

QUICK_SETTINGS = TouchSettings(
    prepare=20e-3, near=2e-3, approach=0.04, press=0.004, settle=0.02, clearance=0.02, speed=0.25
)  # with the patience of a lab, or of the watchdog where that is longer
WORKER_STATE_TIMEOUT_S = 0.5
LENS = Camera(320, 180, 161.2, 161.05, 159.5, 89.5)


def main(host: str, port: str, folder: str, touches: str, watchdog: str = "10") -> int:
    """Collect; returns the exit code."""
    rig, out = Rig(), Path(folder)
    done = {site_number_of(path) for path in list_touches(out)}
    payload, timeout = (rig.mass, rig.centre), max(WORKER_STATE_TIMEOUT_S, 2 / float(watchdog))
    arm = UrArm(host, rig.limits, rig.T_flange_tool, payload, state_timeout=timeout, watchdog_rate=float(watchdog))
    camera = SimulatedCamera(make_scene(), LENS, rig.T_tool_camera, lambda: arm.state().T_b_t, MonotonicClock())
    with ReSkin(port) as skin, camera, arm, Recorder(out, session_info(rig, LENS, "emulated")) as recorder:
        settings = replace(QUICK_SETTINGS, silence=max(QUICK_SETTINGS.silence, 1 / float(watchdog)))
        procedure = Procedure(arm, [SkinOnTool(TOOL, skin, BOARD)], camera, rig, plane_patch, HEIGHT_M, settings)
        print("begun", flush=True)
        left = (number for number in range(int(touches)) if number not in done)
        for _ in procedure.run(lambda history: next((site(number) for number in left), None), recorder):
            if recorder.saved:
                print(recorder.saved[-1].name, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code_of(lambda: main(*sys.argv[1:]), "stopped; the same command goes on"))
