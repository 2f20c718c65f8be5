"""Search for the prior over kernels of `i2t.skin_models.tip_gp.prior` on simulated skins of all kinds.

Candidates are drawn from wide ranges and around two earlier sets of hyperparameters. Each candidate is conditioned on
10, 30 and 100 presses of every skin, and predicts other presses. Candidates of a second generation are drawn around the
best of each skin. The prior weights, for loads by travel and by force, are nonparametric maximum likelihood estimates
of a mixing distribution (Laird, JASA 73, 1978), with few iterations, so that the prior stays wide.
"""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from experiments.calibrate.arguments import CalibrateArgs
from experiments.calibrate.skins import SKIN_KINDS, PressedSkinOfKind, simulate_skins
from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from i2t.runtime.progress import progress
from i2t.skin_models.tip_gp.kernel import UNIFORM_FAR_AMPLITUDE, SkinKernels, geometry, join, signal_covariances, take
from i2t.skin_models.tip_gp.leave_one_out import Observed, condition_all, grouped, ungrouped
from i2t.skin_models.tip_gp.prior import PRIOR_FILE, KernelPrior, save_prior

POPULATION_SEED = 101  # skins of other seeds are reserved for tests
SEARCH_PRESS_COUNTS = (10, 30, 100)  # numbers of presses on which candidates are conditioned
# Low, high, and whether a first-generation draw is logarithmic.
RANGES: dict[str, tuple[float, float, bool]] = {
    "load_power": (0.4, 2.6, False), "load_offset": (0.02, 2.0, True), "map_length": (1.5e-3, 25e-3, True),
    "bend_share": (0.005, 0.95, True), "bend_length": (1e-3, 12e-3, True), "bend_load_width": (0.3, 8.0, True),
    "static_variance": (1e-3, 1.0, True), "static_length": (1.5e-3, 15e-3, True),
    "constant_variance": (1e-3, 0.5, True), "noise_variance": (5e-4, 0.3, True),
    "gain_noise_variance": (1e-4, 0.1, True), "chip_reach": (3e-3, 20e-3, True), "far_amplitude": (0.01, 0.7, True),
}  # fmt: skip
# The two sets of `tip_gp.structured` at a typical load of 2.3 mm and of 0.65 N, with guesses from the geometry.
ANCHORS: dict[str, SkinKernels] = {
    "travel": SkinKernels(*(np.array([v]) for v in (
        1.8, 1.2, 16.5e-3, 0.0145, 2e-3, 3.0, 0.024, 16.5e-3, 1.6e-3, 3.6e-3, 1e-4, 10e-3, UNIFORM_FAR_AMPLITUDE,
    ))),
    "force": SkinKernels(*(np.array(v) for v in (
        [1.4, 0.7], [0.37, 0.15], [2.1e-3, 5e-3], [0.84, 0.05], [5e-3, 5e-3], [12.0, 2.0], [0.12, 0.3], [2.1e-3, 5e-3],
        [0.04, 0.1], [0.007, 0.05], [1e-3, 1e-3], [5.8e-3, 7e-3], [0.013, 0.2],
    ))),
}  # fmt: skip


@dataclass(frozen=True)
class PriorSearch:
    """Settings of the search."""

    skins: int = 8  # skins of each kind
    test_presses: int = 100  # test presses of each skin
    wide: int = 300  # candidates of the first generation from wide ranges
    anchored: int = 24  # candidates of the first generation around each earlier set
    second: int = 300  # candidates of the second generation
    kept: int = 256  # kernels in the prior
    anchor_weight: float = 0.15  # prior weight of the candidates around the earlier set of a load
    sharpness: float = 12.0  # exponent that turns an inverse error into a likelihood
    em_steps: int = 12  # iterations of expectation maximisation
    best_per_task: int = 6  # candidates of each skin around which the second generation is drawn
    jitter: float = 0.35  # standard deviation of the logarithm of each hyperparameter around a candidate


PRESETS: dict[str, PriorSearch] = {
    "paper": PriorSearch(),
    "short": PriorSearch(3, 60, 100, 8, 100, 128),
    "debug": PriorSearch(1, 20, 12, 2, 12, 16),
}


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Search for the prior, and write prior.npz."""
    started, cfg, out = time.perf_counter(), choose_preset(PRESETS, args.preset), args.out
    begin(args, cfg)
    rng = np.random.default_rng(POPULATION_SEED)
    tasks = population_tasks(cfg)
    first = join(
        draw_wide(rng, cfg.wide), *(near(rng, kernels, cfg.anchored, cfg.jitter) for kernels in ANCHORS.values())
    )
    error = errors_of(first, tasks, cfg)
    second = near(rng, take(first, _best(error, cfg.best_per_task)), cfg.second, cfg.jitter)
    candidates, error = join(first, second), np.concatenate([error, errors_of(second, tasks, cfg)], axis=2)
    anchored = {
        "travel": cfg.wide + np.arange(cfg.anchored),
        "force": cfg.wide + cfg.anchored + np.arange(cfg.anchored),
    }
    by_force = np.array([by for _, by in tasks])
    share = np.stack([_weights(error, by_force == (kind == "force"), anchored[kind], cfg) for kind in ANCHORS])
    keep = np.argsort(-share.sum(0), kind="stable")[: cfg.kept]
    with np.errstate(divide="ignore"):
        log_share = np.log(share[:, keep] / share[:, keep].sum(1, keepdims=True))
    about = {
        "source": "simulated", "seed": POPULATION_SEED, "kinds": list(SKIN_KINDS), "skins_of_each": cfg.skins,
        "candidates": int(share.shape[1]), "command": "python -m experiments.calibrate --prior",
    }  # fmt: skip
    save_prior(out / PRIOR_FILE, KernelPrior(take(candidates, keep), log_share), about)
    best = error.mean(0).min(1)
    metrics = about | {
        "kept": len(keep),
        "r2_of_the_best_kernel": {str(n): float(1 - e) for n, e in zip(SEARCH_PRESS_COUNTS, best, strict=True)},
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_json(out / "metrics.json", metrics)
    print(f"simulated; {metrics['kept']} kernels are in {out / PRIOR_FILE}")
    return metrics


def population_tasks(cfg: PriorSearch) -> list[tuple[PressedSkinOfKind, bool]]:
    """Simulate all skins, each with whether its load is the force, which holds for half of the skins of each kind."""
    n = max(SEARCH_PRESS_COUNTS) + cfg.test_presses
    return [
        (skin, kind == "displaced" or i % 2 == 1)
        for kind in SKIN_KINDS
        for i, skin in enumerate(simulate_skins(kind, POPULATION_SEED, cfg.skins, n))
    ]


def draw_wide(rng: np.random.Generator, count: int) -> SkinKernels:
    """Draw candidates from wide ranges."""
    drawn = {
        name: np.exp(rng.uniform(np.log(low), np.log(high), count)) if log else rng.uniform(low, high, count)
        for name, (low, high, log) in RANGES.items()
    }
    drawn["far_amplitude"] = np.where(rng.random(count) < 0.35, UNIFORM_FAR_AMPLITUDE, drawn["far_amplitude"])
    drawn["static_variance"] = np.where(rng.random(count) < 0.4, 0.0, drawn["static_variance"])
    return SkinKernels(**drawn)


def near(rng: np.random.Generator, kernels: SkinKernels, count: int, jitter: float) -> SkinKernels:
    """Draw candidates around given kernels, the first of them unchanged."""
    of = np.arange(count) % len(kernels.load_power)
    moved = {}
    for name, values in take(kernels, of)._asdict().items():
        factor = np.exp(jitter * rng.normal(size=count) * (np.arange(count) >= len(kernels.load_power)))
        moved[name] = np.where(values == UNIFORM_FAR_AMPLITUDE, values, values * factor)
    moved["bend_share"] = np.minimum(moved["bend_share"], 0.98)
    fallen = moved["far_amplitude"] != UNIFORM_FAR_AMPLITUDE
    moved["far_amplitude"] = np.where(fallen, np.minimum(moved["far_amplitude"], 0.9), UNIFORM_FAR_AMPLITUDE)
    return SkinKernels(**moved)


def errors_of(kernels: SkinKernels, tasks: list[tuple[PressedSkinOfKind, bool]], cfg: PriorSearch) -> np.ndarray:
    """Compute the relative squared error of the test presses, (tasks, counts, kernels)."""
    errors = np.empty((len(tasks), len(SEARCH_PRESS_COUNTS), len(kernels.load_power)))
    uses_chips = kernels.far_amplitude < UNIFORM_FAR_AMPLITUDE
    for t, (skin, by_force) in enumerate(progress(tasks, desc="fitting", unit="skins")):
        load = skin.force if by_force else skin.travel
        test = slice(len(load) - cfg.test_presses, None)
        for i, n in enumerate(SEARCH_PRESS_COUNTS):
            typical = np.sqrt(np.mean(load[:n] ** 2))
            for chips in (True, False):
                rows = np.flatnonzero(uses_chips == chips)
                at = [
                    geometry(skin.position[part], load[part] / typical, skin.chip_positions if chips else None)
                    for part in (slice(n), test)
                ]
                errors[t, i, rows] = _errors(take(kernels, rows), skin.readings[:n], skin.readings[test], *at)
    return errors


def _errors(kernels: SkinKernels, readings: np.ndarray, truth: np.ndarray, at, other) -> np.ndarray:
    observed = Observed(readings, np.zeros((len(readings), 1)))
    total = np.sum((truth - truth.mean(0)) ** 2)
    errors = []
    for i, conditioned in enumerate(condition_all(kernels, at, observed)):
        cross = signal_covariances(take(kernels, slice(i, i + 1)), other, at)[0]
        mean = ungrouped(cross @ grouped(conditioned.weights, len(cross)))
        errors.append(np.sum((truth - mean) ** 2) / total)
    return np.array(errors)


def _best(error: np.ndarray, count: int) -> np.ndarray:
    """Select the best kernels of each task over all numbers of presses."""
    order = np.argsort(np.log(error).mean(1), axis=1)[:, :count]
    return np.unique(order)


def _weights(error: np.ndarray, own: np.ndarray, anchored: np.ndarray, cfg: PriorSearch) -> np.ndarray:
    """Estimate the prior weights for one kind of load, whose tasks have nine tenths of the weight."""
    log_likelihood = -cfg.sharpness * np.log(np.maximum(error, 1e-4)).sum(1)
    likelihood = np.exp(log_likelihood - log_likelihood.max(1, keepdims=True))
    count = np.where(own, 0.9 / max(own.sum(), 1), 0.1 / len(own))
    share = np.full(error.shape[2], 1 / error.shape[2])
    for _ in range(cfg.em_steps):
        member = likelihood * share[None]
        share = (count[:, None] * member / member.sum(1, keepdims=True)).sum(0)
        share = share / share.sum()
    anchor = np.zeros_like(share)
    anchor[anchored] = 1 / len(anchored)
    return (1 - cfg.anchor_weight) * share + cfg.anchor_weight * anchor
