"""Entry point for data sets: other people's recordings into ours, ours into other formats, and what a data set holds.

Examples:

    python -m i2t.convert summary DATA
    python -m i2t.convert imagine2touch RECORDINGS DATA
    python -m i2t.convert eflesh RECORDINGS DATA --tip-radius-mm 4
    python -m i2t.convert presses TABLE.csv DATA --indenter sphere:4.0
    python -m i2t.convert stream LOG.csv DATA --indenter sphere:4.0
    python -m i2t.convert pack DATA PACKED                touches of several skins: --skin-name NAME
    python -m i2t.convert ambient DATA CORRECTED --field .ambient.npz
    python -m i2t.convert npz DATA DATA.npz
    python -m i2t.convert lerobot DATA LEROBOT            and back: lerobot LEROBOT DATA
    python -m i2t.convert robomimic DATA DATA.hdf5        and back: robomimic DATA.hdf5 DATA
    python -m i2t.convert csv DATA TABLE                  and back: csv TABLE DATA

DATA is a folder; converters write one packed file in it and refuse a folder that holds anything; --overwrite replaces
an earlier conversion. What cannot be used is refused with one sentence on the error stream and the exit code 2; with
--skip-bad it is left out and named. The formats are described in docs/data.md.
"""

import json as json_text
import math
import sys
import warnings
from collections.abc import Callable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from i2t.cli import exit_code_of, require_writable
from i2t.convert import CAMERA_OFFSET_M, EFLESH_WINDOW_M, TIP_RADIUS_M
from i2t.errors import DataError, SerializationError
from i2t.extras import require_extra
from i2t.files import replacing
from i2t.windows import PATCH_WINDOW, REACH

if TYPE_CHECKING:
    from i2t.convert.common import Converted
    from i2t.dataset import Dataset
    from i2t.types import Board

PACKED = "touches.h5"

Source = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]
Target = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]


def summarise(
    source: Source,
    json: bool = False,
    quick: bool = False,
    skip_bad: bool = False,
    skin_name: str | None = None,
) -> None:
    """Say what a data set holds: touches per object, pad and session, how presses ended, readings, missing values.

    Args:
        source: folder or file of touches
        json: print one JSON object, for a program
        quick: counts only, from the folder's index, without reading every touch again
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
        skin_name: of several skins that were read in each touch, the one that is meant
    """
    _require_source(source)
    found = _counts(source) if quick else _load(source, skip_bad, skin_name).summary()
    print(json_text.dumps(found, indent=1, allow_nan=False) if json else _page(source, found))


def from_imagine2touch(
    source: Source,
    target: Target,
    order: Literal["auto", "binary", "ascii"] = "auto",
    board: Literal["reskin", "anyskin"] = "reskin",
    pad: str = "reskin",
    window_mm: float = 1e3 * PATCH_WINDOW,
    reach_mm: float = 1e3 * REACH,
    camera_mm: float = 1e3 * CAMERA_OFFSET_M,
    quarter_turns: int = 0,
    tool_forces: bool = False,
    as_stated: bool = False,
    overwrite: bool = False,
    skip_bad: bool = False,
) -> None:
    """Convert recordings in the layout of the Imagine2touch code. Pickles inside them are read, never executed.

    Args:
        source: the data set's folder, or one of its objects
        target: folder to write
        order: whether temperature stands first (binary) or last (ascii) in a sample; auto looks for it
        board: order and rotation of the chips
        pad: name of the skin
        window_mm: edge of the square that the depth images were cropped to
        reach_mm: patches are clipped to this depth behind the nearest pixel
        camera_mm: distance of the camera behind the tool's origin
        quarter_turns: turn images counter-clockwise, until rows run along tool y and columns along tool x
        tool_forces: forces are in the tool's axes, not in the robot base's
        as_stated: look for no mistake (units, signs, axes) and correct none
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out sessions and touches that are damaged, and name them
    """
    _require(source, target, overwrite, {"--window-mm": window_mm, "--reach-mm": reach_mm, "--camera-mm": camera_mm})
    from i2t.convert import imagine2touch
    from i2t.skin.boards import make_board

    converted = imagine2touch.convert(
        source,
        board=make_board(board),
        order=order,
        window=1e-3 * window_mm,
        reach=1e-3 * reach_mm,
        camera=1e-3 * camera_mm,
        quarter_turns=quarter_turns,
        tool_forces=tool_forces,
        pad=pad,
        as_stated=as_stated,
        skip_bad=skip_bad,
    )
    _write(target, converted)


def from_eflesh(
    source: Source,
    target: Target,
    tip_radius_mm: float = 1e3 * TIP_RADIUS_M,
    window_mm: float = 1e3 * EFLESH_WINDOW_M,
    reach_mm: float = 1e3 * REACH,
    z0_mm: float | None = None,
    centre_mm: tuple[float, float] | None = None,
    pad: str | None = None,
    board: Literal[0, 1] | None = None,
    as_stated: bool = False,
    overwrite: bool = False,
    skip_bad: bool = False,
) -> None:
    """Convert recordings of eFlesh (characterization/datasets), plain or gzip-ed.

    Args:
        source: a session's folder (states.csv, sensor_post_baselines.csv), or a folder of sessions
        target: folder to write
        tip_radius_mm: radius of the probe's spherical tip, which the recordings do not state
        window_mm: edge of the square that a patch shows; presses outside it are left out
        reach_mm: patches are clipped to this depth behind the tip's lowest point
        z0_mm: the robot's z at first contact; by default where readings begin, or else the session's highest z
        centre_mm: the robot's x and y of the skin's centre; by default the middle of the session's range
        pad: one name for the skin of all sessions; by default each session's own
        board: of recordings with two boards, only this one; by default both, as two pads
        as_stated: look for no mistake (units, signs, lag, height zero, chips) and correct none
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out rows and sessions that are damaged, and name them
    """
    lengths = {"--tip-radius-mm": tip_radius_mm, "--window-mm": window_mm, "--reach-mm": reach_mm}
    _require(source, target, overwrite, lengths)
    from i2t.convert import eflesh

    converted = eflesh.convert(
        source,
        radius=1e-3 * tip_radius_mm,
        window=1e-3 * window_mm,
        reach=1e-3 * reach_mm,
        zero=None if z0_mm is None else 1e-3 * z0_mm,
        centre=None if centre_mm is None else (1e-3 * centre_mm[0], 1e-3 * centre_mm[1]),
        pad=pad,
        board=board,
        as_stated=as_stated,
        skip_bad=skip_bad,
    )
    _write(target, converted)


def from_presses(
    source: Source,
    target: Target,
    indenter: str,
    board: str = "reskin",
    window_mm: float = 1e3 * PATCH_WINDOW,
    reach_mm: float = 1e3 * REACH,
    unit: Literal["m", "cm", "mm", "inch"] | None = None,
    as_stated: bool = False,
    overwrite: bool = False,
    skip_bad: bool = False,
) -> None:
    """Convert a table of presses of one indenter, as docs/data.md describes it.

    Args:
        source: comma-separated table with the columns x_mm, y_mm, depth_mm, b0x_uT, b0y_uT, b0z_uT, b1x_uT ... and more
        target: folder to write
        indenter: sphere:RADIUS or cylinder:RADIUS with a radius in mm, or mesh:FILE
        board: number, order and rotation of the chips: reskin, anyskin, or grid-RxC for R rows of C chips
        window_mm: edge of the square that a patch shows; presses outside it are left out
        reach_mm: patches are clipped to this depth behind the indenter's lowest point
        unit: of the mesh file of mesh:FILE, which does not say it itself
        as_stated: look for no mistake (units, signs, lag, height zero, chips) and correct none
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out rows that are damaged, and name them
    """
    _require(source, target, overwrite, {"--window-mm": window_mm, "--reach-mm": reach_mm})
    _require_indenter(indenter, unit)
    described = _board(board)
    from i2t.convert import presses

    converted = presses.convert(
        source,
        indenter=indenter,
        board=described,
        window=1e-3 * window_mm,
        reach=1e-3 * reach_mm,
        unit=unit,
        as_stated=as_stated,
        skip_bad=skip_bad,
    )
    _write(target, converted)


def from_stream(
    source: Source,
    target: Target,
    indenter: str | None = None,
    board: str = "reskin",
    window_mm: float = 1e3 * PATCH_WINDOW,
    reach_mm: float = 1e3 * REACH,
    unit: Literal["m", "cm", "mm", "inch"] | None = None,
    as_stated: bool = False,
    overwrite: bool = False,
    skip_bad: bool = False,
) -> None:
    """Find the presses in a log of any length, a row for every sample, and convert them or write them as a table.

    Args:
        source: comma-separated table with the columns time_s, b0x_uT, b0y_uT, b0z_uT, b1x_uT ... and, for a data set,
            x_mm, y_mm and depth_mm or z_mm
        target: folder to write; or a file ending in .csv, for a table of the presses
        indenter: for a data set, as of presses: sphere:RADIUS or cylinder:RADIUS in mm, or mesh:FILE
        board: number, order and rotation of the chips: reskin, anyskin, or grid-RxC for R rows of C chips
        window_mm: edge of the square that a patch shows; presses outside it are left out
        reach_mm: patches are clipped to this depth behind the indenter's lowest point
        unit: of the mesh file of mesh:FILE, which does not say it itself
        as_stated: look for no mistake (units, signs, lag, height zero, chips) and correct none
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out rows that are damaged, and say how many
    """
    described = _board(board)
    if target.suffix == ".csv":
        if indenter is not None:
            raise DataError("--indenter is of a data set; give a folder to write, or leave it out for a table")
        _require_source(source)
        _require_free_file(target, ".csv", overwrite)
        from i2t.convert import stream

        table = stream.table_of_presses(source, board=described, skip_bad=skip_bad)
        print(*table.notes, sep="\n")
        print(f"wrote {len(table.rows)} presses to {stream.write_presses(target, table)}")
        return
    _require(source, target, overwrite, {"--window-mm": window_mm, "--reach-mm": reach_mm})
    if indenter is None:
        raise DataError("--indenter is missing; give sphere:RADIUS in mm, or end DST in .csv for a table of presses")
    _require_indenter(indenter, unit)
    from i2t.convert import stream

    converted = stream.convert(
        source,
        indenter=indenter,
        board=described,
        window=1e-3 * window_mm,
        reach=1e-3 * reach_mm,
        unit=unit,
        as_stated=as_stated,
        skip_bad=skip_bad,
    )
    _write(target, converted)


def pack(
    source: Source,
    target: Target,
    overwrite: bool = False,
    skip_bad: bool = False,
    skin_name: str | None = None,
) -> None:
    """Pack all touches of a folder into one file, which loads faster; images and time series of touches stay behind.

    Args:
        source: folder of recorded touches
        target: folder to write
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
        skin_name: of several skins that were read in each touch, the one that is meant
    """
    _require(source, target, overwrite)
    from i2t.convert.common import Converted

    _write(target, Converted(_load(source, skip_bad, skin_name), ()))


def subtract_ambient_field(
    source: Source,
    target: Target,
    field: Path,
    base_turn: Annotated[tuple[float, float, float], tyro.conf.arg(metavar="RX RY RZ")] = (0.0, 0.0, 0.0),
    overwrite: bool = False,
    skip_bad: bool = False,
) -> None:
    """Take a fitted ambient field out of readings that were zeroed once, while the tool turned.

    Args:
        source: folder or file of touches, with the tool's poses
        target: folder to write
        field: the field, as i2t.collect --ambient.poses fits it (.ambient.npz)
        base_turn: rotation vector of the robot's base in the data set's world, rad
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
    """
    _require(source, target, overwrite)
    if not field.is_file():
        raise DataError(f"--field {field}: there is no such file; check the name")
    from i2t.convert.ambient import without_ambient
    from i2t.dataset import load_dataset
    from i2t.skin.ambient import load_ambient

    dataset = load_dataset(source, skip_bad=skip_bad, missing_chips=not skip_bad)
    try:
        fitted, _ = load_ambient(field)
    except SerializationError as error:
        raise DataError(str(error)) from error
    _write(target, without_ambient(dataset, fitted, str(field), base_turn=base_turn))


def to_npz(source: Source, target: Target, overwrite: bool = False, skip_bad: bool = False) -> None:
    """Write a data set as plain NumPy arrays, without pickles: all fields, names, board and provenance.

    Args:
        source: folder or file of touches
        target: file to write, ending in .npz
        overwrite: replace an existing file
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
    """
    _require_free_file(target, ".npz", overwrite)
    _require_source(source)
    _export(source, target, write_npz, skip_bad)


def lerobot(source: Source, target: Target, overwrite: bool = False, skip_bad: bool = False) -> None:
    """Write a data set as a LeRobotDataset v3.0, or read one back that was written so. Needs pyarrow.

    Args:
        source: folder or file of touches; or the folder of a LeRobotDataset, which is read back
        target: folder to write
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
    """
    _require_source(source)
    require_extra("pyarrow", "LeRobot's format")
    if (source / "meta" / "info.json").is_file():
        _require(source, target, overwrite)
        from i2t.convert.lerobot import read_lerobot

        _write_back(target, read_lerobot(source))
    else:
        _require_free_export(target, "meta/i2t.json", overwrite)
        from i2t.convert.lerobot import write_lerobot

        _export(source, target, partial(write_lerobot, overwrite=overwrite), skip_bad)


def robomimic(source: Source, target: Target, overwrite: bool = False, skip_bad: bool = False) -> None:
    """Write a data set as an HDF5 file of robomimic, or read one back that was written so.

    Args:
        source: folder or file of touches; or a file that ends in .hdf5, which is read back
        target: file to write, ending in .hdf5; or the folder to write what is read back
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
    """
    _require_source(source)
    if source.suffix == ".hdf5":
        _require(source, target, overwrite)
        from i2t.convert.robomimic import read_robomimic

        _write_back(target, read_robomimic(source))
    else:
        _require_free_file(target, ".hdf5", overwrite)
        from i2t.convert.robomimic import write_robomimic

        _export(source, target, write_robomimic, skip_bad)


def table(source: Source, target: Target, overwrite: bool = False, skip_bad: bool = False) -> None:
    """Write a data set as a comma-separated table with its pictures next to it, or read one back that was written so.

    Args:
        source: folder or file of touches; or a folder with touches.csv, which is read back
        target: folder to write
        overwrite: replace what an earlier conversion wrote
        skip_bad: leave out files that cannot be used, and touches in which a chip did not answer, and name them
    """
    _require_source(source)
    if (source / "touches.csv").is_file():
        _require(source, target, overwrite)
        from i2t.convert.touch_table import read_table

        _write_back(target, read_table(source))
    else:
        _require_free_export(target, "set.json", overwrite)
        from i2t.convert.touch_table import write_table

        _export(source, target, partial(write_table, overwrite=overwrite), skip_bad)


def write_npz(path: Path, dataset: "Dataset") -> Path:
    """Write a data set as arrays, atomically.

    The file holds every field of the touches under its name (`truth_...` for the truth), the names, board, window,
    reach, source, and provenance as `meta_keys` and `meta_values`.

    Args:
        path: Of the new file; its folder is made.
        dataset: The data set.

    Returns:
        `path`.

    Raises:
        DataError: Its folder cannot be written to; FullDiskError if the disk is full, or failed.
    """
    import numpy as np

    touches = dataset.touches._asdict()
    truth = touches.pop("truth")
    arrays: dict[str, Any] = {name: values for name, values in touches.items() if values is not None}
    if truth is not None:
        arrays |= {f"truth_{name}": values for name, values in truth._asdict().items()}
    arrays |= {kind: np.array(getattr(dataset, kind), np.str_) for kind in ("objects", "pads", "sessions")}
    arrays |= {f"board_{name}": values for name, values in dataset.board._asdict().items()}
    arrays |= {name: np.array(getattr(dataset, name)) for name in ("window", "reach", "source")}
    arrays["meta_keys"] = np.array(list(dataset.meta), np.str_)
    arrays["meta_values"] = np.array(list(dataset.meta.values()), np.str_)
    with replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)
    return path


COMMANDS: dict[str, Callable[..., Any]] = {
    "summary": summarise,
    "imagine2touch": from_imagine2touch,
    "eflesh": from_eflesh,
    "presses": from_presses,
    "stream": from_stream,
    "pack": pack,
    "ambient": subtract_ambient_field,
    "npz": to_npz,
    "lerobot": lerobot,
    "robomimic": robomimic,
    "csv": table,
}


INTERRUPTED_MESSAGE = "interrupted; nothing was written"


def main(args: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        args: The command line without the program's name, by default this process's.

    Returns:
        The exit code, as `i2t.cli` has them: 2 where a recording cannot be used.
    """
    work = tyro.extras.subcommand_cli_from_dict(
        {name: _later(command) for name, command in COMMANDS.items()},
        args=args,
        prog="python -m i2t.convert",
        description=__doc__,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    return exit_code_of(lambda: _run(work), INTERRUPTED_MESSAGE)


def _later(command: Callable[..., None]) -> Callable[..., Callable[[], None]]:
    """A command that reads its options only, and does its work when what it returns is called."""

    @wraps(command)
    def begin(*args: Any, **options: Any) -> Callable[[], None]:
        return partial(command, *args, **options)

    return begin


def _run(work: Callable[[], None]) -> None:
    """Run one command, and print its warnings after it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)  # `BadFileWarning` is one
        try:
            work()
        finally:
            for warning in caught:
                print(warning.message, file=sys.stderr)


def _require(source: Path, target: Path, overwrite: bool, lengths: dict[str, float] | None = None) -> None:
    """Refuse missing sources, taken targets, and lengths (mm) that are none, before anything large is imported."""
    _require_source(source)
    require_writable("DST", target)
    for flag, length in (lengths or {}).items():
        if not 0 <= length < math.inf or (length == 0 and flag != "--camera-mm"):
            raise DataError(f"{flag} is {length:g}; give millimetres, more than 0")
    _require_free(target, overwrite)
    if target.resolve() == source.resolve():
        raise DataError(f"{target}: is what is read; give another folder to write")


def _require_indenter(indenter: str, unit: str | None) -> None:
    """Refuse an unknown kind of indenter, and a mesh without its unit; a radius is judged where it is used."""
    kind, _, value = indenter.partition(":")
    if kind not in ("sphere", "cylinder", "mesh") or not value:
        raise DataError(f"--indenter {indenter}: is unknown; give sphere:RADIUS or cylinder:RADIUS in mm, or mesh:FILE")
    if kind != "mesh" and unit is not None:
        raise DataError("--unit is of the file of --indenter mesh:FILE; leave it out: radii are in mm")
    if kind == "mesh" and unit is None:
        raise DataError(f"--indenter {indenter}: say in which unit the file is, for instance --unit mm")


def _require_source(source: Path) -> None:
    if not source.exists():
        raise DataError(f"{source}: no such file or folder; check the path")


def _require_free(target: Path, overwrite: bool) -> None:
    """Refuse to mix a conversion with other files, and to replace an earlier one unasked."""
    if target.exists() and not target.is_dir():
        raise DataError(f"{target}: is a file; give a folder to write")
    found = sorted(file.name for file in target.iterdir()) if target.is_dir() else []
    if not found:
        return
    from i2t.dataset.card import CARD
    from i2t.dataset.store import INDEX

    others = [name for name in found if name not in (PACKED, INDEX, CARD)]
    if others:
        raise DataError(f"{target}: holds {others[0]}, which no conversion wrote; give another folder")
    if not overwrite:
        raise DataError(f"{target}: holds a data set already; give another folder or pass --overwrite")


def _require_free_file(target: Path, ending: str, overwrite: bool) -> None:
    """Refuse a name without the format's ending, and to replace a file unasked."""
    require_writable("DST", target)
    if target.suffix != ending:
        raise DataError(f"{target}: does not end in {ending}; name the file so")
    if target.is_dir():
        raise DataError(f"{target}: is a folder; give a file to write")
    if target.exists() and not overwrite:
        raise DataError(f"{target}: exists already; choose another name or pass --overwrite")


def _require_free_export(target: Path, mark: str, overwrite: bool) -> None:
    """Refuse a folder that no export of this format may be written to, before anything is read."""
    from i2t.convert.exchange import require_free_folder

    require_writable("DST", target)
    require_free_folder(target, mark, overwrite=overwrite)


def _load(source: Path, skip_bad: bool, skin_name: str | None = None) -> "Dataset":
    """A data set in which chips may be missing, unless such touches are to be left out."""
    from i2t.dataset import load_dataset

    return load_dataset(source, skip_bad=skip_bad, missing_chips=not skip_bad, skin=skin_name)


def _export(source: Path, target: Path, write: Callable[[Path, "Dataset"], Path], skip_bad: bool) -> None:
    """Write a data set in another format, which may know chips that did not answer."""
    dataset = _load(source, skip_bad)
    print(f"wrote {len(dataset)} touches to {write(target, dataset)}")


def _write_back(target: Path, dataset: "Dataset") -> None:
    from i2t.convert.common import Converted

    _write(target, Converted(dataset, ()))


def _board(name: str) -> "Board":
    from i2t.skin.boards import make_board

    try:
        return make_board(name)
    except ValueError as error:
        raise DataError(f"--board {name}: {error}") from error


def _write(target: Path, converted: "Converted") -> None:
    from i2t.dataset import save_dataset
    from i2t.dataset.card import write_card
    from i2t.skin.boards import name_of_board

    path = save_dataset(target / PACKED, converted.dataset)
    write_card(target, converted.dataset, board_name=name_of_board(converted.dataset.board))
    for note in converted.notes:
        print(note)
    print(f"wrote {len(converted.dataset)} touches to {path}")


def _counts(folder: Path) -> dict[str, Any]:
    from i2t.dataset import index

    entries = index(folder).values()
    sources = {entry["source"] for entry in entries}
    found: dict[str, Any] = {
        "touches": sum(entry["touches"] for entry in entries),
        "source": sources.pop() if len(sources) == 1 else "mixed",
    }
    for kind in ("objects", "pads", "sessions"):
        names = dict.fromkeys(name for entry in entries for name in entry[kind])
        found[kind] = {name: sum(entry[kind].get(name, 0) for entry in entries) for name in names}
    return found


def _page(source: Path, found: dict[str, Any]) -> str:
    """A summary for a person."""
    lines = [f"{source}: {found['touches']} touches, {found['source']}"]
    for kind in ("objects", "pads", "sessions"):
        lines += ["", f"{kind:<40} touches", *(f"  {name:<38} {count:7d}" for name, count in found[kind].items())]
    if "codes" not in found:
        return "\n".join(lines)
    lines += ["", f"{'press ended':<40} touches"]
    lines += [f"  {name:<38} {count:7d}" for name, count in found["codes"].items() if count]
    lines += ["", f"{'measured':<22} {'mean':>9} {'std':>9} {'min':>9} {'median':>9} {'max':>9}"]
    measured = [(f"reading {axis} (uT)", 1.0, found["reading_uT"][axis]) for axis in "xyz"]
    measured += [("reading norm (uT)", 1.0, found["reading_norm_uT"]), ("force (N)", 1.0, found["force_N"])]
    measured += [("depth (mm)", 1e3, found["depth_m"]), ("nearest (mm)", 1e3, found["nearest_m"])]
    for label, scale, numbers in measured:
        cells = [" " * 8 + "-" if value is None else f"{scale * value:9.3f}" for value in numbers.values()]
        lines.append(f"  {label:<20} {' '.join(cells)}")
    lines += ["", f"{'not measured':<40} touches"]
    lines += [f"  {name:<38} {count:7d}" for name, count in found["missing"].items() if count]
    pixels, window, reach = found["patch_pixels"], 1e3 * found["window_m"], 1e3 * found["reach_m"]
    truth = "known" if found["truth"] else "unknown"
    lines += ["", f"patches: {pixels} x {pixels} over {window:g} mm, reach {reach:g} mm; truth {truth}"]
    return "\n".join(lines + [f"{key}: {text}" for key, text in found["meta"].items()])
