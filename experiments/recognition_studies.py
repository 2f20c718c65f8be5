"""Questions about recognition by touch beyond `experiments.recognize`, each a study of its own:

    python -m experiments.recognition_studies policy        which next touch makes one sure soonest?
    python -m experiments.recognition_studies open          is it none of the objects that are known?
    python -m experiments.recognition_studies pad           how many presses does a pad need that was never felt?
    python -m experiments.recognition_studies sensitivity   what do errors of pose, noise and harder presses do?
    python -m experiments.recognition_studies many          10, 25 and 50 objects, the meshes of a folder among them
    python -m experiments.recognition_studies policy --preset debug      a handful of sittings, to see it run

Each takes a finished run of `experiments.train` (--run, or a study's folder of several pads and seeds) and uses the
catalogue's test objects and the worlds of `experiments.recognize`; what was fixed before testing is in
docs/recognition.md. Everything is simulated. Results go to --out: metrics.json, config.json, figures.
"""

import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array
from tqdm import tqdm

from experiments import plots
from experiments import recognition_figures as drawing
from experiments import recognition_scores as scores
from experiments.recognition import (
    Learnt,
    Pool,
    Setting,
    Sitting,
    beliefs,
    learn,
    learn_on_pad,
    pool,
    random_sites,
    surfaces_of,
    tabulate,
)
from experiments.recognition_scores import plain
from experiments.recognize import PRESETS, Recognition, finished_runs, taught, trained, training_rows
from experiments.runs import begin, reported, write_json
from i2t import belief, ensemble, objects, outcomes, policy
from i2t.arrays import element
from i2t.belief import Belief, Likelihood, Measured, Particles
from i2t.boards import reskin
from i2t.calibrate.physics import Tip, fit_pad
from i2t.calibrate.structured import Presses
from i2t.outcomes import Outcome
from i2t.skin.contact import GRID
from i2t.skin.noise import Noise, observe
from i2t.skin.pad import press_force, sample_pad
from i2t.types import Pad, Surface
from i2t.world import Errors

Study = Literal["policy", "open", "pad", "sensitivity", "many"]
CANDIDATES = 48  # sites that the next touch is chosen among, drawn anew for each


@dataclass(frozen=True)
class Args:
    """Study recognition by touch."""

    study: tyro.conf.Positional[Study]
    out: Path | None = None  # folder for everything that is made; runs/STUDY unless given
    run: Path = Path("runs/train")  # a finished run of experiments.train, or a study's folder of several
    preset: Literal["paper", "debug"] = "paper"
    sittings: int = 20  # of each object and setting, for each pad and seed
    meshes: Path | None = None  # a folder of STL files in metres that join the objects of `many`
    seed: int = 0
    overwrite: bool = False


class Lab(NamedTuple):
    """One pad and seed: what was learnt, and the objects to tell apart."""

    cfg: Recognition
    pad: Pad
    learnt: Learnt
    names: tuple[str, ...]
    surfaces: list[Surface]
    sittings: int
    seed: int
    key: Array
    args: Args
    training: Callable[[Pad, Array], Learnt]  # learns another pad from the same objects


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Args, args=argv, description=__doc__, prog="python -m experiments.recognition_studies")
    return reported(partial(run, args))


def run(args: Args) -> dict[str, Any]:
    """A study on every pad and seed, pooled."""
    out = args.out or Path("runs") / args.study
    begin(out, args, PRESETS[args.preset], None, args.overwrite)
    parts = []
    for i, folder in enumerate(finished_runs(args.run)):
        parts.append(STUDIES[args.study][0](prepare_lab(args, folder, args.seed + i)))
    result = {"source": "simulated", "seeds": len(parts), **STUDIES[args.study][1](parts, out)}
    write_json(out / "metrics.json", result)
    print(f"\nresults and figures are in {out}")
    return result


def prepare_lab(args: Args, folder: Path, seed: int) -> Lab:
    """What all studies of a pad and seed share."""
    cfg = PRESETS[args.preset]
    dataset, _, pad = trained(folder)
    key_learn, key = jax.random.split(jax.random.key(100 + seed))
    known = taught(dataset)
    learnt = learn(key_learn, dataset, training_rows(dataset, folder), known, cfg.errors, cfg.limits)
    names = cfg.primitives + cfg.tools
    train = [
        name
        for i, name in enumerate(dataset.objects)
        if training_rows(dataset, folder)[dataset.touches.object == i].any()
    ]
    taught_on = [known[name] for name in train]

    def training(other: Pad, key: Array) -> Learnt:
        return learn_on_pad(key, other, taught_on, 100 if args.preset == "debug" else 900, cfg.limits, learnt)

    surfaces = surfaces_of([objects.make(name).mesh for name in names])
    sittings = 2 if args.preset == "debug" else args.sittings
    return Lab(cfg, pad, learnt, names, surfaces, sittings, seed, key, args, training)


def placements_of(lab: Lab, errors: Errors | None = None) -> Particles:
    """Places of an object under the errors of placement."""
    errors = errors or lab.cfg.errors
    return belief.particles(outcomes.prior_spread(errors.placement, errors.placement_angle), lab.cfg.places, lab.seed)


def imagine(lab: Lab, sites: Pool, places: Particles, skins: Sequence[outcomes.SkinMap], what: str) -> list[Outcome]:
    """Outcomes on the lab's objects, with a bar."""
    total = len(lab.surfaces) * len(sites.owner) * len(places.twist)
    with tqdm(total=total, desc=f"{what}: imagining", unit="touch", unit_scale=True) as bar:
        return tabulate(lab.surfaces, places.twist, sites.T_w_t, skins, lab.cfg.limits.past_goal, bar.update)


def sit(lab: Lab, key: Array, sites: Pool, truth: np.ndarray, chosen: np.ndarray, what: str, **world: Any) -> Sitting:
    """Simulated sittings at sites chosen beforehand, with a bar; `world` replaces parts of the lab's."""
    setting = Setting(lab.cfg.errors, lab.cfg.limits, chosen.shape[1])
    surfaces = world.pop("surfaces", lab.surfaces)
    pad = world.pop("pad", lab.pad)
    sitting = Sitting(key, surfaces, truth, sites, pad, replace(setting, **world))
    with tqdm(total=chosen.size, desc=f"{what}: touching", unit="touch") as bar:
        sitting.touch(chosen, bar.update)
    return sitting


# --- policy: which next touch ---

POLICIES = ("random", "heuristic", "information")


def play_policies(lab: Lab) -> dict[str, Any]:
    """The same sittings under each policy."""
    key_pool, key_play, key_choice = jax.random.split(lab.key, 3)
    sites = pool(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.skin], "policy")
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    found = {"truth": truth}
    for name in POLICIES:
        found[name] = play_policy(lab, name, key_play, key_choice, sites, places, jax.device_put(table), truth)
    return found


def play_policy(
    lab: Lab, name: str, key: Array, key_choice: Array, sites: Pool, places: Particles, table: Outcome,
    truth: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Beliefs (e, t, objects) of sittings whose next touch a policy chooses."""
    sitting = Sitting(
        key, lab.surfaces, truth, sites, lab.pad, Setting(lab.cfg.errors, lab.cfg.limits, lab.cfg.touches)
    )
    begun = belief.begin(places, len(lab.surfaces))
    now = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(truth), *x.shape)), begun)
    spent = np.zeros((len(truth), len(sites.owner)), bool)
    after = []
    telling = telling_weights(sites)
    for step in tqdm(range(lab.cfg.touches), desc=f"policy {name}", unit="touch"):
        keys = jax.random.split(jax.random.fold_in(key_choice, step), len(truth))
        if name == "information":
            site = next_touches(keys, now, table, lab.learnt.like, jnp.asarray(spent), lab.cfg.limits.skin_change)
        elif name == "heuristic":
            site = heuristic_touches(keys, now, telling, jnp.asarray(spent), step)
        else:
            site = jax.vmap(lambda k, s: jax.random.categorical(k, jnp.where(s, -jnp.inf, 0.0)))(
                keys, jnp.asarray(spent)
            )
        site = np.asarray(site)
        spent[np.arange(len(truth)), site] = True
        measured = sitting.touch(site[:, None])
        last = jax.tree.map(lambda x: x[:, -1], measured)
        now, p = advance(now, jnp.asarray(site), last, table, lab.learnt.like)
        after.append(np.asarray(p))
    return np.stack(after, axis=1)


@jax.jit
def advance(now: Belief, site: Array, measured: Measured, table: Outcome, like: Likelihood) -> tuple[Belief, Array]:
    """All sittings one touch further."""

    def one(at: tuple[Belief, Array, Measured]) -> tuple[Belief, Array]:
        updated = belief.update(at[0], at[2], element(table, at[1]), like)
        return updated, belief.posterior(updated)[0]

    return jax.lax.map(one, (now, site, measured), batch_size=8)


@jax.jit
def next_touches(keys: Array, now: Belief, table: Outcome, like: Likelihood, spent: Array, skin_change: float) -> Array:
    """The site that is expected to tell most, of some drawn anew for each sitting."""
    sites = spent.shape[1]

    def one(at: tuple[Array, Belief, Array]) -> Array:
        key_some, key_gain = jax.random.split(at[0])
        some = jax.random.permutation(key_some, sites)[: min(CANDIDATES, sites)]
        gain = policy.gains(key_gain, at[1], element(table, some), like, skin_change)
        return some[policy.choose(gain, ~at[2][some])]

    return jax.lax.map(one, (keys, now, spent))


def telling_weights(sites: Pool) -> Array:
    """The heuristic's probability of each object's own sites, (objects, sites)."""
    objects_count = int(sites.owner.max()) + 1
    T = sites.T_w_t.reshape(objects_count, -1, 4, 4)
    own = jax.vmap(lambda o: ensemble.telling(T[..., :3, 3], -T[..., :3, 2], jnp.ones(T.shape[:2], bool), o))(
        jnp.arange(objects_count)
    )
    return jnp.stack(
        [jnp.zeros(len(sites.owner)).at[jnp.asarray(sites.owner == o)].set(own[o]) for o in range(len(own))]
    )


@jax.jit
def heuristic_touches(keys: Array, now: Belief, telling: Array, spent: Array, step: int) -> Array:
    """The paper's: a telling site of the object believed in."""

    def one(key: Array, now: Belief, spent: Array) -> Array:
        key_object, key_site = jax.random.split(key)
        which = ensemble.hypothesis(key_object, belief.posterior(now)[0], step)
        weight = jnp.where(spent, 0.0, telling[which])
        left = jnp.where(jnp.sum(weight) > 0, weight, jnp.where(spent, 0.0, 1.0))
        return jax.random.categorical(key_site, jnp.log(left))

    return jax.vmap(one)(keys, now, spent)


def report_policies(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy and touches until sure under each policy, and what choosing by information saves."""
    truth = np.concatenate([part["truth"] for part in parts])
    p = {name: np.concatenate([part[name] for part in parts]).astype(np.float64) for name in POLICIES}
    touches = next(iter(p.values())).shape[1]
    first = {name: scores.sure_at(each) for name, each in p.items()}
    result: dict[str, Any] = {"sittings": len(truth), "policies": {}, "saved": {}}
    for name, each in p.items():
        result["policies"][name] = {
            "accuracy": plain(scores.accuracy(each, truth)),
            "mean": plain(scores.mean_accuracy(each, truth)),
            "until_95": plain(scores.until(first[name], touches)),
        }
        until = scores.until(first[name], touches)
        print(f"{name:12} {shown(scores.mean_accuracy(each, truth))} mean accuracy, {shown(until.mean)} touches until "
              f"95 % sure (restricted to {touches}), never {float(until.never.mean):.2f}")  # fmt: skip
    for other in ("random", "heuristic"):
        saved = scores.saved(first["information"], first[other], touches)
        result["saved"][other] = plain(saved)
        print(f"information needs {shown(saved)} fewer touches than {other}")
    unsure = {name: scores.unsure(values, touches) for name, values in first.items()}
    plots.save(drawing.until_sure(unsure, "Touches until 95 % sure", True), out / "until_sure.png")
    curves = {name: scores.accuracy(each, truth) for name, each in p.items()}
    plots.save(drawing.accuracy(curves, "Accuracy of each policy", True), out / "accuracy.png")
    return result


def shown(estimate: scores.Estimate) -> str:
    """A mean with its interval."""
    return f"{float(estimate.mean):.3f} [{float(estimate.low):.3f}, {float(estimate.high):.3f}]"


# --- open: none of these ---

STRANGERS = ("hexagon", "parallelogram", "flower", "cross", "spanner", "pliers", "marker", "scissors")
DECOYS = 24  # random objects whose touches stand for all that is not known
DECOY_PLACES = 4


def play_open(lab: Lab) -> dict[str, Any]:
    """Sittings with the known objects and as many with others of the same families."""
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    known = len(lab.surfaces)
    decoys = 2 if lab.args.preset == "debug" else DECOYS
    meshes = [objects.make(name).mesh for name in lab.names + STRANGERS]
    meshes += [objects.random_object(1000 * lab.seed + i).mesh for i in range(decoys)]
    surfaces = surfaces_of(meshes)
    lab = lab._replace(surfaces=surfaces[:known])
    sites = pool(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    places = placements_of(lab)
    (table,) = imagine(lab, sites, places, [lab.learnt.skin], "open")
    others = lab._replace(surfaces=surfaces[known + len(STRANGERS) :])
    few = belief.particles(
        outcomes.prior_spread(lab.cfg.errors.placement, lab.cfg.errors.placement_angle), DECOY_PLACES, lab.seed
    )
    (background,) = imagine(others, sites, few, [lab.learnt.skin], "none of these")
    background = jax.tree.map(lambda x: x.reshape(len(x), -1, *x.shape[3:]), background)
    rng = np.random.default_rng(lab.seed)
    truth = np.repeat(np.arange(known), lab.sittings)
    strange = rng.integers(known, known + len(STRANGERS), len(truth))
    everything = np.concatenate([truth, strange])
    chosen = random_sites(key_site, sites, len(everything), lab.cfg.touches)
    sitting = sit(
        lab, key_play, sites, everything, chosen, "open", surfaces=surfaces[: known + len(STRANGERS)]
    ).episodes()
    p, none = beliefs(
        jax.device_put(table), jnp.asarray(chosen), sitting.measured, lab.learnt.like, places,
        jax.device_put(background), unknown=0.5,
    )  # fmt: skip
    return {"truth": np.where(everything < known, everything, -1), "p": np.asarray(p), "none": np.asarray(none)}


def report_open(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """How well strangers are told from known objects."""
    truth, p, none = (np.concatenate([part[key] for part in parts]) for key in ("truth", "p", "none"))
    p, none = p.astype(np.float64), none.astype(np.float64)
    area = scores.auroc(none, truth < 0)
    result: dict[str, Any] = {"sittings": len(truth), "auroc": plain(area), "shares": {}}
    print("AUROC after each touch: " + " ".join(f"{x:.2f}" for x in area.mean))
    for share in (0.01, 0.25, 0.5):
        found = scores.open_set(p, none, truth, share, prior=0.5)
        result["shares"][str(share)] = plain(found)
        print(
            f"{share:.0%} unknown: right of known {found.known.mean[-1]:.3f}, of unknown {found.unknown.mean[-1]:.3f}"
        )
    sure, right = none[:, -1], truth < 0
    result["calibration_of_none"] = plain(scores.calibration_error(np.maximum(sure, 1 - sure), (sure > 0.5) == right))
    plots.save(drawing.accuracy({"AUROC of none of these": area}, "Telling strangers", True), out / "auroc.png")
    return result


# --- pad: one that was never felt ---

PRESSES = (5, 20, 100)
BALL = Tip("sphere", 4e-3)


def play_pad(lab: Lab) -> dict[str, Any]:
    """The same sittings with a pad that was never felt, which is known better and better."""
    key_pool, key_play, key_site, key_fit = jax.random.split(lab.key, 4)
    other = sample_pad(jax.random.key(5000 + lab.seed))
    learnt = {"another pad's": lab.learnt}
    for n in PRESSES if lab.args.preset == "paper" else PRESSES[:1]:
        fitted = press_and_fit(key_fit, other, n)
        learnt[f"{n} presses"] = lab.training(fitted, key_fit)
    learnt["the pad itself"] = lab.training(other, key_fit)
    sites = pool(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    places = placements_of(lab)
    tables = imagine(lab, sites, places, [each.skin for each in learnt.values()], "new pad")
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    chosen = random_sites(key_site, sites, len(truth), lab.cfg.touches)
    episodes = sit(lab, key_play, sites, truth, chosen, "new pad", pad=other).episodes()
    found: dict[str, Any] = {"truth": truth}
    for (name, each), table in zip(learnt.items(), tables, strict=True):
        for evidence, spatial in (("fused", 1.0), ("tactile only", 0.0)):
            like = each.like._replace(spatial=jnp.float32(spatial))
            p, _ = beliefs(jax.device_put(table), jnp.asarray(chosen), episodes.measured, like, places)
            found[f"{evidence}, {name}"] = np.asarray(p)
    position = lab.learnt.like._replace(tactile=jnp.float32(0.0))
    found["position only"] = np.asarray(
        beliefs(jax.device_put(tables[0]), jnp.asarray(chosen), episodes.measured, position, places)[0]
    )
    return found


def press_and_fit(key: Array, pad: Pad, n: int) -> Pad:
    """Press a pad n times with a known ball, and fit one to what it reads (`i2t.calibrate.physics`)."""
    key_place, key_force, key_noise = jax.random.split(key, 3)
    place = jax.random.uniform(key_place, (n, 2), minval=-8e-3, maxval=8e-3)
    force = jax.random.uniform(key_force, (n,), minval=0.2, maxval=1.0)
    clean = jax.lax.map(lambda at: press_force(pad, BALL.height(at[0], GRID), at[1]).reading, (place, force))
    readings = jax.vmap(lambda k, r: observe(k, r, pad.board, Noise()))(jax.random.split(key_noise, n), clean)
    presses = Presses(place, force + 0.02 * jax.random.normal(key_noise, (n,)))
    return fit_pad(presses, readings, BALL, reskin(), by_force=True).pad


def report_methods(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy of every method on the same sittings."""
    truth = np.concatenate([part["truth"] for part in parts])
    result: dict[str, Any] = {"sittings": len(truth), "methods": {}}
    curves = {}
    for name in parts[0]:
        if name == "truth":
            continue
        p = np.concatenate([part[name] for part in parts]).astype(np.float64)
        curves[name] = scores.accuracy(p, truth)
        result["methods"][name] = {
            "accuracy": plain(curves[name]), "mean": plain(scores.mean_accuracy(p, truth)),
            "log_loss": scores.log_loss(p, truth).mean(0).tolist(),
        }  # fmt: skip
        last = scores.Estimate(*(x[-1] for x in curves[name]))
        print(f"{name:34} after {p.shape[1]}: {shown(last)}   mean: {shown(scores.mean_accuracy(p, truth))}")
    plots.save(drawing.accuracy(curves, "Accuracy", True), out / "accuracy.png")
    return result


# --- sensitivity ---


def play_sensitivity(lab: Lab) -> dict[str, Any]:
    """The same sittings in other worlds, each known to the belief."""
    base = lab.cfg.errors
    worlds: dict[str, tuple[Errors, float]] = {
        "as it is": (base, 25.0),
        "placement 0.3 mm, 0.3 deg": (replace(base, placement=0.3e-3, placement_angle=np.radians(0.3)), 25.0),
        "placement 2 mm, 2 deg": (replace(base, placement=2e-3, placement_angle=np.radians(2.0)), 25.0),
        "tilt 1 deg": (replace(base, approach_angle=np.radians(1.0)), 25.0),
        "noise x 3": (replace(base, noise=base.noise.scaled(3.0)), 25.0),
        "stop at 50 uT": (base, 50.0),
        "stop at 100 uT": (base, 100.0),
        "no errors of pose": (base.scaled(0.0), 25.0),
        "no noise, no faults": (replace(Errors.none(), placement=base.placement, placement_angle=base.placement_angle,
                                        repeatability=base.repeatability, approach_angle=base.approach_angle,
                                        slant=base.slant), 25.0),
    }  # fmt: skip
    if lab.args.preset == "debug":
        worlds = dict(list(worlds.items())[:2])
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    sites = pool(key_pool, lab.surfaces, lab.names, lab.cfg.sites, lab.cfg.reach)
    truth = np.repeat(np.arange(len(lab.surfaces)), lab.sittings)
    chosen = random_sites(key_site, sites, len(truth), lab.cfg.touches)
    tables: dict[tuple[float, float], tuple[Particles, Outcome]] = {}
    found: dict[str, Any] = {"truth": truth}
    for name, (errors, stop) in worlds.items():
        spread = (max(errors.placement, 0.02e-3), max(errors.placement_angle, np.radians(0.02)))
        if spread not in tables:
            places = belief.particles(outcomes.prior_spread(*spread), lab.cfg.places, lab.seed)
            tables[spread] = (places, imagine(lab, sites, places, [lab.learnt.skin], name)[0])
        places, table = tables[spread]
        limits = replace(lab.cfg.limits, skin_change=stop)
        episodes = sit(lab, key_play, sites, truth, chosen, name, errors=errors, limits=limits).episodes()
        like = lab.learnt.like
        wider = errors.noise.xy / base.noise.xy if errors.noise.xy > base.noise.xy else 1.0
        for evidence, spatial in (("fused", 1.0), ("tactile only", 0.0)):
            used = like._replace(spatial=jnp.float32(spatial), inflation=like.inflation * jnp.float32(wider))
            p, _ = beliefs(jax.device_put(table), jnp.asarray(chosen), episodes.measured, used, places)
            found[f"{evidence}, {name}"] = np.asarray(p)
    return found


# --- many objects ---

COUNTS = (10, 25, 50)
MANY_TOUCHES, MANY_SITES, MANY_PLACES, MANY_SITTINGS = 20, 8, 64, 100


def play_many(lab: Lab) -> dict[str, Any]:
    """Sittings with the first 10, 25 and 50 of a list of objects: the catalogue's, the folder's, and random ones."""
    small = lab.args.preset == "debug"
    counts = (3,) if small else COUNTS
    touches, places_count = (3, 8) if small else (MANY_TOUCHES, MANY_PLACES)
    trained_on = ("hexagon", "parallelogram")
    meshes = {name: objects.make(name).mesh for name in lab.names}
    for path in sorted(lab.args.meshes.glob("*.stl")) if lab.args.meshes else ():
        meshes[path.stem] = objects.load(path, "m")[0].mesh
    for name in objects.PRIMITIVES + objects.TOOLS:
        if name not in trained_on:
            meshes.setdefault(name, objects.make(name).mesh)
    for i in range(max(counts)):
        meshes[f"random {i}"] = objects.random_object(7000 + i).mesh
    found: dict[str, Any] = {}
    key_pool, key_play, key_site = jax.random.split(lab.key, 3)
    order = np.random.default_rng(0).permutation(list(meshes)[: max(counts)] if not small else list(meshes)[:3])
    cfg = replace(lab.cfg, touches=touches, sites=2 if small else MANY_SITES, places=places_count)
    for count in counts:
        names = tuple(str(name) for name in order[:count])
        some = lab._replace(names=names, surfaces=surfaces_of([meshes[name] for name in names]), cfg=cfg)
        sites = pool(key_pool, some.surfaces, names, cfg.sites, cfg.reach)
        places = placements_of(some)
        (table,) = imagine(some, sites, places, [lab.learnt.skin], f"{count} objects")
        truth = np.resize(np.arange(count), 4 if small else max(MANY_SITTINGS, count))
        chosen = random_sites(key_site, sites, len(truth), touches)
        episodes = sit(some, key_play, sites, truth, chosen, f"{count} objects").episodes()
        p, _ = beliefs(jax.device_put(table), jnp.asarray(chosen), episodes.measured, lab.learnt.like, places)
        found[f"{count} objects"] = (np.asarray(p), truth)
    return found


def report_many(parts: Sequence[dict[str, Any]], out: Path) -> dict[str, Any]:
    """Accuracy against touches for each number of objects."""
    result: dict[str, Any] = {}
    curves = {}
    for name in parts[0]:
        p = np.concatenate([part[name][0] for part in parts]).astype(np.float64)
        truth = np.concatenate([part[name][1] for part in parts])
        curves[name] = scores.accuracy(p, truth)
        result[name] = {"sittings": len(truth), "accuracy": plain(curves[name])}
        print(f"{name:12} " + " ".join(f"{t + 1}: {curves[name].mean[t]:.2f}" for t in range(0, p.shape[1], 3)))
    plots.save(drawing.accuracy(curves, "Accuracy with more objects", True), out / "accuracy.png")
    return result


STUDIES: dict[str, tuple[Callable[[Lab], Any], Callable[[Sequence[Any], Path], dict[str, Any]]]] = {
    "policy": (play_policies, report_policies),
    "open": (play_open, report_open),
    "pad": (play_pad, report_methods),
    "sensitivity": (play_sensitivity, report_methods),
    "many": (play_many, report_many),
}


if __name__ == "__main__":
    sys.exit(main())
