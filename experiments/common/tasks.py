"""Parts of a study that do not need one another, such as its pads and seeds: made here one by one, or by workers.

A task makes one file, whole or not at all, and is finished when that file is there; so a run that was stopped goes on
with what is missing, whoever made the rest. Workers are processes of this machine (`--executor local`), each with its
share of the cores, or of a Ray cluster (`--executor ray`) whose machines share the folder of --out and have i2t at the
same place. They compute what this process would compute. A task whose worker was killed is begun again, a few times at
most; what a worker prints goes to a log next to the task's file. This module imports nothing large.
"""

import os
import pickle
import signal
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, TypeAlias

from i2t.cli import Count, require_with
from i2t.compile_cache import use_compile_cache
from i2t.extras import require_extra

MAX_TASK_ATTEMPTS = 3  # at a task whose workers die


@dataclass(frozen=True)
class TaskOptions:
    """Who makes the parts of a study: its pads, seeds and settings."""

    FLAT: ClassVar[bool] = True  # flags are --executor, not --tasks.executor

    executor: Literal["serial", "local", "ray"] = "serial"  # this process, several of this machine, or a Ray cluster
    workers: Count | None = None  # at a time; unless given, one for each core
    address: str | None = None  # of a Ray cluster, HOST:PORT; unless given RAY_ADDRESS, or this machine alone

    def check(self) -> None:
        """Refuse what does not go together, and Ray where it is not installed (ValueError)."""
        require_with("--workers", self.workers is not None, "--executor local or ray", self.executor != "serial")
        require_with("--address", self.address is not None, "--executor ray", self.executor == "ray")
        if self.executor == "ray":
            require_extra("ray", "--executor ray")


class Task(NamedTuple):
    """A part of a study."""

    name: str
    finished: Path  # the file that it makes
    work: Callable[[], Any]  # makes it; workers get it pickled

    @property
    def log(self) -> Path:
        """File of a worker's output."""
        return self.finished.parent / f"{self.name}.log"


class WorkerDeath(NamedTuple):
    """A worker ended before its task did."""

    how: str


Outcome: TypeAlias = Exception | WorkerDeath | None  # None: it is finished


class Workers(Protocol):
    """Workers that make tasks."""

    count: int  # at a time
    patience_s: float  # until a file that a worker made is seen here

    def begin(self, task: Task) -> None:
        """Give a task to a worker that has none."""

    def wait(self) -> tuple[Task, Outcome]:
        """The next task that ended."""

    def close(self) -> None:
        """End all workers, at once."""


def run_tasks(tasks: Sequence[Task], options: TaskOptions, *, bar: str | None = None) -> None:
    """Make what is missing, here or elsewhere, as in `tasks_here`."""
    for task in tasks_here(tasks, options, bar=bar):
        task.work()


def tasks_here(tasks: Sequence[Task], options: TaskOptions, *, bar: str | None = None) -> Iterator[Task]:
    """Make what is missing elsewhere, or say what is to be made here.

    Args:
        tasks: In the order in which they are begun.
        options: Who makes them.
        bar: What a bar calls them while this process makes them; without it there is none.

    Yields:
        What this process has to make.

    Raises:
        ChildProcessError: The workers of a task died again and again.
        FileNotFoundError: A worker made a file that is not here.
        Exception: What a task raised; the others end.
    """
    missing = [task for task in tasks if not task.finished.exists()]
    if options.executor == "serial":
        from i2t.progress import progress

        yield from progress(missing, desc=bar or "", disable=bar is None)
    elif missing:
        kind: type[LocalWorkers] | type[RayWorkers] = LocalWorkers if options.executor == "local" else RayWorkers
        with closing(kind(options, len(missing))) as workers:
            _make(missing, workers)


def _make(tasks: Sequence[Task], workers: Workers) -> None:
    """Keep the workers busy until all tasks are finished."""
    waiting, attempts, running, finished = deque(tasks), Counter[str](), 0, 0
    print(f"{len(tasks)} tasks, {workers.count} at a time", flush=True)
    while waiting or running:
        while waiting and running < workers.count:
            task = waiting.popleft()
            attempts[task.name] += 1
            workers.begin(task)
            running += 1
        task, outcome = workers.wait()
        running -= 1
        if isinstance(outcome, WorkerDeath):
            if attempts[task.name] == MAX_TASK_ATTEMPTS:
                raise ChildProcessError(
                    f"{task.name} was begun {MAX_TASK_ATTEMPTS} times, and each time its worker died ({outcome.how}); "
                    f"{task.log} has its last words; fewer --workers need less memory; go on with --resume"
                )
            print(f"{task.name}: its worker died ({outcome.how}); it is begun again", flush=True)
            waiting.append(task)
        elif outcome is not None:
            raise outcome
        elif not _arrives(task.finished, workers.patience_s):
            raise FileNotFoundError(f"{task.finished} was made and is not here; --out must be a folder that all share")
        else:
            finished += 1
            print(f"{task.name}: finished, {finished} of {len(tasks)}", flush=True)


def _arrives(path: Path, patience_s: float) -> bool:
    """Test whether a file is seen here in time."""
    until = time.monotonic() + patience_s
    while not path.exists() and time.monotonic() < until:
        time.sleep(min(patience_s, 0.5))
    return path.exists()


def _attempt(task: Task, folder: str) -> Exception | None:
    """Make a task in a worker, as if in the folder of the process that began it; returns what it raised."""
    os.chdir(folder)
    use_compile_cache()
    task.log.parent.mkdir(parents=True, exist_ok=True)
    with task.log.open("a") as log, redirect_stdout(log), redirect_stderr(log):
        try:
            task.work()
        except Exception as error:
            traceback.print_exc()
            try:
                pickle.loads(pickle.dumps(error))
            except Exception:  # one that cannot travel
                return RuntimeError(f"{task.name}: {type(error).__name__}: {error} ({task.log})")
            return error
    return None


# --- processes of this machine ---


class _Process(NamedTuple):
    process: Any
    connection: Any
    task: Task | None  # that it is at


class LocalWorkers:
    """Processes of this machine; one that ended a task gets the next."""

    patience_s = 0.0

    def __init__(self, options: TaskOptions, tasks: int) -> None:
        import multiprocessing  # here, as the default needs none

        self.cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self.count = min(options.workers or len(self.cores) or os.cpu_count() or 1, tasks)
        self.context = multiprocessing.get_context("spawn")  # a fork would share JAX's threads, and hang
        self.places: list[_Process | None] = [None] * self.count

    def begin(self, task: Task) -> None:
        """Give a task to a worker that has none."""
        place = next(i for i, each in enumerate(self.places) if each is None or each.task is None)
        worker = self.places[place] or self._start(place)
        with suppress(BrokenPipeError):  # killed while it had nothing to do: `wait` sees that
            worker.connection.send((task, os.getcwd()))
        self.places[place] = worker._replace(task=task)

    def share(self, place: int) -> list[int]:
        """The cores of one of the workers; where there are more workers than cores, some share one."""
        return self.cores[place % max(len(self.cores), 1) :: self.count]

    def _start(self, place: int) -> _Process:
        here, there = self.context.Pipe()
        process = self.context.Process(target=_serve, args=(there, self.share(place)), daemon=True)
        process.start()
        there.close()  # so that its death is the end of the pipe
        return _Process(process, here, None)

    def wait(self) -> tuple[Task, Outcome]:
        """The next task that ended."""
        from multiprocessing.connection import wait

        busy = {each.connection: i for i, each in enumerate(self.places) if each is not None and each.task is not None}
        place = busy[wait(list(busy))[0]]
        worker = self.places[place]
        assert worker is not None
        assert worker.task is not None
        outcome: Outcome
        try:
            outcome = worker.connection.recv()
            self.places[place] = worker._replace(task=None)
        except (EOFError, ConnectionResetError):
            worker.process.join()
            outcome = WorkerDeath(_ended(worker.process.exitcode))
            self.places[place] = None
        return worker.task, outcome

    def close(self) -> None:
        """End all workers, at once: what they write is whole or not there."""
        for each in self.places:
            if each is not None:
                each.process.kill()
                each.process.join()


def _serve(connection: Any, cores: Sequence[int]) -> None:
    """Make tasks until the process that sends them ends, or ends us."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal; who began us ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    if cores:
        os.sched_setaffinity(0, cores)  # before JAX counts them
    while True:
        try:
            task, folder = connection.recv()
        except EOFError:
            return
        connection.send(_attempt(task, folder))


def _end_with_parent() -> None:
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _ended(code: int | None) -> str:
    """Explain how a process ended."""
    if code is not None and code < 0:
        return f"killed by {signal.Signals(-code).name}"
    return f"exit code {code}"


# --- a Ray cluster ---


class RayWorkers:
    """Processes of a Ray cluster."""

    patience_s = 60.0  # folders on a network show other machines' files late

    def __init__(self, options: TaskOptions, tasks: int) -> None:
        import ray

        root = str(Path(__file__).parents[2])  # of `experiments`, which is not installed
        paths = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
        environment = {"env_vars": {"PYTHONPATH": paths}}
        ray.init(options.address, log_to_driver=False, logging_level="warning", runtime_env=environment)
        self.ray = ray
        cores = int(ray.cluster_resources().get("CPU", 1))
        self.count = min(options.workers or cores, tasks)
        self.remote = ray.remote(num_cpus=max(cores // self.count, 1), max_retries=0)(_attempt)
        self.running: dict[Any, Task] = {}

    def begin(self, task: Task) -> None:
        """Ask the cluster for a task."""
        self.running[self.remote.remote(task, os.getcwd())] = task

    def wait(self) -> tuple[Task, Outcome]:
        """The next task that ended."""
        reference = self.ray.wait(list(self.running), num_returns=1)[0][0]
        task = self.running.pop(reference)
        try:
            return task, self.ray.get(reference)
        except self.ray.exceptions.RayTaskError as error:  # before the work began, say a module that is not there
            return task, RuntimeError(f"{task.name} could not begin on the cluster: {error}")
        except self.ray.exceptions.RayError as error:  # its worker or its machine is gone
            return task, WorkerDeath(type(error).__name__)

    def close(self) -> None:
        """Take back what was asked for, and leave the cluster."""
        for reference in self.running:
            self.ray.cancel(reference, force=True)
        self.ray.shutdown()
