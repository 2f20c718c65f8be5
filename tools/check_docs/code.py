"""Checks of the code's text: floors, no circles, docstrings that say what is taken and given."""

import ast
import importlib
import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path

import i2t
from tools.check_docs.pages import Finding, wrong_call

# A package imports from lower floors only. Prediction stands above the paper, whose parts it uses.
FLOORS = {
    0: ("_version", "errors", "types", "geometry", "validation", "files", "patches", "runtime", "cli"),
    1: ("models", "objects"),
    2: ("dataset", "training"),
    3: ("rendering", "depth", "skin"),
    4: ("contact", "recordings", "paper", "viz", "hardware"),
    5: ("simulation", "convert", "view"),
    6: ("registration", "emulators", "skin_models", "heads"),
    7: ("prediction",),
    8: ("recognition", "reconstruction", "collect"),
    9: ("environments", "place", "imagine", "__main__"),  # the short name of a command, and the list of all
}  # fmt: skip
FLOOR_OF = {name: floor for floor, names in FLOORS.items() for name in names}
PROJECT = ("i2t", "experiments", "tools", "tests", "examples", "notebooks")
REACH = {"i2t": ("i2t",), "experiments": ("i2t", "experiments"), "tools": ("i2t", "experiments", "tools")}
IMPORTERS = ("import_module", "__import__", "find_spec", "run_module")
ARGS = re.compile(r"^Args:\n((?: +.*\n?|\n)*)", re.MULTILINE)
AS_IN = re.compile(r"as in `([\w.]+)`")
Trees = Mapping[str, ast.Module]  # by name; a package's ends in a point


def findings(root: Path) -> Iterator[Finding]:
    """Find mistakes in the code of `i2t` and `experiments`."""
    trees = {}
    for folder in ("i2t", "experiments", "tools"):
        for path in sorted((root / folder).rglob("*.py")):
            name = ".".join(path.relative_to(root).with_suffix("").parts).removesuffix("__init__")
            trees[name] = ast.parse(path.read_text())
    where = {name: root / (name.replace(".", "/") + ("__init__.py" if name.endswith(".") else ".py")) for name in trees}
    for check in (floors, circle, docstrings):
        for name, line, sentence in check(trees):
            yield Finding(where[name], line, sentence)
    yield from architecture(root / "docs" / "architecture.md")
    for name in i2t.__all__:
        for wrong in face(name):
            yield Finding(root / "i2t" / "__init__.py", 1, wrong)


def imports(name: str, tree: ast.Module, modules: set[str]) -> Iterator[tuple[int, str]]:
    """Line and name of everything of the project that a module imports, wherever in it the import stands and however
    it is written: for type checkers only, relative to the module, or by a function that takes a name.
    """
    for node in ast.walk(tree):
        found: list[str] = []
        if isinstance(node, ast.ImportFrom):
            base = _absolute(name, node.module or "", node.level)
            full = [f"{base}.{alias.name}" for alias in node.names]
            found = [each if each in modules else base for each in full]
        elif isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in IMPORTERS and node.args:
            first = node.args[0]
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                after = first.value.lstrip(".")
                found = [_absolute(name, after, len(first.value) - len(after))]
        yield from ((node.lineno, each) for each in found if each.split(".")[0] in PROJECT)  # type: ignore[attr-defined]


def _absolute(name: str, module: str, level: int) -> str:
    """Resolve `module` after `level` points, as the module `name` imports it."""
    above = name.split(".")[:-level] if level else []
    return ".".join([*above, *([module] if module else [])])


def floors(trees: Trees) -> Iterator[tuple[str, int, str]]:
    """Imports that lead upwards, out of the package, or to the public face, behind which everything stands."""
    modules = {name.removesuffix(".") for name in trees}
    for name, tree in trees.items():
        top, _, rest = name.removesuffix(".").partition(".")
        here = rest.split(".")[0]
        if top == "i2t" and rest and here not in FLOOR_OF:
            yield name, 1, f"{here} has no floor; give it one here and in docs/architecture.md"
            continue
        for line, other in imports(name, tree, modules):
            package, _, inner = other.partition(".")
            there = inner.split(".")[0]
            outside = (
                package
                not in {
                    "i2t": ("i2t",),
                    "experiments": ("i2t", "experiments"),
                    "tools": ("i2t", "experiments", "tools"),
                }[top]
            )
            face = top == "i2t" and not inner
            upwards = (
                top == "i2t" and bool(rest) and there != here and FLOOR_OF.get(there, 99) >= max(FLOOR_OF[here], 1)
            )
            if outside or face or upwards:
                yield name, line, f"{name.removesuffix('.')} imports {other}, which stands no lower"


def circle(trees: Trees) -> Iterator[tuple[str, int, str]]:
    """The first circle of imports."""
    modules = {name.removesuffix(".") for name in trees}
    graph = {
        name.removesuffix("."): {other for _, other in imports(name, tree, modules)} - {name.removesuffix(".")}
        for name, tree in trees.items()
    }
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> str:
        if name in path:
            return " -> ".join((*path[path.index(name) :], name))
        if name in done:
            return ""
        found = next((each for other in sorted(graph.get(name, ())) if (each := visit(other, (*path, name)))), "")
        done.add(name)
        return found

    for name in trees:
        if found := visit(name.removesuffix("."), ()):
            yield name, 1, f"{found} is a circle of imports"
            return


def _described(docstring: str, others: Mapping[str, str]) -> set[str]:
    """Arguments that a docstring names, and "return" if it says what comes back; "as in `Class.method`" in its summary
    stands for what that one's docstring says.
    """
    args = ARGS.search(docstring)
    named = set(re.findall(r"^ {4}\**(\w+):", args[1], re.MULTILINE)) if args else set()
    named |= {"return"} if re.search(r"^(Returns|Yields):", docstring, re.MULTILINE) else set()
    summary = re.split(r"^(?:Args|Returns|Raises):", docstring, maxsplit=1, flags=re.MULTILINE)[0]
    for name in AS_IN.findall(summary):
        named |= _described(others.get(name, ""), others)
    return named


def _to_describe(function: ast.FunctionDef) -> set[str]:
    a = function.args
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *(each for each in (a.vararg, a.kwarg) if each is not None)]
    names = {each.arg for each in every} - {"self", "cls", "_"}
    gives = function.returns is not None and ast.unparse(function.returns) != "None"
    return names | {"return"} if names and gives else names


def docstrings(trees: Trees) -> Iterator[tuple[str, int, str]]:
    """Public functions, methods and constructors of i2t say what they take and give; overloads and the contract's own
    tests do not.
    """
    public = []
    for module, tree in trees.items():
        for node in tree.body if module.startswith("i2t") else ():
            of_class = isinstance(node, ast.ClassDef)
            for each in node.body if isinstance(node, ast.ClassDef) else (node,):
                if not isinstance(each, ast.FunctionDef) or node.name.startswith("_"):  # type: ignore[attr-defined]
                    continue
                decorated = " ".join(map(ast.unparse, each.decorator_list))
                constructor = of_class and each.name == "__init__"
                if (constructor or not each.name.startswith(("_", "test_"))) and not re.search(
                    "overload|register|setter", decorated
                ):
                    said = ast.get_docstring(each) or ""
                    said += "\n\n" + (ast.get_docstring(node) or "") if constructor else ""  # type: ignore[arg-type]
                    name = f"{node.name}.{each.name}" if of_class else each.name  # type: ignore[attr-defined]
                    public.append((module, name, each, said))
    others = {name: said for _, name, _, said in public}
    for module, name, function, said in public:
        if missing := sorted(_to_describe(function) - _described(said, others)):
            yield module, function.lineno, f"{name} does not say {', '.join(missing)}"


def architecture(page: Path) -> Iterator[Finding]:
    """The page has every package at its floor."""
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", page.read_text(), re.M)
    stated = {name: int(floor) for floor, names in rows for name in re.findall(r"`i2t/(\w+)(?:/|\.py)", names)}
    for name, floor in FLOOR_OF.items():
        if stated.get(name) != floor:
            yield Finding(page, 1, f"i2t/{name} stands on floor {floor}")


def face(name: str) -> Iterator[str]:
    """Find mistakes in the docstring of a public name: what it raises, and an example that can be called."""
    value = getattr(i2t, name)
    said = inspect.getdoc(value) or ""
    if inspect.isfunction(value):
        body = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(value))))
        if any(isinstance(node, ast.Raise) for node in ast.walk(body)) and "Raises:" not in said:
            yield f"i2t.{name} raises and does not say what"
    if not inspect.isclass(value) or not issubclass(value, Exception):
        if "Example:\n" not in said:
            yield f"i2t.{name} has no example"
            return
        space = {"i2t": importlib.import_module("i2t")} | {each: getattr(i2t, each) for each in i2t.__all__}
        for node in ast.walk(ast.parse(textwrap.dedent(said.split("Example:\n", 1)[1]))):
            if isinstance(node, ast.Call) and (wrong := wrong_call(node, space)):
                yield f"the example of i2t.{name}: {wrong}"
