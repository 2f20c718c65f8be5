"""Recognise what stands there, by touches that the belief itself chooses, with an arm and a skin.

    python -m experiments.recognize --live                                   all simulated: see how it goes
    python -m experiments.recognize --live --there hammer --arm emulated --skin emulated      the real drivers
    python -m experiments.recognize --live --objects a.stl b.stl --unit mm --arm ur --host 192.168.1.10 \\
        --skin reskin --camera realsense --rig lab.toml

The skin must be the one whose touches the run learnt from (--run). The next touch is the one that is expected to tell
most (`i2t.recognition.policy`); it ends when an error of --error is promised, or after --touches. With --strange 0.1,
say, it may be none of the objects, which is believed as far as decoys, things like them, explain the touches better.
All touches are kept in OUT/touches as a data set, under the name "unknown": a stranger's can be episodes_from_dataset once there is
a mesh of it (--dataset).
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from experiments.common.runs import reported, write_json
from experiments.recognize.run import Recognition, finished_runs, meshes_by_name, load_meshes, taught_by
from i2t.collect import devices, session
from i2t.collect.procedure import SiteOutcome, TouchSettings, Site
from i2t.collect.recorder import touches_in
from i2t.collect.site_plan import orthonormal
from i2t.hardware.rig import Rig
from i2t.objects import catalogue
from i2t.objects.solids import Mesh
from i2t.recognition import belief, calibrated, policy
from i2t.recognition import metrics as scores
from i2t.recognition.belief import TouchObservation
from i2t.recognition.episodes import sample_sites, prepare_surfaces, precompute_outcomes
from i2t.recognition.planning import advance, choose_informative_sites, safe_sites
from i2t.skin.boards import reskin_board
from i2t.types import ReturnCode
from i2t.viz.story import story


@dataclass(frozen=True)
class Live:
    """Recognise an object with an arm."""

    out: Path = Path("runs/live")  # folder of touches/, result.json and story/
    run: Path = Path("runs/train")  # a finished run of experiments.train on touches of this skin
    objects: tuple[Path, ...] = ()  # mesh files to tell apart, in place of the catalogue's
    unit: Literal["m", "cm", "mm", "inch"] = "mm"  # of those files
    there: str | None = None  # what stands there if the arm is not real, strangers of the catalogue too; else drawn
    strange: float = 0.0  # probability beforehand that it is none of the objects
    decoys: int = 16  # things like the objects, that stand for what else it might be then
    touches: int = 10  # at most
    error: float = 0.05  # ends when the most probable object is wrong with at most this probability
    sites: int = 24  # of each object, to choose among
    places: int = 64  # in which each may stand
    arm: Literal["ur", "simulated", "emulated"] = "simulated"
    skin: Literal["reskin", "simulated", "emulated"] = "simulated"
    camera: Literal["realsense", "simulated"] = "simulated"
    host: str | None = None  # of the UR controller
    port: str | None = None  # of the skin
    rig: Path | None = None  # calibration of the lab; says where the object is believed to stand, and how surely
    seed: int = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(Live, args=argv, description=__doc__, prog="python -m experiments.recognize --live")
    return reported(partial(run, args), args.out)


def run(args: Live) -> dict[str, Any]:
    """Learn the skin, imagine, touch."""
    folder = args.out / "touches"
    if folder.is_dir() and touches_in(folder):
        raise ValueError(f"{args.out} holds the touches of another sitting; choose another --out")
    if not 0 <= args.strange < 1:
        raise ValueError(f"--strange {args.strange:g}: give a probability, from 0 to below 1")
    if args.strange > 0 and args.decoys < 1:
        raise ValueError(f"--decoys {args.decoys}: --strange needs decoys, 16 say")
    rig = devices.read_rig(args.rig)
    cfg = Recognition()
    meshes = load_meshes(args.objects, args.unit) if args.objects else meshes_by_name(cfg.primitives + cfg.tools)
    sitting = Sitting(args, meshes, rig)
    sources = {path.stem: str(path) for path in args.objects} or {name: name for name in meshes}
    real = args.arm == "ur"
    there = args.there or str(np.random.default_rng(args.seed).choice(list(meshes)))
    if there not in meshes and there not in catalogue.NAMES:
        raise ValueError(f"--there {there}: choose one of {', '.join(meshes)}, or a stranger of the catalogue")
    sources.setdefault(there, there)
    # A real arm only needs to know how high things may be.
    tallest = max(meshes, key=lambda name: float(meshes[name].vertices[:, 2].max()))
    wanted = session.Args(
        out=folder, touches=args.touches, arm=args.arm, skin=args.skin, camera=args.camera, host=args.host,
        port=args.port, rig=args.rig, object=sources[tallest if real else there], unit=args.unit, name="unknown",
        seed=args.seed, settings=replace(TouchSettings(), skin_change=sitting.limit, past_goal=sitting.past),
    )  # fmt: skip
    code = session.collect(wanted, sitting.choose, sitting.told)
    if code or not sitting.after:
        raise ValueError("no touch was made, so nothing is known")
    return sitting.conclude(None if real else there)


# How decoys' odds are to be read, fitted on validation objects and strangers where half of all were strange.
EVEN, STRANGE = 0.5, calibrated.PlattScaling(-0.04, 0.62, 0.19)

_tempered = jax.jit(belief.apply_temperature)


class Sitting:
    """The belief of one sitting: says which site is next, and hears what became of it."""

    def __init__(self, args: Live, meshes: dict[str, Mesh], rig: Rig) -> None:
        cfg = replace(Recognition(), sites=args.sites, places=args.places)
        key_learn, key_pool, self.key = jax.random.split(jax.random.key(args.seed), 3)
        learnt = taught_by(key_learn, finished_runs(args.run)[0], cfg).learnt
        known = list(meshes.values())
        strange = [catalogue.surrogate_unknown(known, i).mesh for i in range(args.decoys if args.strange > 0 else 0)]
        surfaces = prepare_surfaces(known + strange)
        self.known, self.strange = len(known), len(strange)
        self.args, self.meshes, self.T_w_o = args, meshes, np.asarray(rig.T_world_object)
        self.limit, self.past = cfg.limits.skin_change, cfg.limits.past_goal
        self.like = learnt.likelihood
        self.pool = sample_sites(key_pool, surfaces[: self.known], list(meshes), cfg.sites, cfg.reach)
        places = belief.sample_particles(rig.object_covariance, cfg.places, args.seed)
        (table,) = precompute_outcomes(surfaces, places.twist, self.pool.T_w_t, [learnt.reading_model], self.past, "live")
        self.table = jax.device_put(table)
        self.safe = jnp.asarray(safe_sites(surfaces, self.pool, cfg.reach))
        # One sitting of the many that experiments play at once.
        each = (1 - args.strange) / len(known), args.strange / max(1, len(strange))
        begun = belief.init(places, len(surfaces), np.repeat(each, [len(known), len(strange)]))
        self.now = jax.tree.map(lambda x: x[None], begun)
        self.spent = np.zeros((1, len(self.pool.owner)), bool)
        self.after: list[np.ndarray] = []  # probabilities of the objects; what they lack to 1 is "none of these"
        self.felt: list[SiteOutcome] = []
        self._rehearse()

    def _rehearse(self) -> None:
        """Decide and learn before there is an arm, whose watchdog does not wait for a compiler; from a second touch on
        the belief has other types than at first.
        """
        begun = self.now
        for step in range(2):
            self._next(step)
            self.now, _ = self._learn(0, np.zeros(15), 1.0, 0.0, False)
        self.now = begun

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """The site that is expected to tell most, until it is sure or enough was touched."""
        sure = self.after and policy.should_stop(jnp.asarray(self.after[-1]), self.args.error)
        if sure or len(history) >= self.args.touches or self.spent.all():
            return None
        number = self._next(len(history))
        self.spent[0, number] = True
        return Site(number, self._site(number))

    def told(self, outcome: SiteOutcome) -> None:
        """Learn from a touch, and say what is believed now."""
        touched = outcome.touch
        if touched is None:
            return
        T_w_site = self._site(outcome.site.number)
        travelled = float((touched.T_w_t[:3, 3] - T_w_site[:3, 3]) @ T_w_site[:3, 2])
        met = touched.code != ReturnCode.AIR
        self.now, p = self._learn(outcome.site.number, touched.reading, max(touched.force, 0.0), travelled, met)
        self.felt.append(outcome)
        self.after.append(p)
        order = np.argsort(-p)[:3]
        names = list(self.meshes)
        none = f"; none of these {1 - p.sum():.1%}" if self.strange else ""
        print("  believed: " + ", ".join(f"{names[i]} {p[i]:.1%}" for i in order) + none, flush=True)

    def conclude(self, there: str | None) -> dict[str, Any]:
        """Write down and say what was recognised."""
        names, p = list(self.meshes), np.stack(self.after)
        best, none = int(p[-1].argmax()), float(max(0.0, 1 - p[-1].sum()))
        stranger = none > p[-1, best]
        sure = none if stranger else float(p[-1, best])
        result = {
            "source": "real" if there is None else "simulated", "objects": names,
            "recognised": None if stranger else names[best], "probability": sure, "none": none, "there": there,
            "sites": [o.site.number for o in self.felt], "belief": p.tolist(),
        }  # fmt: skip
        write_json(self.args.out / "result.json", result)
        ended = [outcome.touch for outcome in self.felt if outcome.touch is not None]
        T_o_t = np.linalg.inv(self.T_w_o) @ np.stack([touched.T_w_t for touched in ended])
        readings = np.stack([touched.reading for touched in ended])
        truth = (-1 if stranger else best) if there is None else names.index(there) if there in names else -1
        story(list(self.meshes.values()), names, T_o_t, readings, reskin_board(), p, truth, self.args.out / "story",
              there is not None)  # fmt: skip
        stood = "" if there is None else f"; it was the {there} (simulated)"
        said = "it is none of these" if stranger else f"it is the {names[best]}"
        print(f"\n{said}, {sure:.1%} sure after {len(p)} touches{stood}")
        print(f"touches/, result.json and story/ are in {self.args.out}")
        return result

    def _learn(
        self, number: int, reading: np.ndarray, force: float, advanced: float, met: bool
    ) -> tuple[belief.Belief, np.ndarray]:
        """The belief after a touch, and its probabilities as sure as they should be."""
        measured = TouchObservation(
            jnp.float32(reading)[None], jnp.float32([force]), jnp.float32([advanced]), jnp.asarray([met])
        )
        now, p = advance(self.now, jnp.asarray([number]), measured, self.table, self.like)
        all_of_them = np.asarray(p[0], np.float64)
        named = np.asarray(_tempered(p[0, : self.known], jnp.float32(len(self.felt) + 1)), np.float64)
        if not self.strange:
            return now, named
        raw = all_of_them[: self.known], all_of_them[self.known :].sum()
        _, none = scores.with_unknown_prior(*raw, self.args.strange, EVEN)
        read = STRANGE.apply(none, len(self.felt) + 1)
        _, none = scores.with_unknown_prior(named * (1 - read), read, EVEN, self.args.strange)
        return now, named * (1 - float(none))

    def _next(self, step: int) -> int:
        keys = jax.random.split(jax.random.fold_in(self.key, step), 1)
        spent = jnp.asarray(self.spent)
        return int(choose_informative_sites(keys, self.now, self.table, self.like, spent, self.safe, self.limit)[0])

    def _site(self, number: int) -> np.ndarray:
        return orthonormal(self.T_w_o @ np.asarray(self.pool.T_w_t[number], float))


if __name__ == "__main__":
    sys.exit(main())
