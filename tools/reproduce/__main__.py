"""The measurements of the documents again, and the tables that the documents show.

    python -m tools.reproduce                         all steps, one after another (most of a day on two cores)
    python -m tools.reproduce --only study recognize  some of them
    python -m tools.reproduce --list                  what there is, how long it takes, and what is done
    python -m tools.reproduce --tables                only write the documents' tables from what was measured

Each step is a command that the documents print. It is run as it is printed, in a process of its own; an unfinished one
goes on where it stopped, or begins again if its command cannot go on, and a finished one is not run again. What a step
measured is kept, shortened, in docs/results, and the tables between the marks `<!-- table: STEP NAME -->` and
`<!-- end of table -->` of the documents are written from it; figures outside such marks are compared by eye.

Steps that need recordings or meshes which are no part of the project look for them below the current folder, under the
names of the documents, and are left out where they are not there. Not among the steps are timings, which belong to one
machine (experiments.benchmark), pictures (tools.gallery), notebooks, the ready models, and
what the documents say of single runs with other options.
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
    """Run the studies of the documents again and write their tables."""

    out: Path = Path("runs/reproduce")  # folder for everything that is made
    only: tuple[str, ...] = ()  # names of steps, in place of all; what they use must be there or among them
    list: bool = False  # say what there is, and end
    tables: bool = False  # run nothing; write the tables from docs/results
    docs: Path | None = None  # folder of the documents; this checkout's unless given

    @property
    def folder(self) -> Path:
        """Folder of the documents."""
        return self.docs or DOCS


def run(args: ReproduceArgs) -> None:
    """The steps asked for, then the tables.

    Raises:
        ValueError: A step is unknown, what it uses or needs is missing, or one fails.
    """
    known = {step.name: step for step in STEPS}
    if unknown := [name for name in args.only if name not in known]:
        remedy = did_you_mean(unknown[0], known, "see their names with --list")
        raise ValueError(f"there is no step {unknown[0]}; {remedy}")
    steps = [known[name] for name in known if not args.only or name in args.only]
    if args.list:
        print("\n".join(describe(step, args.out) for step in steps))
        return
    if not args.tables:
        for step in steps:
            if step.needs and not Path(step.needs).exists():
                if args.only:
                    raise ValueError(f"{step.name} needs {step.needs}, which is not there; docs say what it is")
                print(f"\n== {step.name} is left out: it needs {step.needs}, which is not there", flush=True)
                continue
            _run_step(step, args)
    written = write_tables(args.folder)
    print(f"{len(written)} tables written from {args.folder / 'results'}")


def describe(step: Step, out: Path) -> str:
    """One line on a step: whether it is done, how long it takes, and its command."""
    expected = "time?" if step.minutes is None else f"{step.minutes} min"
    done = "done" if (out / step.name / step.result).exists() else expected
    asked = [f"uses {step.uses}"] if step.uses else []
    asked += [f"needs {step.needs}"] if step.needs else []
    return f"{step.name:20} {done:>8}   python {step.command}" + (f"   ({', '.join(asked)})" if asked else "")


def _run_step(step: Step, args: ReproduceArgs) -> None:
    """One command in a process of its own, unless it is done."""
    folder = args.out / step.name
    if step.uses and not (args.out / step.uses).exists():
        raise ValueError(f"{step.name} uses {step.uses}, which is not there; run it first, or name both in --only")
    if not (folder / step.result).exists():
        words = step.arguments(args.out, resume=(folder / "config.json").exists())
        print(f"\n== {step.name}: python {' '.join(words)}", flush=True)
        code = subprocess.run([sys.executable, *words], env=dict(os.environ), check=False).returncode
        if code:
            raise ValueError(f"{step.name} ended with exit code {code}; mend what it says and run this command again")
    if step.name in TABLES:
        results = args.folder / "results"
        results.mkdir(exist_ok=True)
        measured = json.loads((folder / step.result).read_text())
        kept = json.dumps(shortened(step.name, measured), ensure_ascii=False, separators=(",", ":"))
        (results / f"{step.name}.json").write_text(kept + "\n")


main = command(ReproduceArgs, "tools.reproduce.__main__")

if __name__ == "__main__":
    sys.exit(main())
