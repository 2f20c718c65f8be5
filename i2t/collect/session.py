"""Session of collecting: touches done before, choice of the next site, and reports meanwhile.

`i2t.collect.command` is its command line.
"""

import hashlib
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.collect import recorder
from i2t.collect.arguments import CollectArgs, LabArgs, SkinArgs
from i2t.collect.device_configs import device_config
from i2t.collect.devices import Devices, make_devices, source_of, stall_watch_s
from i2t.collect.dry_run import check_camera, dry_run
from i2t.collect.first_touch import first_touch
from i2t.collect.procedure import Procedure
from i2t.collect.recorder import CarriedSkinInfo, Recorder, SessionInfo
from i2t.collect.session_ambient import fitted_ambient
from i2t.collect.site_plan import SiteSampler, patch_extractor
from i2t.collect.touch import ChooseSite, ExtractPatch, Site, SiteOutcome, UnreachableError
from i2t.dataset import load_dataset, read_touch
from i2t.dataset.card import write_card
from i2t.depth.camera import Camera
from i2t.errors import DataError, DeviceError
from i2t.hardware.protocols import View, channel_names
from i2t.hardware.reskin.monitor import bar
from i2t.hardware.rig import RENAMED_RIG_KEYS, Rig
from i2t.hardware.rig_checks import require_plausible
from i2t.hardware.skin_health import check_skin, require_healthy, rest_samples
from i2t.objects.named import read_object
from i2t.objects.solids import Mesh
from i2t.skin.boards import DEFAULT_BOARD, board_note, name_of_board
from i2t.types import ReturnCode

ENDS = {
    ReturnCode.SKIN: "stopped by the skin",
    ReturnCode.WRENCH: "stopped by force or torque",
    ReturnCode.AIR: "met air",
    ReturnCode.FAILED: "failed",
}
NO_RIG = "a real arm needs to know its lab; write a rig (python -m i2t.hardware.rig) and pass --rig"
CHANGEABLE_SETTINGS = ("retries", "failures", "patience")  # settings that say when to give up, and nothing of a touch
BAR_SCALE_UT = 50.0  # at the end of a bar


def collect(
    args: CollectArgs, choose: ChooseSite | None = None, on_outcome: Callable[[SiteOutcome], None] | None = None
) -> int:
    """A collection from its beginning, or from where it stopped, to its end.

    Args:
        args: As on the command line.
        choose: Says which site is next; by default the next of a random list.
        on_outcome: Called with each touch once it is saved.

    Returns:
        The exit code.

    Raises:
        ValueError: What was asked for does not go together, or cannot be read.
        DeviceError: A person is needed.
    """
    rig = read_rig(args.lab, real=args.arm.kind == "ur")
    world = args.world
    target = read_object(world.object, world.unit)
    name = args.name or (target.name if world.object == target.name else Path(world.object).stem)
    if not args.lab.trust_rig and not args.dry_run:
        require_plausible(rig, target.mesh.vertices)
    done, notes = _resume(args, name, rig, target.mesh)
    begin = max(done.values(), default=0.0) + 1.0
    config = device_config(args.arm, args.skin, args.camera, world, begin=begin, rig=rig)
    sampler = SiteSampler(target.mesh, rig.T_world_object, args.sites, world.seed, name)
    with ExitStack() as stack:
        devices = make_devices(config, rig, stack)
        if args.lab.rig is None and devices.arm.features.source == "real":
            raise ValueError(NO_RIG)
        if not args.dry_run and len(done) >= args.touches:
            print(f"{len(done)} touches are there already; raise --touches for more")
            return 0
        procedure = _connect(args, devices, rig, sampler=sampler, notes=notes, stack=stack)
        print(_headline(args, source_of(devices), name))
        print("".join(f"{note}\n" for note in _board_notes(args.skin.board, rig).values()), end="")
        _check_boards(args.out, devices, rig)
        check_camera(procedure)
        if args.dry_run:
            watch_s = stall_watch_s(config.arm)
            return dry_run(procedure, sampler, name, args.touches, args.out, ambient=args.ambient, watch_s=watch_s)
        _check_health(procedure)
        info = _session_info(args, procedure, devices, name=name, notes=notes)
        file_recorder = stack.enter_context(Recorder(args.out, info, devices.clock))
        file_recorder.check()
        if not args.skip_first_touch:
            first_touch(procedure, sampler)
        procedure.ambient_field = fitted_ambient(procedure, args.ambient, args.out, seed=world.seed)
        session = _Session(args, procedure, sampler, set(done))
        _run(session, choose or session.choose, file_recorder, notes, on_outcome)
    return 0


def _connect(
    args: CollectArgs, devices: Devices, rig: Rig, *, sampler: SiteSampler, notes: dict[str, Any], stack: ExitStack
) -> Procedure:
    """Connect the devices, and put them together to a procedure. The arm is connected last, as it must not wait for a
    compiler. Raises DataError where the skin is another one than the folder's.
    """
    skin = stack.enter_context(devices.skin)
    camera = stack.enter_context(devices.camera)
    extract_patch = _compiled_extractor(camera.camera, sampler)
    _keep_serial(notes, "skin", _serial_number(skin), args.out)
    _keep_serial(notes, "camera", _serial_number(camera), args.out)
    for each in devices.carried:
        _keep_serial(notes, f"skin {each.name}", _serial_number(stack.enter_context(each.skin)), args.out)
    arm = stack.enter_context(devices.arm)
    _keep_serial(notes, "arm", _serial_number(arm), args.out)
    return Procedure(
        arm,
        skin,
        camera,
        rig,
        board=devices.board,
        extract_patch=extract_patch,
        top=sampler.top,
        settings=args.settings,
        clock=devices.clock,
        unreachable={int(number): why for number, why in notes["unreachable"].items()},
        carried=devices.carried,
    )


def _board_notes(board: str | None, rig: Rig) -> dict[str, str]:
    """Notes on the places of the chips of named boards, by the skins' names."""
    names = {rig.skin: board or DEFAULT_BOARD, **{place.name: place.board for place in rig.skins}}
    several = len(names) > 1
    notes = {name: board_note(board) for name, board in names.items()}
    return {name: f"{name}: {note}" if several else note for name, note in notes.items() if note}


def _check_boards(out: Path, devices: Devices, rig: Rig) -> None:
    """Refuse boards whose chips lie or turn otherwise than in the touches that are there: no set could hold both."""
    files = recorder.touches_in(out) if out.is_dir() else []
    if not files:
        return
    record = read_touch(files[0])
    now = {rig.skin: devices.board, **{each.name: each.board for each in devices.carried}}
    before = {rig.skin: record.touch.board, **{name: each.board for name, each in record.skins.items()}}
    for name, board in now.items():
        earlier = before.get(name, board)
        same = all(a.shape == b.shape and np.allclose(a, b, atol=1e-6) for a, b in zip(board, earlier, strict=True))
        if not same:
            which = f"of the skin {name} " if len(now) > 1 else ""
            raise DataError(
                f"{out} was begun with a board {which}whose chips lie or turn otherwise; pass that board, as a file if "
                "it has no name (--board my_board.toml), or another --out"
            )


def _check_health(procedure: Procedure) -> None:
    """Refuse skins that are dead, frozen or saturated, and say what else is wrong with them; nothing moves."""
    names = {"": procedure.skin, **{each.name: each.skin for each in procedure.carried}}
    for name, skin in names.items():
        health = check_skin(rest_samples(skin, procedure.clock))
        which = f"the skin {name}, " if name else ""
        require_healthy(health, f"{which}{skin.features.name}")
        print(f"skin{f' {name}' if name else ''} at rest: {health.summary}")
        for defect in health.defects:
            print(f"              {defect.sentence}")


def _session_info(
    args: CollectArgs, procedure: Procedure, devices: Devices, *, name: str, notes: dict[str, Any]
) -> SessionInfo:
    """Metadata that the data set has of every touch of this session."""
    arm, skin, rig = procedure.arm, procedure.skin, procedure.rig
    return SessionInfo(
        object=name,
        pad=args.pad_name or _pad_name(args.skin, args.world.pad),
        session=notes["session"],
        source=source_of(devices),
        board=devices.board,
        T_w_b=rig.T_world_base,
        T_w_o=rig.T_world_object,
        camera=procedure.camera.camera,
        meta={
            "arm": arm.features.name,
            "skin": f"{skin.features.name} ({skin.features.source})",
            **{
                f"{kind} serial number": number
                for kind, device in (("skin", skin), ("arm", arm), ("camera", procedure.camera))
                if (number := _serial_number(device)) or kind == "skin"
            },
            "rig": notes["rig"],
            "settings": json.dumps(vars(args.settings)),
            **({"board": said} if (said := board_note(args.skin.board or DEFAULT_BOARD)) else {}),
        },
        skin=rig.skin if devices.carried else "",
        carried={
            each.name: CarriedSkinInfo(
                each.pad or each.name,
                each.board,
                {
                    "skin": f"{each.skin.features.name} ({each.skin.features.source})",
                    "skin serial number": _serial_number(each.skin),
                    "board": board_note(place.board),
                },
            )
            for each, place in zip(devices.carried, rig.skins, strict=True)
        },
    )


def _serial_number(device: object) -> str:
    """Serial number of a connected device: a board on USB, a camera, an arm's controller; "" where it has none."""
    number = getattr(device, "serial_number", None) or getattr(getattr(device, "info", None), "serial_number", None)
    return str(number or "")


def _run(
    session: "_Session",
    choose: ChooseSite,
    file_recorder: Recorder,
    notes: dict[str, Any],
    on_outcome: Callable[[SiteOutcome], None] | None,
) -> None:
    """Touch until there are enough, and leave notes for the next time however it ends."""
    out, procedure = session.args.out, session.procedure
    recorder.write_notes(out, notes)
    try:
        for outcome in procedure.run(choose, file_recorder):
            session.report(outcome, file_recorder)
            if on_outcome is not None:
                on_outcome(outcome)
    finally:
        notes["unreachable"] = {str(number): why for number, why in procedure.unreachable.items()}
        recorder.write_notes(out, notes)
        with suppress(DataError):  # nothing is lost with a card, and touches that cannot be read say so where they are
            several = session.procedure.rig.skin if session.procedure.carried else None
            collected = load_dataset(out, missing_chips=True, skin=several)
            write_card(out, collected, board_name=name_of_board(collected.board))
        print(session.summary(file_recorder))


class _Session:
    """Choice of the next site, and reports meanwhile."""

    def __init__(self, args: CollectArgs, procedure: Procedure, sampler: SiteSampler, done: set[int]) -> None:
        self.args, self.procedure, self.sampler, self.done = args, procedure, sampler, done
        self.before = len(done)
        self.tried = set(done)
        self.codes: Counter[ReturnCode] = Counter()
        self.begun = self.since = time.monotonic()
        self.live = sys.stdout.isatty()
        self.contradicted = False  # whether the last touch's ambient contradicted the fitted field
        self.drawn = 0

    def choose(self, history: Sequence[SiteOutcome]) -> Site | None:
        """The next sampled site that can be reached, until there are enough touches."""
        if len(self.done) >= self.args.touches:
            return None
        while True:
            site = self.sampler.next(self.tried)
            self.tried.add(site.number)
            try:
                self.procedure.path.check(site)
                return site
            except UnreachableError as error:
                self.procedure.unreachable[site.number] = str(error)
                if len(self.procedure.unreachable) > 20 + 20 * self.args.touches:
                    raise DeviceError(f"hardly any site can be reached, the last not because {error}") from error

    def report(self, outcome: SiteOutcome, file_recorder: Recorder) -> None:
        """Show a touch."""
        self.codes[outcome.code] += 1
        now = time.monotonic()
        took, self.since = now - self.since, now
        number, touch = outcome.site.number, outcome.touch
        if touch is None:
            self._show([f"site {number}: failed, {outcome.reason}"], keep=True)
            return
        self.done.add(number)
        change = touch.ambient_change
        if change is not None and change.changed and not self.contradicted:
            self._show([f"{change.sentence}; free poses now would fit it anew (--ambient.poses)"], keep=True)
        self.contradicted = change is not None and change.changed
        size = float(np.sqrt(np.nansum(touch.reading**2)))
        left = (self.args.touches - len(self.done)) * (now - self.begun) / max(1, len(self.done) - self.before)
        line = (
            f"touch {len(self.done)}/{self.args.touches}  site {number}  {ENDS[outcome.code]}  {size:.1f} uT  "
            f"{touch.force:.2f} N  {1e3 * touch.depth:.2f} mm  {took:.1f} s  {file_recorder.saved[-1].name}"
        )
        names = (name.replace("chip", "chip ").replace("_", " ") for name in channel_names(len(touch.reading) // 3))
        bars = [
            f"  {name}  {value:+7.1f}  {bar(value / BAR_SCALE_UT)}" if np.isfinite(value) else f"  {name}  missing"
            for name, value in zip(names, touch.reading, strict=True)
        ]
        line += "".join(
            f"  {name} {ENDS[each.code]} {np.sqrt(np.nansum(each.reading**2)):.1f} uT"
            for name, each in touch.carried.items()
        )
        self._show([line, *bars, f"  {left / 60:.0f} min to go"] if self.live else [line])

    def _show(self, lines: list[str], keep: bool = False) -> None:
        print(f"\x1b[{self.drawn}F\x1b[J" if self.drawn else "", "\n".join(lines), sep="", flush=True)
        self.drawn = 0 if keep or not self.live else len(lines)

    def summary(self, file_recorder: Recorder) -> str:
        """The end of a session."""
        made = len(file_recorder.saved)
        ends = ", ".join(f"{count} {ENDS[code]}" for code, count in sorted(self.codes.items()))
        seconds = time.monotonic() - self.begun
        counted = [skin.counters for skin in (self.procedure.skin, *(each.skin for each in self.procedure.carried))]
        samples, lost = sum(each.samples for each in counted), sum(each.lost for each in counted)
        lines = [
            f"{len(self.done)} of {self.args.touches} touches are in {self.args.out}; {made} of them now ({ends})",
            f"{seconds / max(1, made):.2f} s and {file_recorder.bytes / max(1, made) / 1024:.0f} KiB a touch; of "
            f"{samples} samples {lost} were lost; {len(self.procedure.unreachable)} sites cannot be "
            "reached",
        ]
        if len(self.done) < self.args.touches:
            lines.append("the same command goes on where this stopped")
        return "\n".join(lines)


def _resume(args: CollectArgs, name: str, rig: Rig, mesh: Mesh) -> tuple[dict[int, float], dict[str, Any]]:
    """Sites that were touched and when (Unix time), and the notes of the collection. Raises DataError."""
    files = recorder.touches_in(args.out) if args.out.is_dir() else []
    notes = recorder.read_notes(args.out)
    same = {
        "object": name,
        "seed": args.world.seed,
        "devices": [args.arm.kind, args.skin.kind, args.camera.kind],
        "board": args.skin.board or DEFAULT_BOARD,
        "pose": args.lab.pose,
        "sites": vars(args.sites),
        "settings": {key: value for key, value in vars(args.settings).items() if key not in CHANGEABLE_SETTINGS},
        "rig": _rig_hash(rig),
        "mesh": _mesh_hash(mesh),
    }
    same = json.loads(json.dumps(same))
    if notes is None:
        if files:
            raise DataError(f"{args.out} holds touches of another making; choose another --out")
        session = args.session or f"{name}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC"
        return {}, {**same, "session": session, "unreachable": {}}
    if "unreachable" not in notes or not {"session", "run"} & notes.keys():
        file = args.out / recorder.NOTES
        raise DataError(f"{file}: is damaged (it names no session); restore it from a copy, or pass another --out")
    if "run" in notes:  # as earlier versions called it
        notes["session"] = notes.pop("run")
    notes.setdefault("board", "reskin")  # earlier versions knew no other
    for key in ("settings", "rig", "mesh"):
        notes.setdefault(key, same[key])  # which earlier versions did not keep
    before, now = _by_name(notes), _by_name(same)
    different = [key for key, value in now.items() if before.get(key) != value]
    if different:
        raise DataError(
            f"{args.out} was begun with another {' and '.join(different)} "
            f"({'; '.join(f'{key}: {before.get(key)}' for key in different)}); pass that again, or another --out"
        )
    if args.session:
        notes["session"] = args.session
    return {recorder.site_number_of(file): recorder.written_at(file) for file in files}, notes


def _mesh_hash(mesh: Mesh) -> str:
    """Hash of a mesh, ten hexadecimal digits."""
    corners = np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]
    return hashlib.sha256(corners.round(7).tobytes()).hexdigest()[:10]


def _rig_hash(rig: Rig) -> str:
    """Hash of a rig and of the object's pose in it, ten hexadecimal digits. Keys have their earlier names, so that a
    collection that an earlier version began goes on.
    """
    text = rig.text()
    for earlier, name in RENAMED_RIG_KEYS["limits"].items():
        text = text.replace(f"\n{name} = ", f"\n{earlier} = ")
    return hashlib.sha256(text.encode()).hexdigest()[:10]


def _by_name(values: Mapping[str, Any]) -> dict[str, Any]:
    """Values by the names of the command line, those of groups as `settings.press`."""
    named: dict[str, Any] = {}
    for key, value in values.items():
        named |= {f"{key}.{name}": each for name, each in value.items()} if isinstance(value, dict) else {key: value}
    return named


def _keep_serial(notes: dict[str, Any], device: str, serial: str, out: Path) -> None:
    """Note a device's serial number ("" where it has none), one for all touches of a folder. Raises DataError."""
    kind, _, name = device.partition(" ")
    key = f"{kind}_serial {name}".strip()
    before = notes.setdefault(key, serial) or serial
    notes[key] = before
    if before and serial and before != serial:
        raise DataError(
            f"{out} was begun with the {kind} {before}, and this one is {serial}; "
            f"{'use' if kind == 'arm' else 'plug in'} that one, or pass another --out"
        )


# What the command line means


def read_rig(args: LabArgs, *, real: bool) -> Rig:
    """The lab's calibration, with the object where the command line says.

    Args:
        args: As on the command line.
        real: Whether a real arm will move.

    Returns:
        The rig; the emulators' own where none is named and no real arm is asked for.

    Raises:
        ValueError: A real arm needs a rig, or the file is damaged.
    """
    if args.rig is None and real:
        raise ValueError(NO_RIG)
    rig = Rig() if args.rig is None else Rig.read(args.rig)
    if args.pose is None:
        return rig
    T = np.eye(4)
    T[:3, 3], T[:3, :3] = args.pose[:3], Rotation.from_euler("xyz", args.pose[3:], degrees=True).as_matrix()
    return replace(rig, T_world_object=T, object_from="given")


# What is said


def _headline(args: CollectArgs, source: str, name: str) -> str:
    devices = f"arm {args.arm.kind}, skin {args.skin.kind}, camera {args.camera.kind}"
    said = {
        "simulated": "SIMULATED: no real device takes part",
        "mixed": "MIXED: some of these devices are not real",
        "real": "real devices",
    }[source]
    return f"{name}: {devices} ({said})"


def _pad_name(skin: SkinArgs, pad: Path | None) -> str:
    if skin.kind == "replay":
        return f"replay of {skin.replay.stem}" if skin.replay else "replay"
    if skin.kind not in ("simulated", "emulated"):
        return "skin"
    return f"simulated, {pad.stem}" if pad else "simulated pad 0"


def _compiled_extractor(camera: Camera, sampler: SiteSampler) -> ExtractPatch:
    """Patch extractor, compiled."""
    extract_patch = patch_extractor()
    pose = sampler.site(0).T_w_t
    blank = View(0.0, np.full((camera.height, camera.width), 0.1, np.float32), None)
    extract_patch(blank, camera, pose, pose)
    return extract_patch
