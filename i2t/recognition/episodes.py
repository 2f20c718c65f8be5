"""What the recognition experiment is made of: pads learnt from touches, sites, imagined outcomes, simulated episodes.

An episode is one sitting: an object is put down near where it is believed, and touched a number of times at safe sites
of what it might be. Sites come from a pool, so that what every possible object would feel like there, in each of its
possible places, is imagined once (`tabulate`) and serves all episodes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key
from tqdm import tqdm

from experiments.train.methods import condition
from i2t.dataset import Dataset
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.prediction import gp
from i2t.prediction.gp import ContactPressure
from i2t.prediction.predictor import Predictor, predict_pressures
from i2t.prediction.pressure import PressureModelConfig
from i2t.recognition import belief, ensemble, outcomes
from i2t.recognition.belief import Likelihood, TouchObservation, Particles
from i2t.recognition.outcomes import CELLS, PredictedTouch, LinearReadingModel
from i2t.registration import touch as register
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_heights, stack_surfaces
from i2t.simulation import sites as touch_sites
from i2t.simulation import touches as simulation
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import Errors, RunErrors
from i2t.types import PATCH_PIXELS, REACH, WIDE_PIXELS, WIDE_WINDOW, Pad, ReturnCode, Surface, Touches, Truth

MILLI = 1e-3
BATCH = 512  # imagined touches at a time
TOUCHES = 40  # simulated touches at a time
ROW = 36  # touches of a run that are registered together
# Weights of readings and of positions.
EVIDENCE = {"tactile only": (1.0, 0.0), "position only": (0.0, 1.0), "fused": (1.0, 1.0)}


class Learnt(NamedTuple):
    """A pad as touches on known objects taught it."""

    skin: LinearReadingModel
    like: Likelihood
    std: np.ndarray  # (15,) uT, of its readings
    r2: float  # of touches left out
    errors: np.ndarray  # (n, 15) uT, of the touches left out


def learn(
    key: Key[Array, ""],
    dataset: Dataset,
    rows: np.ndarray,
    surfaces: dict[str, Surface],
    errors: Errors,
    limits: PressLimits,
) -> Learnt:
    """Learn a pad from the touches in `rows` on objects whose surfaces are known by name.

    Each run's object is registered by its own contacts first: what the skin met is then known ten times better than
    from what the camera saw.
    """
    touches = dataset.touches
    pressure = np.zeros((len(dataset), CELLS.cells**2), np.float32)
    sunk = np.full(len(dataset), np.nan)
    for run in np.unique(touches.run[rows]):
        here = np.flatnonzero(rows & (touches.run == run))
        surface = surfaces[dataset.objects[int(touches.object[here[0]])]]
        padded = np.resize(here, max(ROW, len(here)))
        some = jax.tree.map(lambda x, padded=padded: jnp.asarray(x[padded]), touches)
        T_w_contact, met = register.contact_poses(some)
        met = met & (np.arange(len(padded)) < len(here))
        T_w_o = some.T_w_o[0]
        found = _place(
            jax.random.fold_in(key, int(run)), surface, T_w_o, T_w_contact, met,
            errors.placement, errors.placement_angle,
        )  # fmt: skip
        T_o_t = jnp.linalg.inv(found.T_w_o)[None] @ T_w_contact
        deep, newtons = _press(surface, T_o_t, some.force)
        pressure[here], sunk[here] = newtons[: len(here), 0], deep[: len(here), 0]
    used = np.flatnonzero(rows & np.isfinite(sunk))
    load = np.maximum(touches.force[used], outcomes.SMALLEST)
    told = ContactPressure(jnp.asarray(pressure[used].reshape(-1, CELLS.cells, CELLS.cells)), jnp.asarray(load))
    readings = jnp.asarray(touches.reading[used])
    depth = touches.depth[used] - load / limits.stiffness
    softness = float(np.sum(sunk[used] * depth) / np.sum(sunk[used] ** 2))
    position = float(np.std(depth - softness * sunk[used]))
    return _learnt(told, readings, readings, touches.run[used], softness, position, limits)


_place = jax.jit(register.register_by_touch)


@jax.jit
def _press(surface: Surface, T_o_t: Array, force: Array) -> tuple[Array, Array]:
    return jax.vmap(lambda T, f: outcomes.contact_pressures(surface, T, f[None]))(T_o_t, force)


def learn_oracle(dataset: Dataset, rows: np.ndarray, learnt: Learnt, limits: PressLimits) -> Learnt:
    """What could be learnt from the same simulated touches if pose and reading had no error: a bound, not a method."""
    used = np.flatnonzero(rows)
    touches = jax.tree.map(lambda x: x[used], dataset.touches)
    softness, position = float(learnt.skin.softness), float(learnt.like.position_std)
    readings, ideal = jnp.asarray(touches.reading), jnp.asarray(touches.truth.reading)
    return _learnt(_really_met(touches.truth), ideal, readings, touches.run, softness, position, limits)


def learn_on_pad(
    key: Key[Array, ""], pad: Pad, surfaces: Sequence[Surface], touches: int, limits: PressLimits, felt: Learnt
) -> Learnt:
    """What a known pad, say one fitted to a few presses, would teach: simulated touches of it, without any error, on
    some objects. How far predictions are off, but for what the process itself is unsure of, is taken from a pad that
    was `felt`.
    """
    ideal = replace(Errors.none(), slant=Errors.slant)
    made = simulation.simulate(key, surfaces, pad, ideal, touches // len(surfaces), limits=limits)
    assert made.truth is not None
    process = condition(_really_met(made.truth), made.reading, np.asarray(made.run), seed=0)
    skin, position = outcomes.linear_reading_model(process, float(felt.skin.softness)), float(felt.like.position_std)
    like = belief.fit_likelihood(felt.errors, process.scale, skin.loads, limits.past_goal, position, limits.stiffness)
    return felt._replace(skin=skin, like=like, r2=float("nan"))


def _really_met(truth: Truth) -> ContactPressure:
    """Pressures of simulated touches whose contacts are known exactly."""
    exact = PressureModelConfig(pitch=WIDE_WINDOW / WIDE_PIXELS, smooth=False, tilt=0.0, cell=CELLS.spacing)
    return predict_pressures(exact, truth.wide, truth.force, truth.indentation)


def _learnt(
    told: ContactPressure, readings: Array, recorded: Array, runs: np.ndarray, softness: float, position: float,
    limits: PressLimits,
) -> Learnt:  # fmt: skip
    """Learn `readings`; how far off a prediction of those `recorded` is comes from touches left out."""
    process = condition(told, readings, runs, seed=0)
    left = gp.leave_one_out_errors(process) + np.asarray(recorded - readings)
    skin = outcomes.linear_reading_model(process, softness)
    like = belief.fit_likelihood(left, process.scale, skin.loads, limits.past_goal, position, limits.stiffness)
    around = np.asarray(recorded) - np.mean(np.asarray(recorded), axis=0)
    return Learnt(skin, like, around.std(axis=0), float(1 - np.sum(left**2) / np.sum(around**2)), left)


class Pool(NamedTuple):
    """Safe sites of all objects, each as many."""

    T_w_t: Float[Array, "sites 4 4"]
    owner: Int[np.ndarray, " sites"]


def pool(
    key: Key[Array, ""], surfaces: Sequence[Surface], names: Sequence[str], each: int, limits: touch_sites.Limits
) -> Pool:
    """`each` random safe sites of every object, all objects standing at the world's origin."""
    found = [
        touch_sites.collect_sites(jax.random.fold_in(key, i), surface, each, limits, name)
        for i, (surface, name) in enumerate(zip(surfaces, names, strict=True))
    ]
    return Pool(jnp.concatenate(found), np.repeat(np.arange(len(surfaces)), each))


def tabulate(
    surfaces: Sequence[Surface],
    twist: Float[Array, "k 6"],
    T_w_site: Float[Array, "sites 4 4"],
    skins: Sequence[LinearReadingModel],
    past: float,
    what: str,
) -> list[PredictedTouch]:
    """What every object in every place would feel like at every site, for each of some pads that share their loads:
    an `Outcome` of (sites, objects, k) each. A bar says what for.
    """
    count = len(twist)
    each = max(BATCH // count, 1)
    padded = jnp.asarray(np.resize(np.asarray(T_w_site), (-(-len(T_w_site) // each) * each, 4, 4)))
    columns = []
    total = len(surfaces) * len(padded) * count
    with tqdm(total=total, desc=f"{what}: imagining", unit="touch", unit_scale=True) as bar:
        for surface in surfaces:
            parts = []
            for start in range(0, len(padded), each):
                some = padded[start : start + each]
                parts.append(jax.device_get(_imagine(surface, twist, some, list(skins), past)))
                bar.update(each * count)
            columns.append(jax.tree.map(lambda *x: np.concatenate(x)[: len(T_w_site)], *parts))
    return jax.tree.map(lambda *x: np.stack(x, axis=1), *columns)


@partial(jax.jit, static_argnames=("past",))
def _imagine(surface: Surface, twist: Array, T_w_site: Array, skins: list[LinearReadingModel], past: float) -> list[PredictedTouch]:
    def one(T: Array, x: Array) -> list[PredictedTouch]:
        met = outcomes.predict_contact(surface, jnp.eye(4), x, T, skins[0].loads, past)
        return [outcomes.predict_reading(met, skin) for skin in skins]

    return jax.vmap(lambda T: jax.vmap(lambda x: one(T, x))(twist))(T_w_site)


@dataclass(frozen=True)
class Setting:
    """The world in which episodes are simulated."""

    errors: Errors
    limits: PressLimits
    touches: int

    @property
    def of_touches(self) -> Errors:
        """Without those that a run has drawn already: worlds that differ in these alone share what is compiled."""
        return replace(self.errors, placement=0.0, placement_angle=0.0, hand_eye=0.0, hand_eye_angle=0.0)


class Episodes(NamedTuple):
    """Episodes as they went: e of them, t touches each."""

    truth: Int[np.ndarray, " e"]  # the object that was there
    site: Int[np.ndarray, "e t"]
    measured: TouchObservation  # (e, t)
    T_w_t: Float[np.ndarray, "e t 4 4"]  # where the presses ended


class Sitting:
    """Simulated episodes that go on touch by touch, so that sites may be chosen by what was felt."""

    def __init__(
        self,
        key: Key[Array, ""],
        surfaces: Sequence[Surface],
        truth: np.ndarray,
        sites: Pool,
        pad: Pad,
        setting: Setting,
    ) -> None:
        key_runs, self.key_touch, key_feel = jax.random.split(key, 3)
        self.drawn = np.asarray(jax.random.key_data(jax.random.split(key_feel, len(truth))))  # the same at every touch
        self.surfaces, self.truth, self.sites, self.pad, self.setting = surfaces, truth, sites, pad, setting
        self.runs = _runs(key_runs, len(truth), setting.errors)
        self.touches: list[Touches] = []
        self.chosen: list[np.ndarray] = []

    def touch(self, site: Int[np.ndarray, "e n"], bar: tqdm | None = None) -> None:
        """The next n touches of every episode at these sites of the pool."""
        made_before, n = len(self.touches), site.shape[1]
        keys = jax.vmap(lambda i: jax.random.split(jax.random.fold_in(self.key_touch, i), len(self.truth)), out_axes=1)(
            made_before + jnp.arange(n)
        ).reshape(-1)
        drawn = np.asarray(jax.random.key_data(keys))  # rows of it fill up batches more than once
        episode, where = np.repeat(np.arange(len(self.truth)), n), site.reshape(-1)
        done: list[tuple[np.ndarray, Touches]] = []
        for which, surface in enumerate(self.surfaces):
            rows = np.flatnonzero(self.truth[episode] == which)
            for start in range(0, len(rows), TOUCHES):
                some = rows[start : start + TOUCHES]
                full = np.resize(some, TOUCHES)
                made = _touch_many(
                    drawn[full], surface, self.sites.T_w_t[where[full]], element(self.runs, episode[full]), self.pad,
                    errors=self.setting.of_touches, limits=self.setting.limits,
                )  # fmt: skip
                kept = slice(len(some))
                done.append((some, jax.tree.map(lambda x, kept=kept: np.asarray(x[kept]), jax.device_get(made))))
                if bar is not None:
                    bar.update(len(some))
        order = np.argsort(np.concatenate([rows for rows, _ in done]))
        made = jax.tree.map(lambda *x: np.concatenate(x)[order], *[part for _, part in done])
        made = jax.tree.map(lambda x: x.reshape(len(self.truth), n, *x.shape[1:]), made)
        self.touches += [jax.tree.map(lambda x, i=i: x[:, i], made) for i in range(n)]
        self.chosen += list(np.asarray(site).T)

    def measured(self) -> TouchObservation:
        """All touches so far, (e, t); a sensor's faults depend on the touches before."""
        # Touches to come are there as nothing, so that adding them changes no draw of those made.
        made = jax.tree.map(lambda *x: np.stack(x, axis=1), *self.touches)
        missing = self.setting.touches - len(self.touches)
        full = jax.tree.map(lambda x: np.concatenate([x, np.repeat(np.zeros_like(x[:, :1]), missing, 1)], 1), made)
        reading = np.asarray(_feel(self.drawn, full, self.pad, self.setting.of_touches))[:, : len(self.touches)]
        T_w_site = np.asarray(self.sites.T_w_t)[np.stack(self.chosen, 1)]
        apart = made.T_w_t[..., :3, 3] - T_w_site[..., :3, 3]
        advance = np.sum(apart * T_w_site[..., :3, 2], axis=-1)
        return TouchObservation(
            *map(jnp.asarray, (reading, made.force, advance.astype(np.float32), made.code != ReturnCode.AIR))
        )

    def episodes(self) -> Episodes:
        """What happened."""
        T = np.stack([touches.T_w_t for touches in self.touches], axis=1)
        return Episodes(self.truth, np.stack(self.chosen, 1), self.measured(), T)


def runs_of(key: Key[Array, ""], count: int, errors: Errors) -> RunErrors:
    """What is wrong in each of the episodes that a `Sitting` of this key has."""
    return _runs(jax.random.split(key, 3)[0], count, errors)


def _runs(key: Key[Array, ""], count: int, errors: Errors) -> RunErrors:
    return jax.vmap(lambda k: simulation.sample_run(k, errors))(jax.random.split(key, count))


@partial(jax.jit, static_argnames=("errors", "limits"))
def _touch_many(
    drawn: Array, surface: Surface, T: Array, runs: RunErrors, pad: Pad, errors: Errors, limits: PressLimits
) -> Touches:
    keys = jax.random.wrap_key_data(drawn)
    made = jax.vmap(lambda key, T, run: simulation.touch_once(key, surface, jnp.eye(4), T, run, pad, errors, limits))(
        keys, T, runs
    )
    blank = jnp.zeros((len(drawn), 0))
    return made._replace(patch=blank, wide=blank, truth=None)


@partial(jax.jit, static_argnames=("errors",))
def _feel(drawn: Array, touches: Touches, pad: Pad, errors: Errors) -> Array:
    keys = jax.random.wrap_key_data(drawn)
    return jax.vmap(lambda key, run: simulation.feel(key, run, pad, errors).reading)(keys, touches)


def random_sites(key: Key[Array, ""], sites: Pool, episodes: int, touches: int) -> Int[np.ndarray, "e t"]:
    """A random site of an object drawn anew for each touch; the same sites serve every method."""
    return np.asarray(jax.random.randint(key, (episodes, touches), 0, len(sites.owner)))


def telling_sites(key: Key[Array, ""], sites: Pool, episodes: int, touches: int) -> Int[np.ndarray, "e t"]:
    """As `random_sites`, but the site of an object is drawn by the paper's heuristic
    (`i2t.recognition.ensemble.telling`)."""
    weight = telling(sites)
    key_object, key_site = jax.random.split(key)
    which = jax.random.randint(key_object, (episodes, touches), 0, len(weight))
    return np.asarray(which * weight.shape[1] + jax.random.categorical(key_site, jnp.log(weight[which])))


def telling(sites: Pool) -> Float[Array, "objects each"]:
    """The heuristic's probabilities of each object's own sites."""
    objects = int(sites.owner.max()) + 1
    T = sites.T_w_t.reshape(objects, -1, 4, 4)
    safe = jnp.ones(T.shape[:2], bool)
    return jax.vmap(lambda o: ensemble.telling(T[..., :3, 3], -T[..., :3, 2], safe, o))(jnp.arange(objects))


def paper_rules(
    predictor: Predictor, std: np.ndarray, surfaces: Sequence[Surface], episodes: Episodes, rough: float = 0.0
) -> dict[str, np.ndarray]:
    """Beliefs (e, t, objects) by the paper's rules, from readings and from contact positions.

    Objects are taken to stand at the world's origin; each is rendered where the press ended and pressed with the force
    that was measured. `std` (15,) uT is that of the training readings, `rough` (m) the noise of the views of objects
    that are known from a depth camera only.
    """
    T = episodes.T_w_t.reshape(-1, 4, 4)
    force = np.maximum(episodes.measured.force.reshape(-1), outcomes.SMALLEST)
    if predictor.imagination is not None:  # rendered views have no noise to be smoothed away
        quick = replace(predictor.imagination, smooth=rough > 0, cell=CELLS.spacing)
        predictor = replace(predictor, imagination=quick)
    margin = (WIDE_PIXELS - PATCH_PIXELS) // 2
    rng = np.random.default_rng(0)
    imagined, apart = [], []
    for surface in surfaces:
        wide, seen = jax.device_get(_views(surface, jnp.asarray(T)))
        inner = np.s_[:, margin:-margin, margin:-margin]
        if rough > 0:
            wide = wide + rough * rng.standard_normal(wide.shape, dtype=np.float32)
            wide = np.clip(wide - wide[inner].min((1, 2), keepdims=True), 0, REACH)
        patch = wide[inner]
        blank = np.zeros(len(T), np.float32)
        reading = predictor.predict(patch, force=force, nearest=blank, wide=wide).mean
        imagined.append(np.where(seen[:, None], reading, 0.0))
        apart.append(np.asarray(_near(jnp.asarray(T[:, :3, 3]), surface)))
    shape = episodes.site.shape
    felt = np.asarray(episodes.measured.reading).reshape(-1, 15)
    zero, scale = jnp.zeros(15), jnp.asarray(std, jnp.float32)
    tau = ensemble.distances(jnp.asarray(felt), jnp.float32(np.stack(imagined, 1)), zero, scale)
    distance = {"I2T": tau.reshape(*shape, -1), "proprioception": jnp.stack(apart, -1).reshape(*shape, -1) / MILLI}
    rules = {"votes": ensemble.votes, "average": ensemble.average, "product": ensemble.product}
    return {
        f"{source}, {name}": np.asarray(jax.jit(jax.vmap(rule))(values))
        for source, values in distance.items()
        for name, rule in rules.items()
    }


_near = jax.jit(jax.vmap(ensemble.nearest_distance, (0, None)))


@jax.jit
def _views(surface: Surface, T_w_t: Array) -> tuple[Array, Array]:
    return jax.lax.map(partial(_look, surface), T_w_t, batch_size=64)


def _look(surface: Surface, T_w_t: Array) -> tuple[Array, Array]:
    """A wide view behind the patch's nearest point, as the camera's are (`i2t.simulation.touches.cut`), and whether it
    shows any."""
    z = render_heights(surface, inverse(T_w_t), WIDE_WINDOW, WIDE_PIXELS)
    margin = (WIDE_PIXELS - PATCH_PIXELS) // 2
    nearest = jnp.min(z[margin:-margin, margin:-margin])
    seen = jnp.isfinite(nearest)
    return jnp.clip(z - jnp.where(seen, nearest, 0.0), 0, REACH), seen


def replayed(recorded: Dataset, names: Sequence[str], touches: int) -> tuple[Pool, Episodes]:
    """Each run of a recorded data set as a sitting of its first touches, and the places where they ended as sites.

    Raises DataError where a run's object is not among `names`, or where too few touches can be used.
    """
    made = recorded.touches
    sittings = []
    for run in np.unique(made.run):
        rows = np.flatnonzero((made.run == run) & (made.code != ReturnCode.FAILED) & np.isfinite(made.force))
        if len(rows) >= touches:
            sittings.append(rows[:touches])
    if not sittings:
        raise DataError(f"no run has {touches} touches with a measured force; record longer ones")
    rows = np.stack(sittings)
    kinds = [recorded.objects[i] for i in made.object[rows[:, 0]]]
    strange = sorted(set(kinds) - set(names))
    if strange:
        raise DataError(f"the data set has touches of {', '.join(strange)}, of which there is no mesh; pass --objects")
    T_o_t = np.linalg.inv(made.T_w_o[rows]) @ made.T_w_t[rows]
    measured = TouchObservation(
        jnp.asarray(made.reading[rows]), jnp.asarray(made.force[rows]), jnp.zeros(rows.shape),
        jnp.asarray(made.code[rows] != ReturnCode.AIR),
    )  # fmt: skip
    truth = np.array([list(names).index(kind) for kind in kinds])
    sites = Pool(jnp.float32(T_o_t.reshape(-1, 4, 4)), np.repeat(truth, touches))
    return sites, Episodes(truth, np.arange(rows.size).reshape(rows.shape), measured, T_o_t.astype(np.float32))


@jax.jit
def beliefs(
    table: PredictedTouch, site: Int[Array, "e t"], measured: TouchObservation, like: Likelihood, placements: Particles
) -> Float[Array, "e t objects"]:
    """Posteriors over the objects after each touch of each episode; `table` is (sites, objects, k)."""
    objects = table.hit.shape[1]

    def episode(at: tuple[Array, TouchObservation]) -> Array:
        def step(now: belief.Belief, touched: tuple[Array, TouchObservation]) -> tuple[belief.Belief, Array]:
            now = belief.update(now, touched[1], element(table, touched[0]), like)
            return now, belief.posterior(now)

        return jax.lax.scan(step, belief.init(placements, objects), at)[1]

    return jax.lax.map(episode, (site, measured), batch_size=8)


def by_evidence(
    table: PredictedTouch,
    episodes: Episodes,
    like: Likelihood,
    placements: Particles,
    kinds: Sequence[str] = tuple(EVIDENCE),
) -> dict[str, np.ndarray]:
    """Posteriors (e, t, objects) over the objects from each kind of evidence."""
    table, site = jax.device_put(table), jnp.asarray(episodes.site)
    found = {}
    for kind in kinds:
        tactile, spatial = (jnp.float32(weight) for weight in EVIDENCE[kind])
        used = like._replace(tactile=tactile, spatial=spatial)
        found[kind] = np.asarray(beliefs(table, site, episodes.measured, used, placements))
    return found


def places_about(errors: Errors, count: int, seed: int) -> Particles:
    """Places in which an object may stand under the errors of placement."""
    return belief.sample_particles(outcomes.prior_spread(errors.placement, errors.placement_angle), count, seed)


def surfaces_of(meshes: Sequence[Any]) -> list[Surface]:
    """Prepared surfaces of one size class, so that one compilation serves all."""
    stacked = stack_surfaces([prepare_surface(mesh) for mesh in meshes])
    return [element(stacked, i) for i in range(len(meshes))]
