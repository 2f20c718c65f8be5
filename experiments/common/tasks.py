"""Parts of a study that do not need one another, such as its pads and seeds, made by this process or by several.

A task makes one file, whole or not at all, and is finished when that file is there; so a run that was stopped goes on
with what is missing, whoever made the rest. With `--workers N` processes of this machine make them, each with its share
of the cores; what a worker prints goes to a log next to the task's file. This module imports nothing large.
"""

import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from experiments.common.runs import Part, load_part, save_part
from i2t.runtime.compile_cache import use_compile_cache
from i2t.runtime.progress import progress


class Task(NamedTuple):
    """A part of a study."""

    name: str
    finished: Path  # the file that it makes
    work: Callable[[], Any]  # makes it; workers get it pickled

    @property
    def log(self) -> Path:
        """File of a worker's output."""
        return self.finished.parent / f"{self.name}.log"


def run_tasks(tasks: Sequence[Task], workers: int = 1, *, bar: str | None = None) -> None:
    """Make what is missing.

    Args:
        tasks: In the order in which they are begun.
        workers: Processes that make them side by side; 1 is this one.
        bar: What a bar calls them while this process makes them; without it there is none.

    Raises:
        ChildProcessError: A worker died.
        Exception: What a task raised; the others end.
    """
    missing = [task for task in tasks if not task.finished.exists()]
    if workers == 1 or len(missing) < 2:
        for task in progress(missing, desc=bar or "", disable=bar is None):
            task.work()
    else:
        _make(missing, min(workers, len(missing)))


def make_parts(makers: Mapping[Path, Callable[[], Part]], workers: int = 1, *, bar: str | None = None) -> list[Part]:
    """Make the parts of a run that are missing, each kept at once in its file, and read all.

    Args:
        makers: What makes each part, by its file: .npz for nested dicts of arrays, .json for anything JSON holds;
            workers get them pickled.
        workers: As of `run_tasks`.
        bar: As of `run_tasks`.

    Returns:
        The parts, as `load_part` reads them.
    """
    tasks = [Task(path.stem, path, partial(_keep_part, make, path)) for path, make in makers.items()]
    run_tasks(tasks, workers, bar=bar)
    return [load_part(path) for path in makers]


def _keep_part(make: Callable[[], Part], path: Path) -> None:
    save_part(path, make())


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
