"""Measurement of speeds: contenders take turns in one run, on the same machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax

Work: TypeAlias = Callable[[], Any]

REST_S = 0.1  # pause in which the threads of the previous contender stop
FROM_SECONDS: dict[str, Callable[[float], float]] = {
    "ms": lambda seconds: 1e3 * seconds,
    "1/s": lambda seconds: 1 / seconds,
}


class Contest(NamedTuple):
    """A piece of work, done by us and by a peer, or measured against a goal."""

    work: str
    ours: Work
    peer_name: str = ""
    peer: Work | None = None
    our_calls: float = 1.0  # number of our calls that do the work once; below 1 if one call does it many times
    peer_calls: float = 1.0
    unit: str = "s"  # seconds are turned into ms and 1/s
    goal: float | None = None  # in the same unit
    steady: float = 0.0  # s, duration of each contender's turn, after a pause and a call that is not counted
    measured: bool = False  # whether the calls return the compared value themselves, without a warm-up


class BenchmarkRow(NamedTuple):
    """Result of a contest."""

    section: str
    work: str
    unit: str
    ours: float  # median over the turns
    least: float  # minimum of ours
    most: float  # maximum of ours
    peer_name: str
    peer: float | None  # median over the turns
    ratio: float | None  # median over the turns of the peer's time divided by ours
    goal: float | None


def finish(run: Callable[..., Any], *arguments: Any) -> Any:
    """Call a compiled function, and wait for its result.

    Args:
        run: The function.
        arguments: Its arguments.

    Returns:
        The result of the function.
    """
    return jax.block_until_ready(run(*arguments))


def interleave(contenders: dict[str, Work], turns: int, steady: float = 0.0) -> dict[str, list[float]]:
    """Time contenders one after the other, turn after turn, so that a disturbance affects all of them.

    Args:
        contenders: Functions to call, by name.
        turns: Number of timed turns. An additional first turn, which compiles and warms up, is not counted.
        steady: Duration (s) for which each call is repeated, and the mean taken, if above 0. A pause and a call that is
            not counted come first, so that the previous contender's threads stop and its own start.

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
    """Measure a contest.

    Args:
        section: Section of the benchmark.
        contest: The contest.
        turns: Number of timed turns.

    Returns:
        The medians, the range of ours, and the median of the turns' ratios.
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
