"""Look at i2t in the browser: an object under the mouse, an episode of recognition, recorded touches, a running skin.

    i2t view                                   the hammer of the catalogue
    i2t view mug.stl --unit mm                 an object of your own: click it to press the skin there
    i2t view DATA                              the touches of a session or data set
    i2t view live --skin reskin                the readings of a skin that is plugged in
    i2t view DATA --html                       a page in a file, for others

The page has the scenes "explore", "recognise", "replay" and "live" (docs/view.md).
"""

import os
import sys
import webbrowser
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import Count, Limits, docstring_of, require_with, require_writable
from i2t.cli.signals import ended_by_ctrl_c
from i2t.files.kinds import MESH_SUFFIXES
from i2t.models import ready_path
from i2t.models.checks import require_dataset, require_predictor
from i2t.models.finished import require_pad_model
from i2t.objects.named import require_object, require_objects, split_unit

if TYPE_CHECKING:
    from i2t.types import Pad
    from i2t.view.contents import Contents
    from i2t.view.server import Scene

EPISODE_OBJECTS = ("hammer", "screwdriver", "star", "cylinder", "square")  # candidates of an episode by default


@dataclass(frozen=True)
class ViewArgs:
    """Look at an object, an episode, recorded touches or a running skin in the browser."""

    # name of an object in the catalogue, a mesh file, a folder or file of touches, nominal (the touches that come
    # with i2t), or live
    what: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="WHAT")] = "hammer"
    # unit of mesh files whose names have none (mug.stl:mm); glTF is in metres
    unit: Literal["m", "cm", "mm", "inch"] | None = None
    # address to listen on. The page has no password
    host: str = "127.0.0.1"
    # port to listen on; the next free one if it is taken
    port: Annotated[int, Limits(1, 65535)] = 8080
    # open no browser
    no_browser: bool = False
    # scene to begin with; by default that of WHAT
    scene: Literal["explore", "recognise", "replay", "live"] | None = None
    # predictors to choose from: nominal, or folders in which one was trained
    models: tuple[str, ...] = ("nominal",)
    # pads to simulate with: nominal, files of pads, or boards (anyskin, grid-5x5) with a random pad
    pads: tuple[str, ...] = ("nominal",)
    # candidates of "recognise": names in the catalogue or mesh files; by default five, or those of --dataset
    objects: tuple[Path, ...] = ()
    # recorded sessions for "recognise", which "replay" shows too unless WHAT names others
    dataset: Path | None = None
    # pad model for "recognise": folder of a fit, file, or nominal
    pad_model: Path = Path("nominal")
    # skin for "live": reskin, emulated, a name that a package registers, or package.module:Class
    skin: str = "reskin"
    # port of the skin; by default, that of the only board that is plugged in
    address: str | None = None
    # board of the skin: reskin, anyskin, eflesh, grid-RxC, or a board file (.toml)
    board: str | None = None
    # calibration of the skin, with which "live" shows the place of a contact
    calibration: str | None = None
    # table of all samples that the button "record" of "live" writes; if it exists, a number is added to its name
    record: Path = Path("runs/live.csv")
    # write the touches as an HTML page in a file, and open no page
    html: bool = False
    # write the touches as a Rerun recording (.rrd), and open no page
    rerun: bool = False
    # folder of the files of --html and --rerun, which are named after the touches
    out: Path = Path("runs/view")
    # object of the touches: its name in the catalogue, or a mesh file. By default, as the touches name it
    mesh: str | None = None
    # maximum number of touches to show; the first ones are shown. By default, all
    touches: Count | None = None
    # name of the skin to show; required if each touch has readings of several skins
    skin_name: str | None = None
    # replace existing files
    overwrite: bool = False


def _view(args: ViewArgs) -> None:
    thing, named = _told_apart(args.what)
    dataset = named or args.dataset
    _check(args, thing, dataset)
    if args.html or args.rerun:
        _write(args, dataset)
        return
    from i2t.view.server import Page

    scenes = {
        "explore": lambda: _explore(args, args.mesh or thing or "hammer"),
        "recognise": lambda: _recognize(args),
        "replay": lambda: _replay(args, dataset or Path("nominal")),
        "live": lambda: _live(args),
    }
    first = args.scene or ("explore" if thing else "replay" if named else "live")
    page = Page(scenes, host=args.host, port=args.port)
    print(f"i2t view: {page.address} (Ctrl-C ends it)", flush=True)
    if args.host not in ("127.0.0.1", "localhost", "::1"):  # which only this machine reaches
        print("this page has no password: whoever reaches this address can use it", file=sys.stderr)
    has_display = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if has_display and not args.no_browser:
        webbrowser.open(page.address)
    try:
        with ended_by_ctrl_c():
            page.run(first)
    finally:
        page.close()
    print("ended")


def _told_apart(what: str) -> tuple[str | None, Path | None]:
    """Tell whether WHAT names an object or touches; both are None for a running skin."""
    path = ready_path(what, "touches.h5")
    is_mesh = split_unit(what)[0] != what or path.suffix.lower() in MESH_SUFFIXES
    if what == "live" or (path.exists() and not is_mesh):
        return None, None if what == "live" else path
    return what, None


def _check(args: ViewArgs, thing: str | None, dataset: Path | None) -> None:
    """Refuse wrong options before JAX is imported, as far as that can be seen."""
    require_dataset("--dataset", args.dataset)
    require_dataset("WHAT", dataset)
    for flag, name in (("", thing), ("--mesh", args.mesh)):
        if name is not None:
            require_object(name, args.unit, flag=flag)
    for flag, names in (("--models", args.models), ("--pads", args.pads)):
        if not names:
            raise ValueError(f"{flag}: name at least one, such as nominal")
    for name in args.models:
        require_predictor("--models", name)
    for name in args.pads:
        if Path(name).suffix and not Path(name).is_file():
            raise ValueError(f"--pads {name}: there is no such file; check the name")
    require_pad_model(args.pad_model)
    if args.calibration is not None and not ready_path(args.calibration, "calibration.npz").is_file():
        raise ValueError(f"--calibration {args.calibration}: there is no such file; check the name")
    require_objects(args.objects, args.unit if args.objects else None)
    if args.board is not None:
        from i2t.skin.boards import make_board

        make_board(args.board)
    if (args.html or args.rerun) and dataset is None:
        raise ValueError(f"--html and --rerun need recorded touches, and {args.what} is none; name their folder")
    has_mesh = bool(thing or args.mesh or args.objects)
    require_with("--unit", args.unit is not None, "a mesh file, --mesh or --objects", has_mesh)
    require_with("--overwrite", args.overwrite, "--html or --rerun", args.html or args.rerun)


def _write(args: ViewArgs, dataset: Path | None) -> None:
    """Write the touches as a page and as a Rerun recording."""
    assert dataset is not None
    name = (dataset.resolve().stem or "view") + (f"-{args.skin_name}" if args.skin_name else "")
    page, recording = (args.out / f"{name}{ending}" for ending in (".html", ".rrd"))
    for path in [page] * args.html + [recording] * args.rerun:
        if path.exists() and not args.overwrite:
            raise FileExistsError(f"{path}: exists already; pass --overwrite to replace it, or another --out")
        require_writable("--out", path)
    # Imported late, because --help and refusals do not need NumPy and HDF5.
    from i2t.view.page import write_page
    from i2t.view.rerun_file import require_rerun, write_recording

    if args.rerun:
        require_rerun()
    contents = _contents(args, dataset)
    args.out.mkdir(parents=True, exist_ok=True)
    if args.html:
        print(f"wrote {write_page(contents, page)}")
    if args.rerun:
        print(f"wrote {write_recording(contents, recording)}; look at it with: rerun {recording}")


def _contents(args: ViewArgs, dataset: Path) -> "Contents":
    from i2t.view.contents import read_contents

    return read_contents(
        ready_path(str(dataset), "touches.h5"), mesh=args.mesh, unit=args.unit, max_touches=args.touches,
        skin=args.skin_name,
    )  # fmt: skip


def _explore(args: ViewArgs, name: str) -> "Scene":
    from i2t.objects.named import read_object
    from i2t.prediction.predictor import load_predictor
    from i2t.view import explore

    predictors = {name: load_predictor(name) for name in args.models}
    return explore.ExploreScene(explore.begin(read_object(name, args.unit), predictors, _pads(args)))


def _pads(args: ViewArgs) -> "dict[str, Pad]":
    """Read the pads to simulate with, or draw those that are boards."""
    from i2t.emulators.world import read_pad

    pads = {}
    for name in args.pads:
        file, board = (Path(name), None) if Path(name).is_file() else (None, None if name == "nominal" else name)
        pads[name] = read_pad(file, board)
    return pads


def _recognize(args: ViewArgs) -> "Scene":
    from i2t.dataset import load_dataset
    from i2t.models.finished import find_pad_model
    from i2t.objects.named import meshes_of_dataset, read_meshes
    from i2t.skin_models.pad_model import load_pad_model
    from i2t.view import recognize

    pad_model = load_pad_model(find_pad_model(args.pad_model)[0])
    if args.dataset is None:
        meshes = read_meshes(args.objects or EPISODE_OBJECTS, args.unit)
        name, pad = next(iter(_pads(args).items()))
        other = str(args.pad_model) != name
        note = f"touched with the pad {name}, predicted with the pad model {args.pad_model}" if other else ""
        state = recognize.begin(meshes, pad_model, pad, next(iter(meshes)), note)
    else:
        recorded = load_dataset(args.dataset, skin=args.skin_name)
        meshes = read_meshes(args.objects, args.unit) or meshes_of_dataset(recorded.objects, str(args.dataset))
        state = recognize.begin_recorded(meshes, recorded, pad_model)
    return recognize.RecognizeScene(state)


def _replay(args: ViewArgs, dataset: Path) -> "Scene":
    from i2t.prediction.predictor import load_predictor
    from i2t.view import replay

    return replay.ReplayScene(replay.begin(_contents(args, dataset), load_predictor(args.models[0])))


def _live(args: ViewArgs) -> "Scene":
    import numpy as np

    from i2t.emulators.reskin_board import run_board
    from i2t.hardware.plugins import DeviceSetup, load_device
    from i2t.hardware.rig import Rig
    from i2t.skin.boards import DEFAULT_BOARD, make_board
    from i2t.skin_models.calibration import load_calibration
    from i2t.view.live import LiveScene

    address = args.address
    calibration = None if args.calibration is None else load_calibration(args.calibration)
    with ExitStack() as stack:
        if args.skin == "emulated" and address is None:  # nothing presses this board but its own emulator
            address, _ = stack.enter_context(run_board("--press", "1", "--board", args.board or DEFAULT_BOARD))
        skin = load_device("skin", args.skin, DeviceSetup(Rig(), address, board=args.board, stack=stack))
        board = getattr(skin, "board", None) or make_board(args.board or DEFAULT_BOARD)
        if calibration is not None:
            calibration.locate(np.zeros(len(calibration.interval_scaling)))  # refuses one without positions
        if calibration is not None and len(calibration.interval_scaling) != board.num_readings:
            raise ValueError(
                f"--calibration {args.calibration}: has {len(calibration.interval_scaling)} values, and the skin has "
                f"{board.num_readings}; give the calibration of this skin"
            )
        return LiveScene(skin, board, calibration, args.record, stack.pop_all())


main = command(ViewArgs, _view, program="python -m i2t.view", description=docstring_of("i2t.view.command"))
