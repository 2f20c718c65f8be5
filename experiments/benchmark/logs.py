"""Section `logs` of the benchmark: memory and time of the import of a long log of a skin, next to those of a short one.

A generated log at 400 Hz, in which a stage presses a simulated reading every three seconds, is imported by
`python -m i2t.convert stream` in a process of its own; the peer is the same command with the short log. Linux only.
"""

import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.benchmark.timing import BenchmarkRow

CHIPS = 5
RATE_HZ = 400.0
ROWS_OF_A_PRESS = 1200
REPEATED_PRESSES = 20  # after a minute the same presses come again
DEPTH_MM, ABOVE_MM = 0.8, 2.0
LEVEL_UT, LOG_NOISE_UT = 60.0, 1.5
KIB_PER_MIB = 1024
# The command, and the largest memory that its process had (KiB). The system's account of ended children (`rusage`)
# would count the memory of this process, from which they are forked.
IMPORT = """
import sys
from i2t.convert.commands import main
code = main(["stream", *sys.argv[1:]])
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
sys.exit(code)
"""


@dataclass(frozen=True)
class Logs:
    """Lengths of the logs, in rows."""

    long: int = 2_000_000
    short: int = 20_000


def section(setup: Logs) -> list[BenchmarkRow]:
    """Peak memory and wall-clock seconds of the long log and of the short one."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        long, short = (_measure(folder, rows) for rows in (setup.long, setup.short))
    work, peer = f"import of {setup.long} rows", f"{setup.short} rows"
    return [
        BenchmarkRow("logs", f"{work}, {what}", unit, mine, peer, other, other / mine)
        for what, unit, mine, other in zip(("peak memory", "time"), ("MiB", "s"), long, short, strict=True)
    ]


def write_log(path: Path, rows: int) -> Path:
    """A log of so many rows, simulated."""
    rng = np.random.default_rng(0)
    phase = np.minimum(np.arange(ROWS_OF_A_PRESS) / 200, 3 - np.abs(np.arange(ROWS_OF_A_PRESS) / 200 - 3))
    z = np.clip(ABOVE_MM - (ABOVE_MM + DEPTH_MM) * (phase - 1), -DEPTH_MM, ABOVE_MM)
    tails = []
    for _ in range(REPEATED_PRESSES):
        place = np.tile(rng.uniform(-6, 6, 2), (len(z), 1))
        share = np.maximum(-z, 0)[:, None] / DEPTH_MM
        values = share * rng.normal(scale=LEVEL_UT, size=3 * CHIPS)
        values += rng.normal(scale=LOG_NOISE_UT, size=values.shape)
        table = np.column_stack([place, z, share, values])
        tails += [",".join(f"{value:.3f}" for value in row) for row in table]
    names = ["time_s", "x_mm", "y_mm", "z_mm", "force_N"]
    names += [f"b{chip}{axis}_uT" for chip in range(CHIPS) for axis in "xyz"]
    with path.open("w") as file:
        file.write(",".join(names) + "\n")
        file.writelines(f"{row / RATE_HZ:.4f},{tails[row % len(tails)]}\n" for row in range(rows))
    return path


def _measure(folder: Path, rows: int) -> tuple[float, float]:
    """MiB and seconds of one import."""
    log = write_log(folder / f"{rows}.csv", rows)
    words = [sys.executable, "-c", IMPORT, str(log), str(folder / f"presses_{rows}.csv")]
    begin = time.perf_counter()
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(f"the import of {log.name} ended with {done.returncode}: {done.stderr.strip()[-200:]}")
    return int(done.stdout.split()[-1]) / KIB_PER_MIB, time.perf_counter() - begin
