"""How speeds are measured: contenders in turns, in one run, on the same machine."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

REST = 0.1  # s


class Row(NamedTuple):
    """One comparison."""

    section: str
    work: str
    unit: str
    ours: float  # median over the turns
    peer_name: str
    peer: float
    ratio: float  # median over the turns of the peer's time through ours


class MissingPeerError(RuntimeError):
    """A section's peer is not installed."""


def in_turns(contenders: dict[str, Callable[[], object]], turns: int, steady: float = 0.0) -> dict[str, list[float]]:
    """Seconds of each contender in each turn; a first turn, which compiles and warms up, is not counted.

    With `steady` (s), a contender has its turn to itself: after a call that is not counted, in which the threads of the
    one before it come to rest and its own wake up, it is called for that long, and the mean counts.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(turns + 1):
        for name, work in contenders.items():
            if steady and turn:
                time.sleep(REST)
                work()
            begin, calls = time.perf_counter(), 0
            while not calls or time.perf_counter() - begin < steady:
                work()
                calls += 1
            if turn:
                seconds[name].append((time.perf_counter() - begin) / calls)
    return seconds


def compare(section: str, work: str, ours: list[float], peer_name: str, peer: list[float]) -> Row:
    """A row from the seconds of both in the same turns."""
    ratio = statistics.median(theirs / mine for mine, theirs in zip(ours, peer, strict=True))
    return Row(section, work, "s", statistics.median(ours), peer_name, statistics.median(peer), ratio)
