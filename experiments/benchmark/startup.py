"""Section `startup`: durations of commands and examples on their first run, with nothing compiled, and on the second.

Each runs in its own process with an empty folder of compiled programs, then once more. Wall time ends at the awaited
output or at the end of the process, processor time at the end of the process. Each row has a goal instead of a peer.
"""

import os
import shlex
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from experiments.common.tables import text_table

ROOT = Path(__file__).parents[2]


class TimedCommand(NamedTuple):
    """A command, and its goals on two quiet cores."""

    line: str  # arguments of `python`
    first_goal: float  # s, wall time with nothing compiled
    second_goal: float  # s, wall time of the second run
    until: str = ""  # awaited output, at which it is interrupted (Ctrl-C); empty to run to the end
    trained: bool = False  # whether it needs a run of `experiments.train`


class StartupRow(NamedTuple):
    """Durations of a command: medians, and ranges over the turns."""

    command: str
    first: float  # s, wall
    first_range: tuple[float, float]
    first_processor: float  # s, sum over the cores
    first_goal: float
    second: float
    second_range: tuple[float, float]
    second_processor: float
    second_goal: float


EXAMPLES = sorted(path.name for path in (ROOT / "examples").glob("[0-9][0-9]_*.py"))
COMMANDS = (
    TimedCommand("-m i2t.imagine", 8, 4),
    TimedCommand("-m experiments.train --preset debug --out runs/debug", 20, 10),
    TimedCommand("-m experiments.train", 90, 50),
    TimedCommand("-m experiments.recognize", 90, 60, trained=True),
    TimedCommand("-m experiments.reconstruct", 90, 60, until="growing.png"),
    *(TimedCommand(f"examples/{name}", 15, 6) for name in EXAMPLES),
)


def startup(commands: Sequence[TimedCommand], turns: int) -> Iterator[StartupRow]:
    """Time commands one after the other.

    Args:
        commands: Commands to run.
        turns: Number of turns, each with nothing compiled.

    Yields:
        Row of each command, when it is measured.

    Raises:
        RuntimeError: A command fails, or ends without the awaited output.
    """
    with tempfile.TemporaryDirectory() as folder:
        workspace = Path(folder)
        for command in commands:
            if command.trained and not (workspace / "runs/train").exists():
                _run(TimedCommand("-m experiments.train", 0, 0), workspace, workspace / "other")
            durations = []
            for _ in range(turns):
                with tempfile.TemporaryDirectory() as compiled:
                    durations.append(
                        (_run(command, workspace, Path(compiled)), _run(command, workspace, Path(compiled)))
                    )
            yield _row(command, durations)


def table(rows: Sequence[StartupRow]) -> str:
    """Format the rows as text."""
    head = ("command", "first", "processor", "goal", "second", "processor", "goal")
    return text_table(head, (cells(row) for row in rows))


def cells(row: StartupRow) -> tuple[str, ...]:
    """Format the cells of a row, in seconds."""
    first, second = (
        f"{wall:.1f}" if least == most else f"{wall:.1f} ({least:.1f} to {most:.1f})"
        for wall, (least, most) in ((row.first, row.first_range), (row.second, row.second_range))
    )
    return (
        f"python {row.command}",
        *(first, f"{row.first_processor:.1f}", f"{row.first_goal:g}"),
        *(second, f"{row.second_processor:.1f}", f"{row.second_goal:g}"),
    )


def _row(command: TimedCommand, turns: Sequence[tuple[tuple[float, float], tuple[float, float]]]) -> StartupRow:
    """Summarise (wall, processor) seconds of the first and second run in each turn."""
    (first, first_cpu), (second, second_cpu) = (zip(*runs, strict=True) for runs in zip(*turns, strict=True))
    return StartupRow(
        *(command.line, statistics.median(first), (min(first), max(first)), statistics.median(first_cpu)),
        command.first_goal,
        *(statistics.median(second), (min(second), max(second)), statistics.median(second_cpu), command.second_goal),
    )


def _run(command: TimedCommand, place: Path, compiled: Path) -> tuple[float, float]:
    """Run a command in a folder and return its wall and processor seconds."""
    words = shlex.split(command.line)
    if words[0] == "-m" and words[1].startswith("experiments."):
        words += ["--overwrite"]
    elif words[0] != "-m":
        words[0] = str(ROOT / words[0])
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "XLA_"))},
        **{"PYTHONPATH": str(ROOT), "I2T_COMPILE_CACHE": str(compiled), "PYTHONUNBUFFERED": "1"},
    }
    begin, log = time.perf_counter(), place / "log.txt"
    with log.open("w") as file, subprocess.Popen(
        [sys.executable, *words], cwd=place, env=environment, text=True, stdout=subprocess.PIPE, stderr=file
    ) as process:  # fmt: skip
        assert process.stdout is not None
        enough = False
        for text in process.stdout:
            if command.until and command.until in text and not enough:
                enough, wall = True, time.perf_counter() - begin
                process.send_signal(signal.SIGINT)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if not enough:
        wall = time.perf_counter() - begin
        if process.returncode or command.until:
            output = log.read_text()[-2000:]
            raise RuntimeError(f"python {command.line} ended with exit code {process.returncode}: {output}")
    return wall, usage.ru_utime + usage.ru_stime
