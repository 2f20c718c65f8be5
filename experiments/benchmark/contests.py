"""Measurement of speeds: contenders in turns in one run, on the same machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax

Work: TypeAlias = Callable[[], Any]

REST_S = 0.1


class Contest(NamedTuple):
    """A piece of work, done by us and by a peer."""

    work: str
    ours: Work
    peer_name: str
    peer: Work
    our_calls: float = 1.0  # of ours, that do the work: a share where one call does it many times
    peer_calls: float = 1.0
    unit: str = "s"
    steady: float = 0.0  # s that each contender works in each turn, after a rest and a call that is not counted
    measured: bool = False  # both calls return what is compared, which need not be a time, and are not warmed up


class BenchmarkRow(NamedTuple):
    """One comparison."""

    section: str
    work: str
    unit: str
    ours: float  # median over the turns
    peer_name: str
    peer: float
    ratio: float  # median over the turns of the peer's time through ours


def finish(run: Callable[..., Any], *arguments: Any) -> Any:
    """Call a compiled function, and wait for what it computes.

    Args:
        run: What to call.
        arguments: Its.

    Returns:
        Its result.
    """
    return jax.block_until_ready(run(*arguments))


def interleave(contenders: dict[str, Work], turns: int, steady: float = 0.0) -> dict[str, list[float]]:
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


def measure(section: str, contest: Contest, turns: int) -> BenchmarkRow:
    """Hold a contest.

    Args:
        section: Of the benchmark.
        contest: Who does what.
        turns: How often each is timed.

    Returns:
        Medians, and the median of the turns' ratios.
    """
    contenders = {"ours": contest.ours, "peer": contest.peer}
    if contest.measured:
        found = {name: [float(work()) for _ in range(turns)] for name, work in contenders.items()}
    else:
        found = interleave(contenders, turns, contest.steady)
    ours = [contest.our_calls * each for each in found["ours"]]
    peer = [contest.peer_calls * each for each in found["peer"]]
    ratio = statistics.median(theirs / mine for mine, theirs in zip(ours, peer, strict=True))
    return BenchmarkRow(
        section, contest.work, contest.unit, statistics.median(ours), contest.peer_name, statistics.median(peer), ratio
    )
