"""Section `scaling` of the benchmark: simulated touches by several processes that work as one (`i2t.sharding`), next to
one process.

The cores are shared out among the processes. There are two peers: one process with one share, which says what the
others add, and one with all cores, which is what a user has who starts one process. All give the same touches, to the
last bit where each process has one core, which is checked. Processor time is a row of its own, because it hardly
depends on what else a machine is doing.
"""

import multiprocessing
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.benchmark.timing import BenchmarkRow, compare
from i2t.compile_cache import use_compile_cache
from i2t.objects import catalogue
from i2t.rendering.render import prepare_surface
from i2t.simulation.touches import SimulationErrors, simulate_touches
from i2t.skin.pad import nominal_pad

LAST_BIT_UT = 1e-3  # of readings that are compiled for another number of cores


@dataclass(frozen=True)
class Scaling:
    """Numbers of processes and of simulated touches."""

    processes: int = 2
    touches: int = 288
    touches_per_session: int = 36


class TouchTiming(NamedTuple):
    """Times and readings of a process's simulation."""

    wall_s: float
    processor_s: float
    reading: np.ndarray  # (touches, c) uT


def section(setup: Scaling, turns: int) -> list[BenchmarkRow]:
    """Seconds of all touches, by several processes and by one."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    shares = [cores[i % max(len(cores), 1) :: setup.processes] for i in range(setup.processes)]
    several, one, whole = "several", "one share", "all cores"
    contenders = {several: shares, one: shares[:1], whole: [cores]}
    made: dict[str, list[list[TouchTiming]]] = {name: [] for name in contenders}
    with _Processes(contenders, setup) as processes:
        for turn in range(turns + 1):
            for name in contenders:
                timings = processes.simulate(name)
                if turn:  # the first compiles
                    made[name].append(timings)
    _check_same(made[several][0], made[one][0][0], exact=max(map(len, shares)) == 1)
    _check_same(made[whole][0], made[one][0][0], exact=False)
    wall = {name: [max(each.wall_s for each in turn) for turn in found] for name, found in made.items()}
    used = {name: [sum(each.processor_s for each in turn) for turn in found] for name, found in made.items()}
    work = f"{setup.touches} simulated touches, {setup.processes} processes on {len(cores) or os.cpu_count()} cores"
    return [
        compare("scaling", work, wall[several], "one process, its share of the cores", wall[one]),
        compare("scaling", work, wall[several], "one process, all cores", wall[whole]),
        compare("scaling", f"{work}, processor time", used[several], "one process, its share of the cores", used[one]),
        compare("scaling", f"{work}, processor time", used[several], "one process, all cores", used[whole]),
    ]


class _Processes:
    """The processes of all contenders; those whose turn it is not wait."""

    def __init__(self, contenders: dict[str, list[list[int]]], setup: Scaling) -> None:
        context = multiprocessing.get_context("spawn")
        self.started: list[Any] = []
        self.connections: dict[str, list[Any]] = {name: [] for name in contenders}
        for name, shares in contenders.items():
            port = _free_port()
            for number, cores in enumerate(shares):
                here, there = context.Pipe()
                words = (there, setup, cores, len(shares), number, port)
                process = context.Process(target=_serve, args=words, daemon=True)
                process.start()
                there.close()
                self.started.append(process)
                self.connections[name].append(here)

    def __enter__(self) -> "_Processes":
        return self

    def __exit__(self, *_: object) -> None:
        for process in reversed(self.started):  # the first of several last, as the others miss it loudly
            process.kill()
        for process in self.started:
            process.join()

    def simulate(self, name: str) -> list[TouchTiming]:
        """All touches, by the processes of one contender."""
        for connection in self.connections[name]:
            connection.send("simulate")
        try:
            return [connection.recv() for connection in self.connections[name]]
        except EOFError:
            raise ValueError(f"a process of {name!r} of the section scaling ended; what it said is above") from None


def _serve(connection: Any, setup: Scaling, cores: Sequence[int], processes: int, number: int, port: int) -> None:
    """Simulate whenever asked, as one of several processes."""
    if cores:
        os.sched_setaffinity(0, cores)  # before JAX counts them
    use_compile_cache()
    if processes > 1:
        jax.distributed.initialize(f"127.0.0.1:{port}", processes, number)
    surface, pad = prepare_surface(catalogue.make_object("hammer").mesh), nominal_pad()
    while True:
        try:
            connection.recv()
        except EOFError:
            return
        begin, used = time.perf_counter(), time.process_time()
        made = simulate_touches(
            jax.random.key(0), [surface], pad, SimulationErrors(), setup.touches,
            touches_per_session=setup.touches_per_session,
        )  # fmt: skip
        reading = np.asarray(made.reading)
        connection.send(TouchTiming(time.perf_counter() - begin, time.process_time() - used, reading))


def _check_same(made: Sequence[TouchTiming], alone: TouchTiming, *, exact: bool) -> None:
    """Refuse to compare work that is not the same."""
    for each in made:
        apart = float(np.max(np.abs(each.reading - alone.reading)))
        if apart > (0.0 if exact else LAST_BIT_UT):
            raise ValueError(f"several processes and one read {apart:.3g} uT apart; they do not do the same work")


def _free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])
