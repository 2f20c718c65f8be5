"""The plan of the house: floors, circles, names that mean one thing, calls that can be read."""

import ast
import re
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

# A package imports from lower floors only. Calibration stands above prediction, whose small network it uses.
FLOORS = {
    0: ("_version", "errors", "types", "geometry", "serialization", "cli"),
    1: ("objects",),
    2: ("dataset",),
    3: ("rendering", "depth", "skin"),
    4: ("simulation", "prediction", "convert", "viz", "hardware"),
    5: ("calibration", "registration", "emulators"),
    6: ("recognition", "reconstruction", "environments", "collect"),
    7: ("place",),  # the short name of a command
}
FLOOR_OF = {name: floor for floor, names in FLOORS.items() for name in names}
WITHOUT_JAX = ("i2t", "i2t.types", "i2t.errors", "i2t.objects", "i2t.dataset", "i2t.hardware", "i2t.skin.boards")


def _modules(*folders: str) -> dict[str, ast.Module]:
    found = {}
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = ast.parse(path.read_text())
    return found


MODULES = _modules("i2t", "experiments")


def _imports(tree: ast.Module, modules: dict[str, ast.Module]) -> Iterator[str]:
    """Modules of the project that a module imports, wherever in it the import stands; those for type checkers only are
    left out.
    """
    for_checkers = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in for_checkers:
            continue
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield from (
                    name for name in (full, node.module) if name in modules and (name == full or full not in modules)
                )
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)


GRAPH = {name: set(_imports(tree, MODULES)) - {name} for name, tree in MODULES.items()}


def test_a_package_imports_from_lower_floors_only():
    wrong = []
    for name, imported in GRAPH.items():
        if not name.startswith("i2t."):
            continue
        here = name.split(".")[1]
        assert here in FLOOR_OF, f"{name} has no floor: give it one in tests/test_house.py and docs/architecture.md"
        for other in imported:
            there = other.split(".")[1] if "." in other else ""
            upwards = there and there != here and FLOOR_OF[there] >= max(FLOOR_OF[here], 1)
            if other.startswith("experiments") or upwards:
                wrong.append(f"{name} imports {other}")
    assert not wrong


def test_no_module_imports_itself_in_a_circle():
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join((*path[path.index(name) :], name))
        if name not in done:
            for other in sorted(GRAPH[name]):
                visit(other, (*path, name))
            done.add(name)

    for name in GRAPH:
        visit(name, ())


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


def test_no_constant_has_two_values():
    values = defaultdict(set)
    for tree in MODULES.values():
        for node in tree.body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            for target in targets:
                if isinstance(target, ast.Name) and target.id.isupper() and not target.id.startswith("_"):
                    values[target.id].add(ast.unparse(node.value))
    shared = {name: sorted(found) for name, found in values.items() if len(found) > 1}
    assert not shared


# Array code: functions whose positional arguments are arrays in an order that everybody knows, the kernels of the
# renderer, and functions with derivatives of their own, which JAX calls by position.
ARRAY_CODE = ("jnp.", "np.", "lax.", "jax.", "math.", "struct.", "plt.", "axes", "scipy.")
KERNELS = ("i2t.rendering.", "i2t.depth.patches", "i2t.skin.contact", "i2t.skin.friction")


def test_no_call_has_six_positional_arguments():
    wrong = Counter()
    for name, tree in MODULES.items():
        if not name.startswith("i2t"):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and len(node.args) >= 6:
                called = ast.unparse(node.func)
                if not called.startswith(ARRAY_CODE) and not name.startswith(KERNELS):
                    wrong[f"{name}:{node.lineno} {called}"] += 1
    assert not wrong


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
