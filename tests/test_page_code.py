"""The Python code of the pages runs as printed. Blocks of a page share their names.

A page may use names that are the reader's own, such as recorded presses: the set-up of its test makes them, small and
simulated, in an empty folder. What stands for a device is an emulator. Sizes that would take minutes, and addresses of
devices, are replaced by others before the code runs.
"""

import contextlib
import importlib.util
import re
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from helpers.random_touches import make as random_dataset
from PIL import Image

import i2t
from i2t.convert.commands import main as convert
from i2t.dataset import save_dataset
from i2t.hardware.rig import main as rig_command
from i2t.simulation.touches import SimulationErrors
from i2t.skin.elasticity import GRID
from i2t.skin.pad import numbered_pad

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.M | re.S)
TUTORIALS = ("../README", "tutorial_own_camera", "tutorial_own_object", "tutorial_own_skin", "tutorial_recognise")
TIP_RADIUS_M = 4e-3
PATIENCE_S = 20.0

Names = dict[str, Any]
SetUp = Callable[[], contextlib.AbstractContextManager[Names]]


def _given(make: Callable[[], Names]) -> SetUp:
    """A set-up that leaves nothing to end."""

    @contextlib.contextmanager
    def around() -> Iterator[Names]:
        yield make()

    return around


def _presses(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (m), depths (m) and readings (uT) of a ball on a simulated skin."""
    random = np.random.default_rng(0)
    position, depth = random.uniform(-5e-3, 5e-3, (count, 2)), random.uniform(0.1e-3, 0.5e-3, count)

    def press(at: jax.Array) -> jax.Array:
        squared = (GRID.centres[None, :] - at[0]) ** 2 + (GRID.centres[:, None] - at[1]) ** 2
        return i2t.press(i2t.nominal_pad(), squared / (2 * TIP_RADIUS_M), at[2]).reading

    reading = jax.lax.map(press, np.column_stack([position, depth]).astype(np.float32))
    return position, depth, np.asarray(reading) + random.normal(0, 1.0, reading.shape)


def _star_touches() -> tuple[i2t.Touches, i2t.Surface]:
    surface = i2t.prepare_surface(i2t.make_object("star").mesh)
    return i2t.simulate_touches(jax.random.key(0), [surface], numbered_pad(0), SimulationErrors(), 8), surface


def _recorded() -> Names:
    Path("runs/train").mkdir(parents=True)
    save_dataset("runs/train/data.h5", random_dataset(60))
    return {}


def _pressed() -> Names:
    positions, depths, readings = _presses(30)
    Path("runs/calibrate").mkdir(parents=True)
    i2t.calibrate(positions, depths, readings, load_kind="depth").save("runs/calibrate/calibration.npz")
    return {
        "positions": positions[:20], "depths": depths[:20], "readings": readings[:20],
        "other_positions": positions[20:], "other_depths": depths[20:],
    }  # fmt: skip


def _a_data_set() -> Names:
    Path("DATA").mkdir()
    Path("DATA/today").mkdir()
    save_dataset("DATA/set.h5", random_dataset(60))
    return {
        "touch": random_dataset(1), "depth_uint16": np.zeros((4, 5), np.uint16), "time": np.arange(3.0),
        "values": np.zeros((3, 2)), "columns": ("x", "y"), "time_of_contact": 1.0,
    }  # fmt: skip


def _a_depth_image() -> Names:
    Image.fromarray(np.full((360, 640), 104, np.uint16)).save("depth.tif")
    return {}


def _a_head() -> Names:
    from helpers.skin_presses import presses_of_a_skin

    from i2t.calibration.heads import HeadBudget, fit_head

    recording = presses_of_a_skin(120)
    Path("runs/calibrate").mkdir(parents=True)
    fit_head(recording, "position", budget=HeadBudget(selection_rows=60, known_rows=100)).save(
        "runs/calibrate/position.npz"
    )
    return {"readings": recording.readings[:5]}


@contextlib.contextmanager
def _a_lab() -> Iterator[Names]:
    pytest.importorskip("rtde_control", reason="ur_rtde is not installed (there are wheels for Python 3.10 to 3.12)")
    from i2t.emulators import lab, ur_controller
    from i2t.hardware.ur.poses import from_ur

    assert rig_command(["lab.toml", "--example"]) == 0
    host, port = ur_controller.loopback(230), str(Path("skin").absolute())
    pose = [0.4, 0.0, 0.12, np.pi, 0.0, 0.0]
    words = ["--object", "star", "--pose", *map(str, pose)]
    with lab.started("--host", host, "--link", port, *words) as running:
        yield {
            "HOST": host, "PORT": port, "T_base_tool": from_ur([*pose[:2], 0.1, *pose[3:]]),
            "skin_has_changed": lambda: False,
        }  # fmt: skip
        running.send_signal(signal.SIGTERM)
        assert running.wait(PATIENCE_S) == 0


def _one_press() -> Names:
    surfaces = [i2t.prepare_surface(i2t.make_object(name).mesh) for name in ("star", "cylinder")]
    positions, depths, readings = _presses(20)
    return {
        "surfaces": surfaces, "pad": i2t.nominal_pad(), "reading": readings[0], "force": np.float32(1.0),
        "travel": np.float32(np.nan), "positions": positions, "depths": depths, "readings": readings,
    }  # fmt: skip


def _a_robot() -> Names:
    meshes = [i2t.make_object(name).mesh for name in ("star", "cylinder", "hexagon")]
    return {"meshes": meshes, "touch": lambda site: (site, True)}


def _a_believed_object() -> Names:
    from i2t.simulation.depth_camera import render_view, table_triangles

    touches, surface = _star_touches()
    mesh = i2t.make_object("star").mesh
    camera = i2t.Camera(160, 90, fx=80.0, fy=80.0, cx=79.5, cy=44.5)
    T_w_c = np.diag([1.0, -1.0, -1.0, 1.0])
    T_w_c[2, 3] = 0.25
    depth, _ = render_view(np.concatenate([mesh.vertices[mesh.faces], table_triangles(np.eye(4))]), T_w_c, camera)
    return {
        "touches": touches, "surface": surface, "mesh": mesh, "key": jax.random.key(1), "camera": camera,
        "T_w_o": np.eye(4, dtype=np.float32), "T_w_c": T_w_c.astype(np.float32), "depth": depth.astype(np.float32),
    }  # fmt: skip


SET_UPS: dict[str, SetUp] = {
    "analysis": _given(_recorded), "calibration": _given(_pressed), "data": _given(_a_data_set),
    "depth": _given(_a_depth_image), "environments": _given(dict), "fidelity": _given(_a_head), "hardware": _a_lab,
    "local_shape": _given(_one_press), "model_card": _given(dict), "reconstruction": _given(_a_robot),
    "registration": _given(_a_believed_object), "scaling": _given(dict), "tutorial_touch_to_shape": _given(dict),
}  # fmt: skip
IN_PLACE: dict[str, dict[str, str]] = {
    "environments": {"num_envs=64": "num_envs=2", "placements=8": "placements=2", "sites=8": "sites=4"},
    "hardware": {'"/dev/ttyACM0"': "PORT", '"192.168.0.2"': "HOST"},
    "local_shape": {"20_000": "64"},
    "reconstruction": {"range(20)": "range(2)"},
    "scaling": {
        "range(100)": "range(2)", "10_000": "4", "100_000": "4", '"local"': '"serial"',
        "jax.distributed.initialize()": "jax.process_count()",
    },
    "tutorial_touch_to_shape": {"range(1, 21)": "range(1, 4)", "across=32": "across=20", "range(8)": "range(2)"},
}  # fmt: skip
# Seconds; the others compile, and run in the full tier.
QUICK = ("analysis", "calibration", "data", "fidelity", "reconstruction", "tutorial_touch_to_shape")


def _run(page: str) -> Names:
    blocks = BLOCK.findall((DOCS / f"{page}.md").read_text())
    code = "\n".join(blocks)
    for printed, instead in sorted(IN_PLACE.get(page, {}).items(), key=lambda pair: -len(pair[0])):
        assert printed in code, f"{page} no longer says {printed}"
        code = code.replace(printed, instead)
    with SET_UPS[page]() as names:
        names["__name__"] = "__main__"
        exec(compile(code, f"{page}.md", "exec"), names)
    return names


def test_the_code_of_every_page_is_run_by_a_test():
    with_code = {path.stem for path in DOCS.glob("*.md") if "```python" in path.read_text()}
    assert with_code == SET_UPS.keys() | set(TUTORIALS[1:])


@pytest.mark.parametrize("page", QUICK)
def test_code_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _run(page)


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="the emulators need the addresses 127.x.y.z")
@pytest.mark.parametrize("page", sorted(SET_UPS.keys() - set(QUICK)))
def test_code_of_a_page_that_compiles_or_moves_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _run(page)


@pytest.mark.full
@pytest.mark.parametrize("page", TUTORIALS)
def test_code_of_a_tutorial_runs_as_printed_on_the_data_of_the_examples(page, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples" / "data", tmp_path / "examples" / "data")  # and leaves nothing in the checkout
    monkeypatch.chdir(tmp_path)
    text = (DOCS / f"{page}.md").read_text()
    for command in re.findall(r"python -m i2t\.convert (presses [^`\n]*)", text):
        assert convert(command.split()) == 0
    names: Names = {}
    for block in BLOCK.findall(text):
        exec(block, names)
    for name in names.keys() & {"reading", "std", "mean"} if page != "tutorial_recognise" else ():
        assert np.shape(names[name])[-1] == 15
        assert np.isfinite(names[name]).all()
    assert names.keys() & {"reading", "mean", "site"}


TABLE = "x_mm,y_mm,depth_mm,force_N," + ",".join(f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz")
CHEAP = (  # in an order in which each finds what it needs; "TABLE.csv" is written by the test
    "i2t.hardware.reskin --list",
    "i2t.hardware.rig lab.toml --example",
    "i2t.hardware.rig lab.toml",
    "i2t.convert presses TABLE.csv DATA --indenter sphere:4.0",
    "i2t.convert summary DATA",
    "i2t.convert pack DATA PACKED",
    "i2t.convert npz DATA DATA.npz",
    "i2t.convert robomimic DATA DATA.hdf5",
    "i2t.convert csv DATA TABLE",
)


def test_the_quick_commands_run_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = [f"{x},{-x},0.{x + 3},1.5," + ",".join(str(10 * x + i) for i in range(15)) for x in range(-2, 3)]
    Path("TABLE.csv").write_text("\n".join([TABLE, *rows]) + "\n")
    printed = "\n".join(path.read_text() for path in [ROOT / "README.md", *DOCS.glob("*.md")])
    for command in CHEAP:
        assert f"python -m {command}" in printed
        module, *args = command.split()
        package = importlib.util.find_spec(module).submodule_search_locations
        main = importlib.import_module(f"{module}.__main__" if package else module).main
        assert main(args) == 0, f"{command}: {capsys.readouterr().err}"
    assert np.load("DATA.npz")["reading"].shape == (5, 15)
