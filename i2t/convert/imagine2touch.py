"""The recordings of Imagine2touch (github ayadabdalla/imagine2touch), as its code writes them.

For object O, run E and touch K = 1, 2, ...: `O/O_images/depth/experiment_E_depth_K.tif` (uint16, mm, image of the wrist
camera, cropped to the skin's window), `O/O_tactile/experiment_E_reskin` (object array of samples [time, delay, 5 x
(t, x, y, z) or 5 x (x, y, z, t), device]) and `..._reskin_ambient` (15 values per touch, or 10 samples per touch, or 10
samples for every 10 touches), `O/O_poses/experiment_E_*` (positions in m, quaternions xyzw),
`O/O_forces/experiment_E_*`, `O/meta_data/O_experiment_E.txt`. Only images and tactile files are required.

    reading = mean over samples in contact - mean over ambient samples, without temperatures
    patch   = depth - depth of the nearest pixel, clipped to the reach; 0 and 65535 mean no measurement, taken as no
    surface nearest = depth of the nearest pixel - distance from the camera to the tool - approach from the look to the
    contact

Assumptions, because the recordings do not state it: the tool frame is that of the recorded poses; image rows run along
tool y and columns along tool x; forces are in the robot base's axes and act on the tool, so the force along tool z is
minus their component along it. Objects' poses are unknown (NaN). Pulling forces and fields in millitesla are corrected,
with a note.
"""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.convert import PAPER_CAMERA_OFFSET_M, npy, samples
from i2t.convert.common import Converted, converted
from i2t.dataset import Dataset, concatenate, missing_views
from i2t.dataset.sets import NOT_STATED
from i2t.depth.camera import read_image, stored_mask
from i2t.errors import DataError
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.recordings.diagnose import correction_of, find_force_sign, find_units, findings_to_meta
from i2t.recordings.files import data_error
from i2t.recordings.log import ReadingLog
from i2t.types import Board, ReturnCode, Touches


def convert(
    source: Path,
    *,
    board: Board,
    order: str = "auto",
    window: float = PATCH_WINDOW,
    reach: float = REACH,
    camera: float = PAPER_CAMERA_OFFSET_M,
    quarter_turns: int = 0,
    tool_forces: bool = False,
    pad: str = "reskin",
    stated_source: str | None = None,
    as_stated: bool = False,
    skip_bad: bool = False,
) -> Converted:
    """Convert recordings in the layout of the Imagine2touch code, one object's folder or several, to a data set.

    Args:
        source: Folder of an object, or of several.
        board: Board that recorded the touches.
        order: Order of a chip's values in a sample: "binary" (temperature t first), "ascii" (t last) or "auto" (found
            from the data).
        window: Edge (m) of the square that a patch shows.
        reach: Depth (m) behind the nearest point at which a patch is clipped.
        camera: Distance (m) of the camera behind the tool's origin, along the tool's z axis.
        quarter_turns: Number of counter-clockwise quarter turns of the images.
        tool_forces: Whether forces are recorded in the tool's axes.
        pad: Name of the skin.
        stated_source: "real" or "simulated", which the layout does not state; None if unknown.
        as_stated: Whether to take all units and signs as recorded, without a search for mistakes.
        skip_bad: Whether to leave out damaged parts instead of raising an error.

    Returns:
        The data set, with notes on assumptions and omissions.

    Raises:
        DataError: If the folder cannot be read as a recording in the authors' layout.
    """
    notes = ReadingLog(skip_bad, unit="touches")
    notes.info(f"assumed: image rows along tool y, columns along tool x, after {quarter_turns} quarter turns")
    notes.info(f"assumed: forces act on the tool, in the axes of the {'tool' if tool_forces else 'robot base'}")
    notes.info("left out: colour images, masks, point clouds, joint states, temperatures; object poses are unknown")
    if stated_source is None:
        notes.doubt("source", "not stated: whether the touches are real or simulated; state it with --source")
    folders = _objects(source)
    options = _Options(
        board, order, window=window, reach=reach, camera=camera, quarter_turns=quarter_turns, tool_forces=tool_forces,
        pad=pad, source=stated_source or NOT_STATED,
    )  # fmt: skip
    parts: list[Dataset] = []
    for folder in folders:
        for run in _runs(folder):
            try:
                parts.append(_convert_run(folder, run, options, notes))
            except DataError as error:
                notes.skip(error)
    notes.require_answers(source)
    if not sum(map(len, parts)):
        raise data_error(
            source, f"no touch is left to convert ({' | '.join(notes.lines[3 + (stated_source is None) :])})"
        )
    dataset = concatenate(parts)
    return converted(dataset if as_stated else _corrected(dataset, notes), notes)


def _corrected(dataset: Dataset, notes: ReadingLog) -> Dataset:
    """Make pressing forces positive, and convert readings to microtesla."""
    touches = dataset.touches
    units = find_units(np.full((len(dataset), 2), np.nan), touches.reading.astype(np.float64))
    sign = find_force_sign(touches.force.astype(np.float64), touches.reading)
    for finding in (units, sign):
        notes.finding(finding)
    todo = correction_of([units, sign])
    touches = touches._replace(force=todo.force * touches.force, reading=todo.field * touches.reading)
    return replace(dataset, touches=touches, meta=dict(dataset.meta) | findings_to_meta("all runs", [units, sign]))


class _Options(NamedTuple):
    """Options for reading runs, as the arguments of `convert`."""

    board: Board
    order: str
    window: float  # m
    reach: float  # m
    camera: float  # m
    quarter_turns: int
    tool_forces: bool
    pad: str
    source: str


def _convert_run(folder: Path, run: str, options: _Options, notes: ReadingLog) -> Dataset:
    """Convert one run of an object: its touches that have a reading and an image."""
    tactile = folder / f"{folder.name}_tactile" / f"experiment_{run}_reskin"
    reading, time = samples.readings(tactile, options.order, notes)
    n = len(reading)
    poses = folder / f"{folder.name}_poses" / f"experiment_{run}"
    damaged = np.zeros(n, bool)  # damaged touches, which the functions below mark
    T_w_t, approach = _poses(poses, damaged, notes)
    images = folder / f"{folder.name}_images" / "depth" / f"experiment_{run}_depth"
    patch, closest = _patches(images, n, options, notes)
    axis = np.array([0.0, 0.0, 1.0]) if options.tool_forces else T_w_t[:, :3, 2]
    nearest = closest - options.camera - approach
    _note_distance(nearest, images, notes)
    force, code = _forces(folder / f"{folder.name}_forces" / f"experiment_{run}", axis, damaged, notes)
    touches = Touches(
        patch=patch,
        view=missing_views(n),
        nearest=nearest,
        reading=reading,
        force=force,
        travel=np.full(n, np.nan),
        T_w_t=T_w_t,
        T_w_o=np.full((n, 4, 4), np.nan),
        object=np.zeros(n),
        pad=np.zeros(n),
        session=np.zeros(n),
        code=code,
        time=None if np.isnan(time).all() else time,
    )
    dataset = Dataset(
        touches=touches,
        objects=(folder.name,),
        pads=(options.pad,),
        sessions=(f"{folder.name}/experiment_{run}",),
        board=options.board,
        source=options.source,
        window=options.window,
        reach=options.reach,
        meta={"converter": "imagine2touch", **_remarks(folder, run)},
    )
    return dataset.select(np.isfinite(reading).all(1) & np.isfinite(closest) & ~damaged)


def _objects(source: Path) -> list[Path]:
    candidates = [source, *sorted(source.iterdir())] if source.is_dir() else []
    objects = [folder for folder in candidates if (folder / f"{folder.name}_tactile").is_dir()]
    if not objects:
        raise DataError(f"{source}: holds no folder O/O_tactile; give the data set's folder or one of its objects")
    return objects


def _runs(folder: Path) -> list[str]:
    """List the names of an object's runs, from its tactile files and its images, with numbers in ascending order."""
    runs: set[str] = set()
    for place, pattern in (
        (f"{folder.name}_tactile", r"experiment_(.+)_reskin(\.npy)?"),
        (f"{folder.name}_images/depth", r"experiment_(.+)_depth_\d+\.tif"),
    ):
        files = (folder / place).iterdir() if (folder / place).is_dir() else ()
        runs |= {match[1] for match in (re.fullmatch(pattern, file.name) for file in files) if match}
    if not runs:
        raise data_error(folder, "holds no run")
    return sorted(runs, key=lambda run: [(len(part), part) for part in re.split(r"(\d+)", run)])


def _remarks(folder: Path, run: str) -> dict[str, str]:
    path = folder / "meta_data" / f"{folder.name}_experiment_{run}.txt"
    if not path.is_file():
        return {}
    with path.open(errors="replace") as file:
        text = file.read(2000).strip()
    return {f"remarks on {folder.name} {run}": text} if text else {}


def _poses(stem: Path, damaged: np.ndarray, notes: ReadingLog) -> tuple[np.ndarray, np.ndarray]:
    """Read poses (n, 4, 4) at the contact, and distances (n,) m along tool z from the look to the contact."""
    n = len(damaged)
    final, prepare = (_optional(stem, name, (3,), damaged, notes) for name in ("final_contact", "prepare_contact"))
    rotations = _rotations(stem, damaged, notes)
    T_w_t = np.full((n, 4, 4), np.nan)
    posed = np.isfinite(final).all(1) & np.isfinite(rotations).all((1, 2))
    T_w_t[posed] = np.eye(4)
    T_w_t[posed, :3, :3] = rotations[posed]
    T_w_t[posed, :3, 3] = final[posed]
    moved = final - prepare
    approach = np.sum(moved * T_w_t[:, :3, 2], axis=1)
    offset = np.linalg.norm(moved - approach[:, None] * T_w_t[:, :3, 2], axis=1)
    if (approach < 0).any():
        notes.doubt(
            "poses of the tool",
            f"{stem}: {np.sum(approach < 0)} presses go against tool z; poses may be of another frame than the tool, "
            "or quaternions may have the scalar first",
        )
    # A look from further off the contact's axis showed another place.
    approach = np.where((offset <= 2e-3) & (approach >= 0), approach, np.nan)
    if np.isnan(approach).any():
        notes.doubt(
            "distances to the surface",
            f"{stem}: nearest is unknown for {np.isnan(approach).sum()} touches that were not seen along their "
            "approach",
        )
    return T_w_t, approach


def _rotations(stem: Path, damaged: np.ndarray, notes: ReadingLog) -> np.ndarray:
    """Read rotations (n, 3, 3) of the tool, NaN if unknown."""
    values = _optional(stem, "rotations", (4,), damaged, notes)
    result = np.full((len(damaged), 3, 3), np.nan)
    wrong_norm = np.abs(np.linalg.norm(values, axis=1) - 1) > 1e-3
    for k in np.flatnonzero(wrong_norm):
        notes.skip(data_error(stem, f"quaternion {k + 1} of its rotations is not of length 1"))
    damaged |= wrong_norm
    is_rotation = np.isfinite(values).all(1) & ~wrong_norm
    if is_rotation.any():
        result[is_rotation] = Rotation.from_quat(values[is_rotation]).as_matrix()
    return result


def _forces(stem: Path, axis: np.ndarray, damaged: np.ndarray, notes: ReadingLog) -> tuple[np.ndarray, np.ndarray]:
    """Compute forces (n,) N along tool z, which is `axis` in the axes of the wrenches, and read return codes (n,)."""
    wrenches = _optional(stem, "forces_torques", (6,), damaged, notes)
    codes = _optional(stem, "contact_returns", (), damaged, notes, unknown=float(ReturnCode.UNDEFINED))
    wrong = ~np.isin(codes, [int(code) for code in ReturnCode])
    for k in np.flatnonzero(wrong & ~np.isnan(codes)):
        notes.skip(
            data_error(stem, f"contact_returns hold a value at touch {k + 1} that is not a return code (-1 to 4)")
        )
    damaged |= wrong
    codes = np.where(wrong, float(ReturnCode.UNDEFINED), codes)
    return -np.sum(wrenches[:, :3] * axis, axis=1), codes


def _patches(stem: Path, n: int, options: _Options, notes: ReadingLog) -> tuple[np.ndarray, np.ndarray]:
    """Read patches (n, 48, 48) m, and the depth (n,) m of their nearest pixels, NaN for a damaged image."""
    patches, closest = np.zeros((n, PATCH_PIXELS, PATCH_PIXELS), np.float32), np.full(n, np.nan)
    for k in range(n):
        try:
            depth = np.rot90(_depth_image(stem.with_name(f"{stem.name}_{k + 1}.tif"), notes), options.quarter_turns)
        except DataError as error:
            notes.skip(error)
            continue
        closest[k] = depth.min()
        patches[k] = np.minimum(depth - closest[k], options.reach)
    more = stem.with_name(f"{stem.name}_{n + 1}.tif")
    if more.exists():
        raise data_error(more, f"is one image more than the {n} touches of its run")
    return patches, closest


def _note_distance(nearest: np.ndarray, images: Path, notes: ReadingLog) -> None:
    """Add a note if the surface in the images, at distances (n,) m from the skin, is far from it in the median."""
    middle = float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 0.0
    if abs(middle) > 10e-3:
        notes.doubt(
            "distance of the camera",
            f"{images}: the surface begins {1e3 * abs(middle):.3g} mm {'behind' if middle < 0 else 'in front of'} the "
            "skin at the touches, in the median: correct --camera-mm, or the unit of the images, which are taken for "
            "mm",
        )


def _optional(
    stem: Path,
    name: str,
    width: tuple[int, ...],
    damaged: np.ndarray,
    notes: ReadingLog,
    *,
    unknown: float = math.nan,
) -> np.ndarray:
    """Read numbers (n, *width) of a file, or return the unknown value if there is no file.

    Touches without finite numbers are NaN and marked in `damaged`.
    """
    shape = (len(damaged), *width)
    wanted = stem.with_name(f"{stem.name}_{name}")
    path = npy.find(wanted)
    if path is None:
        notes.doubt("missing files", f"{wanted} is missing: its values are unknown")
        return np.full(shape, unknown)
    values = npy.read(path)
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise data_error(path, f"does not hold numbers of the shape {shape}") from error
    if numbers.size != math.prod(shape) or len(numbers) != shape[0]:
        raise data_error(path, f"has the shape {numbers.shape} where {shape[0]} touches need {shape}")
    numbers = numbers.reshape(shape)
    wrong = ~(np.abs(numbers) < 1e6).reshape(len(damaged), -1).all(1)
    for k in np.flatnonzero(wrong):
        notes.skip(data_error(path, f"is not finite at touch {k + 1}"))
    damaged |= wrong
    numbers[wrong] = np.nan
    return numbers


def _depth_image(path: Path, notes: ReadingLog) -> np.ndarray:
    """Read the crop (48, 48) in metres, infinite where nothing was measured. An image of another size is resampled:
    each pixel takes the value under its centre.
    """
    if not path.is_file():
        raise data_error(path, "is missing")
    try:
        image = read_image(path)
    except DataError:
        raise
    except (OSError, ValueError) as error:
        raise data_error(path, f"is not a readable TIF ({str(error).removeprefix(f'{path}: ')})") from error
    if image.dtype != np.uint16 or not 8 <= max(image.shape) <= 1024:
        raise data_error(path, f"is an image {image.shape} of {image.dtype} where a crop of uint16 should be")
    rows, columns = image.shape
    if rows != columns:
        raise data_error(path, f"is {rows} x {columns} pixels where the crop should be square")
    if rows != PATCH_PIXELS:
        notes.change(
            "images", f"resampled: crops of {rows} pixels, each of {PATCH_PIXELS} taking the one under its centre"
        )
        under = ((np.arange(PATCH_PIXELS) + 0.5) * rows / PATCH_PIXELS).astype(int)
        image = image[np.ix_(under, under)]
    try:
        return np.where(stored_mask(image, path), 1e-3 * image, np.inf)
    except ValueError as error:
        raise DataError(str(error)) from error
