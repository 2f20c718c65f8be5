"""A world of other physics: that it is one, and that predicted contact pressure leads there too."""

import ast
from pathlib import Path

import numpy as np
import pytest
from helpers import second_world as world

from experiments.train.loads import Tried, explained
from i2t.contact.pressure import PressureModelConfig
from i2t.prediction.baselines import Ridge, image_components
from i2t.prediction.touch_model import TouchBatch

SKIN = world.make_skin(np.random.default_rng(0))
FLAT = np.zeros((world.CELLS, world.CELLS))
TOUCHES = 20  # of each object


def test_it_shares_no_code_with_i2t():
    nodes = ast.walk(ast.parse(Path(world.__file__).read_text()))
    imported = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [alias.name for node in imported for alias in node.names]
    names += [getattr(node, "module", "") or "" for node in imported]
    assert not [name for name in names if name.startswith(("i2t", "experiments", "jax"))]


def test_a_flat_sinks_as_its_springs_say_and_a_dipole_has_its_field():
    """On the axis of a dipole: mu0 m / (2 pi r^3)."""
    depth, given = world.press(SKIN, FLAT, 3.0)
    np.testing.assert_allclose(given, depth, rtol=1e-3)
    share = depth / SKIN.thickness
    assert SKIN.stiffness * depth / (1 - share) ** 2 * world.EDGE_M**2 == pytest.approx(3.0, rel=0.01)
    r, moment = 4e-3, np.array([[0.0, 0.0, 1e-4]])
    at, chip = np.array([[0.0, 0.0, -1e-3]]), np.array([[0.0, 0.0, -1e-3 - r]])
    field = world.field(SKIN._replace(magnets=at, moments=moment, chips=chip), FLAT)
    np.testing.assert_allclose(field, [0, 0, 1e6 * 2e-7 * 1e-4 / r**3], atol=1e-9)


@pytest.mark.full
def test_predicted_pressure_leads_ridge_regression_where_the_physics_is_another():
    """On objects that neither has seen: the Gaussian process on pressures that i2t predicts, with i2t's own layer."""
    rng = np.random.default_rng(1)
    made = [world.touch(rng, mesh, SKIN, TOUCHES) for mesh in world.make_objects().values()]
    patch, force, reading = (np.concatenate(part) for part in zip(*made, strict=True))
    groups = np.repeat(np.arange(len(made)), TOUCHES)
    cfg = PressureModelConfig(pitch=world.EDGE_M / world.PIXELS, smooth=False, tilt=0.0)
    f32 = {"views": patch.astype(np.float32), "force": force.astype(np.float32)}
    r2 = explained(
        Tried(**f32, depth=np.full(len(force), np.nan, np.float32), readings=reading.astype(np.float32), groups=groups),
        cfg,
    )
    missed = np.zeros_like(reading)
    for group in range(len(made)):
        train, test = groups != group, groups == group
        components, nothing = image_components(patch[train]), np.zeros((train.sum(), 0))
        model = Ridge().model(components, (), patch[train], nothing, reading[train], groups[train])
        nothing = np.full(test.sum(), np.nan)
        asked = TouchBatch(patch[test], patch[test], nothing, nothing, nothing, nothing)
        missed[test] = model.predict_batch(asked).mean - reading[test]
    ridge = 1 - (missed**2).sum() / ((reading - reading.mean(0)) ** 2).sum()
    assert r2 > ridge + 0.1
