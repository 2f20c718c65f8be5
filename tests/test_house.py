"""The plan of the house: floors, circles, names that mean one thing, calls that can be read."""

import ast
import re
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# A package imports from lower floors only. Calibration stands above prediction, whose small network it uses.
FLOORS = {
    0: (
        "_version",
        "errors",
        "extras",
        "windows",
        "types",
        "geometry",
        "serialization",
        "files",
        "compile_cache",
        "cli",
        "given",
    ),
    1: ("batching", "models", "options", "objects", "progress", "sharding", "views"),
    2: ("dataset",),
    3: ("rendering", "depth", "skin", "unknowns"),
    4: ("simulation", "prediction", "convert", "viz", "hardware"),
    5: ("calibration", "registration", "emulators", "view"),
    6: ("recognition", "reconstruction", "collect"),
    7: ("environments", "place", "imagine", "__main__"),  # the short name of a command, and the list of all
}
FLOOR_OF = {name: floor for floor, names in FLOORS.items() for name in names}
# Called i2t.place, and parts that others start.
UNNAMED_COMMANDS = ("i2t.collect.place", "i2t.hardware.ur.rtde_worker", "experiments.faults.worker")
WITHOUT_JAX = ("i2t", "i2t.types", "i2t.errors", "i2t.objects", "i2t.dataset", "i2t.hardware", "i2t.skin.boards")


PROJECT = ("i2t", "experiments", "tests", "examples", "notebooks")
IMPORTERS = ("import_module", "__import__", "find_spec", "run_module")


def _name_of(path: Path) -> str:
    """A package's name ends in a point, so that what stands in its `__init__` can be told from a module."""
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
    return name.removesuffix("__init__")


def _modules(*folders: str) -> dict[str, ast.Module]:
    paths = (path for folder in folders for path in sorted((ROOT / folder).rglob("*.py")))
    return {_name_of(path): ast.parse(path.read_text()) for path in paths}


def _absolute(name: str, module: str, level: int) -> str:
    """What `module` after `level` points means in the module `name`."""
    above = name.split(".")[:-level] if level else []
    return ".".join([*above, *([module] if module else [])])


def _imports(name: str, tree: ast.Module, modules: set[str]) -> Iterator[str]:
    """Everything of the project that a module imports, wherever in it the import stands and however it is written: for
    type checkers only, relative to the module, or by a function that takes a name.
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
        yield from (each for each in found if each.split(".")[0] in PROJECT)


def _import_graph(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    modules = {name.removesuffix(".") for name in trees}
    return {
        name.removesuffix("."): set(_imports(name, tree, modules)) - {name.removesuffix(".")}
        for name, tree in trees.items()
    }


def _floor_violations(graph: dict[str, set[str]]) -> list[str]:
    """Imports that lead upwards, out of the package, or to the public face, behind which everything stands."""
    wrong = []
    for name, imported in graph.items():
        top, _, rest = name.partition(".")
        for other in sorted(imported):
            package, _, inner = other.partition(".")
            allowed = {"i2t": ("i2t",), "experiments": ("i2t", "experiments")}[top]
            if package not in allowed or (top == "i2t" and not inner):
                wrong.append(f"{name} imports {other}")
            elif top == "i2t" and rest:
                here, there = rest.split(".")[0], inner.split(".")[0]
                if there != here and FLOOR_OF[there] >= max(FLOOR_OF[here], 1):
                    wrong.append(f"{name} imports {other}")
    return wrong


def _circle(graph: dict[str, set[str]]) -> str:
    """The first circle of imports, or nothing."""
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> str:
        if name in path:
            return " -> ".join((*path[path.index(name) :], name))
        found = ""
        if name not in done:
            found = next((each for other in sorted(graph.get(name, ())) if (each := visit(other, (*path, name)))), "")
            done.add(name)
        return found

    return next((found for name in graph if (found := visit(name, ()))), "")


TREES = _modules("i2t", "experiments")
MODULES = {name.removesuffix("."): tree for name, tree in TREES.items()}
GRAPH = _import_graph(TREES)


def test_every_package_has_a_floor():
    here = {name.split(".")[1] for name in MODULES if name.startswith("i2t.")}
    assert here <= FLOOR_OF.keys(), "give it a floor in tests/test_house.py and docs/architecture.md"


def test_the_architecture_page_is_the_tree():
    """Every package at its floor, every folder, and every command."""
    page = (ROOT / "docs" / "architecture.md").read_text()
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", page, re.M)
    stated = {name: int(floor) for floor, names in rows for name in re.findall(r"`i2t/(\w+)(?:/|\.py)", names)}
    assert stated == {name: FLOOR_OF[name] for name in stated}
    here = {name.split(".")[1] for name in MODULES if name.startswith("i2t.")}
    assert here <= stated.keys()
    for package in (name for name in TREES if name.startswith("i2t.") and name.endswith(".")):
        folder = package.replace(".", "/")
        assert f"`{folder}`" in page or f"`{folder.split('/')[-2]}/`" in page, f"the page does not name {folder}"
    for name, tree in MODULES.items():
        if any(isinstance(node, ast.If) and "__main__" in ast.unparse(node.test) for node in tree.body):
            command = name.removesuffix(".__main__")
            named = re.search(rf"`(?:python -m )?{re.escape(command)}`", page)
            assert named or command in UNNAMED_COMMANDS, f"the page does not name {command}"


def test_a_package_imports_from_lower_floors_only():
    assert not _floor_violations({name: found for name, found in GRAPH.items() if name != "i2t"})
    assert all(other.startswith("i2t.") for other in GRAPH["i2t"])


def test_no_module_imports_itself_in_a_circle():
    assert not _circle(GRAPH)


HIDDEN = {  # what the floors must see, in a module of i2t.dataset
    "from i2t.recognition import belief": "i2t.recognition.belief",
    "from ..recognition import belief": "i2t.recognition.belief",
    "from ..recognition.belief import Particles": "i2t.recognition.belief",
    "from i2t import ObjectRecognizer": "i2t",
    "import i2t": "i2t",
    "from .. import ObjectRecognizer": "i2t",
    "importlib.import_module('i2t.recognition.belief')": "i2t.recognition.belief",
    "import_module('..recognition.belief', __package__)": "i2t.recognition.belief",
    "def late():\n    from i2t.recognition.belief import Particles": "i2t.recognition.belief",
    "if TYPE_CHECKING:\n    from i2t.recognition import belief": "i2t.recognition.belief",
    "from tests.helpers import touches": "tests.helpers",
    "from experiments.train import run": "experiments.train.run",
    "import examples": "examples",
}


@pytest.mark.parametrize(("source", "imported"), HIDDEN.items())
def test_an_import_upwards_is_seen_however_it_is_written(source, imported):
    trees = {"i2t.dataset.case": ast.parse(source), "i2t.recognition.belief": ast.parse("")}
    graph = _import_graph(trees | {"experiments.train.run": ast.parse("")})
    assert graph["i2t.dataset.case"] == {imported}
    assert _floor_violations(graph) == [f"i2t.dataset.case imports {imported}"]


def test_what_is_allowed_is_no_violation():
    source = """
import numpy
from i2t import types
from ..types import Array
from . import files
from i2t.dataset.sets import Dataset
"""
    trees = {name: ast.parse("") for name in ("i2t.types", "i2t.dataset.", "i2t.dataset.files", "i2t.dataset.sets")}
    graph = _import_graph({"i2t.dataset.case": ast.parse(source), **trees})
    assert graph["i2t.dataset.case"] == {"i2t.types", "i2t.dataset.files", "i2t.dataset.sets"}
    assert not _floor_violations(graph)


def test_a_circle_is_seen_however_it_is_written():
    one = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from .two import B"
    trees = {"i2t.dataset.": "", "i2t.dataset.one": one, "i2t.dataset.two": "def f():\n    from i2t.dataset import one"}
    graph = _import_graph({name: ast.parse(source) for name, source in trees.items()})
    assert _circle(graph) == "i2t.dataset.one -> i2t.dataset.two -> i2t.dataset.one"
    inside = _import_graph(
        {"i2t.dataset.": ast.parse("from . import one"), "i2t.dataset.one": ast.parse("from .. import dataset")}
    )
    assert _circle(inside) == "i2t.dataset -> i2t.dataset.one -> i2t.dataset"
    assert not _circle({"a": {"b", "c"}, "b": {"c"}, "c": set()})


@pytest.mark.parametrize("name", WITHOUT_JAX)
def test_the_hardware_side_imports_no_jax(name):
    modules = [name]
    if name in ("i2t.dataset", "i2t.objects", "i2t.hardware"):
        modules += [each for each in MODULES if each.startswith(name + ".") and not each.endswith("__main__")]
    code = f"import sys, importlib\nfor name in {modules!r}: importlib.import_module(name)\nprint('jax' in sys.modules)"
    asked = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert asked.stdout.strip() == "False"


def test_no_two_public_classes_share_a_name():
    where = defaultdict(list)
    for name, tree in MODULES.items():
        for node in tree.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                where[node.name].append(name)
    assert not {name: places for name, places in where.items() if len(places) > 1}


def _constants(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Public constants of a module and their values as written; tables (such as PRESETS) are each module's own."""
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and node.value is not None:
            pairs = [(node.target, node.value)]
        elif isinstance(node, ast.Assign):
            pairs = [(target, node.value) for target in node.targets]
        else:
            continue
        for target, value in pairs:
            several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            for name, each in zip(target.elts, value.elts, strict=False) if several else [(target, value)]:
                public = isinstance(name, ast.Name) and name.id.isupper() and not name.id.startswith("_")
                if public and not isinstance(each, ast.Dict | ast.DictComp):
                    yield name.id, ast.unparse(each)


def _with_two_values(trees: Iterable[ast.Module]) -> dict[str, list[str]]:
    values = defaultdict(set)
    for tree in trees:
        for name, value in _constants(tree):
            values[name].add(value)
    return {name: sorted(found) for name, found in values.items() if len(found) > 1}


def test_no_constant_has_two_values():
    """Text is left out: it names an experiment's own methods and columns."""
    numbers = _with_two_values(MODULES.values())
    assert not {name: found for name, found in numbers.items() if not all(each[0] in "'\"" for each in found)}


@pytest.mark.parametrize("other", ["LEVER_M = 2e-3", "LEVER_M: float = 2e-3", "ARM_M, LEVER_M = 1.0, 2e-3"])
def test_a_constant_with_another_value_is_seen_however_it_is_written(other):
    assert _with_two_values([ast.parse("LEVER_M = 1e-3"), ast.parse(other)]) == {"LEVER_M": ["0.001", "0.002"]}
    assert not _with_two_values([ast.parse("LEVER_M = 1e-3\nPRESETS = {1: 2}"), ast.parse("PRESETS: dict = {1: 3}")])


# Array code: functions whose positional arguments are arrays in an order that everybody knows.
ARRAY_CODE = ("jnp.", "np.", "lax.", "jax.lax.", "jax.numpy.", "math.", "struct.", "plt.", "axes.", "scipy.")
# Kernels of the renderer and of the contact: private functions that pass arrays on inside of one module, most of them
# to loops of JAX, which call by position.
KERNELS = {
    "i2t.rendering.raycast": {"_cast", "_cast_listed", "_fronts", "_draw_layers", "cast_dense", "partial"},
    "i2t.rendering.tiles": {"_set_up", "_draw", "_draw_busiest", "_draw_all", "partial"},
    "i2t.skin.contact": {"_tracked", "_contact"},
    "i2t.skin.friction": {"_tracked"},
}


def _crowded_calls(name: str, tree: ast.Module) -> list[str]:
    """Calls with six positional arguments; `jax.vmap(f)(...)` calls f, and is no array code for its first letters."""
    return [
        f"{name}:{node.lineno} {called}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and len(node.args) >= 6
        for called in [ast.unparse(node.func)]
        if called not in KERNELS.get(name, ()) and ("(" in called or not called.startswith(ARRAY_CODE))
        if not called.endswith(".reshape")
    ]


def test_no_call_has_six_positional_arguments():
    assert not [call for name, tree in MODULES.items() if name.startswith("i2t") for call in _crowded_calls(name, tree)]
    for name, called in KERNELS.items():  # an exception that is no longer needed is taken back
        used = {
            ast.unparse(node.func)
            for node in ast.walk(MODULES[name])
            if isinstance(node, ast.Call) and len(node.args) > 5
        }
        assert used >= called, f"{name} no longer calls {called - used} so"


def test_a_crowded_call_is_seen_however_it_is_written():
    six = "1, 2, 3, 4, 5, 6"
    for called in ("f", "self.f", "jax.vmap(f)", "jax.jit(jax.vmap(f))", "table[0]", "_draw", "partial"):
        assert _crowded_calls("i2t.rendering.dense", ast.parse(f"{called}({six})")) == [
            f"i2t.rendering.dense:1 {called}"
        ]
    for called in ("jnp.stack", "jax.lax.cond", "struct.pack"):
        assert not _crowded_calls("i2t.rendering.dense", ast.parse(f"{called}({six})"))
    assert not _crowded_calls("i2t.rendering.tiles", ast.parse(f"_draw({six})"))


ARGS = re.compile(r"^Args:\n((?: +.*\n?|\n)*)", re.MULTILINE)
AS_IN = re.compile(r"as in `([\w.]+)`")


def _described(docstring: str, docstrings: dict[str, str]) -> set[str]:
    """Arguments that a docstring names, and "return" if it says what comes back; "as in `Class.method`" in its summary
    stands for what that one's docstring says.
    """
    args = ARGS.search(docstring)
    named = set(re.findall(r"^ {4}\**(\w+):", args[1], re.MULTILINE)) if args else set()
    named |= {"return"} if re.search(r"^(Returns|Yields):", docstring, re.MULTILINE) else set()
    summary = re.split(r"^(?:Args|Returns|Raises):", docstring, maxsplit=1, flags=re.MULTILINE)[0]
    for name in AS_IN.findall(summary):
        named |= _described(docstrings.get(name, ""), docstrings)
    return named


def _to_describe(function: ast.FunctionDef) -> set[str]:
    a = function.args
    every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *(each for each in (a.vararg, a.kwarg) if each is not None)]
    names = {each.arg for each in every} - {"self", "cls", "_"}
    gives = function.returns is not None and ast.unparse(function.returns) != "None"
    return names | {"return"} if names and gives else names


def _public_functions() -> Iterator[tuple[str, str, ast.FunctionDef]]:
    """Module, qualified name and definition of what i2t offers; overloads and the contract's own tests are no part."""
    for module, tree in MODULES.items():
        for node in tree.body if module.startswith("i2t") else ():
            of_class = isinstance(node, ast.ClassDef)
            for each in node.body if of_class else (node,):
                if not isinstance(each, ast.FunctionDef) or node.name.startswith("_"):
                    continue
                decorated = " ".join(map(ast.unparse, each.decorator_list))
                if not each.name.startswith(("_", "test_")) and not re.search("overload|register|setter", decorated):
                    yield module, f"{node.name}.{each.name}" if of_class else each.name, each


def test_every_public_function_says_what_it_takes_and_gives():
    functions = list(_public_functions())
    assert len(functions) > 800
    docstrings = {name: ast.get_docstring(function) or "" for _, name, function in functions}
    missing = {
        f"{module}.{name}": sorted(_to_describe(function) - _described(ast.get_docstring(function) or "", docstrings))
        for module, name, function in functions
    }
    assert not {name: what for name, what in missing.items() if what}


def test_every_public_class_says_what_it_is_made_of():
    missing = {}
    for module, tree in MODULES.items():
        for node in tree.body if module.startswith("i2t") else ():
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                for each in node.body:
                    if isinstance(each, ast.FunctionDef) and each.name == "__init__":
                        docstrings = (ast.get_docstring(node) or "") + "\n\n" + (ast.get_docstring(each) or "")
                        missing[f"{module}.{node.name}"] = sorted(_to_describe(each) - _described(docstrings, {}))
    assert len(missing) > 20
    assert not {name: what for name, what in missing.items() if what}
