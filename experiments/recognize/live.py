"""Recognise what stands there, by touches that the belief itself chooses, with an arm and a skin.

    python -m experiments.recognize live                                   all simulated: see how it goes
    python -m experiments.recognize live --true-object hammer --arm emulated --skin emulated      the real drivers
    python -m experiments.recognize live --objects star own.stl --unit mm --arm emulated --skin emulated
    python -m experiments.recognize live --pad-model runs/collected --pad-name "skin A" --arm ur \\
        --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml     a real skin, by a run on its own touches

Every skin differs, so --pad-model must be of the skin that touches, by its name in data sets and by its board: the
folder of a run of `experiments.train`, or a file. Any other is refused before anything moves. A
simulated or emulated skin is "simulated pad 0", that of `experiments.train`, unless --pad-file names another; a real
one is called --pad-name, as it was collected. The next touch is the one that is expected to tell most
(`i2t.recognition.recognizer`), among sites that are safe on what may be there; where ten draws of candidates have none,
the run stops and says so. It ends when the most probable object is wrong with at most --max-error-probability, but
after --min-touches, or after --max-touches. A touch that meets air tells something too: it speaks against the objects
that would have been met there. With --prior-unknown 0.1, say, it may be none of the objects, which is believed as far
as surrogates, objects like them, explain the touches better. All touches are kept in OUT/touches as a data set, under
the name of --truth, or "unknown": they can be recognised again (--dataset) with a mesh of that name among --objects,
such as unknown.stl.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.common.runs import write_json
from experiments.recognize.arguments import LiveArgs
from experiments.recognize.config import Recognition
from experiments.recognize.plans import load_meshes, meshes_by_name
from experiments.train.finished import find_pad_model
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

# Settings of the recogniser that have an option of the same name.
CHOICES = (
    "num_sites", "num_particles", "max_touches", "min_touches", "max_error_probability", "prior_unknown",
    "num_surrogates", "seed",
)  # fmt: skip


def run(args: LiveArgs) -> dict[str, Any]:
    """Read the pad model, predict touches, touch."""
    refuse_used(args.out)
    rig = Rig() if args.rig is None else Rig.read(args.rig)
    meshes = load_meshes(args.objects, args.unit) or meshes_by_name(Recognition().objects)
    true_object = args.true_object or str(np.random.default_rng(args.seed).choice(list(meshes)))
    _, key_sites, key_touches = jax.random.split(jax.random.key(args.seed), 3)
    known = load_pad_model(find_pad_model(args.pad_model)[0])
    require_skin(known, [args.mounted_pad], mounted_board(args, known.board), f"--skin {args.skin.kind}")
    print(describe(known))
    recognizer = ObjectRecognizer(
        key_sites, known.model, meshes, T_w_o=np.asarray(rig.T_world_object),
        pose_prior=np.asarray(rig.object_covariance),
        config=RecognizerConfig(**{name: getattr(args, name) for name in CHOICES}),
    )  # fmt: skip
    recognizer.warm_up()  # before there is an arm, whose watchdog does not wait for a compiler
    live = LiveEpisode(recognizer, key_touches)
    standing = None if args.real else true_object
    code = session.collect(begin(collect_args(args, meshes, standing)), live.choose, live.learn)
    if live.nothing_safe and not live.infos:
        raise ValueError(live.nothing_safe)
    if code or not live.infos:
        why = live.recognizer.stop_reason(live.state)
        raise ValueError(f"no touch was made, so nothing is known{f': {why}' if why else ''}")
    return conclude(args, live, meshes, known, standing)


def mounted_board(args: LiveArgs, expected: Board) -> Board:
    """The board that a command line names; that of another package's skin shows with its first touch."""
    skin = args.skin
    if skin.kind == "simulated":
        return Board(*(np.asarray(part) for part in read_pad(args.pad_file, skin.board).board))
    name = skin.board or boards.DEFAULT_BOARD
    if skin.kind == "emulated" and args.pad_file:
        return Board(*(np.asarray(part) for part in read_pad(args.pad_file, name).board))
    return boards.make_board(name) if skin.kind in ("reskin", "emulated") else expected


def collect_args(args: LiveArgs, meshes: dict[str, Mesh], true_object: str | None) -> CollectArgs:
    """Collection whose sites the recogniser chooses, with the object if simulated."""
    sources = {path.stem: str(path) for path in args.objects}
    # A real arm only needs to know how high things may be.
    tallest = max(meshes, key=lambda name: float(meshes[name].vertices[:, 2].max()))
    there = true_object or tallest
    return CollectArgs(
        out=args.out / "touches",
        touches=args.max_touches,
        arm=args.arm,
        skin=args.skin,
        camera=args.camera,
        world=WorldArgs(sources.get(there, there), args.unit or "mm", pad=args.pad_file, seed=args.seed),
        lab=LabArgs(args.rig),
        name=args.truth or "unknown",
        pad_name=args.mounted_pad,
        skip_first_touch=True,  # nobody knows what stands there, so that it would contradict any mesh
        settings=TouchSettings(skin_change=RecognizerConfig.skin_change, overtravel=RecognizerConfig.overtravel),
    )


class LiveEpisode:
    """Episode that chooses the procedure's sites, learns from the touches made there, and prints the belief."""

    def __init__(self, recognizer: ObjectRecognizer, key: jax.Array) -> None:
        self.recognizer, self.key = recognizer, key
        self.state = recognizer.init()
        self.touches: list[TouchResult] = []
        self.infos: list[RecognitionInfo] = []
        self.would_meet: list[np.ndarray] = []  # each object, at each touch, as believed before it
        self.nothing_safe = ""  # why the run ended without a site

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """The site that is expected to tell most; None when enough is known, or when no site is safe."""
        site = self.recognizer.choose_touch(self.state, key=jax.random.fold_in(self.key, len(history)))
        if site is None:
            if self.recognizer.stop_reason(self.state) is None:
                self.nothing_safe = (
                    f"no touch is safe on what may be there: {MAX_EMPTY_DRAWS} draws of up to {NUM_CANDIDATES} sites "
                    "had none that is; pass more --num-sites, or a rig that knows the object's pose better"
                )
                print(f"  stopped: {self.nothing_safe}", flush=True)
            return None
        self.state = self.recognizer.exclude(self.state, site.number)  # a site that fails is not chosen again
        return Site(site.number, site.T_w_t)

    def learn(self, outcome: SiteOutcome) -> None:
        """Update the belief with a touch that was made, and print it."""
        touch = outcome.touch
        if touch is None:
            return
        if len(touch.reading) != self.recognizer.channels:
            raise DeviceError(
                f"the skin sends {len(touch.reading)} values, and the pad model has {self.recognizer.channels}; "
                "recognise with a pad model of this skin"
            )
        if not np.isfinite(touch.reading).all():
            print("  chips of the skin did not answer: this touch is kept, but nothing is learned from it", flush=True)
            return
        if not np.isfinite(touch.force):
            print("  another skin felt it too, and its force is unknown: nothing is learned from it", flush=True)
            return
        site = ChosenSite(outcome.site.number, self.recognizer.site_pose(outcome.site.number))
        contact = touch.code != ReturnCode.AIR
        observation = self.recognizer.observe(
            site, touch.reading, force=touch.force, T_w_t=touch.T_w_t, contact=contact
        )  # fmt: skip
        before, would_meet = self.state.probability, self.recognizer.contact_probability(self.state, site.number)
        self.state, info = self.recognizer.update(self.state, observation)
        self.touches.append(touch)
        self.infos.append(info)
        self.would_meet.append(would_meet)
        names, best = self.recognizer.names, np.argsort(-info.probability)[:3]
        met = ", ".join(f"{names[i]} {would_meet[i]:.0%}" for i in best)
        print(f"  {'contact' if contact else 'no contact'}; poses in which it would be met: {met}")
        unknown = f"; unknown object {info.unknown:.1%}" if self.recognizer.config.prior_unknown else ""
        believed = ", ".join(f"{names[i]} {info.probability[i]:.1%} (before {before[i]:.1%})" for i in best)
        print(f"  believed: {believed}{unknown}", flush=True)


def conclude(
    args: LiveArgs, live: LiveEpisode, meshes: dict[str, Mesh], known: KnownPad, true_object: str | None
) -> dict[str, Any]:
    """Write down and say what was recognised; `true_object` is None for a real arm."""
    names, info = live.recognizer.names, live.infos[-1]
    p = np.stack([each.probability for each in live.infos])
    source = read_touch(list_touches(args.out / "touches")[0]).touch.source
    result = {
        "source": source,
        "pad_model": to_json(known),
        "skin": args.mounted_pad,
        "objects": names,
        "recognised": info.name,
        "probability": info.confidence,
        "unknown": info.unknown,
        "true_object": true_object or args.truth,
        "stopped": live.nothing_safe or live.recognizer.stop_reason(live.state),
        "sites": [touch.site.number for touch in live.touches],
        "belief": p.tolist(),
        "met_air": [touch.code == ReturnCode.AIR for touch in live.touches],
        "would_be_met": np.stack(live.would_meet).tolist(),
    }
    write_json(args.out / "result.json", result)
    T_o_t = inverse(live.recognizer.T_w_o) @ np.stack([touch.T_w_t for touch in live.touches])
    shown = true_object or args.truth or info.name
    record = EpisodeRecord(
        meshes=list(meshes.values()),
        names=names,
        T_w_t=T_o_t,
        readings=np.stack([touch.reading for touch in live.touches]),
        board=known.board,
        p=p,
        truth=names.index(shown) if shown in names else -1,
        simulated=holds_simulated(source),
    )
    write_episode_report(record, args.out / "story")
    stood = "" if true_object is None else f"; it was the {true_object} (simulated)"
    said = "it is an unknown object" if info.name is None else f"it is the {info.name}"
    print(f"\n{said}, {info.confidence:.1%} sure after {len(p)} touches{stood}")
    print(f"touches/, result.json and story/ are in {args.out}")
    if info.name is None:
        print(
            "next, its surface, as a mesh that may join --objects:\n"
            f"  python -m experiments.reconstruct --dataset {args.out / 'touches'} --out {args.out / 'surface'}"
        )
    return result


def refuse_used(out: Path) -> None:
    """Refuse a folder that holds the touches of another episode (ValueError)."""
    folder = out / "touches"
    if folder.is_dir() and list_touches(folder):
        raise ValueError(f"{out} holds the touches of another episode; choose another --out")
