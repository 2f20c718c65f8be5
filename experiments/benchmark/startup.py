"""Section `startup` of the benchmark: a command's second run, which finds what the first compiled, next to its first.

Each turn begins with an empty folder of compiled code (`i2t.compile_cache`) and runs the command twice; the peer is the
first run.
"""

import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass

from experiments.benchmark.timing import BenchmarkRow, compare
from i2t.compile_cache import VARIABLE


@dataclass(frozen=True)
class Startup:
    """Command, as words after `python -m`."""

    command: tuple[str, ...] = ("experiments.train", "--preset", "debug")
    turns: int = 1  # each is two runs


def section(setup: Startup) -> list[BenchmarkRow]:
    """Wall-clock seconds of the second run and of the first."""
    first, second = [], []
    for _ in range(setup.turns):
        with tempfile.TemporaryDirectory() as folder:
            first.append(_run(setup.command, folder, "first"))
            second.append(_run(setup.command, folder, "second"))
    return [compare("startup", f"python -m {' '.join(setup.command)}, again", second, "the first run", first)]


def _run(command: tuple[str, ...], folder: str, out: str) -> float:
    """Seconds of one run."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    words = [sys.executable, "-m", *command, "--out", os.path.join(folder, out)]
    begin = time.perf_counter()
    done = subprocess.run(
        words, env=environment | {VARIABLE: os.path.join(folder, "compiled")}, capture_output=True, text=True
    )
    if done.returncode:
        raise ValueError(f"python -m {' '.join(command)} ended with {done.returncode}: {done.stderr.strip()[-200:]}")
    return time.perf_counter() - begin
