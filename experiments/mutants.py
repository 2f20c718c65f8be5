"""Question: which changes of the core would no test notice?

    python -m experiments.mutants --modules i2t/recognition/belief.py i2t/prediction/gp.py --count 20 --out runs/mutants

Single places of a module are changed, one at a time: a comparison moved by its equality or turned round, an operator
taken for its opposite, a number taken for another, `and` for `or`, a minimum for a maximum, a condition negated, a
statement left out. A sample of them, drawn by `--seed`, is tried on the tests that belong to the module (`TESTS`, or
`--tests`): a mutant is killed where a test fails or does not come to an end, and survives where all pass. Tests run in
a process of their own, on a copy of the checkout, one mutant after another; some 5 s to a minute each.

`--out` gets `mutants.json` with every mutant tried, and the survivors are printed as changes of lines. `--resume` goes
on with an unfinished sample. Some changes make no difference that a test could see: an equal bound of a real number, a
seed, a tolerance that is met with room to spare.
"""

import ast
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from experiments.common.runs import begin, exit_code_of_run, write_json
from i2t.options import read_options
from i2t.progress import progress

ROOT = Path(__file__).parents[1]
COPIED = ("i2t", "experiments", "tests", "examples", "pyproject.toml", "README.md")  # what tests import or read
LINKED = ("docs", "notebooks")
RESULTS = {0: "survived", 1: "killed", 2: "killed"}  # by pytest's exit code; 2: the tests cannot even be imported
TIMEOUT = "timeout"  # as good as killed
EXTRA_TIME, LEAST_TIME_S = 3.0, 60.0  # a mutant may take so many times as long as the tests alone, and so long anyway

# The tests that belong to a module. Other tests would kill more: what is claimed of a module is what its own notice.
TESTS = {
    "i2t/geometry.py": ("tests/test_geometry.py",),
    "i2t/rendering/ops.py": ("tests/rendering/test_render.py", "tests/rendering/test_gradients.py"),
    "i2t/skin/contact.py": ("tests/skin/test_contact.py", "tests/skin/test_contact_spectrum.py"),
    "i2t/skin/dipoles.py": ("tests/skin/test_dipoles.py",),
    "i2t/skin/elasticity.py": (
        "tests/skin/test_contact.py",
        "tests/skin/test_friction.py",
        "tests/skin/test_dipoles.py",
    ),
    "i2t/skin/faults.py": ("tests/skin/test_faults.py",),
    "i2t/skin/friction.py": ("tests/skin/test_friction.py",),
    "i2t/skin/pad.py": ("tests/skin/test_pad.py", "tests/skin/test_boards.py", "tests/skin/test_friction.py"),
    "i2t/simulation/press.py": ("tests/simulation/test_press.py",),
    "i2t/simulation/touches.py": ("tests/simulation/test_touches.py",),
    "i2t/prediction/gp.py": ("tests/prediction/test_gp.py",),
    "i2t/prediction/training.py": ("tests/prediction/test_training.py",),
    "i2t/recognition/belief.py": ("tests/recognition/test_belief.py",),
    "i2t/recognition/ensemble.py": ("tests/recognition/test_ensemble.py",),
    "i2t/recognition/outcomes.py": ("tests/recognition/test_outcomes.py",),
    "i2t/recognition/planar.py": ("tests/recognition/test_planar.py",),
    "i2t/recognition/policy.py": ("tests/recognition/test_policy.py",),
    "i2t/registration/depth.py": ("tests/registration/test_registration.py",),
    "i2t/registration/levenberg_marquardt.py": ("tests/registration/test_levenberg_marquardt.py",),
    "i2t/registration/patch.py": ("tests/registration/test_patch.py",),
    "i2t/registration/touch.py": ("tests/registration/test_registration.py",),
    "i2t/hardware/reskin/frames.py": ("tests/hardware/test_reskin.py",),
    "i2t/collect/recorder.py": ("tests/collect/test_recorder.py",),
    "i2t/collect/stopping.py": ("tests/collect/test_procedure.py",),
}  # fmt: skip

COMPARISONS: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not",
    ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in",
}  # fmt: skip
TURNED: dict[type[ast.cmpop], str] = {ast.Lt: ">", ast.LtE: ">=", ast.Gt: "<", ast.GtE: "<="}
ARITHMETIC: dict[type[ast.operator], str] = {
    ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*", ast.FloorDiv: "*", ast.Mod: "*", ast.Pow: "*",
    ast.BitAnd: "|", ast.BitOr: "&",
}  # fmt: skip
CALLS = {
    "minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "argmin": "argmax", "argmax": "argmin",
    "any": "all", "all": "any", "sum": "mean", "mean": "sum", "sin": "cos", "cos": "sin", "floor": "ceil",
    "ceil": "floor", "zeros": "ones", "ones": "zeros", "zeros_like": "ones_like", "ones_like": "zeros_like",
}  # fmt: skip


@dataclass(frozen=True)
class MutantArgs:
    """Change the core in single places and see whether tests notice."""

    modules: tuple[str, ...] = tuple(TESTS)  # paths from the checkout's root
    out: Path = Path("runs/mutants")  # folder for mutants.json
    tests: tuple[str, ...] = ()  # that belong to the modules; by default those of `TESTS`
    count: int = 20  # mutants of each module, drawn at random; 0 for all
    tier: Literal["fast", "full"] = "fast"  # of the tests
    timeout: float = 300.0  # s at most for the tests of one mutant
    seed: int = 0
    resume: bool = False  # go on with an unfinished run in --out
    overwrite: bool = False  # replace a finished or unfinished one


@dataclass(frozen=True)
class MutantSample:
    """What decides which mutants are drawn and what may kill them."""

    count: int
    seed: int
    tier: str


class Mutant(NamedTuple):
    """A change of one place in a module's text."""

    operator: str
    line: int  # from 1
    start: int  # of the place, in bytes from the module's beginning
    end: int
    before: str
    after: str

    def apply(self, source: bytes) -> bytes:
        """The module's text with the change."""
        return source[: self.start] + self.after.encode() + source[self.end :]


class Place:
    """Where the nodes of a syntax tree lie in a module's text."""

    def __init__(self, source: bytes) -> None:
        self.source = source
        self.lines = np.cumsum([0] + [len(line) for line in source.splitlines(keepends=True)])

    def span(self, node: ast.expr | ast.stmt) -> tuple[int, int]:
        """First byte of a node, and that after it."""
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return (
            int(self.lines[node.lineno - 1]) + node.col_offset,
            int(self.lines[node.end_lineno - 1]) + node.end_col_offset,
        )

    def text(self, node: ast.expr | ast.stmt) -> str:
        """A node's text."""
        start, end = self.span(node)
        return self.source[start:end].decode()

    def replaced(self, operator: str, node: ast.expr | ast.stmt, after: str) -> Mutant:
        """A mutant in which a node reads otherwise."""
        start, end = self.span(node)
        return Mutant(operator, node.lineno, start, end, self.text(node), after)

    def between(self, operator: str, left: ast.expr, right: ast.expr, symbol: str, after: str) -> Mutant | None:
        """A mutant in which the operator between two operands is another; None if a comment there hides it."""
        start, end = self.span(left)[1], self.span(right)[0]
        gap = self.source[start:end].decode()
        if gap.count(symbol) != 1 or "#" in gap:
            return None
        at = start + len(gap[: gap.index(symbol)].encode())
        return Mutant(operator, left.lineno, at, at + len(symbol.encode()), symbol, after)


SYMBOLS: dict[type[ast.AST], str] = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=", ast.Is: "is",
    ast.IsNot: "is not", ast.In: "in", ast.NotIn: "not in", ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/",
    ast.FloorDiv: "//", ast.Mod: "%", ast.Pow: "**", ast.BitAnd: "&", ast.BitOr: "|",
}  # fmt: skip


def mutants_of(source: str) -> list[Mutant]:
    """All mutants of a module, in the order of its text."""
    place = Place(source.encode())
    found = {mutant for node in _code(ast.parse(source)) for mutant in _mutants_at(node, place)}
    return sorted(found, key=lambda mutant: (mutant.start, mutant.end, mutant.after))


def can_be_parsed(source: bytes) -> bool:
    """Whether a changed module is Python at all: what is not would be killed by nobody's merit."""
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def _code(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes that do something: no annotations, decorators, docstrings, messages of errors nor imports."""
    for name, value in ast.iter_fields(tree):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for node in value if isinstance(value, list) else [value]:
            if not isinstance(node, ast.AST) or isinstance(node, ast.Import | ast.ImportFrom | ast.JoinedStr):
                continue
            if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
                continue
            yield node
            if not isinstance(node, ast.Raise):
                yield from _code(node)


def _mutants_at(node: ast.AST, place: Place) -> Iterator[Mutant]:
    if isinstance(node, ast.expr):
        yield from _of_expression(node, place)
    if isinstance(node, ast.If | ast.While | ast.IfExp):
        yield place.replaced("condition negated", node.test, f"(not ({place.text(node.test)}))")
    if isinstance(node, ast.AugAssign) and type(node.op) in ARITHMETIC:
        symbol, after = SYMBOLS[type(node.op)], ARITHMETIC[type(node.op)]
        changed = place.between("arithmetic", node.target, node.value, f"{symbol}=", f"{after}=")
        if changed is not None:
            yield changed
    if isinstance(node, ast.Raise | ast.AugAssign | ast.Continue | ast.Break):
        yield place.replaced("statement removed", node, "pass")
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        yield place.replaced("statement removed", node, "pass")
    if isinstance(node, ast.Assign) and all(
        isinstance(target, ast.Attribute | ast.Subscript) for target in node.targets
    ):
        yield place.replaced("statement removed", node, "pass")


def _of_expression(node: ast.expr, place: Place) -> Iterator[Mutant]:
    changes: list[Mutant | None] = []
    if isinstance(node, ast.Compare):
        for left, op, right in zip([node.left, *node.comparators], node.ops, node.comparators, strict=False):
            for table in (COMPARISONS, TURNED):
                if type(op) in table:
                    symbol = SYMBOLS[type(op)]
                    changes.append(place.between("comparison", left, right, symbol, table[type(op)]))
    elif isinstance(node, ast.BinOp) and type(node.op) in ARITHMETIC:
        after = ARITHMETIC[type(node.op)]
        changes.append(place.between("arithmetic", node.left, node.right, SYMBOLS[type(node.op)], after))
    elif isinstance(node, ast.BoolOp):
        symbol, after = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        pairs = zip(node.values, node.values[1:], strict=False)
        changes += [place.between("boolean", left, right, symbol, after) for left, right in pairs]
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.Invert | ast.USub):
        changes.append(place.replaced("sign or negation dropped", node, f"({place.text(node.operand)})"))
    elif isinstance(node, ast.Constant):
        changes += [place.replaced("constant", node, after) for after in _other_constants(node.value)]
    elif isinstance(node, ast.Call):
        changes += _of_call(node, place)
    yield from (change for change in changes if change is not None)


def _of_call(node: ast.Call, place: Place) -> Iterator[Mutant]:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", None)
    if name in CALLS:
        _, end = place.span(node.func)
        if not (isinstance(node.func, ast.Name) and CALLS[name] == "mean"):  # there is no built-in mean
            yield Mutant("call", node.lineno, end - len(name), end, name, CALLS[name])
    if name == "where" and len(node.args) == 3:
        yield place.replaced("condition negated", node.args[0], f"~({place.text(node.args[0])})")


def _other_constants(value: object) -> list[str]:
    if isinstance(value, bool):
        return [str(not value)]
    if isinstance(value, int):
        return [str(value + 1)]
    if isinstance(value, float):
        return [repr(2 * value) if value else "1.0"]
    return []


class Sandbox:
    """A copy of the checkout in which modules are changed and tests run."""

    def __init__(self, folder: Path, args: MutantArgs) -> None:
        """Copy what tests need; what they compile is kept in the run's folder."""
        self.folder, self.timeout, self.tier = folder, args.timeout, args.tier
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
            elif source.exists():
                shutil.copy(source, folder / name)
        for name in LINKED:
            if (ROOT / name).exists():
                (folder / name).symlink_to(ROOT / name)
        self.environment = os.environ | {
            "I2T_DATA": os.environ.get("I2T_DATA", str(ROOT.parent / "shared" / "data")),
            "JAX_COMPILATION_CACHE_DIR": str((args.out / "compiled").resolve()),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        self._check()

    def _check(self) -> None:
        """Refuse to try mutants on a package that is not the copy."""
        command = [sys.executable, "-c", "import i2t; print(i2t.__file__)"]
        said = subprocess.run(
            command, cwd=self.folder, env=self.environment, capture_output=True, text=True, check=True
        )
        if not Path(said.stdout.strip()).resolve().is_relative_to(self.folder.resolve()):
            raise ValueError(f"python imports i2t from {said.stdout.strip()} and not from the copy in {self.folder}")

    def run(self, tests: Sequence[str], timeout: float | None = None) -> tuple[str, float]:
        """Run tests until the first fails; says how that ended and how long it took (s)."""
        options = ["--full"] if self.tier == "full" else []
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--tb=no", *options, *tests]
        began = time.monotonic()
        process = subprocess.Popen(
            command, cwd=self.folder, env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        try:
            code = process.wait(self.timeout if timeout is None else timeout)
        except subprocess.TimeoutExpired:
            return TIMEOUT, time.monotonic() - began
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)  # the tests' own commands too
                process.wait()
        # A negative code is a crash of the interpreter; the rest is pytest's own trouble.
        result = "killed" if code < 0 else RESULTS.get(code, f"pytest ended with {code}")
        return result, time.monotonic() - began

    def try_mutant(self, module: str, mutant: Mutant, tests: Sequence[str], timeout: float) -> tuple[str, float]:
        """How the tests of a changed module end; afterwards the module is as it was."""
        path = self.folder / module
        source = path.read_bytes()
        try:
            path.write_bytes(mutant.apply(source))
            return self.run(tests, timeout)
        finally:
            path.write_bytes(source)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = read_options(MutantArgs, argv, program="python -m experiments.mutants", description=__doc__, config=())
    return exit_code_of_run(partial(run, args), args.out)


def run(args: MutantArgs) -> dict[str, Any]:
    """Draw mutants, try them, report."""
    plan = [(module, *draw(module, args)) for module in args.modules]
    begin(args.out, args, MutantSample(args.count, args.seed, args.tier), args.resume, args.overwrite)
    path = args.out / "mutants.json"
    tried: list[dict[str, Any]] = json.loads(path.read_text())["tried"] if path.exists() else []
    known = {(row["module"], row["start"], row["before"], row["after"]) for row in tried}
    with tempfile.TemporaryDirectory() as folder:
        sandbox = Sandbox(Path(folder), args)
        for module, tests, mutants in plan:
            left = [m for m in mutants if (module, m.start, m.before, m.after) not in known]
            for row in try_mutants(sandbox, module, tests, left):
                tried.append(row)
                write_json(path, {"tried": tried})
    result = summarise(tried)
    write_json(args.out / "metrics.json", result)
    print(format_report(tried, result))
    return result


def draw(module: str, args: MutantArgs) -> tuple[tuple[str, ...], list[Mutant]]:
    """Tests of a module, and its sample of mutants. Raises ValueError for a module without tests."""
    path = ROOT / module
    if not path.is_file():
        raise ValueError(f"{module} is no file of {ROOT}")
    tests = args.tests or TESTS.get(module, ())
    if not tests:
        raise ValueError(f"{module} has no tests in experiments/mutants.py; name them with --tests")
    source = path.read_text()
    mutants = mutants_of(source)
    order = np.random.default_rng(args.seed).permutation(len(mutants))
    drawn = (i for i in order if can_be_parsed(mutants[i].apply(source.encode())))
    return tests, [mutants[i] for i in sorted(islice(drawn, args.count or None))]


def try_mutants(
    sandbox: Sandbox, module: str, tests: Sequence[str], mutants: Sequence[Mutant]
) -> Iterator[dict[str, Any]]:
    """Try mutants of a module one after another.

    Raises ValueError where the tests fail without a change, as they would kill every mutant.
    """
    if not mutants:
        return
    sandbox.run(tests)  # so that what is compiled once for all does not count
    result, seconds = sandbox.run(tests)
    if result != "survived":
        raise ValueError(f"{', '.join(tests)} of the unchanged {module}: {result}; make them pass first")
    timeout = min(sandbox.timeout, max(LEAST_TIME_S, EXTRA_TIME * seconds))
    for mutant in progress(mutants, desc=module, unit="mutant"):
        result, seconds = sandbox.try_mutant(module, mutant, tests, timeout)
        yield {"module": module, **mutant._asdict(), "result": result, "seconds": round(seconds, 1)}


def summarise(tried: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Counts and kill rates, by module and in all."""

    def rates(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
        counts = Counter(row["result"] for row in rows)
        killed = counts["killed"] + counts[TIMEOUT]
        return {
            "tried": len(rows),
            "killed": killed,
            "survived": counts["survived"],
            "rate": killed / max(len(rows), 1),
        }

    modules = sorted({row["module"] for row in tried})
    by_module = {module: rates([row for row in tried if row["module"] == module]) for module in modules}
    return {"all": rates(tried), "modules": by_module}


def format_report(tried: Sequence[dict[str, Any]], result: dict[str, Any]) -> str:
    """The table of modules, and the survivors with the lines they change."""
    lines = [f"{'module':42s} tried killed  rate"]
    for module, row in [*result["modules"].items(), ("all", result["all"])]:
        lines.append(f"{module:42s} {row['tried']:5d} {row['killed']:6d} {row['rate']:5.0%}")
    for row in tried:
        if row["result"] not in ("killed", TIMEOUT):
            lines.append(f"{row['result']}: {row['module']}:{row['line']}: {row['before']} -> {row['after']}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
