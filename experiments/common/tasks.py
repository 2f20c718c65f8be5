"""Parts of a study that do not need one another, such as its pads and seeds, made by this process or by several.

A task makes one file, whole or not at all, and is finished when that file is there; so a run that was stopped goes on
with what is missing, whoever made the rest. With `--workers N` processes of this machine make them, each with its share
of the cores; what a worker prints goes to a log next to the task's file. This module imports nothing large.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

from experiments.common.runs import Part, load_part, save_part
from i2t.cli.options import Count
from i2t.runtime.compile_cache import use_compile_cache
from i2t.runtime.progress import progress

Run = TypeVar("Run")


@dataclass(frozen=True)
class TaskOptions:
    """Who makes the parts of a study: its pads, seeds and settings."""

    FLAT: ClassVar[bool] = True  # the flag is --workers, not --tasks.workers

    workers: Count = 1  # processes that make pads and seeds side by side; 1 is this one


class Task(NamedTuple):
    """A part of a study."""

    name: str
    finished: Path  # the file that it makes
    work: Callable[[], Any]  # makes it; workers get it pickled

    @property
    def log(self) -> Path:
        """File of a worker's output."""
        return self.finished.parent / f"{self.name}.log"


def run_tasks(tasks: Sequence[Task], options: TaskOptions, *, bar: str | None = None) -> None:
    """Make what is missing, here or elsewhere, as in `tasks_here`."""
    for task in tasks_here(tasks, options, bar=bar):
        task.work()


def tasks_here(tasks: Sequence[Task], options: TaskOptions, *, bar: str | None = None) -> Iterator[Task]:
    """Make what is missing in other processes, or say what is to be made here.

    Args:
        tasks: In the order in which they are begun.
        options: Who makes them.
        bar: What a bar calls them while this process makes them; without it there is none.

    Yields:
        What this process has to make.

    Raises:
        ChildProcessError: A worker died.
        Exception: What a task raised; the others end.
    """
    missing = [task for task in tasks if not task.finished.exists()]
    if options.workers == 1 or len(missing) < 2:
        yield from progress(missing, desc=bar or "", disable=bar is None)
    else:
        _make(missing, min(options.workers, len(missing)))


def parts_of_runs(
    make: Callable[[Run, int], Part],
    runs: Mapping[int, Run],
    stem: Path,
    *,
    seed: int,
    options: TaskOptions,
) -> list[Part]:
    """Make a part of every finished run, kept at once as `stem`-i.npz.

    Args:
        make: Makes a part from a run and a seed; workers get both pickled.
        runs: By the numbers i that their seeds and parts count by.
        stem: Of the parts' files.
        seed: Of run 0.
        options: Who makes them.

    Returns:
        The parts, as `load_part` reads them.
    """
    tasks = []
    for i, run in runs.items():
        path = stem.with_name(f"{stem.name}-{i}.npz")
        tasks.append(Task(path.stem, path, partial(_keep_part, make, run, seed + i, path)))
    run_tasks(tasks, options)
    return [load_part(task.finished) for task in tasks]


def _keep_part(make: Callable[[Run, int], Part], run: Run, seed: int, path: Path) -> None:
    save_part(path, make(run, seed))


def _make(tasks: Sequence[Task], workers: int) -> None:
    """Make all tasks in processes of their own."""
    import multiprocessing  # here, as one process needs neither
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool

    print(f"{len(tasks)} tasks, {workers} at a time", flush=True)
    context = multiprocessing.get_context("spawn")  # a fork would share JAX's threads, and hang
    places = context.Value("i", 0)
    pool = ProcessPoolExecutor(workers, context, initializer=_begin_worker, initargs=(places, workers, os.getcwd()))
    try:
        futures = {pool.submit(_attempt, task): task for task in tasks}
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            print(f"{futures[future].name}: finished, {done} of {len(tasks)}", flush=True)
        pool.shutdown()
    except BrokenProcessPool as error:
        logs = ", ".join(str(task.log) for task in tasks if task.log.exists() and not task.finished.exists())
        raise ChildProcessError(
            f"a worker died, perhaps for want of memory ({logs}); finished parts stay: go on with --resume, and fewer "
            "--workers"
        ) from error
    finally:  # at once: what workers write is whole or not there
        for process in list((pool._processes or {}).values()):
            process.kill()


def _begin_worker(places: Any, workers: int, folder: str) -> None:
    """Set up a worker with its share of the cores, which ends with the process that began it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal; who began us ends us
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.chdir(folder)
    if hasattr(os, "sched_setaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        with places.get_lock():
            place, places.value = places.value, places.value + 1
        os.sched_setaffinity(0, cores[place % len(cores) :: workers])  # before JAX counts them
    use_compile_cache()


def _end_with_parent() -> None:
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _attempt(task: Task) -> None:
    """Make a task in a worker."""
    task.log.parent.mkdir(parents=True, exist_ok=True)
    with task.log.open("a") as log, redirect_stdout(log), redirect_stderr(log):
        task.work()
