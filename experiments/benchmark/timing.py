"""Measurement of speeds: contenders interleaved in one run, on the same machine."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple

REST_S = 0.1


class BenchmarkRow(NamedTuple):
    """One comparison."""

    section: str
    work: str
    unit: str
    ours: float  # median over the turns
    peer_name: str
    peer: float
    ratio: float  # median over the turns of the peer's time through ours


class MissingPeerError(ValueError):
    """A section's peer is not installed."""


def interleave(contenders: dict[str, Callable[[], object]], turns: int, steady: float = 0.0) -> dict[str, list[float]]:
    """Time contenders one after the other, turn after turn, so that a disturbance meets all of them.

    Args:
        contenders: What to call, by name.
        turns: How often each is timed; a first turn more, which compiles and warms up, is not counted.
        steady: s; above 0, each call is repeated for that long after a rest and a call that is not counted, in which
            the threads of the contender before come to rest and its own wake up, and the mean counts.

    Returns:
        Seconds of each contender in each turn.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(turns + 1):
        for name, work in contenders.items():
            if steady and turn:
                time.sleep(REST_S)
                work()
            begin, calls = time.perf_counter(), 0
            while not calls or time.perf_counter() - begin < steady:
                work()
                calls += 1
            if turn:
                seconds[name].append((time.perf_counter() - begin) / calls)
    return seconds


def compare(section: str, work: str, ours: list[float], peer_name: str, peer: list[float]) -> BenchmarkRow:
    """A row of the table.

    Args:
        section: Of the benchmark.
        work: What was done.
        ours: Seconds, by turn.
        peer_name: Whom ours is compared with.
        peer: Seconds, in the same turns.

    Returns:
        Medians, and the median of the turns' ratios.
    """
    ratio = statistics.median(theirs / mine for mine, theirs in zip(ours, peer, strict=True))
    return BenchmarkRow(section, work, "s", statistics.median(ours), peer_name, statistics.median(peer), ratio)
