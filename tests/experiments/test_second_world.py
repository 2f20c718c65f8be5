"""The second world: its own physics against closed forms, that it shares nothing with i2t's, and that mistakes in its
files are found.
"""

import ast
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from experiments.second_world import __main__ as command
from experiments.second_world import run, world
from i2t.convert.__main__ import main as convert
from i2t.dataset import load_dataset

RNG = np.random.default_rng(0)
SKIN = world.make_skin(RNG)
FLAT = np.zeros((world.CELLS, world.CELLS))


def test_it_shares_no_code_with_i2t():
    tree = ast.parse(Path(world.__file__).read_text())
    imported = [node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [alias.name for node in imported for alias in node.names] + [
        getattr(n, "module", "") or "" for n in imported
    ]
    assert not [name for name in names if name.startswith(("i2t", "experiments", "jax"))]


@pytest.mark.parametrize("force", [1.0, 5.0])
def test_a_flat_sinks_as_its_springs_say(force):
    depth, given = world.press(SKIN, FLAT, force)
    np.testing.assert_allclose(given, depth, rtol=1e-3)
    share = depth / SKIN.thickness
    assert SKIN.stiffness * depth / (1 - share) ** 2 * world.EDGE_M**2 == pytest.approx(force, rel=0.01)


def test_the_membrane_falls_off_beside_an_edge_with_its_decay_length():
    """Beside a long edge: exp(-x / l), l = sqrt(tension / stiffness), for deflections far below the thickness."""
    skin = SKIN._replace(tension=SKIN.stiffness * (1.5e-3) ** 2)
    heights = np.where(np.arange(world.CELLS) < world.CELLS // 2, 0.0, 1.0) * np.ones((world.CELLS, 1))
    _, given = world.press(skin, heights, 0.1)
    beside = given[world.CELLS // 2, world.CELLS // 2 - 1 : world.CELLS // 2 + 7]
    cell = world.EDGE_M / world.CELLS
    np.testing.assert_allclose(beside[1:] / beside[:-1], np.exp(-cell / 1.5e-3), rtol=0.03)


def test_a_dipole_has_its_field():
    """On the axis of a dipole: mu0 m / (2 pi r^3)."""
    r, m = 4e-3, 1e-4
    one = SKIN._replace(
        magnets=np.array([[0.0, 0.0, -1e-3]]),
        moments=np.array([[0.0, 0.0, m]]),
        chips=np.array([[0.0, 0.0, -1e-3 - r]]),
    )
    np.testing.assert_allclose(world.field(one, FLAT), [0, 0, 1e6 * 2e-7 * m / r**3], atol=1e-9)


def test_the_camera_sees_a_face_at_its_distance_in_whole_millimetres():
    box = trimesh.creation.box((0.1, 0.1, 0.02))
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.01 + 0.1042
    image = world.photograph(RNG, box, T, world.WorldErrors())
    assert np.allclose(image * 1e3, np.round(image * 1e3), atol=1e-6)
    assert abs(image.mean() - 0.1042) < 2e-4


@pytest.fixture(scope="module")
def session() -> world.WorldTouches:
    rng = np.random.default_rng(1)
    return world.simulate_session(rng, world.make_objects()["block"], SKIN, world.WorldErrors(), 10)


def test_without_errors_the_camera_meets_the_object_where_the_tool_does():
    touches = world.simulate_session(
        np.random.default_rng(2), world.make_objects()["stick"], SKIN, world.WorldErrors.none(), 4
    )
    nearest = np.array([image[image > 0].min() for image in touches.image]) - world.LOOK_M - world.CAMERA_BEHIND_M
    # At the end of the press the surface lies behind the tool's plane by the indentation.
    assert nearest.min() > -1.5e-3
    assert nearest.max() < 0.2e-3


@pytest.mark.parametrize("mistake", ["none", "force_sign", "millimetres", "millitesla"])
def test_the_converter_reads_it_and_puts_mistakes_right(session, mistake, tmp_path):
    run.write_session(np.random.default_rng(3), tmp_path / "raw" / "block", "1", session, mistake)
    assert convert(["imagine2touch", str(tmp_path / "raw"), str(tmp_path / "data")]) == 0
    touches = load_dataset(tmp_path / "data").touches
    np.testing.assert_allclose(touches.force, session.force, rtol=1e-3)
    np.testing.assert_allclose(touches.reading, session.samples - session.ambient, rtol=1e-3, atol=1e-2)
    np.testing.assert_allclose(touches.T_w_t, session.T_w_t, atol=1e-5)
    seen = session.image[0] > 0
    np.testing.assert_allclose(
        touches.patch[0][seen], np.minimum(session.image[0] - session.image[0][seen].min(), 0.017)[seen], atol=1e-6
    )


@pytest.mark.full
def test_it_runs(tmp_path):
    out = tmp_path / "world"
    assert command.main(["--preset", "debug", "--out", str(out)]) == 0
    found = json.loads((out / "metrics.json").read_text())
    assert set(found["worlds"]) == {"lab", "ideal"}
    assert all(np.isfinite(each["lead"]) for each in found["worlds"].values())
