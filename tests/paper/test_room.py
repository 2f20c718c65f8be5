"""The paper's room: what it is built on, and how small it is."""

import ast
import subprocess
import sys
from pathlib import Path

import i2t

ROOM = Path(i2t.__file__).parent / "paper"
ALLOWED = {"paper", "types", "patches", "training", "rendering"}  # of i2t


def imported(tree: ast.Module) -> set[str]:
    """Packages of i2t that a module names."""
    names = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    names += [f"i2t.{each.name}" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module == "i2t"
              for each in node.names]  # fmt: skip
    names += [each.name for node in ast.walk(tree) if isinstance(node, ast.Import) for each in node.names]
    return {name.split(".")[1] for name in names if name.startswith("i2t.")}


def test_the_paper_is_built_on_types_rendering_and_a_training_loop_only():
    for path in ROOM.glob("*.py"):
        assert imported(ast.parse(path.read_text())) <= ALLOWED, path.name


def test_importing_it_loads_nothing_of_hardware_or_recordings():
    said = "import sys, i2t.paper.loop, i2t.paper.loss, i2t.paper.classifier; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", said], capture_output=True, text=True, check=True).stdout.split()
    others = {name.split(".")[1] for name in loaded if name.startswith("i2t.")}
    assert not others & {"hardware", "collect", "calibration", "convert", "prediction", "recognition"}
    assert "i2t.paper.network" in loaded


def test_it_stays_small():
    """At most 400 lines of code, without docstrings, comments and blank lines."""
    lines = 0
    for path in ROOM.glob("*.py"):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef) and ast.get_docstring(node) is not None:
                node.body = node.body[1:] or [ast.Pass()]
        lines += len([line for line in ast.unparse(tree).splitlines() if line.strip()])
    assert lines <= 400
