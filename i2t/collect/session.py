"""Collect touches of an object: an arm looks, presses and retreats, and every touch becomes a file.

    python -m i2t.collect                                        all simulated: see how it goes
    python -m i2t.collect --arm emulated --skin emulated         the real drivers before stand-ins, in a lab's time
    python -m i2t.collect --arm ur --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml \\
        --object mug.stl --out DATA/mug --dry-run                checks everything, moves nothing

The same command again goes on where it stopped. Ctrl-C or SIGTERM stops the arm and keeps everything. What it writes is
a data set: `python -m experiments.train --dataset DATA`.
"""

import json
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

from i2t.cli import ended
from i2t.collect import devices as wiring
from i2t.collect import recorder
from i2t.collect.dry_run import check_camera, dry_run
from i2t.collect.procedure import Choose, Cut, Outcome, Procedure, Settings, Site, Unreachable
from i2t.collect.recorder import Names, Recorder
from i2t.collect.site_plan import Plan, cutter
from i2t.depth.camera import Camera
from i2t.errors import DataError, DeviceError
from i2t.hardware.protocols import View
from i2t.hardware.reskin.monitor import bar
from i2t.hardware.rig import Rig
from i2t.simulation import sites as touch_sites
from i2t.types import CHIPS, ReturnCode

ENDS = {
    ReturnCode.SKIN: "stopped by the skin",
    ReturnCode.WRENCH: "stopped by force or torque",
    ReturnCode.AIR: "met air",
    ReturnCode.FAILED: "failed",
}
SCALE = 50.0  # uT at the end of a bar


@dataclass(frozen=True)
class Args:
    """Collect touches of an object."""

    out: Path = Path("runs/collect")
    """Folder of the touches; a collection that was begun there goes on."""
    touches: int = 36
    """How many there are to be."""
    arm: Literal["ur", "simulated", "emulated"] = "simulated"
    """Emulated: the real driver before a stand-in."""
    skin: Literal["reskin", "simulated", "emulated", "replay"] = "simulated"
    camera: Literal["realsense", "simulated", "folder"] = "simulated"
    host: str | None = None
    """Address of the UR controller."""
    port: str | None = None
    """Serial port of the skin; by default the one board that is plugged in."""
    replay: Path | None = None
    """Recording to play as the skin."""
    views: Path | None = None
    """Folder of views to show as the camera."""
    rig: Path | None = None
    """Calibration of the lab (python -m i2t.hardware.rig); real devices need one."""
    object: str = "hexagon"
    """Of the catalogue, or a mesh file."""
    unit: Literal["m", "cm", "mm", "inch"] = "mm"
    """Of a mesh file."""
    pose: tuple[float, float, float, float, float, float] | None = None
    """Of the object in the world: x y z in m, then turns about x y z in degrees; by default that of the rig."""
    name: str | None = None
    """Of the object in the data set; by default the catalogue's or the file's."""
    pad: Path | None = None
    """A pad on disk, for simulated skins."""
    pad_name: str | None = None
    """Of the skin in the data set."""
    run: str | None = None
    """Of the sitting in the data set; by default the object and the time at which it was begun."""
    seed: int = 0
    """Of the sites, and of what is simulated."""
    exact: bool = False
    """Simulated: object and camera are where they are believed to be."""
    stiffness: float = 10e3
    """Simulated: of arm and mount, N/m."""
    stale: float | None = None
    """s without news after which a UR arm is taken for lost: 0.1, and 0.5 for an emulated one beside other work."""
    watchdog: float | None = None
    """Hz, how often a UR controller must hear from us: 10, and 4 for an emulated one."""
    dry_run: bool = False
    """Check everything and draw the plan; move nothing and write no touch."""
    settings: Settings = field(default_factory=Settings)
    sites: touch_sites.Limits = field(default_factory=touch_sites.Limits)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    args = tyro.cli(
        Args,
        args=argv,
        description=__doc__,
        prog="python -m i2t.collect",
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        return ended(lambda: collect(args), f"stopped; everything is in {args.out}: the same command goes on")
    finally:
        signal.signal(signal.SIGTERM, before)


def collect(args: Args, choose: Choose | None = None, tell: Callable[[Outcome], None] | None = None) -> int:
    """A collection from its beginning, or from where it stopped, to its end. `choose` says which site is next, by
    default the next of a random list; `tell` hears of each touch once it is kept.
    """
    rig = _rig(args)
    thing = wiring.read_object(args.object, args.unit)
    name = args.name or (thing.name if args.object == thing.name else Path(args.object).stem)
    plan = Plan(thing.mesh, rig.T_world_object, args.sites, args.seed, name)
    done, notes = _resumed(args, name)
    with ExitStack() as stack:
        wanted = _wanted(args, done)
        devices = wiring.build(wanted, rig, args.object, args.unit, stack)
        if not args.dry_run and len(done) >= args.touches:
            print(f"{len(done)} touches are there already; raise --touches for more")
            return 0
        skin = stack.enter_context(devices.skin)
        camera = stack.enter_context(devices.camera)
        cut = _warm(camera.camera, plan)
        arm = stack.enter_context(devices.arm)  # last, as it must not wait for a compiler
        source = wiring.source_of(devices)
        print(_headline(args, source, name))
        procedure = Procedure(
            arm, skin, camera, rig, devices.board, cut, plan.top, args.settings, devices.clock,
            {int(number): why for number, why in notes["unreachable"].items()},
        )  # fmt: skip
        check_camera(procedure)
        if args.dry_run:
            return dry_run(procedure, plan, name, args.touches, args.out)
        names = Names(
            name, args.pad_name or _pad_name(args), notes["run"], source, devices.board, rig.T_world_base,
            rig.T_world_object, camera.camera,
            {"arm": arm.features.name, "skin": f"{skin.features.name} ({skin.features.source})"},
        )  # fmt: skip
        kept = stack.enter_context(Recorder(args.out, names, devices.clock))
        kept.check()
        recorder.write_notes(args.out, notes)
        session = _Session(args, procedure, plan, set(done), notes)
        try:
            for outcome in procedure.run(choose or session.choose, kept):
                session.told(outcome, kept)
                if tell is not None:
                    tell(outcome)
        finally:
            notes["unreachable"] = {str(number): why for number, why in procedure.unreachable.items()}
            recorder.write_notes(args.out, notes)
            print(session.summary(kept))
    return 0


class _Session:
    """Which site is next, and what is said meanwhile."""

    def __init__(self, args: Args, procedure: Procedure, plan: Plan, done: set[int], notes: dict[str, Any]) -> None:
        self.args, self.procedure, self.plan, self.done, self.notes = args, procedure, plan, done, notes
        self.before = len(done)
        self.tried = set(done)
        self.codes: Counter[ReturnCode] = Counter()
        self.begun = self.since = time.monotonic()
        self.live = sys.stdout.isatty()
        self.drawn = 0

    def choose(self, history: Sequence[Outcome]) -> Site | None:
        """The next site of the plan that can be reached, until there are enough touches."""
        if len(self.done) >= self.args.touches:
            return None
        while True:
            site = self.plan.next(self.tried)
            self.tried.add(site.number)
            try:
                self.procedure.check(site)
                return site
            except Unreachable as error:
                self.procedure.unreachable[site.number] = str(error)
                if len(self.procedure.unreachable) > 20 + 20 * self.args.touches:
                    raise DeviceError(f"hardly any site can be reached, the last not because {error}") from error

    def told(self, outcome: Outcome, kept: Recorder) -> None:
        """Show a touch."""
        self.codes[outcome.code] += 1
        now = time.monotonic()
        took, self.since = now - self.since, now
        number, touched = outcome.site.number, outcome.touched
        if touched is None:
            self._show([f"site {number}: failed, {outcome.reason}"], keep=True)
            return
        self.done.add(number)
        size = float(np.linalg.norm(touched.reading))
        left = (self.args.touches - len(self.done)) * (now - self.begun) / max(1, len(self.done) - self.before)
        line = (
            f"touch {len(self.done)}/{self.args.touches}  site {number}  {ENDS[outcome.code]}  {size:.1f} uT  "
            f"{touched.force:.2f} N  {1e3 * touched.depth:.2f} mm  {took:.1f} s  {kept.kept[-1].name}"
        )
        bars = [
            f"  chip {i} {axis}  {value:+7.1f}  {bar(value / SCALE)}"
            for i in range(CHIPS)
            for axis, value in zip("xyz", touched.reading[3 * i : 3 * i + 3], strict=True)
        ]
        self._show([line, *bars, f"  {left / 60:.0f} min to go"] if self.live else [line])

    def _show(self, lines: list[str], keep: bool = False) -> None:
        print(f"\x1b[{self.drawn}F\x1b[J" if self.drawn else "", "\n".join(lines), sep="", flush=True)
        self.drawn = 0 if keep or not self.live else len(lines)

    def summary(self, kept: Recorder) -> str:
        """The end of a session."""
        made = len(kept.kept)
        ways = ", ".join(f"{count} {ENDS[code]}" for code, count in sorted(self.codes.items()))
        seconds = time.monotonic() - self.begun
        lost = self.procedure.skin.counters
        lines = [
            f"{len(self.done)} of {self.args.touches} touches are in {self.args.out}; {made} of them now ({ways})",
            f"{seconds / max(1, made):.2f} s and {kept.bytes / max(1, made) / 1024:.0f} KiB a touch; of {lost.samples} "
            f"samples {lost.lost} were lost; {len(self.procedure.unreachable)} sites cannot be reached",
        ]
        if len(self.done) < self.args.touches:
            lines.append("the same command goes on where this stopped")
        return "\n".join(lines)


def _resumed(args: Args, name: str) -> tuple[dict[int, float], dict[str, Any]]:
    """Sites that were touched and when (Unix time), and the notes of the collection. Raises DataError."""
    files = recorder.touches_in(args.out) if args.out.is_dir() else []
    notes = recorder.read_notes(args.out)
    same = {
        "object": name,
        "seed": args.seed,
        "devices": [args.arm, args.skin, args.camera],
        "pose": args.pose,
        "sites": json.loads(json.dumps(vars(args.sites))),
    }
    same = json.loads(json.dumps(same))
    if notes is None:
        if files:
            raise DataError(f"{args.out} holds touches of another making; choose another --out")
        notes = {**same, "run": args.run or f"{name}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC", "unreachable": {}}
        return {}, notes
    different = [key for key, value in same.items() if notes.get(key) != value]
    if different:
        raise DataError(
            f"{args.out} was begun with another {' and '.join(different)} "
            f"({'; '.join(f'{key}: {notes.get(key)}' for key in different)}); pass that again, or another --out"
        )
    if args.run:
        notes["run"] = args.run
    return {recorder.site_of(file): recorder.written_at(file) for file in files}, notes


def _rig(args: Args) -> Rig:
    if args.rig is None and args.arm == "ur":
        raise ValueError("a real arm needs to know its lab; write a rig (python -m i2t.hardware.rig) and pass --rig")
    rig = wiring.read_rig(args.rig)
    if args.pose is None:
        return rig
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = args.pose[:3], Rotation.from_euler("xyz", args.pose[3:], degrees=True).as_matrix()
    return replace(rig, T_world_object=T, object_from="given")


def _wanted(args: Args, done: dict[int, float]) -> wiring.Wanted:
    begin = max(done.values(), default=0.0) + 1.0
    return wiring.Wanted(
        args.arm, args.skin, args.camera, args.host, args.port, args.replay, args.views, args.pad, args.seed,
        args.exact, args.stiffness, args.stale, args.watchdog, begin,
    )  # fmt: skip


def _headline(args: Args, source: str, name: str) -> str:
    devices = f"arm {args.arm}, skin {args.skin}, camera {args.camera}"
    said = {
        "simulated": "SIMULATED: no real device takes part",
        "mixed": "MIXED: some of these devices are not real",
        "real": "real devices",
    }[source]
    return f"{name}: {devices} ({said})"


def _pad_name(args: Args) -> str:
    if args.skin == "reskin":
        return "skin"
    return f"simulated, {args.pad.stem}" if args.pad else "simulated pad 0"


def _warm(camera: Camera, plan: Plan) -> Cut:
    """What cuts patches, compiled."""
    cut = cutter()
    pose = plan.site(0).T_w_t
    cut(View(0.0, np.full((camera.height, camera.width), 0.1, np.float32), None), camera, pose, pose)
    return cut


def _terminated(*_: Any) -> None:
    sys.exit(128 + signal.SIGTERM)
