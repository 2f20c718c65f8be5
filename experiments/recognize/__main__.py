"""Which object is it, by touch?

    python -m experiments.recognize                simulated episodes on a finished run of experiments.train
    python -m experiments.recognize live           an arm, real or not, that touches where the belief wants it to

Each has its own --help: python -m experiments.recognize simulate --help. Without a subcommand it simulates.
"""

import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tyro

from experiments.common.commands import carrying_out
from experiments.recognize.arguments import LiveArgs, SimulateArgs
from i2t.cli import docstring_of, read_options

Command = (
    Annotated[SimulateArgs, tyro.conf.subcommand("simulate", description=docstring_of("experiments.recognize.run"))]
    | Annotated[LiveArgs, tyro.conf.subcommand("live", description=docstring_of("experiments.recognize.live"))]
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words[:1] not in (["simulate"], ["live"], ["--help"], ["-h"]):
        words = ["simulate", *words]
    commands: Any = Command  # a union is no type to mypy
    args: SimulateArgs | LiveArgs = read_options(
        commands, words, program="python -m experiments.recognize", description=__doc__, config=()
    )
    module = "experiments.recognize.live" if isinstance(args, LiveArgs) else "experiments.recognize.run"
    with carrying_out(args, words, module) as this:
        checked = this.checked()
        this.run(checked)
    return this.code


if __name__ == "__main__":
    sys.exit(main())
