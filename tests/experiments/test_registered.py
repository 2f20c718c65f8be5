"""Training on registered sessions: what is known better afterwards, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from registration.test_session import APART, MESHES, SURFACES, embree_touches

import i2t
from experiments.train.registered import registered
from experiments.train.sources import ObjectsKnown
from i2t.dataset import Dataset
from i2t.geometry import from_twist, inverse
from i2t.rendering.render import render_view
from i2t.simulation.touches import SimulationErrors


@pytest.mark.full
def test_registered_views_are_those_of_where_the_tool_was_and_the_placement_is_known_better():
    placed, camera = (np.asarray(from_twist(jnp.float32(twist)), float) for twist in APART)
    touches = embree_touches(MESHES[1], SURFACES["hammer"], placed, camera)
    dataset = Dataset.simulated(touches, ("hammer",), i2t.nominal_pad())
    found = registered(dataset, ObjectsKnown({}, SimulationErrors()))
    assert found.notes[-1].startswith("1 of 1 sessions are registered: objects stand 1.7 mm from")
    errors, before = found.objects.errors, SimulationErrors()
    assert errors.placement < 0.1 * before.placement
    assert errors.placement_angle < 0.1 * before.placement_angle
    assert errors.hand_eye == before.hand_eye
    T_o_t = inverse(jnp.float32(placed)) @ touches.T_w_t
    true = jax.vmap(lambda T: render_view(SURFACES["hammer"], T).patch.depth)(T_o_t)
    missed = [np.abs(np.asarray(true) - each.patch).mean() for each in (dataset.touches, found.dataset.touches)]
    assert missed[1] < 0.25 * missed[0]

    with pytest.raises(ValueError, match="needs meshes"):
        registered(Dataset.simulated(touches, ("gadget",), i2t.nominal_pad()), ObjectsKnown({}, before))
    wrong = {"hammer": MESHES[0]}
    with pytest.raises(ValueError, match="agree with its mesh"):
        registered(dataset, ObjectsKnown(wrong, before))
