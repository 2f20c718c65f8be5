"""Import recordings as data sets, export data sets to LeRobot, and print the summary of a data set.

Examples:

    i2t convert summary DATA
    i2t convert imagine2touch RECORDINGS DATA
    i2t convert eflesh RECORDINGS DATA --tip-radius-mm 4
    i2t convert presses TABLE.csv DATA --indenter sphere:4.0
    i2t convert stream LOG.csv DATA --indenter sphere:4.0
    i2t convert pack DATA PACKED                touches of several skins: --skin-name NAME
    i2t convert lerobot DATA LEROBOT

DATA is a folder. Converters write one packed file in it and refuse a folder that is not empty; --overwrite replaces an
earlier conversion. Unusable input is refused with one sentence on the error stream and the exit code 2; with --skip-
bad, it is left out and named. The formats are described in docs/data.md.
"""

import json as json_text
import math
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from i2t.cli.exit_codes import command
from i2t.cli.options import require_writable
from i2t.convert import EFLESH_TIP_RADIUS_M, EFLESH_WINDOW_M, PAPER_CAMERA_OFFSET_M
from i2t.errors import DataError, printable, require_extra
from i2t.installation import checkout
from i2t.patches.dimensions import PATCH_WINDOW, REACH

if TYPE_CHECKING:
    from i2t.convert.common import Converted
    from i2t.dataset import Dataset
    from i2t.types import Board

PACKED_FILE = "touches.h5"  # name of the file that a converter writes


@dataclass(kw_only=True)
class ReadCommand:
    """Base of the commands of i2t.convert: the file or folder to read, and whether damaged parts are left out."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")]  # file or folder to read
    # leave out damaged parts and touches in which a chip did not answer, and name what was left out
    skip_bad: bool = False

    def run(self) -> None:
        """Carry out the command that the options describe; raise DataError for unusable input."""
        raise NotImplementedError

    def _require_source(self) -> None:
        if not self.source.exists():
            raise DataError(f"{self.source}: no such file or folder; check the path")

    def _load(self, skin_name: str | None = None) -> "Dataset":
        """Read a data set. Touches in which a chip is missing are kept unless --skip-bad leaves them out."""
        from i2t.dataset import load_dataset

        return load_dataset(self.source, skip_bad=self.skip_bad, missing_chips=not self.skip_bad, skin=skin_name)


@dataclass(kw_only=True)
class WriteCommand(ReadCommand):
    """Base of the commands of i2t.convert that write: the file or folder to write, and whether it may be replaced."""

    target: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DST")]  # folder or file to write
    overwrite: bool = False  # replace the files of an earlier conversion
    verbose: bool = False  # print all notes on the conversion; the data set holds them as well
    written: ClassVar[tuple[str, ...]] = (PACKED_FILE, "README.md", "index.json")  # files of an earlier conversion
    of_one_tip: ClassVar[bool] = False  # whether the result holds presses of one tip, which a calibration can use

    def _require(self) -> None:
        """Refuse a missing source and an occupied folder, before anything large is imported."""
        self._require_source()
        require_writable("DST", self.target)
        self._require_free()
        if self.target.resolve() == self.source.resolve():
            raise DataError(f"{self.target}: is the folder to read; give another folder to write")

    def _require_free(self) -> None:
        """Refuse to mix a conversion with other files, and to replace an earlier one without --overwrite."""
        target = self.target
        if target.exists() and not target.is_dir():
            raise DataError(f"{target}: is a file; give a folder to write")
        names = sorted(file.name for file in target.iterdir()) if target.is_dir() else []
        if not names:
            return
        others = [name for name in names if name not in self.written]
        if others:
            raise DataError(f"{target}: holds {others[0]}, which no conversion wrote; give another folder")
        if not self.overwrite:
            raise DataError(f"{target}: holds a data set already; give another folder or pass --overwrite")

    def _require_free_file(self) -> None:
        """Refuse to replace a file without --overwrite."""
        self._require_source()
        require_writable("DST", self.target)
        if self.target.is_dir():
            raise DataError(f"{self.target}: is a folder; give a file to write")
        if self.target.exists() and not self.overwrite:
            raise DataError(f"{self.target}: exists already; choose another name or pass --overwrite")

    def _write(self, converted: "Dataset | Converted") -> None:
        """Write a data set with its card, and print what was changed or is doubtful."""
        from i2t.convert.common import Converted
        from i2t.dataset import save_dataset
        from i2t.dataset.card import write_card
        from i2t.skin.boards import name_of_board

        dataset = converted.dataset if isinstance(converted, Converted) else converted
        notes, brief = (converted.notes, converted.brief) if isinstance(converted, Converted) else ((), ())
        path = save_dataset(self.target / PACKED_FILE, dataset)
        write_card(self.target, dataset, board_name=name_of_board(dataset.board))
        self._print_notes(notes, brief)
        parts = ((dataset.objects, "object"), (dataset.pads, "skin"), (dataset.sessions, "session"))
        counts = ", ".join(f"{len(names)} {noun}{'s' if len(names) > 1 else ''}" for names, noun in parts)
        print(f"wrote {len(dataset)} touches ({counts}) to {path}")
        print(f"next: i2t view {self.target}")
        if self.of_one_tip and len(dataset.pads) == 1:
            module = f"python -m experiments.calibrate --dataset {self.target}"
            print(f"      {module if checkout() else 'i2t.calibrate, in Python (docs/calibration.md)'}")

    def _print_notes(self, notes: Sequence[str], brief: Sequence[str]) -> None:
        """Print all notes or the brief ones."""
        for note in notes if self.verbose else brief:
            print(printable(note))
        if not self.verbose and len(notes) > len(brief):
            print(f"--verbose prints all {len(notes)} notes on the conversion")


@dataclass(kw_only=True)
class Recording(WriteCommand):
    """Base of the commands that convert a recording to a data set: window and reach of its patches (mm), whether the
    touches are real, and whether mistakes are looked for.
    """

    # edge (mm) of the square that a patch shows; presses whose tip it does not show are left out
    window_mm: float = 1e3 * PATCH_WINDOW
    # largest depth (mm) behind the nearest point in a patch; deeper points are clipped to it
    reach_mm: float = 1e3 * REACH
    # whether the touches are real or simulated, if the recording does not state it
    stated_source: Annotated[Literal["real", "simulated"] | None, tyro.conf.arg(name="source")] = None
    # convert the values as they are: neither look for nor correct mistakes (units, signs, axes, lag, zero height,
    # chips)
    as_stated: bool = False

    def _shared_options(self) -> dict[str, Any]:
        """Return the options that all converters share; refuse invalid lengths."""
        names = ("window_mm", "reach_mm", "camera_mm", "tip_radius_mm")
        lengths = {name: value for name, value in vars(self).items() if name in names}
        for name, length in lengths.items():
            if not 0 <= length < math.inf or (length == 0 and name != "camera_mm"):
                raise DataError(f"--{name.replace('_', '-')} is {length:g}; give millimetres, more than 0")
        sizes = {"window": 1e-3 * self.window_mm, "reach": 1e-3 * self.reach_mm}
        stated = {"stated_source": self.stated_source, "as_stated": self.as_stated}
        return {**sizes, **stated, "skip_bad": self.skip_bad}


@dataclass(kw_only=True)
class Summary(ReadCommand):
    """Print a summary of a data set: touches per object, pad and session, ends of presses, readings, missing values."""

    json: bool = False  # print the summary as one JSON object
    skin_name: str | None = None  # name of the skin to summarise; required if each touch has readings of several skins

    def run(self) -> None:
        """Read the data set and print its summary."""
        self._require_source()
        summary = self._load(self.skin_name).summary()
        print(json_text.dumps(summary, indent=1, allow_nan=False) if self.json else _page(self.source, summary))


@dataclass(kw_only=True)
class FromImagine2touch(Recording):
    """Convert recordings in the layout of the Imagine2touch code: the data set's folder, or the folder of one object.
    Pickles in the recordings are read but never executed.
    """

    # order within a sample: temperature first (binary) or last (ascii); auto detects it
    order: Literal["auto", "binary", "ascii"] = "auto"
    # board of the skin, which determines order and rotation of its chips
    board: Literal["reskin", "anyskin"] = "reskin"
    pad: str = "reskin"  # name of the skin in the data set
    camera_mm: float = 1e3 * PAPER_CAMERA_OFFSET_M  # distance (mm) of the camera behind the tool's origin
    # number of counter-clockwise quarter turns after which image rows run along tool y and columns along tool x
    quarter_turns: int = 0
    tool_forces: bool = False  # forces are given in the tool's axes, not in those of the robot base

    def run(self) -> None:
        """Convert the Imagine2touch recordings and write the data set."""
        self._require()
        shared = self._shared_options()
        from i2t.convert import imagine2touch

        own: dict[str, Any] = {"order": self.order, "pad": self.pad, "camera": 1e-3 * self.camera_mm}
        own |= {"quarter_turns": self.quarter_turns, "tool_forces": self.tool_forces}
        self._write(imagine2touch.convert(self.source, board=_board(self.board), **own, **shared))


@dataclass(kw_only=True)
class FromEflesh(Recording):
    """Convert recordings of eFlesh (characterization/datasets), plain or compressed by gzip: the folder of a session
    (states.csv, sensor_post_baselines.csv), or a folder of sessions.
    """

    # edge (mm) of the square that a patch shows; presses whose tip it does not show are left out
    window_mm: float = 1e3 * EFLESH_WINDOW_M
    # radius (mm) of the probe's spherical tip, which the recordings do not state
    tip_radius_mm: float = 1e3 * EFLESH_TIP_RADIUS_M
    # the robot's z (mm) at first contact; by default, where readings begin, or the highest z
    z0_mm: float | None = None
    pad: str | None = None  # name of the skin for all sessions; by default, each session has its own

    def run(self) -> None:
        """Convert the eFlesh sessions and write the data set."""
        self._require()
        shared = self._shared_options()
        from i2t.convert import eflesh

        zero = None if self.z0_mm is None else 1e-3 * self.z0_mm
        own: dict[str, Any] = {"radius": 1e-3 * self.tip_radius_mm, "zero": zero, "pad": self.pad}
        self._write(eflesh.convert(self.source, **own, **shared))


@dataclass(kw_only=True)
class _FromTable(Recording):
    """Base of the commands that convert presses of one indenter."""

    of_one_tip: ClassVar[bool] = True
    indenter: str | None = None  # shape of the indenter: sphere:RADIUS or cylinder:RADIUS (mm), or mesh:FILE
    # board of the skin, which determines number, order and rotation of its chips: reskin, anyskin, or grid-RxC
    board: str = "reskin"
    # unit of the file in --indenter mesh:FILE, if its name has none (mesh:tip.stl:mm)
    unit: Literal["m", "cm", "mm", "inch"] | None = None

    def _indenter_options(self, missing: str) -> dict[str, Any]:
        """Return the options of the converter."""
        if self.indenter is None:
            raise DataError(f"--indenter is missing; give sphere:RADIUS in mm{missing}")
        return {"indenter": self.indenter, "unit": self.unit, "board": _board(self.board), **self._shared_options()}


@dataclass(kw_only=True)
class FromPresses(_FromTable):
    """Convert a table of presses of one indenter. The table is comma-separated and has the columns x_mm, y_mm,
    travel_mm, b0x_uT, b0y_uT, b0z_uT, b1x_uT ... and others that docs/data.md describes.
    """

    def run(self) -> None:
        """Convert the table of presses and write the data set."""
        self._require()
        options = self._indenter_options("")
        from i2t.convert import presses

        self._write(presses.convert(self.source, **options))


@dataclass(kw_only=True)
class FromStream(_FromTable):
    """Find the presses in a log of any length and convert them, or write them as a table if DST ends in .csv. The log
    has a row for each sample and the columns time_s, b0x_uT, b0y_uT ...; a data set also needs x_mm, y_mm and travel_mm
    or z_mm.
    """

    # rate (Hz) of the rows; required for a log without time stamps, or whose time stamps do not show the rate
    rate_hz: float | None = None

    def run(self) -> None:
        """Find the presses in the log, and write them as a data set or a table."""
        if self.rate_hz is not None and not 1 <= self.rate_hz <= 1e4:
            raise DataError(f"--rate-hz is {self.rate_hz:g}; give 1 to 10000 rows in a second")
        if self.target.suffix.lower() == ".csv":
            self._write_table()
            return
        self._require()
        options = self._indenter_options(", or end DST in .csv for a table of presses")
        from i2t.convert import stream

        self._write(stream.convert(self.source, rate=self.rate_hz, **options))

    def _write_table(self) -> None:
        if self.indenter is not None:
            raise DataError("--indenter belongs to a data set; give a folder to write, or leave it out for a table")
        self._require_free_file()
        from i2t.convert import stream

        options: dict[str, Any] = {"skip_bad": self.skip_bad, "rate": self.rate_hz}
        table = stream.table_of_presses(self.source, board=_board(self.board), **options)
        self._print_notes(table.notes, table.log.brief() if table.log is not None else ())
        print(f"wrote {len(table.rows)} presses to {stream.write_presses(self.target, table)}")


@dataclass(kw_only=True)
class Pack(WriteCommand):
    """Pack all touches of a folder into one file, which loads faster; images and time series are not copied."""

    skin_name: str | None = None  # name of the skin to pack; required if each touch has readings of several skins

    def run(self) -> None:
        """Pack the touches into one file."""
        self._require()
        self._write(self._load(self.skin_name))


@dataclass(kw_only=True)
class ToLeRobot(WriteCommand):
    """Write a data set as a LeRobotDataset v3.0, in which chips that did not answer are NaN. Needs pyarrow."""

    written: ClassVar[tuple[str, ...]] = ("data", "meta", "README.md")

    def run(self) -> None:
        """Read the data set and write it in the LeRobot format."""
        self._require_source()
        require_extra("pyarrow", "LeRobot's format")
        self._require()
        from i2t.convert import lerobot

        dataset = self._load()
        print(f"wrote {len(dataset)} touches to {lerobot.write(self.target, dataset)}")


ConvertArgs = (
    Annotated[Summary, tyro.conf.subcommand(name="summary")]
    | Annotated[FromImagine2touch, tyro.conf.subcommand(name="imagine2touch")]
    | Annotated[FromEflesh, tyro.conf.subcommand(name="eflesh")]
    | Annotated[FromPresses, tyro.conf.subcommand(name="presses")]
    | Annotated[FromStream, tyro.conf.subcommand(name="stream")]
    | Annotated[Pack, tyro.conf.subcommand(name="pack")]
    | Annotated[ToLeRobot, tyro.conf.subcommand(name="lerobot")]
)


def _run(args: ReadCommand) -> None:
    """Run one command, and print its warnings afterwards."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)  # `BadFileWarning` is one
        try:
            args.run()
        finally:
            for warning in caught:
                print(printable(warning.message), file=sys.stderr)


main = command(
    ConvertArgs,
    _run,
    program="python -m i2t.convert",
    description=__doc__,
    interrupted="interrupted; nothing was written",
)


def _board(name: str) -> "Board":
    from i2t.skin.boards import make_board

    try:
        return make_board(name)
    except ValueError as error:
        raise DataError(f"--board {name}: {error}") from error


def _page(source: Path, summary: dict[str, Any]) -> str:
    """Format a summary as text."""
    from i2t.dataset import source_phrase

    lines = [f"{printable(source)}: {summary['touches']} touches, {source_phrase(summary['source'])}"]
    for kind in ("objects", "pads", "sessions"):
        lines += ["", f"{kind:<40} touches"]
        lines += [f"  {printable(name):<38} {count:7d}" for name, count in summary[kind].items()]
    lines += ["", f"{'press ended':<40} touches"]
    lines += [f"  {name:<38} {count:7d}" for name, count in summary["codes"].items() if count]
    lines += ["", f"{'measured':<22} {'mean':>9} {'std':>9} {'min':>9} {'median':>9} {'max':>9}"]
    measured = [(f"reading {axis} (uT)", 1.0, summary["reading_uT"][axis]) for axis in "xyz"]
    measured += [("reading norm (uT)", 1.0, summary["reading_norm_uT"]), ("force (N)", 1.0, summary["force_N"])]
    measured += [("travel (mm)", 1e3, summary["travel_m"]), ("nearest (mm)", 1e3, summary["nearest_m"])]
    for label, scale, numbers in measured:
        cells = [" " * 8 + "-" if value is None else f"{scale * value:9.3f}" for value in numbers.values()]
        lines.append(f"  {label:<20} {' '.join(cells)}")
    lines += ["", f"{'not measured':<40} touches"]
    lines += [f"  {name:<38} {count:7d}" for name, count in summary["missing"].items() if count]
    pixels, window, reach = summary["patch_pixels"], 1e3 * summary["window_m"], 1e3 * summary["reach_m"]
    truth = "known" if summary["truth"] else "unknown"
    lines += ["", f"patches: {pixels} x {pixels} over {window:g} mm, reach {reach:g} mm; truth {truth}"]
    return "\n".join(lines + [printable(f"{key}: {text}") for key, text in summary["meta"].items()])
