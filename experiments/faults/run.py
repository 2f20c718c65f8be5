"""Question: what is lost, and what moves, when something breaks while touches are collected?

    python -m experiments.faults                         everything at full size: about two hours
    python -m experiments.faults --sections skin disk    some of it
    python -m experiments.faults --preset debug          everything once or twice, in a minute

The same command goes on where it was stopped: sections that are done are kept, and of the sections rig, sites, links
and stalls every trial is kept as it is made. `--again` begins anew.

Real drivers talk to emulators of a skin and a UR controller (whose watchdog and protective stop follow Universal
Robots' documents and were compared with no real controller), and simulated devices fill disks and press a thousand
times. Every figure says how often it was tried. Results go to --out: report.md and metrics.json. Exit code 1 if a goal
was missed.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict

from experiments.common.presets import choose_preset
from experiments.common.runs import write_json
from experiments.faults.ambient import ambient
from experiments.faults.arguments import PRESETS, FaultsArgs, FaultSection
from experiments.faults.arm import arm, force
from experiments.faults.kill import kill
from experiments.faults.links import links
from experiments.faults.rig import rig
from experiments.faults.rows import FaultCounts, FaultRow
from experiments.faults.simulated import disk, presses
from experiments.faults.sites import sites
from experiments.faults.skin import skin
from experiments.faults.stalls import stalls
from experiments.faults.trials import TrialStore
from experiments.faults.volume import volume
from experiments.faults.wire import wire
from i2t.errors import DeviceError

SECTIONS: dict[FaultSection, Callable[[FaultCounts], list[FaultRow]]] = {
    "disk": disk,
    "presses": presses,
    "ambient": ambient,
    "wire": wire,
    "arm": arm,
    "skin": skin,
    "force": force,
    "volume": volume,
    "kill": kill,
}
TRIAL_SECTIONS: dict[FaultSection, Callable[[FaultCounts, TrialStore], list[FaultRow]]] = {
    "rig": rig,
    "sites": sites,
    "links": links,
    "stalls": stalls,
}


def run(args: FaultsArgs) -> int:
    """Every section that was asked for, and the report after each.

    Returns:
        1 if a goal was missed, else 0.
    """
    rows: list[FaultRow] = []
    sizes = choose_preset(PRESETS, args.preset).times(args.share)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.sections:
        print(f"{name} ...", flush=True)
        begun = time.monotonic()
        found = _section(name, args, sizes)
        rows += found
        print(table(found), f"({time.monotonic() - begun:.0f} s)\n", sep="\n", flush=True)
        (args.out / "report.md").write_text(table(rows) + "\n")
        write_json(args.out / "metrics.json", {"sizes": asdict(sizes), "rows": [row._asdict() for row in rows]})
    missed = sum(row.met is False for row in rows)
    print(f"{len(rows)} figures, {missed} goals missed; the report is {args.out / 'report.md'}")
    return int(bool(missed))


def _section(name: FaultSection, args: FaultsArgs, sizes: FaultCounts) -> list[FaultRow]:
    """The figures of a section, of an earlier run where they are kept."""
    kept, trials = args.out / "sections" / f"{name}.json", args.out / "trials" / f"{name}.jsonl"
    if args.again:
        kept.unlink(missing_ok=True)
        trials.unlink(missing_ok=True)
    if kept.exists():
        before = json.loads(kept.read_text())
        if before["sizes"] == asdict(sizes):
            return [FaultRow(**row) for row in before["rows"]]
    try:
        found = SECTIONS[name](sizes) if name in SECTIONS else TRIAL_SECTIONS[name](sizes, TrialStore(trials))
    except DeviceError as error:
        return [FaultRow(name, "the section", "-", f"ended early: {error}", "", False)]
    kept.parent.mkdir(exist_ok=True)
    write_json(kept, {"sizes": asdict(sizes), "rows": [row._asdict() for row in found]})
    return found


def table(rows: Sequence[FaultRow]) -> str:
    """Figures as a table in Markdown."""
    lines = ["| section | what | tried | measured | goal | |", "| --- | --- | --- | --- | --- | --- |"]
    outcomes = {True: "met", False: "MISSED", None: ""}
    return "\n".join(
        lines
        + [
            f"| {row.section} | {row.what} | {row.tried} | {row.measured} | {row.goal} | {outcomes[row.met]} |"
            for row in rows
        ]
    )
