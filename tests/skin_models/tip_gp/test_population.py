"""The Gaussian process of a population: its algebra against dense formulas, and the effect of each of its parts."""

from itertools import product
from pathlib import Path

import numpy as np
import pytest

from i2t.skin_models.tip_gp import kernel, prior
from i2t.skin_models.tip_gp import leave_one_out as lo
from i2t.skin_models.tip_gp import population as mixture
from i2t.skin_models.tip_gp.kernel import SkinKernels
from i2t.skin_models.tip_gp.plain import fit_scales, predict_plain
from i2t.skin_models.tip_gp.population import (
    PopulationGP,
    PressTable,
    fit_population,
    interval_scaling,
    predict_population,
)
from i2t.skin_models.tip_gp.prior import KernelPrior, load_prior
from i2t.skin_models.tip_gp.structured import TRAVEL_HYPERPARAMETERS, fit_structured

CHIPS = np.array([[0, 0], [6, 0], [-6, 0], [0, 6], [0, -6]]) * 1e-3
CHANNELS = 15
KINDS = SkinKernels(
    load_power=np.array([1.7, 0.8]), load_offset=np.array([0.5, 0.2]), map_length=np.array([6e-3, 4e-3]),
    bend_share=np.array([0.2, 0.1]), bend_length=np.array([3e-3, 2e-3]), bend_load_width=np.array([1.5, 2.0]),
    static_variance=np.array([0.2, 0.1]), static_length=np.array([5e-3, 7e-3]),
    constant_variance=np.array([0.1, 0.05]), noise_variance=np.array([0.02, 0.01]),
    gain_noise_variance=np.array([0.01, 0.02]), chip_reach=np.array([7e-3, 5e-3]), far_amplitude=np.array([0.3, 1.0]),
)  # fmt: skip


def drawn(seed: int, n: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-8e-3, 8e-3, (n, 2)), rng.uniform(0.2, 1.8, n)


def skin(seed: int, length: float = 5e-3, static: float = 0.0):
    """Make a function from positions and loads to readings without noise."""
    rng = np.random.default_rng(seed)
    waves, phase = rng.normal(size=(60, 2)) / length, rng.uniform(0, 2 * np.pi, 60)
    size, still = rng.normal(size=(2, 60, CHANNELS)) * 40 * np.sqrt(2 / 60)

    def read(position: np.ndarray, load: np.ndarray) -> np.ndarray:
        shape = np.cos(position @ waves.T + phase)
        return (load[:, None] ** 1.5) * (shape @ size) + static * (shape @ still)

    return read


def table(position: np.ndarray, *loads: np.ndarray) -> PressTable:
    return PressTable(position, np.column_stack(loads) if loads else np.zeros((len(position), 0)))


def r2(truth: np.ndarray, mean: np.ndarray) -> float:
    return 1 - ((truth - mean) ** 2).sum() / ((truth - truth.mean(0)) ** 2).sum()


def fit(presses: PressTable, readings: np.ndarray, load_kinds=("travel",), **more) -> PopulationGP:
    return fit_population(presses, readings, load_kinds=load_kinds, **more)


def explained(gp: PopulationGP, at: PressTable, truth: np.ndarray) -> float:
    return r2(truth, predict_population(gp, at)[0])


def dense(s: int, x: np.ndarray, d: np.ndarray, z: np.ndarray, e: np.ndarray, chip: np.ndarray | None) -> np.ndarray:
    """Compute the covariance of kernel s by the formula of the module."""
    k = SkinKernels(*(values[s] for values in KINDS))

    def amplitude(at: np.ndarray) -> np.ndarray:
        near = np.ones(len(at)) if chip is None else np.exp(-((at - chip) ** 2).sum(1) / 2 / k.chip_reach**2)
        return k.far_amplitude + (1 - k.far_amplitude) * near

    def response(load: np.ndarray) -> np.ndarray:
        return ((load + k.load_offset) / (1 + k.load_offset)) ** k.load_power

    square = ((x[:, None] - z) ** 2).sum(-1)
    bent = np.exp(-square / 2 / k.bend_length**2 - (d[:, None] - e) ** 2 / 2 / k.bend_load_width**2)
    moving = (1 - k.bend_share) * np.exp(-square / 2 / k.map_length**2) + k.bend_share * bent
    inner = np.outer(response(d), response(e)) * moving
    inner += k.static_variance * np.exp(-square / 2 / k.static_length**2)
    return np.outer(amplitude(x), amplitude(z)) * inner + k.constant_variance


def noise(s: int, x: np.ndarray, d: np.ndarray, chip: np.ndarray | None) -> np.ndarray:
    """Compute the noise variance of kernel s by its formula: sensor noise and a part that grows with the press."""
    signal = np.diag(dense(s, x, d, x, d, chip)) - KINDS.constant_variance[s]
    response = ((d + KINDS.load_offset[s]) / (1 + KINDS.load_offset[s])) ** KINDS.load_power[s]
    by_load = signal / (1 + KINDS.static_variance[s] / response**2)
    return KINDS.noise_variance[s] + KINDS.gain_noise_variance[s] * by_load


@pytest.mark.parametrize("chips", [None, CHIPS])
def test_leave_one_out_agrees_with_refitting_without_the_press(chips):
    rng = np.random.default_rng(2)
    x, d = drawn(3, 9)
    readings, extra = rng.normal(size=(9, CHANNELS)), np.abs(rng.normal(size=(9, 5)))
    at = kernel.geometry(x, d, chips)
    part = np.array([0, 1, 2, 0, 1, 2, 0, 0, 1])
    result = lo.leave_one_out(KINDS, at, lo.Observed(readings, extra), part)
    alone = lo.leave_one_out(KINDS, at, lo.Observed(readings, extra))
    np.testing.assert_array_equal(alone.part_error, alone.error)
    for s in range(2):
        for c in (0, 4, 14):
            chip = None if chips is None else chips[c // 3]
            K = dense(s, x, d, x, d, chip)
            K_noise = K + np.diag(noise(s, x, d, chip) + extra[:, c // 3])
            ways = ((np.arange(9), result.error, result.variance), (part, result.part_error, result.part_variance))
            for i, (left, error, spread) in product((0, 5), ways):
                rest = left != left[i]
                solved = np.linalg.solve(K_noise[np.ix_(rest, rest)], np.column_stack([readings[rest, c], K[rest, i]]))
                np.testing.assert_allclose(readings[i, c] - error[s, i, c], K[i, rest] @ solved[:, 0], rtol=1e-6)
                relative = K_noise[i, i] - K[i, rest] @ solved[:, 1]
                np.testing.assert_allclose(spread[s, i, c] / result.scale[s, c] ** 2, relative, rtol=1e-6)


def test_a_mixture_of_one_kernel_agrees_with_dense_algebra():
    rng = np.random.default_rng(6)
    (x, d), (z, e) = drawn(7, 12), drawn(8, 5)
    readings = rng.normal(scale=20, size=(12, CHANNELS))
    unit = np.sqrt(np.mean(d**2))
    alone = kernel.take(KINDS, slice(0, 1))
    gp = mixture.fit_one(alone, table(x, d), readings, typical_load=unit, chip_positions=CHIPS)
    mean, std = predict_population(gp, table(z, e))
    d, e = d / unit, e / unit
    for c in (0, 7):
        chip = CHIPS[c // 3]
        K = dense(0, x, d, x, d, chip) + np.diag(noise(0, x, d, chip))
        k = dense(0, z, e, x, d, chip)
        solved = np.linalg.solve(K, np.column_stack([readings[:, c], k.T]))
        np.testing.assert_allclose(mean[:, c], k @ solved[:, 0], rtol=1e-6)
        variance = np.diag(dense(0, z, e, z, e, chip)) + noise(0, z, e, chip)
        variance -= np.sum(k * solved[:, 1:].T, axis=1)
        scale = np.sqrt(variance[0]) / std[0, c]
        np.testing.assert_allclose(std[:, c] * scale, np.sqrt(variance), rtol=1e-6)


@pytest.mark.parametrize("rough", [0.4, 0.0])
def test_heights_of_a_given_kernel_help_on_a_rough_skin_and_do_no_harm_on_a_flat_one(rough):
    rng = np.random.default_rng(3)
    waves, phase = rng.normal(size=(60, 2)) / 3e-3, rng.uniform(0, 2 * np.pi, 60)
    read, (x, d), (z, e) = skin(4), drawn(40, 200), drawn(41, 200)

    def touched(position: np.ndarray, load: np.ndarray) -> np.ndarray:
        height = 0.5 * rough * np.sqrt(2 / 60) * np.cos(position @ waves.T + phase).sum(1)
        return read(position, np.maximum(load + height, 0))

    given = TRAVEL_HYPERPARAMETERS._replace(
        unit_load=1.0, load_offset=0.1, load_power=1.5, map_length=5e-3, height_std=0.2, height_length=3e-3
    )
    readings, truth = touched(x, d) + rng.normal(size=(200, CHANNELS)), touched(z, e)
    without, with_ = (
        explained(fit_structured(h, table(x, d), readings), table(z, e), truth)
        for h in (given._replace(height_std=0.0), given)
    )
    if rough:
        assert 1 - with_ < 0.9 * (1 - without)
    else:
        assert with_ > without - 5e-3 > 0.9


def test_unknown_heights_widen_a_reading_by_its_slope_along_the_load():
    """Tested 5 mm from the presses, which therefore say nothing about the height, on a map that reaches that far."""
    given = TRAVEL_HYPERPARAMETERS._replace(
        unit_load=1.0, load_offset=0.1, load_power=1.5, map_length=20e-3, height_std=0.2, height_length=1e-3
    )
    (x, d), (z, e), step = drawn(43, 60), drawn(44, 10), 1e-4
    x, z = np.abs(x), -np.abs(z) * [1, 0] - [5e-3, 0]
    gp = fit_structured(given, table(x, d), skin(45, length=20e-3)(x, d))
    gp = gp._replace(heights=gp.heights._replace(measured=np.zeros(60)))
    flat = gp._replace(heights=gp.heights._replace(share=0 * gp.heights.share))
    up, down = (predict_population(flat, table(z, e + sign * step))[0] for sign in (1, -1))
    (mean, std), (same, less) = (predict_population(model, table(z, e)) for model in (gp, flat))
    np.testing.assert_allclose(mean, same, atol=1e-9)
    np.testing.assert_allclose(std**2 - less**2, ((up - down) / (2 * step) * given.height_std) ** 2, rtol=1e-3)


def test_given_variances_are_relative_to_map_and_bend_and_given_loads_to_the_unit_load():
    given = TRAVEL_HYPERPARAMETERS._replace(
        unit_load=2.0, load_offset=1.0, bend_load_width=3.0, map_variance=3.0, bend_variance=1.0, static_variance=2.0,
        constant_variance=0.4, noise_variance=0.04,
    )  # fmt: skip
    kernels = fit_structured(given, table(*drawn(42, 5)), np.ones((5, CHANNELS))).components.kernels
    relative = {"load_offset": 0.5, "bend_load_width": 1.5, "bend_share": 0.25, "static_variance": 0.5}
    for name, value in (relative | {"constant_variance": 0.1, "noise_variance": 0.01}).items():
        assert getattr(kernels, name) == pytest.approx(value), name


def test_weights_go_to_the_kernel_that_generated_the_presses(monkeypatch):
    """Tested before the mixture is stacked with the plain process, which may predict the presses as well."""
    monkeypatch.setattr(mixture, "_stacked_on_plain", lambda gp, _: gp)
    rng = np.random.default_rng(9)
    both = KernelPrior(KINDS._replace(far_amplitude=np.ones(2)), np.log(np.full((2, 2), 0.5)))
    x, d = drawn(10, 80)
    unit = np.sqrt(np.mean(d**2))
    at = kernel.geometry(x, d / unit, None)
    for s in range(2):
        own = kernel.noise_variances(both.kernels, at)[s, 0]
        K = kernel.signal_covariances(both.kernels, at, at)[s, 0] + np.diag(own)
        readings = 30 * np.linalg.cholesky(K) @ rng.normal(size=(80, CHANNELS))
        gp = fit(table(x, d), readings, prior=both)
        mine = np.isclose(gp.components.kernels.load_power, KINDS.load_power[s])
        assert gp.weights[mine].sum(0).min() > 0.9


def test_one_bad_press_does_little_harm(monkeypatch):
    read = skin(11)
    (x, d), (z, e) = drawn(12, 40), drawn(13, 60)
    rng = np.random.default_rng(14)
    readings = read(x, d) + rng.normal(size=(40, CHANNELS))
    readings[5, 3:6] += 800.0
    score = {}
    for robust in (True, False):
        if not robust:
            monkeypatch.setattr(mixture, "_with_heavy_tails", lambda gp: gp)
        gp = fit(table(x, d), readings, chip_positions=CHIPS[None])
        score[robust] = r2(read(z, e)[:, 3:6], predict_population(gp, table(z, e))[0][:, 3:6])
        if robust:
            assert gp.extra_noise[5, 1] == gp.extra_noise.max()
            assert gp.extra_noise[5, 1] > 1
    assert score[True] > 0.9
    assert score[True] > score[False] + 0.05


def test_an_earlier_session_is_used_only_if_it_still_agrees():
    read, other = skin(18), skin(19)
    (x, d), (z, e) = drawn(20, 12), drawn(21, 60)
    readings = read(x, d) + np.random.default_rng(22).normal(size=(12, CHANNELS))
    base = explained(fit(table(x, d), readings), table(z, e), read(z, e))
    for earlier, better in ((read, True), (other, False)):
        fitted, test = (table(*at)._replace(previous_mean=1.02 * earlier(*at)) for at in ((x, d), (z, e)))
        score = explained(fit(fitted, readings), test, read(z, e))
        assert score > (0.98 if better else base - 0.05)


def test_presses_may_have_two_loads_or_no_position_or_no_load():
    read = skin(23)
    (x, d), (z, e) = drawn(24, 60), drawn(25, 60)
    rng = np.random.default_rng(26)
    truth, noise = read(z, e), rng.normal(size=(60, CHANNELS))
    useless = rng.uniform(0.1, 2.0, 120)
    gp = fit(table(x, useless[:60], d), read(x, d) + noise, load_kinds=("travel", "force"))
    assert explained(gp, table(z, useless[60:], e), truth) > 0.9
    gp = fit(table(x), read(x, d) + noise, load_kinds=())
    mean, std = predict_population(gp, table(z))
    assert r2(truth, mean) > 0.2  # the positions explain much, although the loads are unknown
    assert np.mean(np.abs(truth - mean) < 1.645 * std * interval_scaling(gp)) > 0.8
    nowhere = np.zeros((60, 2))
    gp = fit(table(nowhere, d), read(nowhere, d) + noise, load_kinds=("force",))
    assert explained(gp, table(nowhere, e), read(nowhere, e)) > 0.98


@pytest.mark.parametrize("n", [1, 2])
def test_few_presses_give_finite_predictions_from_many_kernels(n):
    read = skin(27)
    (x, d), (z, e) = drawn(28, n), drawn(29, 10)
    for loads in (d, np.zeros(n), np.full(n, 1e-3)):
        gp = fit(table(x, loads), read(x, d), chip_positions=CHIPS[None])
        mean, std = predict_population(gp, table(z, e))
        assert len(gp.weights) == mixture._MIXTURE.selection.max_members  # so few presses cannot distinguish them
        assert np.isfinite(mean).all()
        assert (std > 0).all()
        assert np.isfinite(interval_scaling(gp)).all()


@pytest.mark.full
def test_the_stated_range_holds_nine_in_ten_readings():
    inside = []
    for seed in range(12):
        read = skin(100 + seed, length=3e-3, static=0.3)
        (x, d), (z, e) = drawn(200 + seed, 30), drawn(300 + seed, 100)
        rng = np.random.default_rng(seed)
        gp = fit(table(x, d), read(x, d) + 3 * rng.normal(size=(30, CHANNELS)), load_kinds=("force",))
        mean, std = predict_population(gp, table(z, e))
        truth = read(z, e) + 3 * rng.normal(size=mean.shape)
        inside.append(np.mean(np.abs(truth - mean) < 1.645 * std * interval_scaling(gp)))
    assert 0.84 < np.mean(inside) < 0.96


def test_the_prior_of_the_package_is_small_and_complete():
    packaged = load_prior()
    assert (Path(prior.__file__).parent / prior.PRIOR_FILE).stat().st_size < 100_000
    assert packaged.log_share.shape == (2, len(packaged.kernels.load_power))
    np.testing.assert_allclose(np.exp(packaged.log_share).sum(1), 1, rtol=1e-4)
    assert all(np.isfinite(values).all() for values in packaged.kernels)


def test_weights_far_from_the_presses_come_from_presses_left_out_together():
    """A kernel that is best among the presses and worst beyond them gets all weight near them and none far away."""
    x, d = drawn(37, 30)
    gp = mixture._unweighted_members(table(x, d), skin(38)(x, d), ("travel",), None, load_prior())
    k, n, c = len(gp.weights), 30, CHANNELS
    error, part_error = np.ones((k, n, c)), np.ones((k, n, c))
    error[0], part_error[0] = 0.01, 100.0
    near, far = mixture._weights(gp, lo.LeaveOneOutPresses(error, error**2, np.ones((k, c)), part_error, part_error**2))
    assert near[0].min() > 0.5
    assert far is not None
    assert far[0].max() < 0.01


def share_of_plain(weights: np.ndarray | None) -> np.ndarray:
    assert weights is not None
    return weights[-1]


@pytest.mark.parametrize("n", [12, 40])
def test_far_from_the_presses_the_plain_process_keeps_a_share_that_falls_with_their_number(n):
    """The share is p / (n + p) for p prior presses, however much better the mixture is on the parts left out."""
    prior_presses = mixture._MIXTURE.stacking.far_plain_presses
    x, d = drawn(50, n)
    gp = mixture._unweighted_members(table(x, d), skin(51)(x, d), ("travel",), None, load_prior())
    rng = np.random.default_rng(52)
    plain_error = rng.normal(size=(2, n, CHANNELS))
    far = mixture._stacking_share(gp, 0 * plain_error, plain_error, prior_presses)
    np.testing.assert_allclose(far, n / (n + prior_presses), rtol=1e-9)
    np.testing.assert_allclose(mixture._stacking_share(gp, 0 * plain_error, plain_error, 0.0), 1, rtol=1e-9)
    # The share is 0 if the mixture is worse where the two differ, and otherwise that of least squares.
    assert mixture._stacking_share(gp, 2 * plain_error, plain_error, 0.0).max() == 0
    half = mixture._stacking_share(gp, -plain_error, plain_error, 0.0)
    np.testing.assert_allclose(half, 0.5, rtol=1e-9)
    fitted = fit(table(x, d), skin(51)(x, d) + rng.normal(size=(n, CHANNELS)))
    floor = prior_presses / (n + prior_presses)
    assert share_of_plain(fitted.far_weights).min() >= floor - 1e-9
    np.testing.assert_allclose(fitted.weights.sum(0), 1, rtol=1e-9)


def test_the_share_of_a_channel_depends_on_its_own_errors_and_on_those_of_all_channels():
    x, d = drawn(53, 30)
    gp = mixture._unweighted_members(table(x, d), skin(54)(x, d), ("travel",), None, load_prior())
    plain_error = np.random.default_rng(55).normal(size=(1, 30, CHANNELS))
    error = 0 * plain_error
    error[..., 0] = 2 * plain_error[..., 0]
    share = mixture._stacking_share(gp, error, plain_error, 0.0)
    assert share[0] < share[1:].min() - 0.1
    assert share[0] > 0  # neither of two channels that differ this much is trusted entirely
    assert share[1:].max() <= 1


MISLEADING = KernelPrior(
    # Amplitudes fall to nearly nothing off a chip, so a reading far from the chip is magnified near it.
    KINDS._replace(
        chip_reach=np.array([2e-3, 2.5e-3]), far_amplitude=np.array([0.05, 0.1]), noise_variance=np.full(2, 1e-3)
    ),
    np.log(np.full((2, 2), 0.5)),
)


def test_misleading_kernels_are_not_worse_than_the_plain_process_where_nothing_was_pressed():
    """Noisy skins without chips, fitted with kernels that fall off a chip, are tested in a hole among the presses."""
    gains = []
    for seed in range(8):
        read, rng = skin(60 + seed, length=4e-3, static=1.0), np.random.default_rng(70 + seed)
        (x, d), (z, e) = drawn(80 + seed, 400), drawn(90 + seed, 600)
        outside, inside = (np.abs(x) > 2.5e-3).any(1), (np.abs(z) < 2.5e-3).all(1)
        x, d, z, e = x[outside][:24], d[outside][:24], z[inside], e[inside]
        readings = read(x, d) + 20 * rng.normal(size=(24, CHANNELS))
        gp = fit(table(x, d), readings, prior=MISLEADING, chip_positions=CHIPS[None])
        plain = predict_plain(fit_scales(x, d, readings), (x, d, readings), (z, e))
        gains.append(explained(gp, table(z, e), read(z, e)) - r2(read(z, e), plain))
    assert np.mean(gains) > -0.01
    assert min(gains) > -0.05


def test_a_short_list_of_kernels_chooses_one_of_several_boards(monkeypatch):
    """Beyond the kernels that a given board takes, at most the short list is used for each board."""
    x, d = drawn(100, 30)
    near = np.exp(-((x[:, None] - CHIPS) ** 2).sum(-1) / 2 / 4e-3**2).repeat(3, axis=1)
    readings = near * skin(101)(x, d) + np.random.default_rng(102).normal(size=(30, CHANNELS))
    turned = CHIPS @ np.array([[0.8, -0.6], [0.6, 0.8]]).T
    counts, leave_one_out = [], mixture.leave_one_out

    def counting(kernels, at, *rest):
        counts.append((len(kernels.load_power), at.chip_square is not None))
        return leave_one_out(kernels, at, *rest)

    monkeypatch.setattr(mixture, "leave_one_out", counting)
    monkeypatch.setattr(mixture, "_with_heavy_tails", lambda gp: gp)
    monkeypatch.setattr(mixture, "_with_heights", lambda gp: gp)
    monkeypatch.setattr(mixture, "_stacked_on_plain", lambda gp, _: gp)
    kernels, fits = {}, {}
    for boards in ((CHIPS,), (turned, CHIPS)):
        counts.clear()
        fits[len(boards)] = fit(table(x, d), readings, chip_positions=np.stack(boards))
        kernels[len(boards)] = sum(count for count, chips in counts if chips)
    assert kernels[2] <= kernels[1] + 2 * mixture._MIXTURE.selection.board_kernels
    np.testing.assert_array_equal(fits[2].chip_positions, fits[1].chip_positions)
    np.testing.assert_allclose(fits[2].weights, fits[1].weights, rtol=1e-9)
