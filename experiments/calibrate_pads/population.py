"""Hyperparameters of the structured GP for forces, searched on a population of simulated pads."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from experiments.calibrate.data import PressRecording
from experiments.calibrate.methods import PLAIN, Predictors
from experiments.calibrate.report import summarise, table_row
from experiments.calibrate_pads.simulate import add_faults, board, press_pads
from experiments.common.runs import write_json
from i2t.calibration import FORCE_HYPERPARAMETERS, Presses, StructuredGPHyperparameters, structured_gp
from i2t.calibration.model import hyperparameters_to_json
from i2t.prediction.metrics import score
from i2t.progress import progress

GUESSED, FOUND, IN_USE = "guessed", "found", "in use"
PAD_LABEL_WIDTH = 40
# What geometry suggests for a layer of a few mm: a chip feels what happens within twice the layer's thickness, and the
# part that does not depend on the force is as large as the rest. The search for `FORCE_HYPERPARAMETERS` begins here.
GUESS = FORCE_HYPERPARAMETERS._replace(
    load_offset=0.1, load_power=0.7, map_length=5e-3, bend_variance=0.03, bend_length=5e-3, bend_load_width=1.0,
    static_variance=0.3, constant_variance=0.1, noise_variance=5e-2, chip_reach=7e-3, far_amplitude=0.2,
)  # fmt: skip
# Not what does not depend on the force: simulated boards have none of it, real ones may.
SEARCHED = (
    "map_length", "noise_variance", "load_power", "load_offset", "chip_reach", "far_amplitude", "bend_variance",
    "bend_length", "bend_load_width",
)  # fmt: skip
STEP_FACTORS = (2.0, 1.4, 1.2)  # on one hyperparameter at a time
MAX_SWEEPS = 5  # through all of them with one factor
MIN_R2_GAIN = 1e-4  # that is worth a step


@dataclass(frozen=True)
class Population:
    """Pads that hyperparameters are chosen on, and others that they are tried on."""

    pads: int = 24
    others: int = 32
    counts: tuple[int, ...] = (10, 20, 50, 100)
    held_out_presses: int = 100  # of each pad


PRESETS: dict[str, Population] = {
    "paper": Population(),
    "short": Population(6, 6),
    "debug": Population(2, 2, (10, 20), 20),
}


def evaluate(cfg: Population, seed: int) -> dict[str, Any]:
    """Hyperparameters by the mean R2 of all pads and counts, and what they are worth on pads never seen."""
    started = time.perf_counter()
    keys = jax.random.split(jax.random.fold_in(jax.random.key(seed), 1), 4)
    n = max(cfg.counts) + cfg.held_out_presses
    (_, presses, readings), (_, others, clean) = press_pads(keys[0], cfg.pads, n), press_pads(keys[1], cfg.others, n)
    found, chosen = _search_on(cfg, presses, add_faults(keys[2], readings))
    conditions = {"boards in a session": add_faults(keys[3], clean), "the same pads without faults": clean}
    r2 = {condition: _r2_by_name(cfg, found, others, values) for condition, values in conditions.items()}
    gains = {
        condition: {f"{FOUND} - {name}": by_name[FOUND] - value for name, value in by_name.items() if name != FOUND}
        for condition, by_name in r2.items()
    }
    return {
        "source": "simulated",
        "seed": seed,
        "pads": {"chosen on": cfg.pads, "tried on": cfg.others},
        "hyperparameters": hyperparameters_to_json(found),
        "r2_chosen_on": chosen,
        "r2": {condition: over_pads(cfg.counts, by_name) for condition, by_name in r2.items()},
        "differences": {condition: over_pads(cfg.counts, by_name) for condition, by_name in gains.items()},
        "seconds": round(time.perf_counter() - started, 1),
    }


def report(metrics: dict[str, Any], out: Any) -> None:
    """Write the metrics and print the tables."""
    write_json(out / "metrics.json", metrics)
    pads = metrics["pads"]
    print(f"simulated; found on {pads['chosen on']} pads: {metrics['hyperparameters']}")
    print(f"mean R2 there: {metrics['r2_chosen_on']}; on {pads['tried on']} others:")
    for condition in metrics["r2"]:
        print(condition)
        for name, by_count in {**metrics["r2"][condition], **metrics["differences"][condition]}.items():
            print(table_row(name, by_count, PAD_LABEL_WIDTH))


def search(
    mean_r2: Callable[[StructuredGPHyperparameters], float], start: StructuredGPHyperparameters
) -> StructuredGPHyperparameters:
    """Coordinate search upwards from a start: one hyperparameter at a time times a factor, in ever smaller steps."""
    best, most = start, mean_r2(start)
    for step in STEP_FACTORS:
        for _ in range(MAX_SWEEPS):
            before = most
            for name in SEARCHED:
                for factor in (step, 1 / step):
                    tried = best._replace(**{name: getattr(best, name) * factor})
                    if tried.far_amplitude <= 1 and (r2 := mean_r2(tried)) > most + MIN_R2_GAIN:
                        best, most = tried, r2
                        break
            if most == before:
                break
    return best


def structured_r2(
    hyperparameters: StructuredGPHyperparameters,
    presses: Presses,
    readings: Float[Array, "pads n c"],
    counts: Sequence[int],
    held_out: int,
) -> Float[np.ndarray, "pads counts"]:
    """R2 on the last presses of each pad, of the structured GP conditioned on the first ones."""
    # One count after the other: batched factors that run side by side can wait for each other's threads for ever.
    columns = [_structured_r2(hyperparameters, presses, readings, n, held_out) for n in counts]
    return np.stack([np.asarray(column, np.float64) for column in columns], axis=1)


def plain_r2(
    presses: Presses, readings: Float[Array, "pads n c"], counts: Sequence[int], held_out: int
) -> Float[np.ndarray, "pads counts"]:
    """R2 on the same presses of the plain process, whose scales each pad's presses choose."""
    position, force, y = (np.asarray(part, np.float64) for part in (presses.position, presses.load, readings))
    test = np.arange(y.shape[1] - held_out, y.shape[1])
    skins = [PressRecording(*one, True) for one in zip(position, force, y, strict=True)]
    return np.array(
        [[score(skin.readings[test], Predictors(skin).plain(np.arange(n), test)).r2 for n in counts] for skin in skins]
    )


def over_pads(counts: Sequence[int], values: dict[str, np.ndarray]) -> dict[str, Any]:
    """Mean and 95 % interval over pads of values (pads, counts)."""
    return summarise({name: dict(zip(counts, v.T.tolist(), strict=True)) for name, v in values.items()})


def _search_on(
    cfg: Population, presses: Presses, readings: Float[Array, "pads n c"]
) -> tuple[StructuredGPHyperparameters, dict[str, float]]:
    """Hyperparameters found, rounded to two digits, and the mean R2 of the guess and of those found."""
    with progress(desc="hyperparameters", unit="set") as bar:

        def mean_r2(hyperparameters: StructuredGPHyperparameters) -> float:
            r2 = float(structured_r2(hyperparameters, presses, readings, cfg.counts, cfg.held_out_presses).mean())
            bar.update()
            return r2 if np.isfinite(r2) else -np.inf

        found = search(mean_r2, GUESS)
        found = StructuredGPHyperparameters(*(float(f"{float(value):.2g}") for value in found))
        return found, {GUESSED: mean_r2(GUESS), FOUND: mean_r2(found)}


def _r2_by_name(
    cfg: Population, found: StructuredGPHyperparameters, presses: Presses, readings: Float[Array, "pads n c"]
) -> dict[str, np.ndarray]:
    tried = {GUESSED: GUESS, FOUND: found, IN_USE: FORCE_HYPERPARAMETERS}
    sizes = (cfg.counts, cfg.held_out_presses)
    structured = {name: structured_r2(one, presses, readings, *sizes) for name, one in tried.items()}
    return structured | {PLAIN: plain_r2(presses, readings, *sizes)}


@partial(jax.jit, static_argnums=(3, 4))
def _structured_r2(
    hyperparameters: StructuredGPHyperparameters, presses: Presses, readings: Array, n: int, held_out: int
) -> Float[Array, " pads"]:
    chips = jnp.asarray(board().chips[:, :2], jnp.float32)

    def skin(one: tuple[Presses, Array]) -> Array:
        at, y = one
        known = Presses(at.position[:n], at.load[:n])
        test, truth = Presses(at.position[-held_out:], at.load[-held_out:]), y[-held_out:]
        mean = structured_gp.predict(structured_gp.fit(hyperparameters, known, y[:n], chips), test)[0]
        return 1 - jnp.sum((truth - mean) ** 2) / jnp.sum((truth - jnp.mean(truth, axis=0, keepdims=True)) ** 2)

    return jax.lax.map(skin, (presses, readings))
