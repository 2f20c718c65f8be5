"""Tasks of a study: any worker writes the same files, and a killed worker's task is started again."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from helpers import small_tasks

from experiments.common.runs import begin, exit_code_of_run
from experiments.common.tasks import Task, run_tasks
from experiments.train.arguments import TrainArgs

ROOT = Path(__file__).parents[2]
WORKERS = 2


def numbered(folder, count=4, work=small_tasks.write_number, **more):
    return [
        Task(f"part-{i}", folder / f"part-{i}", partial(work, folder / f"part-{i}", i, **more)) for i in range(count)
    ]


def made(folder):
    return {path.name: path.read_text() for path in sorted(folder.iterdir()) if not path.suffix}


def test_workers_make_what_this_process_makes_and_log_what_they_print(tmp_path, capsys):
    for name, workers in {"serial": 1, "local": WORKERS}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "part-1").write_text("1\n")  # what is there is not made again
        run_tasks(numbered(tmp_path / name), workers)
    assert not (tmp_path / "local" / "part-1.log").exists()
    assert made(tmp_path / "serial") == made(tmp_path / "local") == {f"part-{i}": f"{i}\n" for i in range(4)}
    assert (tmp_path / "local" / "part-2.log").read_text() == "number 2\n"
    assert not list((tmp_path / "serial").glob("*.log"))
    assert "part-2: finished" in capsys.readouterr().out


def test_a_killed_worker_ends_the_study_in_one_sentence_and_it_can_resume(tmp_path, capsys):
    tasks = numbered(tmp_path, 3, small_tasks.die_at_first)
    assert exit_code_of_run(partial(run_tasks, tasks, WORKERS)) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: a worker died, perhaps for want of memory (")
    assert said.count("\n") == 1
    for task in tasks:
        task.finished.with_suffix(".seen").write_text("xx")  # nobody dies from here on
    run_tasks(tasks, WORKERS)
    assert made(tmp_path) == {f"part-{i}": f"{i}\n" for i in range(3)}


def test_a_worker_raises_the_error_of_its_task(tmp_path):
    tasks = [Task(f"part-{i}", tmp_path / f"part-{i}", partial(small_tasks.refuse, tmp_path / "part")) for i in (0, 1)]
    with pytest.raises(ValueError, match="part cannot be made"):
        run_tasks(tasks, WORKERS)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores are shared out on Linux alone")
def test_workers_share_the_cores(tmp_path):
    tasks = [
        Task(f"cores-{i}", tmp_path / f"cores-{i}", partial(small_tasks.write_cores, tmp_path / f"cores-{i}"))
        for i in (0, 1)
    ]
    run_tasks(tasks, WORKERS)
    cores = sorted(os.sched_getaffinity(0))
    assert {task.finished.read_text() for task in tasks} <= {repr(cores[i::2]) for i in (0, 1)}


def test_an_unfinished_run_resumes_with_other_workers(tmp_path):
    experiment = TrainArgs(tmp_path)  # any dataclass does
    begin(TrainArgs(tmp_path / "out"), experiment)
    (tmp_path / "out" / "part-0.npz").touch()
    begin(TrainArgs(tmp_path / "out", resume=True, workers=WORKERS), experiment)
    with pytest.raises(ValueError, match="other settings"):
        begin(TrainArgs(tmp_path / "out", seed=1, resume=True, workers=WORKERS), experiment)


HANGING = """
import signal, sys, time
from functools import partial
from pathlib import Path
from experiments.common.runs import exit_code_of_run
from experiments.common.tasks import Task, run_tasks
from helpers import small_tasks

folder = Path(sys.argv[1])
quick = Task("quick", folder / "quick", partial(small_tasks.write_number, folder / "quick", 1))
slow = Task("slow", folder / "slow", partial(time.sleep, 600))
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.exit(exit_code_of_run(partial(run_tasks, [quick, slow], 2), folder))
"""


@pytest.mark.full
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_the_process_that_began_them_and_leave_what_is_finished(tmp_path, how):
    """This holds after Ctrl-C, which reaches the workers too, and after a kill, which does not."""
    (tmp_path / "study.py").write_text(HANGING)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    words = [sys.executable, str(tmp_path / "study.py"), str(tmp_path)]
    study = subprocess.Popen(words, env=environment, cwd=ROOT, start_new_session=True)
    until = time.monotonic() + 120
    while not ((tmp_path / "quick").exists() and (tmp_path / "slow.log").exists()):
        assert time.monotonic() < until
        time.sleep(0.1)
    if how == signal.SIGINT:
        os.killpg(study.pid, how)
        assert study.wait(120) == 130
    else:
        study.kill()
        study.wait(120)
    while _members(study.pid) and time.monotonic() < until:
        time.sleep(0.1)
    assert not _members(study.pid)
    assert (tmp_path / "quick").read_text() == "1\n"


def _members(session: int) -> list[str]:
    """Processes of a session that are still running."""
    stats = [path.read_text().rpartition(")")[2].split() for path in Path("/proc").glob("[0-9]*/stat") if path.exists()]
    return [fields[0] for fields in stats if int(fields[3]) == session and fields[0] != "Z"]
