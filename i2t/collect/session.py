"""Session of collecting: one flow from the command line to the last touch, and reports meanwhile.

The devices are made and connected for what `i2t.collect.beginning` found, skins and camera are checked, the rig is
tried by first looks and a slow touch, and then site after site is touched; a dry run ends before anything moves.
`i2t.collect.command` is its command line.
"""

import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from functools import cached_property
from typing import Any

import numpy as np

from i2t.collect.arguments import CollectArgs
from i2t.collect.beginning import MISSING_RIG_MESSAGE, Beginning
from i2t.collect.checks import require_checks, still_checks, touch_checks
from i2t.collect.devices import Devices, make_devices
from i2t.collect.dry_run import dry_run
from i2t.collect.notes import board_notes, device_notes, keep_same, serial_number, write_notes
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import Recorder, SessionInfo, SkinInfo
from i2t.collect.registration_check import where_all_stood
from i2t.collect.site_plan import SiteSampler, extract_patch
from i2t.collect.touch import ChooseSite, Site, SiteOutcome
from i2t.dataset import SKIN_NAME, Dataset, load_dataset
from i2t.dataset.card import write_card
from i2t.errors import DataError, DeviceError, printable
from i2t.hardware.protocols import View
from i2t.hardware.rig import Rig
from i2t.skin.boards import name_of_board
from i2t.types import ReturnCode

ENDS = {
    ReturnCode.SKIN: "stopped by the skin",
    ReturnCode.WRENCH: "stopped by force or torque",
    ReturnCode.AIR: "met air",
    ReturnCode.FAILED: "failed",
}
SAID_OF_SOURCES = {
    "simulated": "SIMULATED: no real device takes part",
    "mixed": "MIXED: some of these devices are not real",
    "real": "real devices",
}


def collect(
    begun: Beginning, choose: ChooseSite | None = None, on_outcome: Callable[[SiteOutcome], None] | None = None
) -> int:
    """A collection from its beginning, or from where it stopped, to its end.

    Args:
        begun: As `i2t.collect.beginning.begin` found it.
        choose: Says which site is next; by default the next of a random list.
        on_outcome: Called with each touch once it is saved.

    Returns:
        The exit code.

    Raises:
        ValueError: What was asked for does not go together, or cannot be read.
        DeviceError: A person is needed.
    """
    args, rig, name, target, done, notes = begun
    if not args.dry_run and len(done) >= args.touches:
        print(f"{len(done)} touches are there already; raise --touches for more")
        return 0
    sampler = SiteSampler(target, rig.T_world_object, args.sites, args.world.seed, name)
    with ExitStack() as stack:
        devices = make_devices(args, rig, stack, begin=max(done.values(), default=0.0) + 1.0)
        if args.lab.rig is None and devices.arm.features.source == "real":
            raise ValueError(MISSING_RIG_MESSAGE)
        procedure = _connect(args, devices, rig, sampler, notes, stack)
        kinds = f"arm {args.arm.kind}, skin {args.skin.kind}, camera {args.camera.kind}"
        print(f"{printable(name)}: {kinds} ({SAID_OF_SOURCES[devices.source]})")
        for each in devices.skins:
            if each.note:
                print(printable(f"{each.name or rig.skin}: {each.note}" if len(devices.skins) > 1 else each.note))
        if args.dry_run:
            return dry_run(procedure, sampler, args)
        require_checks(still_checks(strict=False), procedure)
        info = _session_info(args, procedure, devices, name, notes)
        recorder = stack.enter_context(Recorder(args.out, info, devices.clock))
        recorder.check()
        if not args.skip_first_touch:
            require_checks(touch_checks(sampler), procedure)
        write_notes(args.out, notes)
        session = _Session(args, procedure, sampler, recorder, set(done))
        session.run(choose, on_outcome)
    if session.is_complete:  # said when all devices are let go, as it takes half a minute
        print(session.where_all_stood())
    return 0


def _connect(
    args: CollectArgs, devices: Devices, rig: Rig, sampler: SiteSampler, notes: dict[str, Any], stack: ExitStack
) -> Procedure:
    """Connect the devices, and put them together to a procedure. The arm is connected last, as it must not wait for a
    compiler. Raises DataError where a device is another one than the folder's.
    """
    for each in devices.skins:
        skin = stack.enter_context(each.skin)
        keep_same(notes, device_notes("skin", skin, each.name) | board_notes(each), args.out)
    camera = stack.enter_context(devices.camera)
    keep_same(notes, device_notes("camera", camera), args.out)
    pose = sampler.site(0).T_w_t
    blank = np.full((camera.camera.height, camera.camera.width), 0.1, np.float32)
    extract_patch(View(0.0, blank, None), camera.camera, pose, pose)  # which compiles it
    arm = stack.enter_context(devices.arm)
    keep_same(notes, device_notes("arm", arm), args.out)
    return Procedure(
        arm,
        devices.skins,
        camera,
        rig,
        extract_patch=extract_patch,
        top=sampler.top,
        settings=args.settings,
        clock=devices.clock,
    )


def _session_info(
    args: CollectArgs, procedure: Procedure, devices: Devices, name: str, notes: Mapping[str, Any]
) -> SessionInfo:
    """Metadata that the data set has of every touch of this session."""
    arm, camera, rig = procedure.arm, procedure.camera, procedure.rig
    skins = {}
    for each in devices.skins:
        about = {
            "skin": f"{each.skin.features.name} ({each.skin.features.source})",
            "skin serial number": serial_number(each.skin),
        }
        about |= {"board": each.note} if each.note else {}
        named = {SKIN_NAME: each.name or rig.skin} if len(devices.skins) > 1 else {}
        skins[each.name] = SkinInfo(each.pad, each.board, about | named)
    about = {
        "arm": arm.features.name,
        "arm serial number": serial_number(arm),
        "camera serial number": serial_number(camera),
        "rig": notes["rig"],
        "settings": json.dumps(vars(args.settings)),
    }
    meta = {key: value for key, value in about.items() if value}
    T_w_b, T_w_o = rig.T_world_base, rig.T_world_object
    return SessionInfo(name, notes["session"], devices.source, T_w_b, T_w_o, camera.camera, skins, meta)


class _Session:
    """Choice of the next site, and reports meanwhile."""

    def __init__(
        self,
        args: CollectArgs,
        procedure: Procedure,
        sampler: SiteSampler,
        recorder: Recorder,
        done: set[int],
    ) -> None:
        self.args, self.procedure, self.sampler, self.recorder = args, procedure, sampler, recorder
        self.done, self.tried = done, set(done)
        self.before, self.unreachable = len(done), 0
        self.codes: Counter[ReturnCode] = Counter()
        self.begun = self.since = time.monotonic()

    def run(self, choose: ChooseSite | None, on_outcome: Callable[[SiteOutcome], None] | None) -> None:
        """Touch until there are enough, and say what was made however it ends."""
        out, procedure = self.args.out, self.procedure
        try:
            for outcome in procedure.run(choose or self.choose, self.recorder):
                self.report(outcome)
                if on_outcome is not None:
                    on_outcome(outcome)
        finally:
            with suppress(DataError):  # nothing is lost with a card, and touches that cannot be read say so themselves
                write_card(out, self.collected, board_name=name_of_board(self.collected.board))
            print(self.summary())

    @cached_property
    def collected(self) -> Dataset:
        """All touches of the folder, of one skin, once none is added any more."""
        skin = self.procedure.rig.skin if len(self.procedure.skins) > 1 else None
        return load_dataset(self.args.out, missing_chips=True, skin=skin)

    @property
    def is_complete(self) -> bool:
        """Tell whether there are as many touches as were asked for."""
        return len(self.done) >= self.args.touches

    def where_all_stood(self) -> str:
        """Where the object and the camera were, by all touches of this session; they are safe whatever comes of it."""
        try:
            last = int(self.collected.touches.session[-1])
            return where_all_stood(self.collected, self.sampler.mesh, last, self.procedure.rig)
        except ValueError as error:
            return printable(f"note: where object and camera were is not known: {error}")

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """The next sampled site that can be reached, until there are enough touches."""
        while len(self.done) < self.args.touches:
            site = self.sampler.next(self.tried)
            self.tried.add(site.number)
            why = self.procedure.path.why_not(site)
            if not why:
                return site
            self.unreachable += 1
            if self.unreachable > 20 + 20 * self.args.touches:
                raise DeviceError(f"hardly any site can be reached, the last not because {why}")
        return None

    def report(self, outcome: SiteOutcome) -> None:
        """Show a touch."""
        self.codes[outcome.code] += 1
        now = time.monotonic()
        took, self.since = now - self.since, now
        number, touch = outcome.site.number, outcome.touch
        if touch is None:
            print(printable(f"site {number}: failed, {outcome.reason}"), flush=True)
            return
        self.done.add(number)
        left = (self.args.touches - len(self.done)) * (now - self.begun) / max(1, len(self.done) - self.before)
        felt = "  ".join(
            f"{printable(name)} {ENDS[each.code]}  {np.sqrt(np.nansum(each.reading**2)):.1f} uT".strip()
            for name, each in touch.skins.items()
        )
        print(
            f"touch {len(self.done)}/{self.args.touches}  site {number}  {felt}  {touch.force:.2f} N  "
            f"{1e3 * touch.depth:.2f} mm  {took:.1f} s, {left / 60:.0f} min to go  {self.recorder.saved[-1].name}",
            flush=True,
        )

    def summary(self) -> str:
        """The end of a session."""
        made, seconds = len(self.recorder.saved), time.monotonic() - self.begun
        ends = ", ".join(f"{count} {ENDS[code]}" for code, count in sorted(self.codes.items()))
        counted = [each.skin.counters for each in self.procedure.skins]
        samples, lost = sum(each.samples for each in counted), sum(each.lost for each in counted)
        lines = [
            f"{len(self.done)} of {self.args.touches} touches are in {self.args.out}; {made} of them now ({ends})",
            f"{seconds / max(1, made):.2f} s and {self.recorder.bytes / max(1, made) / 1024:.0f} KiB a touch; of "
            f"{samples} samples {lost} were lost; {self.unreachable} sites cannot be reached",
        ]
        if len(self.done) < self.args.touches:
            lines.append("the same command goes on where this stopped")
        return "\n".join(lines)
