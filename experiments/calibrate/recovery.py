"""Coverage of the parameter ranges of fitted pads. Pads with known parameters are simulated, pressed and fitted.

Board, tip and first contact have errors drawn from the prior of the fit.
"""

import time
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from experiments.calibrate.arguments import CalibrateArgs
from experiments.calibrate.evaluate import explained
from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from experiments.common.tables import text_table
from i2t.runtime.progress import progress
from i2t.skin.boards import reskin_board
from i2t.skin.elasticity import CELL_GRID, GRID, Grid
from i2t.skin.pad import press, press_force, sample_pad
from i2t.skin_models.layer_fit import LayerPosterior
from i2t.skin_models.magnetic_layer import DESIGN_PARAMETERS, LayerParameters, RoundTip, layer_prior, make_pad
from i2t.skin_models.magnetization import MagnetizationModel, TipReadings
from i2t.types import Pad

PADS_SEED = 505  # unlike the seeds of other experiments
TIP = RoundTip("sphere", 4e-3)
LOADS = {"force": (0.1, 1.2), "travel": (0.15e-3, 0.6e-3)}  # ranges of the presses, N and m


@dataclass(frozen=True)
class RecoveryPreset:
    """Settings of the experiment."""

    pads: int = 10
    places: int = 40
    presses_of_place: int = 2
    half_edge: float = 7e-3  # m, half of the edge of the square that is pressed
    noise: float = 1.0  # uT, standard deviation
    grid: Grid = GRID


PRESETS: dict[str, RecoveryPreset] = {
    "paper": RecoveryPreset(),
    "short": RecoveryPreset(pads=3),
    "debug": RecoveryPreset(pads=1, places=8, grid=CELL_GRID),
}


class KnownLayer(NamedTuple):
    """A simulated skin with the true values of the fitted parameters."""

    pad: Pad
    layer: LayerParameters


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Fit each pad to presses by force and to presses by travel, and count how often the ranges hold the truth."""
    started, cfg = time.perf_counter(), choose_preset(PRESETS, args.preset)
    begin(args, cfg)
    cases = [(number, load) for load in LOADS for number in range(cfg.pads)]
    fits = [_fit(number, load, cfg) for number, load in progress(cases, desc="pads", unit="fits")]
    metrics = {
        "source": "simulated",
        "seed": PADS_SEED,
        "pads": cfg.pads,
        "presses": cfg.places * cfg.presses_of_place,
        "by_load": {load: _summary([fit for (_, own), fit in zip(cases, fits, strict=True) if own == load])
                    for load in LOADS},
        "seconds": round(time.perf_counter() - started, 1),
    }  # fmt: skip
    write_json(args.out / "metrics.json", metrics)
    _report(metrics)
    return metrics


def known_layer(key: Key[Array, ""]) -> KnownLayer:
    """Draw a random pad, with errors of its mount and tip from the prior."""
    key_pad, key_mount = jax.random.split(key)
    board = reskin_board()
    pad, prior = sample_pad(key_pad, board=board), layer_prior(board.num_readings)
    errors = ("contact_offset", "tip_offset", "tip_scale", "board_offset", "board_rotation")
    drawn = {}
    for name, own in zip(errors, jax.random.split(key_mount, len(errors)), strict=True):
        median, std = getattr(prior.median, name), getattr(prior.std, name)
        change = std * jax.random.normal(own, jnp.shape(median))
        drawn[name] = median * jnp.exp(change) if name == "tip_scale" else median + change
    layer = prior.median._replace(
        thickness=pad.thickness,
        gap=-pad.board.chips[0, 2] - pad.thickness,
        young=pad.young,
        poisson=pad.poisson,
        mount_compliance=pad.mount_compliance,
        gains=pad.gains,
        **drawn,
    )
    return KnownLayer(make_pad(layer, board, pad.magnetization)._replace(friction=pad.friction), layer)


@partial(jax.jit, static_argnames=("by_force", "grid"))
def _read(
    skin: KnownLayer, position: Float[Array, "n 2"], load: Float[Array, " n"], *, by_force: bool, grid: Grid
) -> Float[Array, "n c"]:
    """Simulate the readings (uT) of presses."""
    tip = replace(TIP, radius=TIP.radius * skin.layer.tip_scale)

    def read_press(at_load: tuple[Array, Array]) -> Array:
        height = tip.height(at_load[0] + skin.layer.tip_offset, grid)
        if by_force:
            return press_force(skin.pad, height, at_load[1], grid=grid).reading
        return press(skin.pad, height, at_load[1] - skin.layer.contact_offset, grid=grid).reading

    return jax.lax.map(read_press, (position, load))


def _fit(number: int, load: str, cfg: RecoveryPreset) -> dict[str, Any]:
    """Fit one pad, and report which ranges hold the truth, with R2 of presses and of places left out."""
    skin, rng = known_layer(jax.random.fold_in(jax.random.key(PADS_SEED), number)), np.random.default_rng(number)
    places = rng.uniform(-cfg.half_edge, cfg.half_edge, (cfg.places, 2))
    order = rng.permutation(cfg.places * cfg.presses_of_place)
    position = jnp.float32(np.tile(places, (cfg.presses_of_place, 1))[order])
    amount = jnp.float32(rng.uniform(*LOADS[load], len(order)))
    clean = np.asarray(_read(skin, position, amount, by_force=load == "force", grid=cfg.grid))
    readings = clean + cfg.noise * rng.normal(size=clean.shape)
    data = TipReadings(position, amount, jnp.float32(readings), reskin_board())
    fitted = MagnetizationModel(TIP, load == "force", cfg.grid).fit(None, data)
    unused = "contact_offset" if load == "force" else "young"  # presses of this kind do not depend on it
    names = [name for name in (*DESIGN_PARAMETERS, "gains") if name != unused]
    return {
        "inside": {name: _inside(fitted.posterior, skin.layer, name) for name in names},
        "converged": bool(fitted.posterior.converged),
        "r2": explained(readings, (fitted.leave_one_out**2).sum(1)),
        "r2_places": explained(readings, (fitted.leave_one_place_out**2).sum(1)),
    }


def _inside(posterior: LayerPosterior, truth: LayerParameters, name: str) -> list[bool]:
    low, high, value = (np.ravel(getattr(part, name)) for part in (posterior.low, posterior.high, truth))
    return [bool(x) for x in (low <= value) & (value <= high)]


def _summary(fits: list[dict[str, Any]]) -> dict[str, Any]:
    """Count the values inside their ranges by parameter, and collect R2."""
    inside = {name: np.concatenate([fit["inside"][name] for fit in fits]) for name in fits[0]["inside"]}
    all_values = np.concatenate(list(inside.values()))
    return {
        "inside": {name: [int(part.sum()), len(part)] for name, part in inside.items()},
        "inside_all": [int(all_values.sum()), len(all_values)],
        "converged": sum(fit["converged"] for fit in fits),
        "r2": [fit["r2"] for fit in fits],
        "r2_places": [fit["r2_places"] for fit in fits],
    }


def _report(metrics: dict[str, Any]) -> None:
    """Print the table."""
    by_load = metrics["by_load"]
    print(f"\n{metrics['pads']} simulated pads, {metrics['presses']} presses each: values inside their 95 % ranges")
    names = list(dict.fromkeys(name for part in by_load.values() for name in part["inside"]))
    counts = [part["inside"] | {"all": part["inside_all"]} for part in by_load.values()]
    rows = [[name, *("/".join(map(str, part.get(name, "-"))) for part in counts)] for name in (*names, "all")]
    for name in ("r2", "r2_places"):
        rows.append([f"mean {name}", *(f"{np.mean(part[name]):.3f}" for part in by_load.values())])
    rows.append(["fits that converged", *(str(part["converged"]) for part in by_load.values())])
    print(text_table(["parameter", *(f"by {load}" for load in by_load)], rows))
