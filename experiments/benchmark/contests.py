"""Timing of contenders that take turns in one run on one machine."""

import statistics
import time
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import jax

Work: TypeAlias = Callable[[], Any]

FROM_SECONDS: dict[str, Callable[[float], float]] = {
    "ms": lambda seconds: 1e3 * seconds,
    "1/s": lambda seconds: 1 / seconds,
}


class Contest(NamedTuple):
    """A piece of work, done by i2t and by a peer, or measured against a goal."""

    work: str
    ours: Work
    peer_name: str = ""
    peer: Work | None = None
    our_calls: float = 1.0  # number of our calls for one unit of work; below 1 if one call does several
    peer_calls: float = 1.0
    unit: str = "s"  # "ms" and "1/s" are converted from seconds
    goal: float | None = None  # in `unit`
    steady: float = 0.0  # s, duration of each contender's turn, after a pause and an untimed call
    measured: bool = False  # whether the calls return the compared value instead of being timed


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
    ratio: float | None  # peer's time divided by ours, median over the turns
    goal: float | None


def finish(run: Callable[..., Any], *arguments: Any) -> Any:
    """Call a compiled function, and wait for its result.

    Args:
        run: Compiled function.
        arguments: Arguments of the function.

    Returns:
        The function's result, computed completely.
    """
    return jax.block_until_ready(run(*arguments))


def interleave(contenders: dict[str, Work], turns: int, steady: float = 0.0) -> dict[str, list[float]]:
    """Time contenders alternately, turn by turn, so that a disturbance affects all of them.

    Args:
        contenders: Functions to call, by name.
        turns: Number of timed turns, after one untimed turn that compiles and warms up.
        steady: If above 0, each call is repeated for this duration (s) and averaged. A pause and an untimed call come
            first, so that the previous contender's threads stop and its own start.

    Returns:
        Seconds of each contender in each turn.
    """
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for turn in range(turns + 1):
        for name, work in contenders.items():
            if steady and turn:
                time.sleep(0.1)
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
        contest: Contest to measure.
        turns: Number of timed turns.

    Returns:
        Medians over the turns, the range of our values, and the median of the ratios.
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
