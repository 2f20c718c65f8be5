"""The package of the paper: its dependencies and its size."""

import ast
import subprocess
import sys
from pathlib import Path

import i2t

ROOM = Path(i2t.__file__).parent / "paper"
ALLOWED = {"paper", "types", "patches", "training", "rendering"}  # of i2t


def imported(tree: ast.Module) -> set[str]:
    """List the packages of i2t that a module imports."""
    names = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names += [f"i2t.{alias.name}" for node in ast.walk(tree)
              if isinstance(node, ast.ImportFrom) and node.module == "i2t" for alias in node.names]  # fmt: skip
    names += [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    return {name.split(".")[1] for name in names if name.startswith("i2t.")}


def test_the_paper_depends_only_on_types_rendering_and_training():
    for path in ROOM.glob("*.py"):
        assert imported(ast.parse(path.read_text())) <= ALLOWED, path.name


def test_importing_the_paper_loads_neither_hardware_nor_recordings():
    program = "import sys, i2t.paper.loop, i2t.paper.loss, i2t.paper.classifier; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    others = {name.split(".")[1] for name in loaded if name.startswith("i2t.")}
    assert not others & {"hardware", "collect", "calibration", "convert", "prediction", "recognition"}
    assert "i2t.paper.network" in loaded


def test_the_paper_stays_small():
    """The limit of 400 lines excludes docstrings, comments and blank lines."""
    lines = 0
    for path in ROOM.glob("*.py"):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        lines += len([line for line in ast.unparse(tree).splitlines() if line.strip()])
    assert lines <= 400
