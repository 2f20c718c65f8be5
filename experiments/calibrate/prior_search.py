"""The prior over kernels of `i2t.skin_models.tip_gp.prior`, made from simulated skins of all kinds.

Candidates are drawn from wide ranges and about two sets of hyperparameters that were known before. Each is tried on
every skin: conditioned on 10, 30 and 100 presses it predicts others. Candidates of a second generation are drawn about
the best of each skin. The shares of the population, for loads by travel and by force, are those that make what was
found most likely (the nonparametric maximum likelihood estimate of a mixing distribution; Laird, JASA 73, 1978), its
iterations stopped early, so that they stay wide.
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

POPULATION_SEED = 101  # skins of other seeds are never seen by the search
SEARCH_PRESS_COUNTS = (10, 30, 100)
ANCHOR_SHARE = 0.15  # of the prior of each kind of load, of the candidates about what was known before
SHARPNESS = 12.0  # by which the logarithm of an error counts as a likelihood
PRIOR_EM_STEPS = 12
BEST_OF_TASK = 6
START_JITTER = 0.35  # standard deviation of the logarithm of each hyperparameter, about the best
# (low, high, logarithmic) of a wide draw
RANGES: dict[str, tuple[float, float, bool]] = {
    "load_power": (0.4, 2.6, False), "load_offset": (0.02, 2.0, True), "map_length": (1.5e-3, 25e-3, True),
    "bend_share": (0.005, 0.95, True), "bend_length": (1e-3, 12e-3, True), "bend_load_width": (0.3, 8.0, True),
    "static_variance": (1e-3, 1.0, True), "static_length": (1.5e-3, 15e-3, True),
    "constant_variance": (1e-3, 0.5, True), "noise_variance": (5e-4, 0.3, True),
    "gain_noise_variance": (1e-4, 0.1, True), "chip_reach": (3e-3, 20e-3, True), "far_amplitude": (0.01, 0.7, True),
}  # fmt: skip
# What the two sets of `tip_gp.structured` are at a typical load of 2.3 mm and of 0.65 N, and a guess by geometry.
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
    """Sizes of the search."""

    skins: int = 8  # of each kind
    test_presses: int = 100  # of each skin
    wide: int = 300  # candidates of the first generation
    anchored: int = 24  # about each known set
    second: int = 300  # candidates of the second generation
    kept: int = 256


PRESETS: dict[str, PriorSearch] = {
    "paper": PriorSearch(),
    "short": PriorSearch(3, 60, 100, 8, 100, 128),
    "debug": PriorSearch(1, 20, 12, 2, 12, 16),
}


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Search, and write prior.npz."""
    started, cfg, out = time.perf_counter(), choose_preset(PRESETS, args.preset), args.out
    begin(args, cfg)
    rng = np.random.default_rng(POPULATION_SEED)
    tasks = population_tasks(cfg)
    first = join(draw_wide(rng, cfg.wide), *(near(rng, kernels, cfg.anchored) for kernels in ANCHORS.values()))
    error = errors_of(first, tasks, cfg)
    second = near(rng, take(first, _best(error)), cfg.second)
    every, error = join(first, second), np.concatenate([error, errors_of(second, tasks, cfg)], axis=2)
    first_anchored = cfg.wide + np.arange(cfg.anchored)
    anchored = {"travel": first_anchored, "force": cfg.anchored + first_anchored}
    by_force = np.array([by for _, by in tasks])
    share = np.stack([_shares(error, by_force == (kind == "force"), anchored[kind]) for kind in ("travel", "force")])
    keep = np.argsort(-share.sum(0), kind="stable")[: cfg.kept]
    with np.errstate(divide="ignore"):
        log_share = np.log(share[:, keep] / share[:, keep].sum(1, keepdims=True))
    about = {
        "source": "simulated", "seed": POPULATION_SEED, "kinds": list(SKIN_KINDS), "skins_of_each": cfg.skins,
        "candidates": int(share.shape[1]), "command": "python -m experiments.calibrate --prior",
    }  # fmt: skip
    save_prior(out / PRIOR_FILE, KernelPrior(take(every, keep), log_share), about)
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
    """Every skin with whether its load is the force; half of each kind is."""
    n = max(SEARCH_PRESS_COUNTS) + cfg.test_presses
    return [
        (skin, kind == "displaced" or i % 2 == 1)
        for kind in SKIN_KINDS
        for i, skin in enumerate(simulate_skins(kind, POPULATION_SEED, cfg.skins, n))
    ]


def draw_wide(rng: np.random.Generator, count: int) -> SkinKernels:
    """Candidates from wide ranges."""
    drawn = {
        name: np.exp(rng.uniform(np.log(low), np.log(high), count)) if log else rng.uniform(low, high, count)
        for name, (low, high, log) in RANGES.items()
    }
    drawn["far_amplitude"] = np.where(rng.random(count) < 0.35, UNIFORM_FAR_AMPLITUDE, drawn["far_amplitude"])
    drawn["static_variance"] = np.where(rng.random(count) < 0.4, 0.0, drawn["static_variance"])
    return SkinKernels(**drawn)


def near(rng: np.random.Generator, kernels: SkinKernels, count: int) -> SkinKernels:
    """Candidates about given kernels, the first of them as they are."""
    of = np.arange(count) % len(kernels.load_power)
    moved = {}
    for name, values in take(kernels, of)._asdict().items():
        factor = np.exp(START_JITTER * rng.normal(size=count) * (np.arange(count) >= len(kernels.load_power)))
        moved[name] = np.where(values == UNIFORM_FAR_AMPLITUDE, values, values * factor)
    moved["bend_share"] = np.minimum(moved["bend_share"], 0.98)
    fallen = moved["far_amplitude"] != UNIFORM_FAR_AMPLITUDE
    moved["far_amplitude"] = np.where(fallen, np.minimum(moved["far_amplitude"], 0.9), UNIFORM_FAR_AMPLITUDE)
    return SkinKernels(**moved)


def errors_of(kernels: SkinKernels, tasks: list[tuple[PressedSkinOfKind, bool]], cfg: PriorSearch) -> np.ndarray:
    """(tasks, counts, kernels): squared error of held-out presses over their variance."""
    found = np.empty((len(tasks), len(SEARCH_PRESS_COUNTS), len(kernels.load_power)))
    knows_chips = kernels.far_amplitude < UNIFORM_FAR_AMPLITUDE
    for t, (skin, by_force) in enumerate(progress(tasks, desc="skins", unit="skin")):
        load = skin.force if by_force else skin.travel
        test = slice(len(load) - cfg.test_presses, None)
        for i, n in enumerate(SEARCH_PRESS_COUNTS):
            typical = np.sqrt(np.mean(load[:n] ** 2))
            for chips in (True, False):
                rows = np.flatnonzero(knows_chips == chips)
                at = [
                    geometry(skin.position[part], load[part] / typical, skin.chip_positions if chips else None)
                    for part in (slice(n), test)
                ]
                found[t, i, rows] = _errors(take(kernels, rows), skin.readings[:n], skin.readings[test], *at)
    return found


def _errors(kernels: SkinKernels, known: np.ndarray, truth: np.ndarray, at, other) -> np.ndarray:
    observed = Observed(known, np.zeros((len(known), 1)))
    total = np.sum((truth - truth.mean(0)) ** 2)
    found = []
    for i, given in enumerate(condition_all(kernels, at, observed)):
        cross = signal_covariances(take(kernels, slice(i, i + 1)), other, at)[0]
        mean = ungrouped(cross @ grouped(given.weights, len(cross)))
        found.append(np.sum((truth - mean) ** 2) / total)
    return np.array(found)


def _best(error: np.ndarray) -> np.ndarray:
    """The best kernels of each task, over all counts."""
    order = np.argsort(np.log(error).mean(1), axis=1)[:, :BEST_OF_TASK]
    return np.unique(order)


def _shares(error: np.ndarray, own: np.ndarray, anchored: np.ndarray) -> np.ndarray:
    """Shares of the population among the tasks of one kind of load; a tenth is that of all tasks."""
    log_likelihood = -SHARPNESS * np.log(np.maximum(error, 1e-4)).sum(1)
    likelihood = np.exp(log_likelihood - log_likelihood.max(1, keepdims=True))
    count = np.where(own, 0.9 / max(own.sum(), 1), 0.1 / len(own))
    share = np.full(error.shape[2], 1 / error.shape[2])
    for _ in range(PRIOR_EM_STEPS):
        member = likelihood * share[None]
        share = (count[:, None] * member / member.sum(1, keepdims=True)).sum(0)
        share = share / share.sum()
    known = np.zeros_like(share)
    known[anchored] = 1 / len(anchored)
    return (1 - ANCHOR_SHARE) * share + ANCHOR_SHARE * known
