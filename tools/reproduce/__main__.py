"""Repeat the measurements of the documents, and write the documents' tables.

    python -m tools.reproduce                         all steps in turn (most of a day on two cores)
    python -m tools.reproduce --only study recognize  some steps
    python -m tools.reproduce --list                  names, durations and states of the steps
    python -m tools.reproduce --tables                only write the tables from docs/results

Each step is a command printed in the documents, run in its own process. An unfinished step resumes, or restarts if its
command cannot resume; a finished step is not run again. The shortened results of a step are kept in docs/results. The
tables between the marks `<!-- table: STEP NAME -->` and `<!-- end of table -->` in the documents are written from them;
numbers outside these marks must be compared by hand.

Steps that need recordings or meshes from elsewhere look for them in the current folder, under the names in the
documents, and are skipped if they are missing. Not included are timings, which depend on the machine
(experiments.benchmark), figures (tools.gallery), notebooks, the ready models, and single runs with other options.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.common.commands import command
from i2t.errors import did_you_mean
from tools.reproduce.steps import STEPS, Step
from tools.reproduce.tables import TABLES, shortened, write_tables

DOCS = Path(__file__).parents[2] / "docs"


@dataclass(frozen=True)
class ReproduceArgs:
    """Repeat the documents' measurements and write their tables."""

    out: Path = Path("runs/reproduce")  # output folder
    only: tuple[str, ...] = ()  # names of the steps to run, with those that they use; default: all
    list: bool = False  # list the steps and stop
    tables: bool = False  # write the tables from docs/results, without running a step
    docs: Path | None = None  # folder of the documents; default: that of this checkout

    @property
    def folder(self) -> Path:
        """Folder of the documents."""
        return self.docs or DOCS


def run(args: ReproduceArgs) -> None:
    """Run the selected steps, then write the tables.

    Args:
        args: Options of the command.

    Raises:
        ValueError: A step is unknown, fails, or lacks data or a step that it uses.
    """
    by_name = {step.name: step for step in STEPS}
    if unknown := [name for name in args.only if name not in by_name]:
        remedy = did_you_mean(unknown[0], by_name, "see their names with --list")
        raise ValueError(f"there is no step {unknown[0]}; {remedy}")
    steps = [by_name[name] for name in by_name if not args.only or name in args.only]
    if args.list:
        print("\n".join(describe(step, args.out) for step in steps))
        return
    if not args.tables:
        for step in steps:
            if step.needs and not Path(step.needs).exists():
                if args.only:
                    raise ValueError(f"{step.name} needs {step.needs}, which is missing; the documents describe it")
                print(f"\n== {step.name} is left out: it needs {step.needs}, which is missing", flush=True)
                continue
            _run_step(step, args)
    written = write_tables(args.folder)
    print(f"{len(written)} tables written from {args.folder / 'results'}")


def describe(step: Step, out: Path) -> str:
    """Describe a step in one line: state or duration, and command."""
    expected = "time?" if step.minutes is None else f"{step.minutes} min"
    done = "done" if (out / step.name / step.result).exists() else expected
    requirements = [f"uses {step.uses}"] if step.uses else []
    requirements += [f"needs {step.needs}"] if step.needs else []
    return f"{step.name:20} {done:>8}   python {step.command}" + (
        f"   ({', '.join(requirements)})" if requirements else ""
    )


def _run_step(step: Step, args: ReproduceArgs) -> None:
    """Run the command of a step in its own process unless it is done, and keep its results."""
    folder = args.out / step.name
    if step.uses and not (args.out / step.uses).exists():
        raise ValueError(f"{step.name} uses {step.uses}, which is missing; run it first, or name both in --only")
    if not (folder / step.result).exists():
        words = step.arguments(args.out, resume=(folder / "config.json").exists())
        print(f"\n== {step.name}: python {' '.join(words)}", flush=True)
        code = subprocess.run([sys.executable, *words], env=dict(os.environ), check=False).returncode
        if code:
            raise ValueError(f"{step.name} ended with exit code {code}; fix its error and run this command again")
    if step.name in TABLES:
        results = args.folder / "results"
        results.mkdir(exist_ok=True)
        measured = json.loads((folder / step.result).read_text())
        kept = json.dumps(shortened(step.name, measured), ensure_ascii=False, separators=(",", ":"))
        (results / f"{step.name}.json").write_text(kept + "\n")


main = command(ReproduceArgs, "tools.reproduce.__main__")

if __name__ == "__main__":
    sys.exit(main())
