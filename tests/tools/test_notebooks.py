"""Every notebook runs from top to bottom at its debug size, and the results of its cells can be shown."""

import ast
import json
import os
from pathlib import Path

import numpy as np
import pytest
import trimesh

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
NAMES = ("paper", "first_touches", "skin_physics", "recognition", "reconstruction", "data_tsne", "real_press")


def sources(name: str) -> list[str]:
    """The code cells of a notebook."""
    cells = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def run(name: str) -> list[object]:
    """The value of the last expression of each code cell."""
    shown: list[object] = []
    space: dict[str, object] = {"__name__": "__main__"}
    for number, source in enumerate(sources(name)):
        tree = ast.parse(source, f"{name}, code cell {number}")
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, f"{name}, code cell {number}", "exec"), space)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), f"{name}, code cell {number}", "eval"), space))
    return shown


@pytest.fixture(autouse=True)
def _small(monkeypatch, tmp_path, request):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("I2T_NOTEBOOK", "debug")
    monkeypatch.setitem(os.environ, "I2T_EFLESH", str(tmp_path / "none"))


@pytest.mark.full
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_and_every_figure_can_be_shown(name, tmp_path, monkeypatch, capsys):
    if name == "data_tsne":
        monkeypatch.setenv("I2T_TOUCHES", str(stamped(tmp_path)))
    shown = run(name)
    pictures = [made._repr_png_() for made in shown if hasattr(made, "_repr_png_")]
    assert len(pictures) >= 3
    assert all(picture.startswith(b"\x89PNG") for picture in pictures)
    said = capsys.readouterr().out
    assert "simulated" in said.lower()
    assert ("mug.stl does not exist" in said) == (name == "first_touches")
    assert ("SIMULATED" in said) or name != "real_press"  # recordings are missing


def stamped(folder: Path) -> Path:
    """A small data set on disk: a few presses of stamps."""
    import jax

    from experiments.shapes import run as shapes
    from experiments.shapes.world import press_stamps
    from i2t import dataset
    from i2t.skin.pad import pad_from_seed

    path = folder / "touches.h5"
    dataset.save_dataset(
        path, press_stamps(jax.random.key(0), [pad_from_seed(0)], 50, shapes.PRESETS["debug"].pressing)
    )
    return path


@pytest.mark.full
def test_the_first_notebook_takes_a_mesh_file_of_its_reader():
    """Its cells run on a mesh file that a reader names; without one, an object of the catalogue is used."""
    import i2t
    from i2t import viz

    mesh = i2t.make_object("square").mesh
    trimesh.Trimesh(1e3 * mesh.vertices, mesh.faces).export("mug.stl")
    cells = sources("first_touches")
    (number,) = [i for i, cell in enumerate(cells) if cell.startswith("OWN_MESH")]
    space: dict[str, object] = {"i2t": i2t, "viz": viz}
    exec(cells[number].rsplit("\n", 1)[0], space)  # without its picture
    np.testing.assert_allclose(np.ptp(space["own"].vertices, axis=0), np.ptp(mesh.vertices, axis=0), atol=1e-6)
    space |= {"predictor": i2t.load_predictor("nominal"), "board": i2t.reskin_board()}
    exec(cells[number + 1], space)
    assert space["own_readings"].shape == (4, 15)


def test_every_notebook_is_run():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(NAMES)
