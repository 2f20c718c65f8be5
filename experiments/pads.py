"""Question: how well is a press located on a pad that was never seen, and how many presses of it does that take?

    python -m experiments.pads                   18 skins on 6 boards, as in ReSkin's study; about an hour on two cores
    python -m experiments.pads --skins 6         fewer skins
    python -m experiments.pads --preset debug    2 skins, too few to mean anything

ReSkin (Bhirangi et al., CoRL 2021) reports how often a press is located within 1 mm: 25 % with a network trained on one
other pad, 84 % on many, 87 % after 390 presses of the new pad whose places nobody noted. Here skins, boards and
presses are simulated (`sample_pad` with the faults and the noise of a board in order): a tip of 4.6 mm at random places
within 7 mm of the middle along x and y, 0.6-1.0 N, the force not told. Each skin is tested on presses of its own that
no method sees; networks that learn from other skins learn from those of the other boards only. The share within 1 mm is
the mean over skins with its 95 % interval (Student's t). Results go to --out: metrics.json, config.json and
accuracy.png.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Float, Key
from matplotlib.figure import Figure

from experiments.common.runs import begin, reported, write_json
from i2t import viz
from i2t.calibration import localize
from i2t.calibration.physics import Tip, fit_pad, prior, solve_map
from i2t.calibration.structured_gp import Presses
from i2t.prediction.metrics import nearest_neighbours, student_interval
from i2t.skin import faults
from i2t.skin.boards import reskin_board
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise, observe
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Pad

TIP = Tip("sphere", 2.3e-3)
REACH = 7e-3  # m, of the places
FORCES = (0.6, 1.0)  # N
LOADS = np.linspace(*FORCES, 3)  # of the atlas
NOISE = 4.0  # uT, of a reading of a pad that nothing is known of: sensor, faults and layer
LAYER = 20  # presses, at most, that the layer is fitted to


@dataclass(frozen=True)
class Study:
    """How much of everything."""

    boards: int = 6
    labelled: tuple[int, ...] = (5, 20, 100, 390)
    unlabelled: int = 390
    own: int = 1500  # presses of the pad itself that the ceiling learns from
    test: int = 400
    epochs: int = 200  # of the networks
    spacing: float = localize.SPACING  # m, of the atlas


PRESETS = {"study": Study(), "debug": Study(2, (), 10, 10, 20, 3, 3.5e-3)}


@dataclass(frozen=True)
class Args:
    """Locate presses on pads that were never seen."""

    out: Path = Path("runs/pads")
    preset: Literal["study", "debug"] = "study"
    skins: int | None = None  # 18 in the study, 2 in debug; a multiple of the boards is best
    seed: int = 0
    overwrite: bool = False


class Session(NamedTuple):
    """Presses of one skin."""

    place: Float[Array, "n 2"]  # m
    force: Float[Array, " n"]  # N
    reading: Float[Array, "n 15"]  # uT


def main(argv: Sequence[str] | None = None) -> int:
    """The command."""
    args = tyro.cli(Args, description=__doc__, args=argv)
    return reported(partial(run, args))


def run(args: Args) -> dict[str, Any]:
    """Locate on every skin, and report."""
    study = PRESETS[args.preset]
    skins = args.skins if args.skins is not None else 18 if args.preset == "study" else 2
    if skins < 2:
        raise ValueError(f"--skins {skins} leaves no other skin to learn from; 2 are needed")
    begin(args.out, args, study, None, args.overwrite)
    key = jax.random.key(args.seed)
    pads = make_skins(jax.random.fold_in(key, 0), skins, study.boards)
    # Skin i sits on board i % boards, or alone on a board of its own where there are fewer skins.
    board = np.arange(skins) % study.boards
    sessions = []
    for i, pad in enumerate(pads):
        sessions.append(session(jax.random.fold_in(key, 1 + i), pad, study.own + study.test))
        print(f"\rpressed {i + 1} of {skins} skins", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    found: dict[str, list[float]] = {}
    for i in range(skins):
        others = [j for j in range(skins) if board[j] != board[i]]
        for name, share in locate_all(jax.random.fold_in(key, 1000 + i), sessions, i, others, study).items():
            found.setdefault(name, []).append(share)
        print(f"skin {i + 1} of {skins}: " + ", ".join(f"{name} {v[-1]:.2f}" for name, v in found.items()), flush=True)
        write_json(args.out / "partial.json", found)
    metrics = {
        "source": "simulated",
        "skins": skins,
        "within_1_mm": {
            name: dict(zip(("mean", "low", "high"), interval(v), strict=True)) for name, v in found.items()
        },
        "each": found,
    }
    write_json(args.out / "metrics.json", metrics)
    (args.out / "partial.json").unlink()
    viz.save_figure(figure({name: interval(v) for name, v in found.items()}, skins), args.out / "accuracy.png")
    print(f"\nlocated within 1 mm: mean of {skins} simulated skins [95 %]")
    for name, shares in found.items():
        mean, low, high = interval(shares)
        print(f"{name:42s} {mean:.3f} [{low:.3f}, {high:.3f}]")
    return metrics


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Mean and 95 % interval over skins, within 0 and 1."""
    mean, low, high = student_interval(values)
    return mean, max(low, 0.0), min(high, 1.0)


def make_skins(key: Key[Array, ""], skins: int, boards: int) -> list[Pad]:
    """Skins, of which those on one board share its chips' gains and what lies between chips and layer."""
    key_skins, key_boards = jax.random.split(key)
    sample = jax.jit(jax.vmap(sample_pad))
    skin, board = sample(jax.random.split(key_skins, skins)), sample(jax.random.split(key_boards, boards))
    pads = []
    for i in range(skins):
        one, under = (jax.tree.map(lambda leaf, k=k: leaf[k], part) for part, k in ((skin, i), (board, i % boards)))
        gap = -under.board.chips[:, 2] - under.thickness
        chips = under.board.chips.at[:, 2].set(-(one.thickness + gap))
        pads.append(one._replace(gains=under.gains, board=under.board._replace(chips=chips)))
    return pads


@partial(jax.jit, static_argnums=2)
def session(key: Key[Array, ""], pad: Pad, n: int) -> Session:
    """n presses, as a board in order records them."""
    key_place, key_force, key_faults, key_noise = jax.random.split(key, 4)
    place = jax.random.uniform(key_place, (n, 2), minval=-REACH, maxval=REACH)
    force = jax.random.uniform(key_force, (n,), minval=FORCES[0], maxval=FORCES[1])
    ideal = jax.lax.map(lambda at: press_force(pad, TIP.height(at[0]), at[1]).reading, (place, force), batch_size=16)
    upright = jnp.broadcast_to(jnp.eye(4), (n, 4, 4))
    felt = faults.apply(key_faults, ideal, upright, pad.board, Faults.typical())
    keys = jax.random.split(key_noise, n)
    return Session(place, force, jax.vmap(lambda key, one: observe(key, one, pad.board, Noise()))(keys, felt))


def locate_all(
    key: Key[Array, ""], sessions: list[Session], skin: int, others: list[int], study: Study
) -> dict[str, float]:
    """Share of the test presses of one skin located within 1 mm, by each method."""
    everything = sessions[skin]
    own, test = (jax.tree.map(lambda part, s=s: part[s], everything) for s in _halves(study))
    pool = [jax.tree.map(lambda part: part[: study.unlabelled], sessions[j]) for j in others]
    keys = jax.random.split(key, 3)

    def right(places: Array | np.ndarray) -> float:
        return float(np.mean(np.linalg.norm(np.asarray(places) - np.asarray(test.place), axis=1) <= 1e-3))

    found = {
        "network, one other skin": right(network(keys[0], pool[0], test.reading, study.epochs)),
        "network, skins of other boards": right(
            network(
                keys[1],
                Session(*(jnp.concatenate(part) for part in zip(*pool, strict=True))),
                test.reading,
                study.epochs,
            )
        ),
    }
    middle, board = jax.tree.map(jnp.asarray, prior().middle), reskin_board()
    unpressed = localize.make_atlas(middle, board, TIP, REACH, LOADS, spacing=study.spacing)
    nothing = localize.unknown(unpressed, NOISE)
    found["physics, no press"] = right(localize.locate(unpressed, nothing, test.reading)[0])
    coarse = localize.make_atlas(middle, board, TIP, REACH, LOADS, finer=1, spacing=study.spacing)
    learnt = localize.learn(coarse, own.reading[: study.unlabelled], NOISE)
    name = f"physics, {study.unlabelled} presses without labels"
    found[name] = right(localize.locate(unpressed, learnt, test.reading)[0])

    fitted = None
    for n in (*study.labelled, study.own):
        some = jax.tree.map(lambda part, n=n: part[:n], own)
        presses = Presses(some.place, some.force)
        if fitted is None or n <= LAYER:
            fitted = fit_pad(presses, some.reading, TIP, board, True, limit=LAYER)
            atlas = localize.make_atlas(fitted.layer, board, TIP, REACH, LOADS, spacing=study.spacing)
        else:
            fitted = solve_map(fitted.layer, fitted.spread, presses, some.reading, TIP, board, True)
        weights = localize.Weights(fitted.weights, fitted.cholesky, fitted.layer.noise)
        seen = atlas._replace(phi=atlas.phi * fitted.pad.gains[None, :, None])
        found[f"physics, {n} presses"] = right(localize.locate(seen, weights, test.reading)[0])
        found[f"nearest presses, {n} presses"] = right(neighbours(some, test.reading))
    found[f"network, {study.own} presses"] = right(network(keys[2], own, test.reading, study.epochs))
    return found


def _halves(study: Study) -> tuple[slice, slice]:
    return slice(0, study.own), slice(study.own, study.own + study.test)


def neighbours(known: Session, readings: Float[Array, "n 15"]) -> np.ndarray:
    """Mean place of the k nearest known readings; k from leave-one-out."""
    x, y = np.asarray(known.reading), np.asarray(known.place)
    apart = np.linalg.norm(x[:, None] - x[None], axis=-1)
    np.fill_diagonal(apart, np.inf)
    order = np.argsort(apart, axis=1)

    def missed(k: int) -> float:
        return float(np.mean(np.linalg.norm(y[order[:, :k]].mean(axis=1) - y, axis=1) > 1e-3))

    best = min((k for k in (1, 2, 3, 5, 8) if k < len(x)), key=missed)
    return nearest_neighbours(x, y, np.asarray(readings), best)


def network(key: Key[Array, ""], known: Session, readings: Float[Array, "n 15"], epochs: int) -> Array:
    """Places (m) told by a network of two hidden layers, 15-256-256-2, trained on known presses (Adam, decayed)."""
    middle, scale = jnp.mean(known.reading, axis=0), jnp.std(known.reading, axis=0)
    x, y = (known.reading - middle[None]) / scale[None], known.place / REACH
    steps = _steps(len(x), epochs)
    trained = _train(key, x, y, steps)
    return REACH * _answer(trained, (readings - middle[None]) / scale[None])


SIZES = (15, 256, 256, 2)
BATCH = 128


def _steps(n: int, epochs: int) -> int:
    return max(1, epochs * n // BATCH)


def _answer(weights: list[tuple[Array, Array]], x: Float[Array, "n 15"]) -> Float[Array, "n 2"]:
    for matrix, offset in weights[:-1]:
        x = jax.nn.gelu(x @ matrix + offset[None])
    matrix, offset = weights[-1]
    return x @ matrix + offset[None]


@partial(jax.jit, static_argnums=3)
def _train(key: Key[Array, ""], x: Array, y: Array, steps: int) -> list[tuple[Array, Array]]:
    key_weights, key_batches = jax.random.split(key)
    keys = jax.random.split(key_weights, len(SIZES) - 1)
    start = [
        (jax.random.normal(k, (a, b)) * np.sqrt(2 / a), jnp.zeros(b))
        for k, a, b in zip(keys, SIZES[:-1], SIZES[1:], strict=True)
    ]
    optimiser = optax.adamw(optax.cosine_decay_schedule(1e-3, steps), weight_decay=1e-3)

    def step(state: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], None]:
        weights, memory = state
        rows = jax.random.randint(key, (BATCH,), 0, len(x))
        slope = jax.grad(lambda w: jnp.mean((_answer(w, x[rows]) - y[rows]) ** 2))(weights)
        change, memory = optimiser.update(slope, memory, weights)
        return (optax.apply_updates(weights, change), memory), None

    (trained, _), _ = jax.lax.scan(step, (start, optimiser.init(start)), jax.random.split(key_batches, steps))
    return trained


def figure(values: dict[str, tuple[float, float, float]], skins: int) -> Figure:
    """One bar for each method."""
    return viz.plot_intervals(values, f"Presses located within 1 mm on {skins} unseen skins", "share of presses", True)


if __name__ == "__main__":
    sys.exit(main())
