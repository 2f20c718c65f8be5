"""A world of other physics: that it is one, and that predicted contact pressure leads there too."""

import ast
from pathlib import Path

import numpy as np
import pytest

from tests.second_world import world
from tests.second_world.run import methods_compared, r2_of_skin

SKIN = world.make_skin(np.random.default_rng(0))
FLAT = np.zeros((world.CELLS, world.CELLS))
TOUCHES = 20  # of each object


def test_the_second_world_shares_no_code_with_i2t():
    nodes = ast.walk(ast.parse(Path(world.__file__).read_text()))
    imported = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    names = [alias.name for node in imported for alias in node.names]
    names += [getattr(node, "module", "") or "" for node in imported]
    assert not [name for name in names if name.startswith(("i2t", "experiments", "jax"))]


def test_a_flat_sinks_like_its_springs_and_a_dipole_has_its_field():
    """The field on the axis of a dipole is mu0 m / (2 pi r^3)."""
    indentation, given = world.press(SKIN, FLAT, 3.0)
    np.testing.assert_allclose(given, indentation, rtol=1e-3)
    share = indentation / SKIN.thickness
    assert SKIN.stiffness * indentation / (1 - share) ** 2 * world.EDGE_M**2 == pytest.approx(3.0, rel=0.01)
    r, moment = 4e-3, np.array([[0.0, 0.0, 1e-4]])
    at, chip = np.array([[0.0, 0.0, -1e-3]]), np.array([[0.0, 0.0, -1e-3 - r]])
    field = world.field(SKIN._replace(magnets=at, moments=moment, chips=chip), FLAT)
    np.testing.assert_allclose(field, [0, 0, 1e6 * 2e-7 * 1e-4 / r**3], atol=1e-9)


@pytest.mark.full
def test_predicted_pressure_leads_baselines_on_patches_where_the_physics_is_another():
    """The objects are unseen, the layer is i2t's own, and the baselines are given the force, too."""
    methods = methods_compared()
    r2 = r2_of_skin(methods, 0, TOUCHES)
    on_patches = [r2[method.title] for method in methods if method.baseline and not getattr(method, "on_pressure", 0)]
    assert r2[methods[-1].title] > max(on_patches) + 0.1
