"""How fast is i2t, against the peer a user would otherwise take?

    python -m experiments.benchmark --sections training rendering skin policy [--out DIR]

Every section interleaves our work and its peer's in one run, on the same machine with the same inputs, after
checking that both compute the same thing; the table gives the median of each and the median of the turns' ratios (above
1: we are faster). Each section takes three to five minutes on a quiet machine of two cores; `training`, `rendering` and
`skin` need the extra `bench`. Four more sections are run where they are named: `environment`, steps of the
environments of active touch, `startup`, a command's second run next to its first, `scaling`, touches by several
processes, and `logs`, the memory that the import of a long log takes.
"""

import os
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import jax

from experiments.benchmark import environment as benchmark_environment
from experiments.benchmark import logs as benchmark_logs
from experiments.benchmark import policy as benchmark_policy
from experiments.benchmark import rendering as benchmark_rendering
from experiments.benchmark import scaling as benchmark_scaling
from experiments.benchmark import skin as benchmark_skin
from experiments.benchmark import startup as benchmark_startup
from experiments.benchmark import training as benchmark_training
from experiments.benchmark.environment import EnvironmentBenchmark
from experiments.benchmark.logs import Logs
from experiments.benchmark.policy import Policy
from experiments.benchmark.rendering import Rendering
from experiments.benchmark.scaling import Scaling
from experiments.benchmark.skin import SkinBenchmark
from experiments.benchmark.startup import Startup
from experiments.benchmark.timing import BenchmarkRow
from experiments.benchmark.training import Training
from experiments.common.runs import check_folder, exit_code_of_run, write_json
from i2t.extras import require_extra
from i2t.options import read_options


@dataclass(frozen=True)
class Benchmark:
    """Sections to run, repetitions, and the folder of `benchmark.json`."""

    sections: tuple[str, ...] = ("training", "rendering", "skin", "policy")
    out: Path | None = None
    turns: int = 5
    training: Training = field(default_factory=Training)
    rendering: Rendering = field(default_factory=Rendering)
    skin: SkinBenchmark = field(default_factory=SkinBenchmark)
    policy: Policy = field(default_factory=Policy)
    environment: EnvironmentBenchmark = field(default_factory=EnvironmentBenchmark)
    startup: Startup = field(default_factory=Startup)
    scaling: Scaling = field(default_factory=Scaling)
    logs: Logs = field(default_factory=Logs)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = read_options(Benchmark, argv, program="python -m experiments.benchmark", description=__doc__, config=())
    return exit_code_of_run(partial(run, args))


def run(cfg: Benchmark) -> list[BenchmarkRow]:
    """Run the sections, print their tables, and write them down."""
    unknown = [name for name in cfg.sections if name not in SECTIONS]
    if unknown or not cfg.sections:
        raise ValueError(f"--sections is {' '.join(cfg.sections)!r}; choose from {', '.join(SECTIONS)}.")
    for name in cfg.sections:
        for peer in PEERS.get(name, ()):
            require_extra(peer, f"section {name}")
    if cfg.out is not None:
        check_folder(cfg.out)
    rows = [row for name in cfg.sections for row in SECTIONS[name](cfg)]
    print(table(rows))
    if cfg.out is not None:
        cfg.out.mkdir(parents=True, exist_ok=True)
        report = {
            "machine": {
                "cores": os.cpu_count(),
                "platform": platform.platform(),
                "device": jax.devices()[0].device_kind,
            },
            "config": asdict(cfg),
            "rows": [row._asdict() for row in rows],
        }
        write_json(cfg.out / "benchmark.json", report)
    return rows


def table(rows: list[BenchmarkRow]) -> str:
    """The rows as text, one comparison a line."""
    lines = [("section", "work", "ours", "peer", "", "ratio")]
    for row in rows:
        ours, peer = (f"{value:.3g} {row.unit}" for value in (row.ours, row.peer))
        lines.append((row.section, row.work, ours, peer, row.peer_name, f"{row.ratio:.2f}"))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


PEERS = {  # packages that a section compares with
    "training": ("torch",), "rendering": ("open3d", "embreex"), "skin": ("ContactMechanics",),
}  # fmt: skip
SECTIONS: dict[str, Callable[[Benchmark], list[BenchmarkRow]]] = {
    "training": lambda cfg: benchmark_training.section(cfg.training, cfg.turns),
    "rendering": lambda cfg: benchmark_rendering.section(cfg.rendering, cfg.turns),
    "skin": lambda cfg: benchmark_skin.section(cfg.skin, cfg.turns),
    "policy": lambda cfg: benchmark_policy.section(cfg.policy, cfg.turns),
    "environment": lambda cfg: benchmark_environment.section(cfg.environment, cfg.turns),
    "startup": lambda cfg: benchmark_startup.section(cfg.startup),
    "scaling": lambda cfg: benchmark_scaling.section(cfg.scaling, cfg.turns),
    "logs": lambda cfg: benchmark_logs.section(cfg.logs),
}
