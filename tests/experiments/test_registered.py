"""Training on registered sessions: errors that become smaller, and refusals."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from registration.test_session import APART, MESHES, SURFACES, embree_touches

import i2t
from experiments.train.registered import correct_by_camera, correct_by_sessions, register_known_objects
from experiments.train.sources import KnownObjects
from i2t.dataset import Dataset
from i2t.geometry import from_twist, inverse
from i2t.rendering.render import render_view
from i2t.simulation.touches import SimulationErrors

PAD = i2t.nominal_pad()


@pytest.mark.full
def test_registered_views_are_at_the_true_tool_pose_and_the_placement_is_more_certain():
    placed, camera = (np.asarray(from_twist(jnp.float32(twist)), float) for twist in APART)
    touches = embree_touches(MESHES[1], SURFACES["hammer"], placed, camera)
    dataset = Dataset.simulated(touches, ("hammer",), i2t.nominal_pad())
    found = correct_by_sessions(register_known_objects(dataset, KnownObjects({}, SimulationErrors())))
    assert found.notes[-1].startswith("1 of 1 sessions are registered: objects are 1.7 mm from")
    errors, before = found.objects.errors, SimulationErrors()
    assert errors.placement < 0.1 * before.placement
    assert errors.placement_angle < 0.1 * before.placement_angle
    assert errors.hand_eye == before.hand_eye
    T_o_t = inverse(jnp.float32(placed)) @ touches.T_w_t
    true = jax.vmap(lambda T: render_view(SURFACES["hammer"], T).patch.depth)(T_o_t)
    missed = [np.abs(np.asarray(true) - each.patch).mean() for each in (dataset.touches, found.dataset.touches)]
    assert missed[1] < 0.25 * missed[0]

    with pytest.raises(ValueError, match="needs meshes"):
        register_known_objects(Dataset.simulated(touches, ("gadget",), i2t.nominal_pad()), KnownObjects({}, before))
    wrong = {"hammer": MESHES[0]}
    with pytest.raises(ValueError, match="agree with the mesh"):
        register_known_objects(dataset, KnownObjects(wrong, before))


@pytest.mark.full
def test_sessions_on_known_objects_correct_views_of_unknown_ones_and_reveal_a_moved_camera():
    """The hammer's mesh shows the camera's pose; the other object has no mesh."""
    _, camera = (np.asarray(from_twist(jnp.float32(twist)), float) for twist in APART)
    parts = [embree_touches(MESHES[1], SURFACES["hammer"], np.eye(4), camera)]
    parts.append(parts[0]._replace(session=parts[0].session + 1, object=parts[0].object + 1))
    dataset = Dataset.simulated(jax.tree.map(lambda *each: np.concatenate(each), *parts), ("hammer", "gadget"), PAD)
    found = register_known_objects(dataset, KnownObjects({}, SimulationErrors()))
    assert not found.all_known
    corrected = correct_by_camera(found, np.zeros(5, int))
    said = re.fullmatch(r"by 1 training session the camera's offset is (\S+) mm \(.+", corrected.notes[-1])
    assert float(said[1]) == pytest.approx(1e3 * np.linalg.norm(camera[:3, 3]), abs=0.2)
    true = jax.vmap(lambda T: render_view(SURFACES["hammer"], T).patch.depth)(jnp.float32(parts[0].T_w_t))
    views = (each.touches.patch[len(true) :] for each in (dataset, corrected.dataset))
    missed = [np.median(np.abs(np.asarray(true) - each).mean((1, 2))) for each in views]
    assert missed[1] < 0.25 * missed[0]
    assert corrected.objects.errors == SimulationErrors()

    with pytest.raises(ValueError, match="no training session is registered"):
        correct_by_camera(found, np.ones(5, int))
    own = found.estimates[0]
    moved = own._replace(T_t_camera=own.T_t_camera @ np.asarray(from_twist(jnp.float32([1e-3, 0, 0, 0, 0, 0]))))
    with pytest.raises(ValueError, match="the camera was not mounted alike"):
        correct_by_camera(found._replace(estimates={0: own, 1: moved}), np.arange(2))
