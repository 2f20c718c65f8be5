"""Recorded sessions as episodes: the sites of touches, and the evidence of a touch without contact."""

import inspect
from unittest.mock import create_autospec

import jax.numpy as jnp
import numpy as np
import pytest

from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.recognition import belief
from i2t.recognition import episodes as episodes_module
from i2t.recognition.episodes import (
    EVIDENCE_WEIGHTS,
    BeliefModel,
    Episodes,
    episodes_from_dataset,
    select_evidence,
)
from i2t.recognition.site_pool import SitePool
from i2t.skin.boards import grid_board
from i2t.skin_models.likelihood import fit_likelihood
from i2t.types import ReturnCode, Touches

BOARD = grid_board(2, 2)
CHANNELS = 3 * len(BOARD.chips)
OVERTRAVEL = 6e-3
TOP = 30e-3  # m, height of the object's top
DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


LIKELIHOOD = fit_likelihood(
    np.random.default_rng(0).normal(size=(50, CHANNELS)), jnp.ones(CHANNELS), jnp.array([0.3, 0.9]),
    overtravel=OVERTRAVEL, position_std=1e-4,
)  # fmt: skip


def touches(T, **changes) -> Touches:
    """Touches of the skin whose fields are empty except for the given ones."""
    n, blank, index = len(T), np.zeros((len(T), 0)), np.zeros(len(T), np.int32)
    usual = Touches(
        patch=blank, view=blank, nearest=np.zeros(n), reading=np.ones((n, CHANNELS)), force=np.full(n, 0.5),
        travel=np.full(n, 1e-3), T_w_t=T, T_w_o=np.tile(np.eye(4), (n, 1, 1)), object=index, pad=index, session=index,
        code=index + int(ReturnCode.SKIN),
    )  # fmt: skip
    return usual._replace(**changes)


def recorded(heights: np.ndarray, codes: list[ReturnCode]) -> Dataset:
    """A session of presses straight down that ended at these heights (m), on a 4-chip board."""
    T = np.tile(DOWN, (len(heights), 1, 1))
    T[:, 2, 3] = heights
    travel = np.where(np.array(codes) == ReturnCode.AIR, np.nan, 1e-3)
    images = {"patch": np.zeros((len(heights), 48, 48)), "view": np.zeros((len(heights), 72, 72))}
    recording = touches(T, travel=travel, code=np.array(codes, np.int32), **images)
    return Dataset(recording, ("square",), ("pad",), ("session",), BOARD, "simulated")


def test_the_site_of_a_touch_without_contact_is_before_its_end():
    heights = np.array([TOP, TOP + 3e-3, TOP - 1e-3])
    data = recorded(heights, [ReturnCode.SKIN, ReturnCode.AIR, ReturnCode.WRENCH])
    sites, episodes = episodes_from_dataset(data, ["square"], 3, overtravel=OVERTRAVEL)
    np.testing.assert_allclose(sites.T_w_t[:, 2, 3], heights + np.array([0, OVERTRAVEL, 0]), atol=1e-8)
    np.testing.assert_allclose(episodes.observations.advance[0], [0, OVERTRAVEL, 0])
    np.testing.assert_array_equal(episodes.observations.contact[0], [True, False, True])
    np.testing.assert_allclose(episodes.T_w_t[0, :, 2, 3], heights, atol=1e-8)
    for names, count, message in (
        (["hexagon"], 1, "no object to recognise has this name"),
        (["square"], 4, "no session has 4"),
    ):
        with pytest.raises(DataError, match=message):
            episodes_from_dataset(data, names, count)


def test_each_kind_of_evidence_has_its_own_weight_and_fused_has_all():
    for kind in EVIDENCE_WEIGHTS:
        weighed = select_evidence(LIKELIHOOD, kind)
        on = [bool(x > 0) for x in (weighed.tactile_weight, weighed.spatial_weight, weighed.presence_weight)]
        assert on == [kind == "fused" or name in kind for name in ("readings", "position", "presence")]


@pytest.mark.parametrize(("share", "together"), [(1, 2), (2, 3)])
def test_the_batch_size_of_episodes_does_not_change_beliefs(monkeypatch, share, together):
    """Each touch is compared with the prediction at its own site, in any batch of episodes; a site that episodes share
    is predicted once, also in a batch that has room for one more episode.
    """
    rng = np.random.default_rng(0)
    heights, chosen = rng.random(30).astype(np.float32), rng.permutation(30)[:21].reshape(7, 3)
    chosen = chosen[np.arange(7) // share]
    T = np.tile(np.eye(4, dtype=np.float32), (30, 1, 1))
    T[:, 2, 3] = heights
    batches: list[int] = []

    def predict(surfaces, twist, T_w_site, reading_models, *, overtravel, label, bar):
        batches.append(len(T_w_site))
        return [np.asarray(T_w_site)[:, 2, 3] for _ in reading_models]

    def judge(table, some, likelihood, particles, kinds):
        return {kind: np.repeat(table[some.site][..., None], 2, -1) + some.truth[:, None, None] for kind in kinds}

    monkeypatch.setattr(episodes_module, "predict_outcomes", predict)
    monkeypatch.setattr(episodes_module, "run_belief", judge)
    observations = belief.TouchObservation(*(np.zeros((7, 3)) for _ in range(4)))
    episodes = Episodes(np.arange(7), chosen, observations, np.zeros((7, 3, 4, 4), np.float32))
    model = create_autospec(BeliefModel, instance=True, kinds=("readings", "fused"))
    beliefs = inspect.unwrap(episodes_module.believe)(
        [None, None], SitePool(jnp.asarray(T), np.zeros(30, int)), episodes,
        belief.sample_particles(np.full(6, 1e-3), 1),
        {"": model, ", oracle": model}, overtravel=OVERTRAVEL, label="test", touches_at_a_time=3 * together,
    )  # fmt: skip
    assert set(beliefs) == {"readings", "fused", "readings, oracle", "fused, oracle"}
    expected = np.repeat(heights[chosen][..., None], 2, -1) + np.arange(7)[:, None, None]
    for p in beliefs.values():
        np.testing.assert_allclose(p, expected, rtol=1e-6)
    assert batches == [6 // share] * 4  # the last one is filled up
