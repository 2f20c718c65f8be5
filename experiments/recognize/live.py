"""Recognise an object with an arm and a skin, at sites chosen by the current belief.

    python -m experiments.recognize live                                   a simulated arm, skin and object
    python -m experiments.recognize live --true-object star --arm emulated --skin emulated        with the real drivers
    python -m experiments.recognize live --objects star own.stl --unit mm --arm emulated --skin emulated
    python -m experiments.recognize live --pad-model runs/collected --pad-name "skin A" --arm ur \\
        --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml     a real skin and a run on its touches

The default objects are equally high and about equally wide, and the skin meets all of them at every candidate site
(--min-contact-probability), so that readings decide. Each touch prints its weights of evidence (nats) for the most
probable object against the next one, from the reading, from the position at which the press ended, from presence,
whether it met anything, and from the calibration, which reduces the weight of all touches as their number grows. They
sum to the change of the log odds of the printed belief (`i2t.recognition.recognizer.TouchEvidence`).

Skins differ, so --pad-model must be the folder of a run of `experiments.train`, or a file, for the same skin, by its
name in data sets and its board. Other pad models are refused before anything moves. A simulated or emulated skin is
"simulated pad 0", as in `experiments.train`, unless --pad-file names another pad. Without the run runs/train, such a
skin is recognised with the ready pad model "nominal". A real skin has the name --pad-name, as in its data sets. The
next touch is the most informative one (`i2t.recognition.recognizer`) among sites that are safe for all possible
objects. If ten draws of candidates have no safe site, the run stops with a message. The run ends when the most probable
object is wrong with a probability of at most --max-error-probability, but not before --min-touches, or after
--max-touches. A touch without contact is evidence too, against the objects that it should have met. With
--prior-unknown, such as 0.1, the object may be unknown; the probability of that grows if surrogates, random objects
similar to the known ones, explain the touches better. All touches are saved in OUT/touches as a data set, under the
name --truth or "unknown". They can be recognised again (--dataset) with a mesh of that name among --objects, such as
unknown.stl.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.common.runs import write_json
from experiments.recognize.arguments import LIVE_OBJECTS, LIVE_PAD_MODELS, LiveArgs
from i2t.collect import session
from i2t.collect.arguments import CollectArgs, LabArgs
from i2t.collect.recorder import list_touches
from i2t.collect.settings import TouchSettings
from i2t.collect.start import begin
from i2t.collect.touch import Site, SiteOutcome, TouchResult
from i2t.dataset import holds_simulated, read_touch
from i2t.emulators.world import read_pad
from i2t.errors import DeviceError
from i2t.geometry import inverse
from i2t.hardware.rig import Rig
from i2t.hardware.world import WorldArgs
from i2t.models.finished import find_pad_model
from i2t.objects.named import object_name, read_meshes, units_of
from i2t.objects.solids import Mesh
from i2t.recognition.policy import NUM_CANDIDATES
from i2t.recognition.recognizer import (
    MAX_EMPTY_DRAWS,
    ChosenSite,
    ObjectRecognizer,
    RecognitionInfo,
    RecognizerConfig,
)
from i2t.recognition.recorded import describe, to_json
from i2t.skin import boards
from i2t.skin_models.pad_model import KnownPad, load_pad_model, require_skin
from i2t.types import Board, ReturnCode
from i2t.viz import EpisodeRecord, write_episode_report
from i2t.viz.episode_report import EVIDENCE_SOURCES


def run(args: LiveArgs) -> dict[str, Any]:
    """Run an episode, and write and print its result."""
    result, record = play(args)
    write_json(args.out / "result.json", result)
    write_episode_report(record, args.out / "story")
    print_result(args.out, result, record)
    return result


def play(args: LiveArgs) -> tuple[dict[str, Any], EpisodeRecord]:
    """Read the pad model, predict touches, and run the episode. Returns its result and its record for the report."""
    refuse_used(args.out)
    rig = Rig() if args.rig is None else Rig.read(args.rig)
    meshes = read_meshes(args.objects, args.unit) or read_meshes(LIVE_OBJECTS)
    true_object = args.true_object or str(np.random.default_rng(args.seed).choice(list(meshes)))
    _, key_sites, key_touches = jax.random.split(jax.random.key(args.seed), 3)
    pad_model = args.used_pad_model
    if args.pad_model is None and pad_model != LIVE_PAD_MODELS[0]:
        print(f"There is no run {LIVE_PAD_MODELS[0]}, so the ready pad model {pad_model} is used.")
    fitted = load_pad_model(find_pad_model(pad_model)[0])
    require_skin(fitted, [args.mounted_pad], mounted_board(args, fitted.board), f"--skin {args.skin.kind}")
    print(describe(fitted))
    same_names = (
        "num_sites", "num_particles", "max_touches", "min_touches", "max_error_probability", "prior_unknown",
        "num_surrogates", "seed",
    )  # fmt: skip
    recognizer = ObjectRecognizer(
        key_sites, fitted.model, meshes, T_w_o=np.asarray(rig.T_world_object),
        pose_prior=np.asarray(rig.object_covariance),
        config=RecognizerConfig(
            **{name: getattr(args, name) for name in same_names}, min_contact_probability=args.contact_probability
        ),
    )  # fmt: skip
    recognizer.warm_up()  # compile before connecting the arm, whose watchdog would time out
    live = LiveEpisode(recognizer, key_touches)
    simulated_object = None if args.real else true_object
    code = session.collect(begin(collect_args(args, meshes, simulated_object)), live.choose, live.learn)
    if live.nothing_safe and not live.infos:
        raise ValueError(live.nothing_safe)
    if code or not live.infos:
        why = live.recognizer.stop_reason(live.state)
        raise ValueError(f"no touch was made, so there is no result{f': {why}' if why else ''}")
    return conclude(args, live, meshes, fitted, simulated_object)


def mounted_board(args: LiveArgs, expected: Board) -> Board:
    """Find the board of the skin from the options. The board of another package's skin is known at its first touch."""
    skin = args.skin
    if skin.kind == "simulated":
        return Board(*(np.asarray(part) for part in read_pad(args.pad_file, skin.board).board))
    name = skin.board or boards.DEFAULT_BOARD
    if skin.kind == "emulated" and args.pad_file:
        return Board(*(np.asarray(part) for part in read_pad(args.pad_file, name).board))
    return boards.make_board(name) if skin.kind in ("reskin", "emulated") else expected


def collect_args(args: LiveArgs, meshes: dict[str, Mesh], true_object: str | None) -> CollectArgs:
    """Convert the options to those of a collection whose sites the recogniser chooses."""
    names = list(map(str, args.objects))
    sources: dict[str, Any] = dict(
        zip(map(object_name, names), zip(names, units_of(names, args.unit), strict=True), strict=True)
    )
    # For a real arm, only the height of the tallest object matters.
    tallest = max(meshes, key=lambda name: float(meshes[name].vertices[:, 2].max()))
    name = true_object or tallest
    source, unit = sources.get(name, (name, None))
    return CollectArgs(
        out=args.out / "touches",
        touches=args.max_touches,
        arm=args.arm,
        skin=args.skin,
        camera=args.camera,
        world=WorldArgs(object=source, unit=unit, pad=args.pad_file, seed=args.seed),
        lab=LabArgs(args.rig),
        name=args.truth or "unknown",
        pad_name=args.mounted_pad,
        skip_first_touch=True,  # the check against the mesh is impossible, because the object is unknown
        settings=TouchSettings(skin_change=RecognizerConfig.skin_change, overtravel=RecognizerConfig.overtravel),
    )


class LiveEpisode:
    """Episode that chooses the sites, updates the belief with their touches, and prints it."""

    def __init__(self, recognizer: ObjectRecognizer, key: jax.Array) -> None:
        self.recognizer, self.key = recognizer, key
        self.state = recognizer.init()
        self.touches: list[TouchResult] = []
        self.infos: list[RecognitionInfo] = []
        self.contact_probability: list[np.ndarray] = []  # of each object at each touch, before it
        self.nothing_safe = ""  # reason if the run ended for lack of a safe site

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """Choose the most informative site; None if the belief is sure enough, or if no site is safe."""
        site = self.recognizer.choose_touch(self.state, key=jax.random.fold_in(self.key, len(history)))
        if site is None:
            if self.recognizer.stop_reason(self.state) is None:
                self.nothing_safe = (
                    f"no site is safe for all possible objects in {MAX_EMPTY_DRAWS} draws of up to {NUM_CANDIDATES} "
                    "sites; pass more --num-sites, or a rig with a more certain pose of the object"
                )
                print(f"  stopped: {self.nothing_safe}", flush=True)
            return None
        self.state = self.recognizer.exclude(self.state, site.number)  # do not choose the site again if it fails
        return Site(site.number, site.T_w_t)

    def learn(self, outcome: SiteOutcome) -> None:
        """Update the belief with a touch, and print it."""
        touch = outcome.touch
        if touch is None:
            return
        if len(touch.reading) != self.recognizer.channels:
            raise DeviceError(
                f"the skin sends {len(touch.reading)} values, and the pad model has {self.recognizer.channels}; "
                "recognise with a pad model of this skin"
            )
        if not np.isfinite(touch.reading).all():
            print("  chips of the skin did not answer: this touch is saved, but not used", flush=True)
            return
        if not np.isfinite(touch.force):
            print("  another skin was pressed too, so the force is unknown: this touch is not used", flush=True)
            return
        site = ChosenSite(outcome.site.number, self.recognizer.site_pose(outcome.site.number))
        contact = touch.code != ReturnCode.AIR
        observation = self.recognizer.observe(
            site, touch.reading, force=touch.force, T_w_t=touch.T_w_t, contact=contact
        )  # fmt: skip
        before, contacts = self.state.probability, self.recognizer.contact_probability(self.state, site.number)
        self.state, info = self.recognizer.update(self.state, observation)
        self.touches.append(touch)
        self.infos.append(info)
        self.contact_probability.append(contacts)
        names, best = self.recognizer.names, np.argsort(-info.probability)[:3].tolist()
        predicted = ", ".join(f"{names[i]} {contacts[i]:.0%}" for i in best)
        print(f"  {'contact' if contact else 'no contact'}; predicted probability of contact: {predicted}")
        unknown = f"; unknown object {info.unknown:.1%}" if self.recognizer.config.prior_unknown else ""
        belief = ", ".join(f"{names[i]} {info.probability[i]:.1%} (before {before[i]:.1%})" for i in best)
        print(f"  belief: {belief}{unknown}")
        first, second = best[:2]
        weights = describe_evidence(info.evidence.weights(first, second))
        print(f"  evidence for {names[first]} against {names[second]}: {weights}", flush=True)


def describe_evidence(weights: np.ndarray) -> str:
    """Describe weights of evidence (4,), those of `EVIDENCE_SOURCES`, and their sum (nats)."""
    rounded = np.round(weights, 2) + 0.0  # no minus before zero
    parts = ", ".join(f"{name} {weight:+.2f}" for name, weight in zip(EVIDENCE_SOURCES, rounded, strict=True))
    return f"{parts}, together {weights.sum():+.2f} nats"


def conclude(
    args: LiveArgs, live: LiveEpisode, meshes: dict[str, Mesh], fitted: KnownPad, true_object: str | None
) -> tuple[dict[str, Any], EpisodeRecord]:
    """Collect the result and the record of an episode; `true_object` is None for a real arm."""
    names, info = live.recognizer.names, live.infos[-1]
    p = np.stack([step.probability for step in live.infos])
    evidence = np.stack([np.stack(step.evidence, axis=-1)[: len(names)] for step in live.infos])
    source = read_touch(list_touches(args.out / "touches")[0]).touch.source
    result = {
        "source": source,
        "pad_model": to_json(fitted),
        "skin": args.mounted_pad,
        "objects": names,
        "recognised": info.name,
        "probability": info.confidence,
        "unknown": info.unknown,
        "true_object": true_object or args.truth,
        "stopped": live.nothing_safe or live.recognizer.stop_reason(live.state),
        "sites": [touch.site.number for touch in live.touches],
        "belief": p.tolist(),
        "evidence": dict(zip(EVIDENCE_SOURCES, np.moveaxis(evidence, -1, 0).tolist(), strict=True)),
        "met_air": [touch.code == ReturnCode.AIR for touch in live.touches],
        "would_be_met": np.stack(live.contact_probability).tolist(),
    }
    shown = true_object or args.truth or info.name
    return result, EpisodeRecord(
        meshes=list(meshes.values()),
        names=names,
        T_w_t=inverse(live.recognizer.T_w_o) @ np.stack([touch.T_w_t for touch in live.touches]),
        readings=np.stack([touch.reading for touch in live.touches]),
        board=fitted.board,
        p=p,
        truth=names.index(shown) if shown in names else -1,
        simulated=holds_simulated(source),
        evidence=evidence,
    )


def print_result(out: Path, result: dict[str, Any], record: EpisodeRecord) -> None:
    """Print the recognised object, the evidence of all touches by its source, and the written files."""
    name, true_object = result["recognised"], result["true_object"]
    truth = f"; the true object is the {true_object}" if true_object else ""
    object_text = "an unknown object" if name is None else f"the {name}"
    print(
        f"\nrecognised {object_text} with a probability of {result['probability']:.1%} after {len(record.p)} touches"
        f"{truth}{' (simulated)' if record.simulated else ''}"
    )
    first, second = record.leaders
    weights = describe_evidence(record.weights.sum(0))
    print(f"evidence of all touches for {record.names[first]} against {record.names[second]}: {weights}")
    print(f"touches/, result.json and story/ are in {out}")
    if name is None:
        print(
            "next, reconstruct its surface as a mesh for --objects:\n"
            f"  python -m experiments.reconstruct --dataset {out / 'touches'} --out {out / 'surface'}"
        )


def refuse_used(out: Path) -> None:
    """Refuse a folder that holds the touches of another episode (ValueError)."""
    folder = out / "touches"
    if folder.is_dir() and list_touches(folder):
        raise ValueError(f"{out} holds the touches of another episode; choose another --out")
