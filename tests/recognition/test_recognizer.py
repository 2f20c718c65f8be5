"""A recogniser without devices: touches are those that its own pad model predicts of one object in one pose, with
errors. In the fast tier they are given (`helpers.predicted_touches`), so that nothing is imagined.
"""

from copy import copy
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import predicted_touches as given
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp

from i2t.geometry import contact_frame, from_twist
from i2t.objects import catalogue
from i2t.objects.solids import transform_mesh
from i2t.recognition import policy
from i2t.recognition import recognizer as recognizer_module
from i2t.recognition.calibrated import POSTERIOR_TEMPERATURE
from i2t.recognition.recognizer import ChosenSite, ObjectRecognizer, RecognizerConfig, SiteObservation
from i2t.recognition.site_pool import SitePool
from i2t.rendering.render import prepare_surface
from i2t.simulation import sites as touch_sites
from i2t.skin.elasticity import CELL_GRID
from i2t.skin_models.likelihood import fit_likelihood
from i2t.skin_models.pad_model import PadModel
from i2t.skin_models.reading_model import LOADS_N, LinearReadingModel

CHANNELS = 12  # of a 4-chip board
POSITION_STD_M = 1e-4
NAMES = ("square", "cylinder")
POSE = 2  # the particle that is true
CONFIG = RecognizerConfig(num_sites=3, num_particles=4, max_touches=6, prior_unknown=0.1, num_surrogates=1)
TILTED = np.eye(4)  # an object that leans by 30 degrees, 20 mm above the table
TILTED[:3, :3], TILTED[:3, 3] = Rotation.from_euler("x", 30, degrees=True).as_matrix(), (0.3, 0.1, 0.02)
# Sites on a half ball of 30 mm: how far they lean from the object's own z, and which are safe once it leans too.
LEANING_DEG, SAFE_WHEN_TILTED = (-60, -30, 0, 40, 55), (True, True, True, False, False)


@pytest.fixture(scope="module")
def pad_model() -> PadModel:
    """A pad whose channels see blurred parts of the pressure."""
    rng, loads = np.random.default_rng(0), jnp.float32(LOADS_N)
    away = CELL_GRID.centres[:, None, None] * 1e3 - rng.uniform(-6, 6, (CHANNELS, 2))
    along = np.exp(-(away**2) / 5.0**2)
    mean = np.tile(60 * (along[:, None, :, 0] * along[None, :, :, 1]).reshape(1, -1, CHANNELS), (len(loads), 1, 1))
    model = LinearReadingModel(
        loads, jnp.float32(mean), jnp.zeros((*mean.shape[:2], 1)), jnp.ones(CHANNELS), jnp.float32(1.0)
    )
    errors = rng.normal(scale=0.5, size=(200, CHANNELS))
    likelihood = fit_likelihood(
        errors, jnp.ones(CHANNELS), loads, overtravel=CONFIG.overtravel, position_std=POSITION_STD_M
    )
    return PadModel(model, likelihood, np.ones(CHANNELS), 1.0, errors)


@pytest.fixture(scope="module")
def recognizer(pad_model) -> ObjectRecognizer:
    meshes = {name: catalogue.make_object(name).mesh for name in NAMES}
    return ObjectRecognizer(jax.random.key(0), pad_model, meshes, T_w_o=TILTED, config=CONFIG)


@pytest.fixture(scope="module")
def leaning() -> ObjectRecognizer:
    """A recogniser among two objects of one shape that lean, with five sites and touches that are given."""
    mesh = catalogue.make_object("dome").mesh
    angle = np.radians(LEANING_DEG)
    normals = np.stack([0 * angle, -np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)
    poses = np.stack([np.asarray(contact_frame(30e-3 * normal, normal, np.float32(0))) for normal in normals])
    sites = SitePool(jnp.float32(poses), np.array([0, 0, 1, 1, 1]))
    model = PadModel(None, given.likelihood(), np.ones(CHANNELS), 1.0, np.zeros((0, CHANNELS)))
    config = RecognizerConfig(num_particles=given.PARTICLES, max_touches=100)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recognizer_module, "predict_outcomes", lambda *_, **__: [given.predicted_touches()])
        return ObjectRecognizer(
            jax.random.key(0), model, {"one": mesh, "other": mesh}, T_w_o=TILTED, sites=sites, config=config
        )


def are_safe_in_the_world(mesh, poses) -> list[bool]:
    """Check the sites on the mesh at its true pose."""
    surface = prepare_surface(transform_mesh(mesh, TILTED))
    check = jax.jit(jax.vmap(lambda T: touch_sites.is_safe(surface, T, CONFIG.site_limits)))
    return check(jnp.float32(np.stack(poses))).tolist()


def touch(recognizer: ObjectRecognizer, site: ChosenSite, truth: int, key: jax.Array):
    """Measurements of a robot: reading, force, end of the press and contact."""
    row = jax.tree.map(lambda x: x[site.number, truth, POSE], recognizer.table)
    # Errors of the channels, of the position (m), and of the indentation.
    noise = jax.random.normal(key, (CHANNELS + 2,)).at[-2].multiply(POSITION_STD_M)
    observation = jax.jit(policy.simulate_observation)(
        row, jnp.zeros(6), noise, likelihood=recognizer.likelihood, skin_change=25.0, force=8.0
    )
    T_w_t = site.T_w_t.copy()
    T_w_t[:3, 3] += float(observation.advance) * site.T_w_t[:3, 2]
    return np.asarray(observation.reading), float(observation.force), T_w_t, bool(observation.contact)


@pytest.mark.full
@pytest.mark.parametrize("truth", [0, 1])
def test_an_object_is_recognised_by_chosen_touches(recognizer, truth):
    state, sites = recognizer.init(), []
    while (site := recognizer.choose_touch(state)) is not None:
        key = jax.random.fold_in(jax.random.key(truth), len(sites))
        reading, force, T_w_t, contact = touch(recognizer, site, truth, key)
        observation = recognizer.observe(site, reading, force=force, T_w_t=T_w_t, contact=contact)
        state, info = recognizer.update(state, observation)
        sites.append(site.number)
    assert info.name == NAMES[truth]
    assert info.confidence == info.probability[truth] >= 0.95
    assert info.probability.sum() + info.unknown == pytest.approx(1)
    assert recognizer.stop_reason(state) == "an object is 95% probable"
    assert len(set(sites)) == len(sites) == state.touches
    # It stands where the true particle lies, to the width of the particles.
    pose = recognizer.object_pose(state, NAMES[truth])
    assert np.linalg.norm(pose[:3, 3] - recognizer.T_w_o[:3, 3]) < 5e-3


@pytest.mark.full
def test_sites_are_on_the_believed_object_and_safe_at_its_tilt(recognizer):
    own = np.flatnonzero(recognizer.sites.owner == 0).tolist()
    poses = [recognizer.site_pose(number) for number in own]
    assert all(are_safe_in_the_world(catalogue.make_object(NAMES[0]).mesh, poses))
    np.testing.assert_allclose(poses[0][:3, :3] @ poses[0][:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(TILTED) @ poses[0], recognizer.sites.T_w_t[own[0]], atol=1e-6)


def test_only_sites_that_are_safe_at_the_object_s_pose_are_chosen(leaning):
    """Three of five sites are safe: where the object leans away, a site that leans with it would send the tool in from
    the side.
    """
    poses = [leaning.site_pose(number) for number in range(given.SITES)]
    assert tuple(are_safe_in_the_world(catalogue.make_object("dome").mesh, poses)) == SAFE_WHEN_TILTED
    state, chosen = leaning.init(), []
    while (site := leaning.choose_touch(state)) is not None:
        chosen.append(site.number)
        np.testing.assert_array_equal(site.T_w_t, poses[site.number])
        state = leaning.exclude(state, site.number)
    assert sorted(chosen) == list(np.flatnonzero(SAFE_WHEN_TILTED))
    assert leaning.stop_reason(state) is None  # it wants one more, and none is safe
    cautious = copy(leaning)
    cautious.safe = leaning.safe.at[:, 1].set(False)  # unsafe on an object that is as probable as not
    assert cautious.choose_touch(leaning.init()) is None


def test_an_episode_stops_when_certain_after_the_minimum_number_of_touches(leaning):
    three = copy(leaning)
    three.config = replace(leaning.config, max_touches=5, min_touches=3)
    state = three.init()._replace(probability=np.array([1.0, 0.0]))
    reasons = [three.stop_reason(state._replace(touches=touches)) for touches in range(4)]
    assert reasons == [None, None, None, "an object is 95% probable"]
    three.config = replace(three.config, max_touches=2)  # fewer than the least: those are enough
    assert three.stop_reason(state._replace(touches=2)) == "an object is 95% probable"


def test_a_touch_without_contact_is_evidence_against_objects_in_its_way(leaning):
    some = copy(leaning)
    hit = np.zeros(leaning.table.hit.shape, bool)
    hit[0, 0, :], hit[0, 1, :1] = True, True  # in every pose of one object, and in one pose of the other
    some.table = leaning.table._replace(hit=jnp.asarray(hit))
    state = some.init()
    probability = some.contact_probability(state, 0)
    weight = np.exp(np.asarray(state.belief.log_weight[1]))
    np.testing.assert_allclose(probability, [1.0, weight[0] / weight.sum()], rtol=1e-5)
    np.testing.assert_array_equal(some.contact_probability(state, 1), 0)


def test_excluded_sites_do_not_count_as_touches(leaning):
    two = copy(leaning)
    two.config = replace(leaning.config, max_touches=2, max_excluded=3)
    state = two.exclude(two.exclude(two.init(), 0), 1)
    assert two.stop_reason(state) is None
    assert two.stop_reason(two.exclude(state, 2)) == "3 sites were excluded, after 0 touches"
    assert two.choose_touch(two.exclude(state, 2)) is None
    for number in (2, 3):
        state, _ = two.update(state, SiteObservation(number, given.measured(two.table, number, 1)))
    assert two.stop_reason(state._replace(probability=np.array([0.5, 0.5]))) == "2 sites were touched"
    everything = two.init()._replace(touched=np.ones(given.SITES, bool))
    assert two.stop_reason(everything) == f"every site was touched, or excluded ({given.SITES})"
    assert leaning.stop_reason(everything._replace(touches=given.SITES)) == "every site was touched"


def test_an_update_makes_a_new_state(leaning):
    state = leaning.init()
    before = jax.tree.map(np.array, state)
    after, info = leaning.update(state, SiteObservation(2, given.measured(leaning.table, 2, 1)))
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.array, state))
    assert info.name == "other"
    assert info.confidence == info.probability[1] > 0.6  # less sure than uncalibrated
    assert info.probability.sum() + info.unknown == pytest.approx(1)
    assert after.touches == 1
    np.testing.assert_array_equal(after.touched, np.arange(given.SITES) == 2)


def test_weights_of_evidence_sum_to_the_change_of_the_calibrated_log_odds(leaning):
    """The temperature divides all evidence so far, which leaves the calibration a part of the earlier log odds."""
    weak = copy(leaning)
    weak.likelihood = leaning.likelihood._replace(inflation=8 * leaning.likelihood.inflation)
    state = weak.init(np.array([2.0, 1.0]))
    np.testing.assert_array_equal(weak.info(state).evidence.weights(0, 1), 0)
    before, raw, temperature = np.log(2), np.log(2), 1.0
    for touches, number in enumerate((2, 3), start=1):
        state, info = weak.update(state, SiteObservation(number, given.measured(weak.table, number, 0)))
        weights = info.evidence.weights(0, 1)
        np.testing.assert_array_equal(info.evidence.weights(1, 0), -weights)
        after = np.log(info.probability[0] / info.probability[1])
        assert weights.sum() == pytest.approx(after - before, abs=1e-9)
        one, other = logsumexp(np.asarray(state.belief.log_weight, np.float64), axis=1)
        earlier, temperature = temperature, POSTERIOR_TEMPERATURE.temperature(touches)
        reading, position, presence, calibration = weights
        assert calibration == pytest.approx(raw / temperature - raw / earlier, abs=1e-5)
        assert reading + position + presence == pytest.approx((one - other - raw) / temperature, abs=1e-5)
        assert reading > 0.5 > 0.01 > abs(position) + abs(presence)  # only the readings of the objects differ
        before, raw = after, one - other


def test_an_unknown_object_is_one_hypothesis_of_the_evidence(leaning):
    some = copy(leaning)
    some.names, some._objects = ("one",), 4  # and three surrogates
    densities = np.random.default_rng(0).uniform(0.1, 1, (4, 4))
    summed = np.log(np.stack([densities[:, 0], densities[:, 1:].sum(1)], axis=1))
    presence, position, reading = np.diff(summed[:, 0] - summed[:, 1])
    before, after = np.array([0.5]), np.array([0.8])
    weights = some._evidence(np.log(densities), before, after, 3).weights(0, 1)
    sources = np.array([reading, position, presence]) / POSTERIOR_TEMPERATURE.temperature(3)
    np.testing.assert_allclose(weights, [*sources, np.log(4) - sources.sum()])


def test_only_sites_at_which_every_object_is_met_are_candidates(leaning, monkeypatch):
    table = given.predicted_touches()
    hit = np.ones(table.hit.shape, bool)
    hit[0], hit[3, 1, :1] = False, False  # no pose of either object, and a quarter of those of one
    monkeypatch.setattr(recognizer_module, "predict_outcomes", lambda *_, **__: [table._replace(hit=jnp.asarray(hit))])

    def candidates(share: float) -> ObjectRecognizer:
        model = PadModel(None, given.likelihood(), np.ones(CHANNELS), 1.0, np.zeros((0, CHANNELS)))
        mesh = catalogue.make_object("dome").mesh
        config = RecognizerConfig(num_particles=given.PARTICLES, min_contact_probability=share)
        meshes = {"one": mesh, "other": mesh}
        return ObjectRecognizer(jax.random.key(0), model, meshes, T_w_o=TILTED, sites=leaning.sites, config=config)

    for share, kept in ((0.2, [1, 2, 3, 4]), (0.95, [1, 2, 4])):
        some = candidates(share)
        np.testing.assert_array_equal(some.sites.T_w_t, leaning.sites.T_w_t[np.array(kept)])
        np.testing.assert_array_equal(some.sites.owner, leaning.sites.owner[kept])
        np.testing.assert_array_equal(some.table.reading, table.reading[np.array(kept)])
        assert len(some.safe) == len(some.init().touched) == len(kept)
    hit[:] = False
    with pytest.raises(ValueError, match=r"at no site is every object met with a probability of 0\.5"):
        candidates(0.5)


def test_the_advance_is_the_distance_along_the_approach_of_the_site(leaning):
    site = ChosenSite(3, leaning.site_pose(3))
    end = site.T_w_t @ np.array([[1, 0, 0, 2e-3], [0, 1, 0, -1e-3], [0, 0, 1, 5e-3], [0, 0, 0, 1]])
    observation = leaning.observe(site, np.arange(float(CHANNELS)), force=-0.1, T_w_t=end, contact=True)
    assert (observation.number, float(observation.touch.force), bool(observation.touch.contact)) == (3, 0.0, True)
    assert float(observation.touch.advance) == pytest.approx(5e-3, abs=1e-8)
    np.testing.assert_array_equal(observation.touch.reading, np.arange(CHANNELS))


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"force": np.nan}, "force is nan, which is not finite"),
        ({"force": 250.0}, "force is 250 N; a skin bears at most 100 N"),
        ({"T_w_t": np.full((4, 4), np.nan)}, "T_w_t: is not a rigid motion"),
        ({"T_w_t": np.diag([1.0, 1, -1, 1])}, "T_w_t: is not a rigid motion"),
        ({"T_w_t": np.eye(4) + np.array([[0, 0, 0, 4.0], *np.zeros((3, 4))])}, "from the site that was asked for"),
        ({"T_w_t": np.eye(4) + np.array([[0, 0, 0, 400.0], *np.zeros((3, 4))])}, "divide millimetres by 1000"),
        ({"reading": np.zeros(CHANNELS + 3)}, "reading: has the shape"),
    ],
)
def test_an_invalid_measurement_is_refused_before_an_update(leaning, given, why):
    site = ChosenSite(3, leaning.site_pose(3))
    right = {"reading": np.zeros(CHANNELS), "force": 1.0, "T_w_t": site.T_w_t, "contact": True}
    with pytest.raises(ValueError, match=why):
        leaning.observe(site, **{**right, **given})


@pytest.mark.full
def test_the_first_belief_is_the_prior(recognizer):
    info = recognizer.info(recognizer.init(np.array([2.0, 1.0])))
    np.testing.assert_allclose([*info.probability, info.unknown], [0.6, 0.3, 0.1], rtol=1e-5)
    assert info.name == NAMES[0]


def test_impossible_options_are_refused(pad_model):
    with pytest.raises(ValueError, match="prior_unknown is 1"):
        RecognizerConfig(prior_unknown=1.0)
    with pytest.raises(ValueError, match=r"min_contact_probability is 1\.5"):
        RecognizerConfig(min_contact_probability=1.5)
    with pytest.raises(ValueError, match="num_surrogates is 0"):
        RecognizerConfig(prior_unknown=0.1, num_surrogates=0)
    with pytest.raises(ValueError, match="at least two objects"):
        ObjectRecognizer(jax.random.key(0), pad_model, {"square": catalogue.make_object("square").mesh})


def test_the_site_that_is_chosen_is_expected_to_tell_most(recognizer):
    """With three sites all are candidates; only the random outcomes differ from those of the choice."""
    state = recognizer.init()
    gain = recognizer.expected_information(state)
    assert gain.shape == (len(recognizer.sites.owner),)
    allowed = np.isfinite(gain)
    assert (gain[allowed] >= 0).all()
    number = recognizer.choose_touch(state).number
    assert gain[number] > 0.5 * np.nanmax(gain)
    assert np.isnan(recognizer.expected_information(recognizer.exclude(state, number))[number])


def test_the_most_probable_poses_of_an_object_come_first(recognizer):
    state = recognizer.init()
    poses, weights = recognizer.particle_poses(state, NAMES[0], 3)
    assert poses.shape == (3, 4, 4)
    np.testing.assert_allclose(weights, 1 / CONFIG.num_particles)
    likely = state.belief._replace(log_weight=state.belief.log_weight.at[0, 1].add(5.0))
    poses, weights = recognizer.particle_poses(state._replace(belief=likely), NAMES[0], 3)
    assert weights[0] > 0.9
    twist = np.asarray(recognizer.particles.twist[1])
    np.testing.assert_allclose(poses[0][:3, 3], (TILTED @ np.append(from_twist(twist)[:3, 3], 1))[:3], atol=1e-6)
