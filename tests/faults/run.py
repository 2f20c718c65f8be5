"""Question: what is lost, and what moves, when a part fails while touches are collected?

    python -m tests.faults                         all sections at full size: some hours
    python -m tests.faults --sections skin disk    some sections
    python -m tests.faults --preset debug          one trial of each fault

The same command resumes where it stopped, because every trial is saved as soon as it is made.

Real drivers are connected to emulators of a skin and a UR controller (whose watchdog and protective stop follow
Universal Robots' documents and were not compared with a real controller), and simulated devices fill disks and press a
thousand times. Every figure is given with its number of trials. Results are written to --out: report.md and
metrics.json. The exit code is 1 if a goal was missed.
"""

import re
import time

from experiments.common.runs import write_json
from i2t.errors import DeviceError
from tests.faults.arguments import FaultsArgs
from tests.faults.camera import CAMERA_FAULTS
from tests.faults.data import DATA_FAULTS
from tests.faults.motion import MOTION_FAULTS
from tests.faults.rig import RIG_FAULTS
from tests.faults.skin import SKIN_FAULTS
from tests.faults.table import Fault, FaultRow, judge, report, run_trials

FAULTS: tuple[Fault, ...] = (*DATA_FAULTS, *CAMERA_FAULTS, *MOTION_FAULTS, *SKIN_FAULTS, *RIG_FAULTS)


def run(args: FaultsArgs) -> int:
    """Every fault of the sections that were asked for, and the report after each.

    Returns:
        1 if a goal was missed, else 0.
    """
    rows: list[FaultRow] = []
    args.out.mkdir(parents=True, exist_ok=True)
    for fault in (each for section in args.sections for each in FAULTS if each.section == section):
        begun = time.monotonic()
        rows.append(_tried(fault, args))
        print(f"{report(rows[-1:]).splitlines()[-1]} ({time.monotonic() - begun:.0f} s)", flush=True)
        (args.out / "report.md").write_text(report(rows) + "\n")
    write_json(args.out / "metrics.json", {"source": "simulated", "rows": [row._asdict() for row in rows]})
    missed = sum(row.met is False for row in rows)
    print(f"{len(rows)} faults, {missed} goals missed; the report is {args.out / 'report.md'}")
    return int(bool(missed))


def _tried(fault: Fault, args: FaultsArgs) -> FaultRow:
    """The row of a fault, with the trials of an earlier run where they are kept."""
    count = fault.count if args.preset == "paper" else 1
    path = args.out / "trials" / f"{fault.section}-{re.sub('[^a-z0-9.]+', '-', fault.name.lower())}.jsonl"
    try:
        return judge(fault, run_trials(fault, count, path), count)
    except DeviceError as error:
        return FaultRow(fault.section, fault.name, "-", f"ended early: {error}", "", False)
