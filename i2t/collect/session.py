"""Session of a collection, from its start to the last touch, with progress reports.

The devices are made and connected, skins and camera are checked, the rig is checked by first looks and slow touches,
and then site after site is touched. A dry run ends before any motion. `i2t.collect.command` is the command line.
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
from i2t.collect.checks import motionless_checks, require_checks, touch_checks
from i2t.collect.devices import Devices, make_devices
from i2t.collect.dry_run import dry_run
from i2t.collect.folder_notes import board_notes, device_notes, require_same, serial_number, write_notes
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import Recorder, SessionInfo, SkinInfo
from i2t.collect.registration_check import describe_offsets
from i2t.collect.site_plan import SiteSampler, extract_patch
from i2t.collect.start import MISSING_RIG_MESSAGE, PreparedCollection
from i2t.collect.touch import ChooseSite, Site, SiteOutcome
from i2t.dataset import SKIN_NAME, Dataset, load_dataset
from i2t.dataset.card import write_card
from i2t.errors import DataError, DeviceError, printable
from i2t.hardware.protocols import View
from i2t.hardware.rig import Rig
from i2t.skin.boards import name_of_board
from i2t.types import ReturnCode

# How a press ended, in the words of the progress line, by return code.
PRESS_ENDS = {
    ReturnCode.SKIN: "stopped by the skin",
    ReturnCode.WRENCH: "stopped by force or torque",
    ReturnCode.AIR: "no contact",
    ReturnCode.FAILED: "failed",
}
# Words of the first line of a collection, by the source of its touches.
SOURCE_DESCRIPTIONS = {
    "simulated": "SIMULATED: no real device takes part",
    "mixed": "MIXED: some of these devices are not real",
    "real": "real devices",
}


def collect(
    begun: PreparedCollection, choose: ChooseSite | None = None, on_outcome: Callable[[SiteOutcome], None] | None = None
) -> int:
    """Carry out a collection, from its start or from where it stopped, to its end.

    Args:
        begun: The collection, as `i2t.collect.start.begin` returned it.
        choose: Function that chooses the next site from the outcomes of earlier ones; by default, the next random
            site.
        on_outcome: Function that is called with each touch once it is saved.

    Returns:
        The exit code: 0 if nothing failed, or 1 if a dry run found a defect.

    Raises:
        ValueError: If options contradict each other, or a file cannot be read.
        DeviceError: If a device fails in a way that a person must remedy.
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
        about = name if choose is None else f"touches recorded as {name}"  # a recogniser does not know the object
        print(f"{printable(about)}: {kinds} ({SOURCE_DESCRIPTIONS[devices.source]})")
        for on_tool in devices.skins:
            if on_tool.note:
                named = f"{on_tool.name or rig.skin}: {on_tool.note}" if len(devices.skins) > 1 else on_tool.note
                print(printable(named))
        if args.dry_run:
            return dry_run(procedure, sampler, args)
        require_checks(motionless_checks(strict=False), procedure)
        info = _session_info(args, procedure, devices, name, notes)
        recorder = stack.enter_context(Recorder(args.out, info, devices.clock))
        recorder.check()
        if not args.skip_first_touch:
            require_checks(touch_checks(sampler), procedure)
        write_notes(args.out, notes)
        session = _Session(args, procedure, sampler, recorder, set(done))
        session.run(choose, on_outcome)
    if session.is_complete:  # printed after the devices were released, because it takes half a minute
        print(session.offsets_sentence())
    return 0


def _connect(
    args: CollectArgs, devices: Devices, rig: Rig, sampler: SiteSampler, notes: dict[str, Any], stack: ExitStack
) -> Procedure:
    """Connect the devices and combine them to a procedure. Raise DataError if the folder was begun with another device.

    The arm is connected last, because it must not wait for a compiler.
    """
    for on_tool in devices.skins:
        skin = stack.enter_context(on_tool.skin)
        require_same(notes, device_notes("skin", skin, on_tool.name) | board_notes(on_tool), args.out)
    camera = stack.enter_context(devices.camera)
    require_same(notes, device_notes("camera", camera), args.out)
    pose = sampler.site(0).T_w_t
    blank = np.full((camera.camera.height, camera.camera.width), 0.1, np.float32)
    extract_patch(View(0.0, blank, None), camera.camera, pose, pose)  # compiles the function
    arm = stack.enter_context(devices.arm)
    require_same(notes, device_notes("arm", arm), args.out)
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
    """Collect the metadata that the data set holds for every touch of this session."""
    arm, camera, rig = procedure.arm, procedure.camera, procedure.rig
    skins = {}
    for on_tool in devices.skins:
        about = {
            "skin": f"{on_tool.skin.features.name} ({on_tool.skin.features.source})",
            "skin serial number": serial_number(on_tool.skin),
        }
        about |= {"board": on_tool.note} if on_tool.note else {}
        named = {SKIN_NAME: on_tool.name or rig.skin} if len(devices.skins) > 1 else {}
        skins[on_tool.name] = SkinInfo(on_tool.pad, on_tool.board, about | named)
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
    """Choice of the next site, and progress reports."""

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
        self.before, self.unreachable, self.bound = len(done), 0, ""
        self.codes: Counter[ReturnCode] = Counter()
        self.begun = self.since = time.monotonic()

    def run(self, choose: ChooseSite | None, on_outcome: Callable[[SiteOutcome], None] | None) -> None:
        """Touch until there are enough touches, and print a summary however the run ends."""
        out, procedure = self.args.out, self.procedure
        self.bound = "" if choose is None else "at most "  # a recogniser may stop earlier
        try:
            for outcome in procedure.run(choose or self.choose, self.recorder):
                self.report(outcome)
                if on_outcome is not None:
                    on_outcome(outcome)
        finally:
            with suppress(DataError):  # the card is optional, and unreadable touches are reported elsewhere
                write_card(out, self.collected, board_name=name_of_board(self.collected.board))
            print(self.summary(can_resume=choose is None))

    @cached_property
    def collected(self) -> Dataset:
        """All touches of the folder, of one skin. Read it once no touch is added any more."""
        skin = self.procedure.rig.skin if len(self.procedure.skins) > 1 else None
        return load_dataset(self.args.out, missing_chips=True, skin=skin)

    @property
    def is_complete(self) -> bool:
        """Whether the requested number of touches was made."""
        return len(self.done) >= self.args.touches

    def offsets_sentence(self) -> str:
        """Describe where the object and the camera were, by all touches of this session, which are stored by then."""
        try:
            last = int(self.collected.touches.session[-1])
            return describe_offsets(self.collected, self.sampler.mesh, last, self.procedure.rig)
        except ValueError as error:
            return printable(f"note: the poses of object and camera are unknown: {error}")

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """Choose the next random site that can be reached, until there are enough touches."""
        while len(self.done) < self.args.touches:
            site = self.sampler.next(self.tried)
            self.tried.add(site.number)
            why = self.procedure.path.explain_unreachable(site)
            if not why:
                return site
            self.unreachable += 1
            if self.unreachable > 20 + 20 * self.args.touches:
                raise DeviceError(f"hardly any site can be reached; the last is unreachable because {why}")
        return None

    def report(self, outcome: SiteOutcome) -> None:
        """Print the outcome of a site."""
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
            f"{printable(name)} {PRESS_ENDS[skin.code]}  {np.sqrt(np.nansum(skin.reading**2)):.1f} uT".strip()
            for name, skin in touch.skins.items()
        )
        # A touch without contact has no travel, and one that several skins felt has no force of one skin.
        measured = [(touch.force, "N"), (1e3 * touch.travel, "mm")]
        numbers = "".join(f"{value:.2f} {unit}  " for value, unit in measured if np.isfinite(value))
        print(
            f"touch {len(self.done)}/{self.args.touches}  site {number}  {felt}  {numbers}"
            f"{took:.1f} s, {self.bound}{np.ceil(left / 60):.0f} min to go  {self.recorder.saved[-1].name}",
            flush=True,
        )

    def summary(self, *, can_resume: bool) -> str:
        """Summarise the session. A session whose sites a recogniser chooses cannot be resumed."""
        saved, seconds = len(self.recorder.saved), time.monotonic() - self.begun
        ends = ", ".join(f"{count} {PRESS_ENDS[code]}" for code, count in sorted(self.codes.items()))
        counts = [on_tool.skin.counters for on_tool in self.procedure.skins]
        samples, lost = sum(count.samples for count in counts), sum(count.lost for count in counts)
        lines = [
            f"{len(self.done)} of {self.args.touches} touches are in {self.args.out}; {saved} of them new ({ends})",
            f"{seconds / max(1, saved):.2f} s and {self.recorder.bytes / max(1, saved) / 1024:.0f} KiB a touch; of "
            f"{samples} samples {lost} were lost; {self.unreachable} sites cannot be reached",
        ]
        if can_resume and len(self.done) < self.args.touches:
            lines.append("the same command resumes the collection")
        return "\n".join(lines)
