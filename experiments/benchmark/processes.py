"""Sections `startup` and `logs` of the benchmark: work in processes of their own, which say what it took."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from experiments.benchmark.contests import Contest
from i2t.compile_cache import VARIABLE

DEBUG_TRAINING = ("-m", "experiments.train", "--preset", "debug")
CHIPS, RATE_HZ = 5, 400.0
LONG_LOG, SHORT_LOG = 2_000_000, 20_000  # rows
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


def run_python(words: list[str], **variables: str) -> str:
    """What a Python of its own prints.

    Args:
        words: After the interpreter's name.
        **variables: Of its environment.

    Returns:
        Its output.

    Raises:
        ValueError: It failed.
    """
    done = subprocess.run([sys.executable, *words], capture_output=True, text=True, env=os.environ | variables)
    if done.returncode:
        raise ValueError(f"{' '.join(words)[:80]} ended with {done.returncode}: {done.stderr.strip()[-200:]}")
    return done.stdout


# A command's second run, which finds what the first compiled


def startup(small: bool) -> Iterator[Contest]:
    """A command's second run, which finds what the first compiled in an empty folder, next to the first."""
    words = list(("-c", "import jax; print(jax.jit(lambda x: x)(1))") if small else DEBUG_TRAINING)
    with tempfile.TemporaryDirectory() as folder:
        runs = iter(range(1_000_000))

        def seconds(compiled: str) -> float:
            begin, out = time.perf_counter(), [] if small else ["--out", f"{folder}/{next(runs)}"]
            run_python([*words, *out], **{VARIABLE: f"{folder}/{compiled}"})
            return time.perf_counter() - begin

        def first() -> float:
            return seconds(f"compiled-{next(runs)}")

        seconds("compiled")
        work = "python -m experiments.train --preset debug, again"
        yield Contest(work, lambda: seconds("compiled"), "the first run", first, measured=True)


# The import of a long log


def logs(small: bool) -> Iterator[Contest]:
    """Memory and time of the import of a long log of a skin, next to those of a short one. Linux only.

    A generated log at 400 Hz, in which a stage presses a simulated reading every three seconds, is imported by
    `python -m i2t.convert stream` in a process of its own; the peer is the same command with the short log.
    """
    long, short = (6000, 3000) if small else (LONG_LOG, SHORT_LOG)
    with tempfile.TemporaryDirectory() as folder:
        paths = [write_log(Path(folder) / f"{rows}.csv", rows) for rows in (long, short)]
        work, peer = f"import of {long} rows", f"{short} rows"
        ours, theirs = (partial(_imported, path) for path in paths)
        yield Contest(f"{work}, peak memory", ours, peer, theirs, unit="MiB", measured=True)
        yield Contest(f"{work}, time", ours, peer, theirs)


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
        tails += [",".join(f"{value:.3f}" for value in row) for row in np.column_stack([place, z, share, values])]
    names = ["time_s", "x_mm", "y_mm", "z_mm", "force_N"]
    names += [f"b{chip}{axis}_uT" for chip in range(CHIPS) for axis in "xyz"]
    with path.open("w") as file:
        file.write(",".join(names) + "\n")
        file.writelines(f"{row / RATE_HZ:.4f},{tails[row % len(tails)]}\n" for row in range(rows))
    return path


def _imported(log: Path) -> float:
    """MiB of one import."""
    out = log.with_suffix(".presses.csv")
    out.unlink(missing_ok=True)
    return int(run_python(["-c", IMPORT, str(log), str(out)]).split()[-1]) / KIB_PER_MIB
