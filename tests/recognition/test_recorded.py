"""Recorded touches for recognition: those of known objects, and samples of one contact as one touch."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import recorded_presses, sessions_of

from i2t.errors import DataError
from i2t.objects import Mesh
from i2t.patches.dimensions import TWIST_LEVER_M
from i2t.recognition.recorded import merge_samples, recorded_touches, with_placement
from i2t.simulation.touches import SimulationErrors
from i2t.types import ReturnCode

MUG = Mesh(np.array([[0, 0, 0], [0, 0.02, 0], [0.02, 0, 0], [0, 0, 0.02]]), np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1]]))


def test_poses_of_recorded_touches_are_in_the_frame_of_the_object():
    dataset = recorded_presses()
    rows = np.ones(len(dataset), bool)
    rows[:4] = False
    touches = dataset.touches
    selected = recorded_touches(dataset, rows, {"mug": MUG}, "DATA")
    assert len(selected.dataset) == selected.rows.sum() == 36
    T_o_t = np.linalg.inv(touches.T_w_o[rows]) @ touches.T_w_t[rows]
    np.testing.assert_allclose(selected.dataset.touches.T_w_t, T_o_t, atol=1e-6)
    np.testing.assert_array_equal(selected.dataset.touches.T_w_o, np.broadcast_to(np.eye(4), (36, 4, 4)))
    np.testing.assert_array_equal(selected.dataset.touches.reading, touches.reading[rows])
    assert list(selected.surfaces) == ["star", "mug"]
    assert selected.made_from == "DATA"


def test_objects_without_a_mesh_are_left_out_or_named():
    dataset = recorded_presses(80)
    touches = recorded_touches(dataset, np.ones(len(dataset), bool), {}, "DATA")
    assert list(touches.surfaces) == ["star"]
    assert len(touches.dataset) == 40
    nameless = recorded_presses(objects=("mug", "cup"))
    with pytest.raises(DataError, match="there is no mesh of cup, mug; give their files"):
        recorded_touches(nameless, np.ones(40, bool), {}, "DATA")


def test_samples_of_one_contact_are_one_touch_with_their_mean():
    dataset = sessions_of(8, 6)
    n = len(dataset)
    time = 10.0 * np.arange(n)
    T_w_t = np.array(dataset.touches.T_w_t)
    rows, apart = np.arange(4, 7), 11  # three samples of a contact; two touches of a place, at another time
    time[rows] = time[4] + [0.0, 0.1, 0.2]
    T_w_t[rows] = T_w_t[4]
    T_w_t[rows, 0, 3] += [0.0, 5e-5, -5e-5]
    T_w_t[apart + 1] = T_w_t[apart]
    held = replace(dataset, touches=dataset.touches._replace(time=time, T_w_t=T_w_t))
    merged = merge_samples(held)
    assert len(merged) == n - 2
    np.testing.assert_allclose(merged.touches.reading[4], held.touches.reading[rows].mean(0), rtol=1e-6)
    np.testing.assert_array_equal(merged.touches.reading[5:], held.touches.reading[7:])
    np.testing.assert_array_equal(merged.touches.session, np.delete(held.touches.session, rows[1:]))
    assert len(merge_samples(replace(held, touches=held.touches._replace(time=None)))) == n
    moved = T_w_t.copy()
    moved[5, 0, 3] += 2e-3  # a touch between them elsewhere
    assert len(merge_samples(replace(held, touches=held.touches._replace(T_w_t=moved)))) == n


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"code": np.full(40, ReturnCode.AIR)}, "no press among the training touches was ended by the skin"),
        ({"force": np.full(40, np.nan)}, "no press among the training touches has a measured force, travel and pose"),
        ({"pad": np.arange(40) % 2}, r"of several skins \(pad b, pad é\), but a pad model describes one skin"),
        ({"session": np.zeros(40)}, "40 usable training touches in 1 sessions are too few"),
        (
            {"code": np.where(np.arange(40) < 12, ReturnCode.SKIN, ReturnCode.AIR)},
            "12 usable training touches in 4 sessions",
        ),
    ],
)
def test_touches_unsuitable_for_a_pad_model_are_refused_with_the_reason(changed, message):
    dataset = recorded_presses(objects=("star", "hammer"), **changed)
    with pytest.raises(DataError, match=message):
        recorded_touches(dataset, np.ones(len(dataset), bool), {}, "DATA")


def test_the_rig_sets_the_uncertainty_of_placements():
    errors = with_placement(SimulationErrors(), np.diag([4e-6] * 3 + [(0.05 * TWIST_LEVER_M) ** 2] * 3))
    assert errors.placement == pytest.approx(2e-3)
    assert errors.placement_angle == pytest.approx(0.05)
