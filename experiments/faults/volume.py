"""A thousand simulated touches by the command: how long each takes, how large it is, and whether memory stays flat."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from experiments.faults.rows import FaultCounts, FaultRow
from i2t import dataset
from i2t.collect.recorder import touches_in

WARM_TOUCHES = 20  # until everything has been compiled and allocated
MAX_GROWTH = 0.1  # share of the memory, that may come on top


def volume(sizes: FaultCounts) -> list[FaultRow]:
    """Run the command and watch it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "data"
        command = [
            sys.executable,
            "-u",
            "-m",
            "i2t.collect",
            "--out",
            str(out),
            "--touches",
            str(sizes.touches),
        ]
        times, memory = [], []
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("touch "):
                    times.append(time.monotonic())
                    memory.append(_resident(process.pid))
        files = touches_in(out)
        bytes_each = np.mean([path.stat().st_size for path in files]) if files else 0
        readable = len(dataset.load_dataset(out)) if files else 0
    each = np.diff(times[min(1, len(times) - 1) :])
    after = memory[min(WARM_TOUCHES, len(memory) - 1) :]
    growth = max(after) / after[0] - 1 if after and after[0] else 0.0
    tried = f"{len(files)} simulated touches"
    spent = f"median {np.median(each):.2f} s, 95 % {np.quantile(each, 0.95):.2f} s" if len(each) else "-"
    return [
        FaultRow(
            "volume", "touches of the command, all readable", tried, str(readable), "all", readable == sizes.touches
        ),
        FaultRow(
            "volume", "time of a touch beyond motion (simulated time is not waited for)", tried, spent, "stated", None
        ),
        FaultRow("volume", "size of a file", tried, f"{bytes_each / 1024:.0f} KiB", "stated", None),
        FaultRow(
            "volume",
            f"memory after touch {WARM_TOUCHES}",
            tried,
            f"{after[0] / 2**20:.0f} to at most {max(after) / 2**20:.0f} MiB ({100 * growth:+.1f} %)",
            f"< {100 * MAX_GROWTH:+.0f} %",
            growth < MAX_GROWTH,
        ),
    ]


def _resident(pid: int) -> int:
    """Bytes of a process in memory (Linux)."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")
