"""Do the ranges of a fitted pad hold the truth? Pads with known parameters are simulated, pressed, and fitted.

Board, tip and first contact are off by what the prior of the fit expects of a careful mount.
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

PADS_SEED = 505  # other pads than those of any other experiment
TIP = RoundTip("sphere", 4e-3)
LOADS = {"force": (0.1, 1.2), "travel": (0.15e-3, 0.6e-3)}  # N and m, of the presses
HALF_EDGE_M = 7e-3  # of the square that is pressed
NOISE_UT = 1.0
MOUNT_ERRORS = ("contact_offset", "tip_offset", "tip_scale", "board_offset", "board_rotation")
UNUSED = {"force": "contact_offset", "travel": "young"}  # the parameter that such presses do not depend on


@dataclass(frozen=True)
class RecoveryPreset:
    """Sizes of the experiment."""

    pads: int = 10
    places: int = 40
    presses_of_place: int = 2
    grid: Grid = GRID


PRESETS: dict[str, RecoveryPreset] = {
    "paper": RecoveryPreset(),
    "short": RecoveryPreset(pads=3),
    "debug": RecoveryPreset(pads=1, places=8, grid=CELL_GRID),
}


class KnownLayer(NamedTuple):
    """A simulated skin, and the parameters that its fit is to find."""

    pad: Pad
    layer: LayerParameters


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Fit each pad to presses by force and to presses by travel; count how often the ranges hold the truth."""
    started, cfg = time.perf_counter(), choose_preset(PRESETS, args.preset)
    begin(args, cfg)
    cases = [(number, load) for load in LOADS for number in range(cfg.pads)]
    fits = [_fit(number, load, cfg) for number, load in progress(cases, desc="pads", unit="fit")]
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
    """A random pad on a board that is mounted, and under a tip that is known, as well as the prior expects."""
    key_pad, key_mount = jax.random.split(key)
    board = reskin_board()
    pad, prior = sample_pad(key_pad, board=board), layer_prior(board.num_readings)
    drawn = {}
    for name, own in zip(MOUNT_ERRORS, jax.random.split(key_mount, len(MOUNT_ERRORS)), strict=True):
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
    known: KnownLayer, position: Float[Array, "n 2"], load: Float[Array, " n"], *, by_force: bool, grid: Grid
) -> Float[Array, "n c"]:
    tip = replace(TIP, radius=TIP.radius * known.layer.tip_scale)

    def one(each: tuple[Array, Array]) -> Array:
        height = tip.height(each[0] + known.layer.tip_offset, grid)
        if by_force:
            return press_force(known.pad, height, each[1], grid=grid).reading
        return press(known.pad, height, each[1] - known.layer.contact_offset, grid=grid).reading

    return jax.lax.map(one, (position, load))


def _fit(number: int, load: str, cfg: RecoveryPreset) -> dict[str, Any]:
    """One pad: which of its parameters its ranges hold, and R2 of presses and of places left out."""
    known, rng = known_layer(jax.random.fold_in(jax.random.key(PADS_SEED), number)), np.random.default_rng(number)
    places = rng.uniform(-HALF_EDGE_M, HALF_EDGE_M, (cfg.places, 2))
    order = rng.permutation(cfg.places * cfg.presses_of_place)
    position = jnp.float32(np.tile(places, (cfg.presses_of_place, 1))[order])
    amount = jnp.float32(rng.uniform(*LOADS[load], len(order)))
    clean = np.asarray(_read(known, position, amount, by_force=load == "force", grid=cfg.grid))
    readings = clean + NOISE_UT * rng.normal(size=clean.shape)
    data = TipReadings(position, amount, jnp.float32(readings), reskin_board())
    fitted = MagnetizationModel(TIP, load == "force", cfg.grid).fit(None, data)
    names = [name for name in (*DESIGN_PARAMETERS, "gains") if name != UNUSED[load]]
    return {
        "inside": {name: _inside(fitted.posterior, known.layer, name) for name in names},
        "converged": bool(fitted.posterior.converged),
        "r2": explained(readings, (fitted.leave_one_out**2).sum(1)),
        "r2_places": explained(readings, (fitted.leave_one_place_out**2).sum(1)),
    }


def _inside(posterior: LayerPosterior, truth: LayerParameters, name: str) -> list[bool]:
    low, high, value = (np.ravel(getattr(part, name)) for part in (posterior.low, posterior.high, truth))
    return [bool(x) for x in (low <= value) & (value <= high)]


def _summary(fits: list[dict[str, Any]]) -> dict[str, Any]:
    """Share of values inside their ranges, by parameter and of all, and mean R2."""
    inside = {name: np.concatenate([fit["inside"][name] for fit in fits]) for name in fits[0]["inside"]}
    every = np.concatenate(list(inside.values()))
    return {
        "inside": {name: [int(part.sum()), len(part)] for name, part in inside.items()},
        "inside_all": [int(every.sum()), len(every)],
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
