"""Question: how fast is i2t compared with the library that a user would otherwise choose?

    python -m experiments.benchmark --sections training rendering skin [--out DIR]

Each row times i2t and a peer alternately, on the same machine with the same inputs, after checking that their results
agree. The table gives the median of each and the median of the ratios per turn (above 1: i2t is faster). A section
takes three to five minutes on a quiet machine with two cores; `training`, `rendering` and `skin` need the extra
`bench`. Sections `latency`, `simulation` and `startup` have goals instead of peers. `startup` runs commands and
examples with nothing compiled, then once more, in twenty minutes per turn (`--commands` selects some);
`python -m experiments.benchmark.programs` lists what they compile. `accelerator` is for a GPU: patches compared with a
peer, and rates.
"""

import os
import platform
from collections.abc import Callable, Iterator
from itertools import chain

import jax

from experiments.benchmark import accelerator, startup
from experiments.benchmark.arguments import BenchmarkArgs, BenchmarkSection
from experiments.benchmark.contests import BenchmarkRow, Contest, measure
from experiments.benchmark.goals import latency, simulation
from experiments.benchmark.rendering import rendering
from experiments.benchmark.skin import skin
from experiments.benchmark.startup import COMMANDS, StartupRow
from experiments.benchmark.training import training
from experiments.common.runs import write_json
from experiments.common.tables import text_table

CONTESTS: dict[BenchmarkSection, Callable[[bool], Iterator[Contest]]] = {  # True selects small sizes
    "training": training,
    "rendering": rendering,
    "skin": skin,
    "latency": latency,
    "simulation": simulation,
    "accelerator": lambda small: chain(accelerator.patches(small), accelerator.rates(small)),
}


def run(args: BenchmarkArgs) -> list[BenchmarkRow]:
    """Run the sections, print their tables, and write `benchmark.json` to --out."""
    small = args.preset == "debug"
    rows = [
        measure(name, contest, args.turns)
        for name in args.sections
        if name in CONTESTS
        for contest in CONTESTS[name](small)
    ]
    if rows:
        print(table(rows))
    started = _startup(args, small) if "startup" in args.sections else []
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        machine = {"cores": os.cpu_count(), "platform": platform.platform(), "device": jax.devices()[0].device_kind}
        report = {
            "machine": machine,
            "config": {"turns": args.turns, "preset": args.preset},
            "rows": [row._asdict() for row in rows],
            "startup": [row._asdict() for row in started],
        }
        write_json(args.out / "benchmark.json", report)
    return rows


def _startup(args: BenchmarkArgs, small: bool) -> list[StartupRow]:
    """Run section `startup`; print each row when it is measured, and the table at the end."""
    commands = [
        command
        for command in (COMMANDS[:1] if small else COMMANDS)
        if not args.commands or any(part in command.line for part in args.commands)
    ]
    rows = []
    for row in startup.startup(commands, args.turns):
        print(*startup.cells(row), sep=" | ", flush=True)
        rows.append(row)
    print(startup.table(rows))
    return rows


def table(rows: list[BenchmarkRow]) -> str:
    """Format the rows as text."""
    lines = []
    for row in rows:
        ours = f"{row.ours:.3g} ({row.least:.3g} to {row.most:.3g}) {row.unit}"
        peer = "-" if row.peer is None else f"{row.peer:.3g} {row.unit}"
        ratio = "-" if row.ratio is None else f"{row.ratio:.2f}"
        goal = "-" if row.goal is None else f"{row.goal:g}"
        lines.append((row.section, row.work, ours, peer, row.peer_name, ratio, goal))
    return text_table(("section", "work", "ours (range)", "peer", "", "ratio", "goal"), lines)
