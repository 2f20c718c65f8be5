"""Independent parts of a study, such as its pads and seeds, computed by one process or several.

A task writes one file atomically, and is finished when that file exists. A run that was stopped therefore resumes with
the missing files, whichever process wrote the others. With `--workers N`, processes of this machine share the tasks and
the cores. The output of a worker goes to a log next to the task's file. This module has no slow imports.
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
    finished: Path  # the file that the task writes
    work: Callable[[], Any]  # function that writes the file; it is pickled for workers

    @property
    def log(self) -> Path:
        """Path of the worker's log."""
        return self.finished.parent / f"{self.name}.log"


def run_tasks(tasks: Sequence[Task], workers: int = 1, *, bar: str | None = None) -> None:
    """Run the tasks whose file is missing.

    Args:
        tasks: Tasks in the order in which they are started.
        workers: Number of processes; 1 means this process.
        bar: Label of the progress bar while this process runs the tasks; there is no bar by default.

    Raises:
        ChildProcessError: A worker died.
        Exception: A task raised this exception, and the other tasks were ended.
    """
    missing = [task for task in tasks if not task.finished.exists()]
    if workers == 1 or len(missing) < 2:
        for task in progress(missing, desc=bar or "", unit="parts", disable=bar is None):
            task.work()
    else:
        _run_in_workers(missing, min(workers, len(missing)))


def make_parts(makers: Mapping[Path, Callable[[], Part]], workers: int = 1, *, bar: str | None = None) -> list[Part]:
    """Compute the missing parts of a run, save each in its file at once, and load all parts.

    Args:
        makers: Function that computes each part, by the part's file: .npz for nested dicts of arrays, .json for other
            values. The functions are pickled for workers.
        workers: Number of processes, as in `run_tasks`.
        bar: Label of the progress bar, as in `run_tasks`.

    Returns:
        The parts, as `load_part` reads them.
    """
    tasks = [Task(path.stem, path, partial(_compute_part, make, path)) for path, make in makers.items()]
    run_tasks(tasks, workers, bar=bar)
    return [load_part(path) for path in makers]


def _compute_part(make: Callable[[], Part], path: Path) -> None:
    save_part(path, make())


def _run_in_workers(tasks: Sequence[Task], workers: int) -> None:
    """Run all tasks in separate processes."""
    import multiprocessing  # a single process does not need this slow import
    from concurrent.futures import ProcessPoolExecutor, as_completed
    from concurrent.futures.process import BrokenProcessPool

    print(f"{len(tasks)} tasks, {workers} at a time", flush=True)
    context = multiprocessing.get_context("spawn")  # a forked process would share JAX's threads and hang
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
    finally:  # workers may be killed at once, because they write files atomically
        for process in list((pool._processes or {}).values()):
            process.kill()


def _begin_worker(places: Any, workers: int, folder: str) -> None:
    """Set up a worker with its share of the cores. It ends with the process that started it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends the workers after Ctrl-C
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
    """Run a task in a worker."""
    task.log.parent.mkdir(parents=True, exist_ok=True)
    with task.log.open("a") as log, redirect_stdout(log), redirect_stderr(log):
        task.work()
