"""The Python code of the pages runs as printed. Blocks of a page share their names.

`tools.snippets` runs the README, the start page and the tutorials as they are, and compares their outputs. Here are the
pages that use names of the reader's own.

A page may use names that are the reader's own, such as recorded presses: the set-up of its test makes them, small and
simulated, in an empty folder. Sizes that would take minutes are replaced by others before the code runs. Code that
compiles for a minute or moves an arm is not run here: the tests of its package do, and `tools.check_docs` checks
what it calls.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.random_touches import make as random_dataset
from helpers.skin_presses import presses_of_a_skin

import i2t
from i2t.dataset import save_dataset
from i2t.heads.heads import fit_head
from i2t.heads.regression import HeadBudget
from tools import snippets

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOT_RUN = ("environments", "hardware", "local_shape", "registration")

Names = dict[str, Any]


def _pressed() -> Names:
    random = np.random.default_rng(0)
    positions, travels = random.uniform(-5e-3, 5e-3, (30, 2)), random.uniform(0.1e-3, 0.5e-3, 30)
    readings = 1e5 * travels[:, None] * np.cos(positions @ random.normal(0, 200, (2, 15)))
    Path("runs/calibrate").mkdir(parents=True)
    i2t.calibrate(positions, travels, readings, load_kind="travel").save("runs/calibrate/calibration.npz")
    return {
        "positions": positions[:20], "travels": travels[:20], "readings": readings[:20],
        "other_positions": positions[20:], "other_travels": travels[20:],
    }  # fmt: skip


def _a_data_set() -> Names:
    Path("DATA/today").mkdir(parents=True)
    save_dataset("DATA/set.h5", random_dataset(60))
    return {
        "touch": random_dataset(1), "depth_uint16": np.zeros((4, 5), np.uint16), "time": np.arange(3.0),
        "values": np.zeros((3, 2)), "columns": ("x", "y"), "time_of_contact": 1.0,
    }  # fmt: skip


def _a_head() -> Names:
    recording, budget = presses_of_a_skin(120), HeadBudget(selection_rows=60, known_rows=100)
    Path("runs/calibrate").mkdir(parents=True)
    fit_head(recording, "position", budget=budget).save("runs/calibrate/position.npz")
    return {"readings": recording.readings[:5]}


SET_UPS: dict[str, Callable[[], Names]] = {
    "calibration": _pressed, "data": _a_data_set, "fidelity": _a_head, "model_card": dict, "prediction": dict,
}  # fmt: skip
IN_PLACE: dict[str, dict[str, str]] = {
    "prediction": {"fit_predictor(dataset)": "fit_predictor(dataset, method='mean')"},
}


@pytest.fixture(autouse=True)
def _compiled_quickly():
    """The pages compile much and compute little."""
    jax.config.update("jax_disable_most_optimizations", True)


def test_the_code_of_every_page_is_run_or_known_to_be_slow():
    with_code = {path.stem for path in DOCS.glob("*.md") if "```python" in path.read_text()}
    assert with_code - snippets.pages_of(ROOT).keys() == {*SET_UPS, *NOT_RUN}


@pytest.mark.parametrize("page", SET_UPS)
def test_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = snippets.snippets_of((DOCS / f"{page}.md").read_text())
    code = "\n".join(block.code for block in blocks if block.language == "python")
    for printed, instead in IN_PLACE.get(page, {}).items():
        assert printed in code, f"{page} no longer says {printed}"
        code = code.replace(printed, instead)
    names = SET_UPS[page]() | {"__name__": "__main__"}
    exec(compile(code, f"{page}.md", "exec"), names)
