"""Programs that a command or an example compiles, with their sizes and the seconds of each stage.

    python -m experiments.benchmark.programs -m experiments.train --preset debug
    python -m experiments.benchmark.programs examples/08_recognize_an_object.py

The command runs as usual, with nothing compiled before. `jax.monitoring` reports the times of tracing, lowering and
compilation; the size is the number of HLO instructions before optimisation, from XLA's dump. The dump costs a little
time, so the sums exceed the command's own by a few per cent. PROGRAMS_JSON=FILE writes the table to a file.
"""

import atexit
import json
import os
import re
import runpy
import shutil
import sys
import tempfile
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from experiments.common.tables import text_table

STAGES = {  # JAX's events for one program, in order
    "/jax/core/compile/jaxpr_trace_duration": "traced",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lowered",
    "/jax/core/compile/backend_compile_duration": "compiled",
}
DUMP = re.compile(r"module_(\d+)\.jit_(.*?)\.(?:cpu_gpu_|sm_.*|cpu_)?before_optimizations\.txt")
ROOT = Path(__file__).parents[2]
WRAPPERS = (Path(__file__), ROOT / "i2t" / "runtime" / "compiling.py")  # modules that only forward a call


@dataclass
class Program:
    """One compiled program."""

    name: str
    line: str = ""  # file and line of the checkout that called it
    instructions: int = 0  # HLO, before optimisation
    traced: float = 0.0  # s, tracing in Python
    lowered: float = 0.0  # s
    compiled: float = 0.0  # s, XLA

    @property
    def seconds(self) -> float:
        """Time of all stages."""
        return self.traced + self.lowered + self.compiled


class ProgramRecorder:
    """Programs in the order in which XLA compiled them."""

    def __init__(self) -> None:
        self.programs: list[Program] = []
        self._begun: dict[str, dict[str, float]] = {"traced": {}, "lowered": {}}

    def record(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        """Record an event of `jax.monitoring`.

        Args:
            event: JAX's name of the event.
            duration_secs: Duration in seconds.
            kwargs: Further data, with the program's name as `fun_name`.
        """
        stage, name = STAGES.get(event), str(kwargs.get("fun_name", "")).removeprefix("jit(").removesuffix(")")
        if stage == "compiled":
            traced, lowered = (self._begun[before].pop(name, 0.0) for before in ("traced", "lowered"))
            self.programs.append(Program(name, _calling_line(), 0, traced, lowered, duration_secs))
        elif stage is not None:
            self._begun[stage][name] = duration_secs

    def add_sizes(self, dump: Path) -> None:
        """Add the number of instructions of each program.

        Args:
            dump: Folder of XLA's dump, which numbers programs of one name in order.
        """
        files = sorted((int(match[1]), match[2], path) for path in dump.iterdir() if (match := DUMP.match(path.name)))
        sizes: dict[str, list[int]] = {}
        for _, name, path in files:
            sizes.setdefault(name, []).append(path.read_text(errors="replace").count(" = "))
        for program in self.programs:
            if of_name := sizes.get(re.sub(r"[^\w.-]", "_", program.name)):
                program.instructions = of_name.pop(0)


def _calling_line() -> str:
    """Find the innermost running line of the checkout, apart from wrappers."""
    for frame, line in traceback.walk_stack(None):
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(ROOT) and path not in WRAPPERS and "site-packages" not in path.parts:
            return f"{path.relative_to(ROOT)}:{line}"
    return ""


def table(programs: Sequence[Program], rows_shown: int = 15) -> str:
    """Format the slowest programs, and the sum of the others.

    Args:
        programs: Programs in any order.
        rows_shown: Number of programs with a row of their own.

    Returns:
        Table as text.
    """
    ordered = sorted(programs, key=lambda program: -program.seconds)
    shown, others = ordered[:rows_shown], ordered[rows_shown:]
    rows = [
        (
            *(program.name, program.line, str(program.instructions)),
            *(f"{s:.2f}" for s in (program.traced, program.lowered, program.compiled)),
        )
        for program in shown
    ]
    for title, group in ((f"{len(others)} others", others), (f"all {len(ordered)}", ordered)):
        sums = (sum(getattr(program, stage) for program in group) for stage in STAGES.values())
        rows.append((title, "", str(sum(program.instructions for program in group)), *(f"{s:.2f}" for s in sums)))
    return text_table(("program", "called in", "instructions", "traced s", "lowered s", "compiled s"), rows)


def main(words: Sequence[str]) -> None:
    """Run a module (-m NAME) or a script, and print the table at exit.

    Args:
        words: Arguments as for `python`.
    """
    if words[:1] in ([], ["-h"], ["--help"]) or words == ["-m"]:
        print(__doc__)
        return
    dump, recorder = Path(tempfile.mkdtemp()), ProgramRecorder()
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_dump_to={dump} --xla_dump_hlo_as_text"
    os.environ["I2T_COMPILE_CACHE"] = "off"
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    import jax

    jax.monitoring.register_event_duration_secs_listener(recorder.record)

    def report() -> None:
        recorder.add_sizes(dump)
        shutil.rmtree(dump, ignore_errors=True)
        print(f"\n{table(recorder.programs)}", flush=True)
        if path := os.environ.get("PROGRAMS_JSON"):
            Path(path).write_text(json.dumps([asdict(program) for program in recorder.programs]))

    atexit.register(report)
    if words[0] == "-m":
        sys.argv = list(words[1:])
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    else:
        sys.argv = list(words)
        sys.path.insert(0, str(Path(words[0]).resolve().parent))
        runpy.run_path(words[0], run_name="__main__")


if __name__ == "__main__":
    main(sys.argv[1:])
