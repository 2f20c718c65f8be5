"""Checks of the code beyond the linters': missing docstring sections, layers on the page, examples of public names."""

import ast
import inspect
import re
import textwrap
import tomllib
from collections.abc import Iterator
from pathlib import Path

import i2t
from tools.check_docs.pages import PageProblem


def findings(root: Path) -> Iterator[PageProblem]:
    """Find mistakes in the code of `i2t`, and in the page that describes its packages."""
    for path in sorted((root / "i2t").rglob("*.py")):
        yield from docstrings(path, path.read_text())
    yield from architecture(root / "docs" / "architecture.md")
    for name in i2t.__all__:
        for sentence in face(name):
            yield PageProblem(root / "i2t" / "__init__.pyi", 1, sentence)


def docstrings(path: Path, text: str) -> Iterator[PageProblem]:
    """Find public functions, methods and constructors with arguments whose docstring lacks sections.

    Ruff compares sections with the signature, but accepts a docstring without sections.
    """
    for node in ast.parse(text).body:
        for member in node.body if isinstance(node, ast.ClassDef) else (node,):
            if isinstance(member, ast.FunctionDef) and (sections := _missing_sections(member, node)):
                yield PageProblem(path, member.lineno, f"{member.name} has no section {', '.join(sections)}")


def _missing_sections(function: ast.FunctionDef, holder: ast.stmt) -> list[str]:
    constructor = function.name == "__init__"
    public = constructor or not function.name.startswith(("_", "test_"))
    if not public or getattr(holder, "name", "").startswith("_"):
        return []
    if any(re.search("overload|register|setter", ast.unparse(decorator)) for decorator in function.decorator_list):
        return []  # another docstring describes it
    docstring = ast.get_docstring(function) or ""
    if constructor and isinstance(holder, ast.ClassDef):
        docstring += "\n" + (ast.get_docstring(holder) or "")
    names = {word.arg for word in ast.walk(function.args) if isinstance(word, ast.arg)} - {"self", "cls", "_"}
    if not names or "as in `" in docstring:  # a reference to the method that it implements
        return []
    returns = function.returns is not None and ast.unparse(function.returns) != "None"
    needed = {"Args": "Args:", **({"Returns": "Returns:|Yields:"} if returns else {})}
    return [name for name, title in needed.items() if not re.search(f"^(?:{title})", docstring, re.M)]


def architecture(page: Path) -> Iterator[PageProblem]:
    """Find packages whose layer on the page differs from the contract of import-linter."""
    contracts = tomllib.loads((page.parents[1] / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract["id"] == "floors")
    floors = {name: floor for floor, layer in enumerate(reversed(layers)) for name in re.findall(r"\w+", layer)}
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \|", page.read_text(), re.M)
    stated = {name: int(floor) for floor, names in rows for name in re.findall(r"`i2t/(\w+)(?:/|\.py)", names)}
    for name in sorted(floors.keys() | stated.keys()):
        if stated.get(name) != floors.get(name):
            yield PageProblem(page, 1, f"i2t/{name} stands on floor {floors.get(name)} in pyproject.toml")


def face(name: str) -> Iterator[str]:
    """Find missing parts of a public name's docstring: its exceptions and an example."""
    value = getattr(i2t, name)
    docstring = inspect.getdoc(value) or ""
    if inspect.isfunction(value):
        body = ast.parse(textwrap.dedent(inspect.getsource(inspect.unwrap(value))))
        if any(isinstance(node, ast.Raise) for node in ast.walk(body)) and "Raises:" not in docstring:
            yield f"i2t.{name} raises an exception, but has no section Raises"
    error = inspect.isclass(value) and issubclass(value, Exception)
    if not (error or inspect.ismodule(value)) and "Example:\n" not in docstring:
        yield f"i2t.{name} has no example"
