"""Measurement of speeds: contenders in turns in one run, on the same machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax

Work: TypeAlias = Callable[[], Any]

REST_S = 0.1
FROM_SECONDS: dict[str, Callable[[float], float]] = {
    "ms": lambda seconds: 1e3 * seconds,
    "1/s": lambda seconds: 1 / seconds,
}


class Contest(NamedTuple):
    """A piece of work, done by us, and by a peer or within a goal."""

    work: str
    ours: Work
    peer_name: str = ""
    peer: Work | None = None
    our_calls: float = 1.0  # of ours, that do the work: a share where one call does it many times
    peer_calls: float = 1.0
    unit: str = "s"  # seconds are turned into ms and 1/s
    goal: float | None = None  # in that unit
    steady: float = 0.0  # s that each contender works in each turn, after a rest and a call that is not counted
    measured: bool = False  # both calls return what is compared, which need not be a time, and are not warmed up


class BenchmarkRow(NamedTuple):
    """What a piece of work took."""

    section: str
    work: str
    unit: str
    ours: float  # median over the turns
    least: float  # of ours
    most: float
    peer_name: str
    peer: float | None  # median over the turns
    ratio: float | None  # median over the turns of the peer's time through ours
    goal: float | None


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
        Medians and the range of ours, and the median of the turns' ratios.
    """
    contenders = {"ours": contest.ours} | ({} if contest.peer is None else {"peer": contest.peer})
    if contest.measured:
        measured = {name: [float(work()) for _ in range(turns)] for name, work in contenders.items()}
    else:
        measured = interleave(contenders, turns, contest.steady)
    ours = [contest.our_calls * value for value in measured["ours"]]
    peer = ratio = None
    if contest.peer is not None:
        theirs = [contest.peer_calls * value for value in measured["peer"]]
        peer = statistics.median(theirs)
        ratio = statistics.median(their_time / our_time for our_time, their_time in zip(ours, theirs, strict=True))
    ours = list(map(FROM_SECONDS.get(contest.unit, float), ours))
    return BenchmarkRow(
        section, contest.work, contest.unit, statistics.median(ours), min(ours), max(ours), contest.peer_name, peer,
        ratio, contest.goal,
    )  # fmt: skip
