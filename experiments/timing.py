"""How speeds are measured: contenders in turns, in one run, on the same machine."""

import statistics
import time
from collections.abc import Callable
from typing import NamedTuple


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


def in_turns(contenders: dict[str, Callable[[], object]], turns: int) -> dict[str, list[float]]:
    """Seconds of each contender in each turn; a first turn, which compiles and warms up, is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(turns + 1):
        for name, work in contenders.items():
            begin = time.perf_counter()
            work()
            if turn:
                seconds[name].append(time.perf_counter() - begin)
    return seconds


def compare(section: str, work: str, ours: list[float], peer_name: str, peer: list[float]) -> Row:
    """A row from the seconds of both in the same turns."""
    ratio = statistics.median(theirs / mine for mine, theirs in zip(ours, peer, strict=True))
    return Row(section, work, "s", statistics.median(ours), peer_name, statistics.median(peer), ratio)
