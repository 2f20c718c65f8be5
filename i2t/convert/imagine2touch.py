"""The recordings of Imagine2touch (github ayadabdalla/imagine2touch), as its code writes them.

For object O, run E and touch K = 1, 2, ...: `O/O_images/depth/experiment_E_depth_K.tif` (uint16, mm, what the wrist
camera saw, cropped to the skin's window), `O/O_tactile/experiment_E_reskin` (object array of samples [time, delay, 5 x
(t, x, y, z) or 5 x (x, y, z, t), device]) and `..._reskin_ambient` (15 values per touch, or 10 samples per touch, or 10
samples for every 10 touches), `O/O_poses/experiment_E_*` (positions in m, quaternions xyzw),
`O/O_forces/experiment_E_*`, `O/meta_data/O_experiment_E.txt`. Only images and tactile files are required.

    reading = mean over samples in contact - mean over ambient samples, without temperatures
    patch   = depth - depth of the nearest pixel, clipped to the reach; the value 0 is no measurement: no surface
    nearest = depth of the nearest pixel - distance from the camera to the tool - approach from the look to the contact

Assumed, for the recordings do not say: the tool frame is the one of the recorded poses; image rows run along tool y and
columns along tool x; forces are in the robot base's axes and act on the tool, so that the force along tool z is minus
their component along it. Objects' poses are unknown (NaN). What contradicts that is found and put right, with a
sentence: forces that pull, or that push only in the other axes; positions in millimetres, images in another unit,
fields in millitesla.
"""

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from i2t.convert import CAMERA_OFFSET_M, npy, samples
from i2t.convert.common import ConversionLog, Converted, data_error
from i2t.dataset import Dataset, concatenate, missing_context
from i2t.depth.camera import read_image
from i2t.errors import DataError
from i2t.types import Board, ReturnCode, Touches
from i2t.unknowns import find_force_sign, find_units, findings_to_meta
from i2t.windows import PATCH_PIXELS, PATCH_WINDOW, REACH

MAX_LOOK_OFFSET_M = 2e-3  # m: a look from further off the contact's axis saw another place
QUATERNION_NORM_TOLERANCE = 1e-3  # how far the norm of a quaternion may be from 1
MAX_PATCH_M = 1e3  # beyond any image, in any unit
MAX_POSE_VALUE = 1e6  # of any recorded number, in its unit
MAX_ARM_REACH_M = 5.0  # of a tool's position: beyond it are millimetres
MOST_TOUCHES = 0.9  # of the informative ones, for a recording to be read otherwise than it is documented
MIN_INFORMATIVE_TOUCHES = 3
MIN_PUSHES = 8  # touches with a force, for their sign to be turned
IMAGE_UNITS = {10.0: "0.1 mm", 100.0: "0.01 mm", 0.1: "cm", 1000.0: "um"}  # how many of a unit go into a millimetre
NOTE_LENGTH = 2000  # characters kept of a run's own notes

_TACTILE = re.compile(r"experiment_(.+)_reskin(\.npy)?")
_IMAGE = re.compile(r"experiment_(.+)_depth_\d+\.tif")


def convert(
    source: Path,
    *,
    board: Board,
    order: str = "auto",
    window: float = PATCH_WINDOW,
    reach: float = REACH,
    camera: float = CAMERA_OFFSET_M,
    quarter_turns: int = 0,
    tool_forces: bool = False,
    pad: str = "reskin",
    as_stated: bool = False,
    skip_bad: bool = False,
) -> Converted:
    """Convert one object's folder or a folder of them.

    Args:
        source: The folder.
        board: That recorded the touches.
        order: Of a sample's values: "binary" (t first), "ascii" (t last) or "auto".
        window: m, edge of the square that a patch shows.
        reach: m, depth at which a patch ends.
        camera: m, distance of the camera behind the tool's origin.
        quarter_turns: By which images are turned counter-clockwise.
        tool_forces: Whether forces are in the tool's axes.
        pad: Name of the skin.
        as_stated: Look for no mistake and correct none.
        skip_bad: Leave out what cannot be read instead of ending.

    Returns:
        The data set and what was noted.

    Raises:
        DataError: The folder cannot be read as such a recording.
    """
    notes = ConversionLog(skip_bad)
    notes.info(f"assumed: image rows along tool y, columns along tool x, after {quarter_turns} quarter turns")
    notes.info(f"assumed: forces act on the tool, in the axes of the {'tool' if tool_forces else 'robot base'}")
    notes.info("left out: colour images, masks, point clouds, joint states, temperatures; object poses are unknown")
    folders = _objects(source)
    options = _Options(
        board,
        order,
        window=window,
        reach=reach,
        camera=camera,
        quarter_turns=quarter_turns,
        tool_forces=tool_forces,
        pad=pad,
        as_stated=as_stated,
    )
    parts: list[_Run] = []
    for folder in folders:
        for run in _runs(folder):
            try:
                parts.append(_convert_run(folder, run, options, notes))
            except DataError as error:
                notes.skip(error)
    if not sum(len(part.dataset) for part in parts):
        raise data_error(source, f"no touch is left to convert ({' | '.join(notes.lines[3:])})")
    dataset = concatenate([part.dataset for part in parts])
    if not as_stated:
        dataset = _pushing(dataset, np.concatenate([part.other_force for part in parts]), options, notes)
    return notes.close(dataset)


class _Run(NamedTuple):
    """A run, and its forces along tool z if they were recorded in the other axes."""

    dataset: Dataset
    other_force: np.ndarray  # (n,) N


def _pushing(dataset: Dataset, other_force: np.ndarray, options: "_Options", notes: ConversionLog) -> Dataset:
    """The data set with forces that push and readings in microtesla, if need be turned and scaled."""
    touches = dataset.touches
    found = find_units(np.zeros((len(dataset), 2)), touches.reading.astype(np.float64))
    force = touches.force.astype(np.float64)
    sign = find_force_sign(force, touches.reading)
    other = find_force_sign(other_force, touches.reading)
    enough = sign.evidence.get("presses", 0) >= MIN_PUSHES
    if enough and not sign.identifiable and other.identifiable and not options.tool_forces:
        notes.info(
            "corrected: forces are taken in the tool's axes: along the base's they push in some touches and pull in "
            "others, along the tool's they do not"
        )
        force, sign = other_force, other
    if sign.wrong and enough:
        force = -force
    for finding in (found, sign):
        if finding is found or (enough or finding.wrong is False):
            notes.info(f"{'corrected' if finding.wrong else 'found'}: {finding.sentence}")
    touches = touches._replace(force=force, reading=found.correction.get("field_factor", 1.0) * touches.reading)
    return replace(dataset, touches=touches, meta=dict(dataset.meta) | findings_to_meta("all runs", [found, sign]))


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
    as_stated: bool


def _convert_run(folder: Path, run: str, options: _Options, notes: ConversionLog) -> _Run:
    """One run of an object: its touches that have a reading and an image."""
    tactile = folder / f"{folder.name}_tactile" / f"experiment_{run}_reskin"
    reading, time = samples.readings(tactile, options.order, notes)
    n = len(reading)
    poses = _poses(folder / f"{folder.name}_poses" / f"experiment_{run}", n, options, notes)
    images = folder / f"{folder.name}_images" / "depth" / f"experiment_{run}_depth"
    patch, closest = _patches(images, n, options, notes)
    if not options.as_stated:
        unit = _image_unit(images, closest, options.camera + poses.approach, notes)
        closest, patch = unit * closest, np.minimum(unit * patch, options.reach).astype(np.float32)
    forces = folder / f"{folder.name}_forces" / f"experiment_{run}"
    along_base, along_tool, code = _forces(forces, poses.T_w_t[:, :3, 2], n, notes)
    force, other_force = (along_tool, along_base) if options.tool_forces else (along_base, along_tool)
    touches = Touches(
        patch=patch,
        wide=missing_context(n),
        nearest=closest - options.camera - poses.approach,
        reading=reading,
        force=force,
        depth=np.full(n, np.nan),
        T_w_t=poses.T_w_t,
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
        source="real",
        window=options.window,
        reach=options.reach,
        meta={"converter": "imagine2touch", **_remarks(folder, run)},
    )
    kept = np.isfinite(reading).all(1) & np.isfinite(closest)
    return _Run(dataset.select(kept), other_force[kept])


def _objects(source: Path) -> list[Path]:
    candidates = [source, *sorted(source.iterdir())] if source.is_dir() else []
    objects = [folder for folder in candidates if (folder / f"{folder.name}_tactile").is_dir()]
    if not objects:
        raise DataError(f"{source}: holds no folder O/O_tactile; give the data set's folder or one of its objects")
    return objects


def _runs(folder: Path) -> list[str]:
    """The names of an object's runs, from its tactile files and its images, numbers in the order of counting."""
    runs: set[str] = set()
    for place, name in ((f"{folder.name}_tactile", _TACTILE), (f"{folder.name}_images/depth", _IMAGE)):
        files = (folder / place).iterdir() if (folder / place).is_dir() else ()
        runs |= {match[1] for match in (name.fullmatch(file.name) for file in files) if match}
    if not runs:
        raise data_error(folder, "holds no run")
    return sorted(runs, key=lambda run: [(len(part), part) for part in re.split(r"(\d+)", run)])


def _remarks(folder: Path, run: str) -> dict[str, str]:
    text = folder / "meta_data" / f"{folder.name}_experiment_{run}.txt"
    if not text.is_file():
        return {}
    with text.open(errors="replace") as file:
        words = file.read(NOTE_LENGTH).strip()
    return {f"remarks on {folder.name} {run}": words} if words else {}


class _Poses(NamedTuple):
    T_w_t: np.ndarray  # (n, 4, 4) at the contact
    approach: np.ndarray  # (n,) m along tool z, from where the camera looked to the contact


def _poses(stem: Path, n: int, options: "_Options", notes: ConversionLog) -> _Poses:
    final, prepare = (_optional(stem, name, (n, 3), notes) for name in ("final_contact", "prepare_contact"))
    if not options.as_stated and (unit := _position_unit(final)) != 1.0:
        notes.info(
            f"corrected: {stem}: positions are {_distance(final):.3g} from the robot, which can be no metres: they are "
            "read as millimetres"
        )
        final, prepare = unit * final, unit * prepare
    rotations = _rotations(stem, n, notes)
    T_w_t = np.full((n, 4, 4), np.nan)
    posed = np.isfinite(final).all(1) & np.isfinite(rotations).all((1, 2))
    T_w_t[posed] = np.eye(4)
    T_w_t[posed, :3, :3] = rotations[posed]
    T_w_t[posed, :3, 3] = final[posed]
    moved = final - prepare
    approach = np.sum(moved * T_w_t[:, :3, 2], axis=1)
    aside = np.linalg.norm(moved - approach[:, None] * T_w_t[:, :3, 2], axis=1)
    if (approach < 0).any():
        notes.info(
            f"{stem}: {np.sum(approach < 0)} presses go against tool z, so this may be another frame than the tool's, "
            "or quaternions have the scalar first"
        )
    approach = np.where((aside <= MAX_LOOK_OFFSET_M) & (approach >= 0), approach, np.nan)
    if np.isnan(approach).any():
        notes.info(f"{stem}: nearest is unknown for {np.isnan(approach).sum()} touches, not seen along their approach")
    return _Poses(T_w_t, approach)


def _distance(position: np.ndarray) -> float:
    """Median distance of positions (n, 3) from the robot; 0 where none is known."""
    far = np.linalg.norm(position, axis=1)
    return float(np.median(far[np.isfinite(far)])) if np.isfinite(far).any() else 0.0


def _position_unit(position: np.ndarray) -> float:
    """m in the unit of positions (n, 3): a metre, or the millimetre where no arm reaches as many metres."""
    return 1e-3 if _distance(position) > MAX_ARM_REACH_M else 1.0


def _rotations(stem: Path, n: int, notes: ConversionLog) -> np.ndarray:
    """Rotations (n, 3, 3) of the tool, NaN where unknown."""
    values = _optional(stem, "rotations", (n, 4), notes)
    result = np.full((n, 3, 3), np.nan)
    known = np.isfinite(values).all(1)
    crooked = np.abs(np.linalg.norm(values, axis=1) - 1) > QUATERNION_NORM_TOLERANCE
    if crooked.any():
        raise data_error(stem, f"quaternion {np.flatnonzero(crooked)[0] + 1} of its rotations is not of length 1")
    if known.any():
        result[known] = Rotation.from_quat(values[known]).as_matrix()
    return result


def _forces(stem: Path, axis: np.ndarray, n: int, notes: ConversionLog) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Force along tool z, (n,) N, from a wrench in the base's axes, with tool z as `axis`, and from one in the tool's;
    return codes (n,).
    """
    wrenches = _optional(stem, "forces_torques", (n, 6), notes)
    codes = _optional(stem, "contact_returns", (n,), notes, unknown=float(ReturnCode.UNDEFINED))
    if not np.isin(codes, [int(code) for code in ReturnCode]).all():
        raise data_error(stem, "contact_returns hold a value that is no return code (-1 to 4)")
    return -np.sum(wrenches[:, :3] * axis, axis=1), -wrenches[:, 2], codes


def _image_unit(stem: Path, closest: np.ndarray, expected: np.ndarray, notes: ConversionLog) -> float:
    """Factor on images in another unit than millimetres: the nearest pixel is about as far as the arm travels."""
    ratio = (closest / expected)[np.isfinite(closest) & np.isfinite(expected)]
    if len(ratio) < MIN_INFORMATIVE_TOUCHES:
        return 1.0
    median = float(np.median(ratio))
    for many, name in IMAGE_UNITS.items():
        if many / 2 < median < many * 2 and np.mean(np.abs(np.log(ratio / median)) < math.log(2)) > MOST_TOUCHES:
            notes.info(
                f"corrected: {stem}: images are in units of {name}, as their nearest pixel is {median:.3g} times as "
                "far as the arm travels to it"
            )
            return 1 / many
    return 1.0


def _patches(stem: Path, n: int, options: _Options, notes: ConversionLog) -> tuple[np.ndarray, np.ndarray]:
    """Patches (n, 48, 48) m, and the depth of their nearest pixels (n,) m, NaN where the image is damaged; they are not
    yet clipped to the reach if images may be in another unit.
    """
    reach = options.reach if options.as_stated else MAX_PATCH_M
    patches, closest = np.zeros((n, PATCH_PIXELS, PATCH_PIXELS), np.float32), np.full(n, np.nan)
    for k in range(n):
        try:
            depth = np.rot90(_depth_image(stem.with_name(f"{stem.name}_{k + 1}.tif"), notes), options.quarter_turns)
        except DataError as error:
            notes.skip(error)
            continue
        closest[k] = depth.min()
        patches[k] = np.minimum(depth - closest[k], reach)
    more = stem.with_name(f"{stem.name}_{n + 1}.tif")
    if more.exists():
        raise data_error(more, f"is one image more than the {n} touches of its run")
    return patches, closest


def _optional(
    stem: Path, name: str, shape: tuple[int, ...], notes: ConversionLog, *, unknown: float = math.nan
) -> np.ndarray:
    """A file of numbers of this shape, or the unknown value where there is no file."""
    wanted = stem.with_name(f"{stem.name}_{name}")
    path = npy.find(wanted)
    if path is None:
        notes.info(f"{wanted} is missing: what it holds is unknown")
        return np.full(shape, unknown)
    values = npy.read(path)
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise data_error(path, f"does not hold numbers of the shape {shape}") from error
    if numbers.size != math.prod(shape) or len(numbers) != shape[0]:
        raise data_error(path, f"has the shape {numbers.shape} where {shape[0]} touches need {shape}")
    if not (np.abs(numbers) < MAX_POSE_VALUE).all():
        raise data_error(path, f"is not finite at touch {np.argwhere(~(np.abs(numbers) < MAX_POSE_VALUE))[0][0] + 1}")
    return numbers.reshape(shape)


def _depth_image(path: Path, notes: ConversionLog) -> np.ndarray:
    """The crop (48, 48) in metres, infinite where nothing was measured; another size is resampled, each pixel taking
    the one under its centre.
    """
    if not path.is_file():
        raise data_error(path, "is missing")
    try:
        image = read_image(path)
    except DataError:
        raise
    except (OSError, ValueError) as error:
        raise data_error(path, f"is no readable TIF ({str(error).removeprefix(f'{path}: ')})") from error
    if image.dtype != np.uint16 or not 8 <= max(image.shape) <= 1024:
        raise data_error(path, f"is an image {image.shape} of {image.dtype} where a crop of uint16 should be")
    rows, columns = image.shape
    if rows != columns:
        raise data_error(path, f"is {rows} x {columns} pixels where the crop should be square")
    if rows != PATCH_PIXELS:
        notes.info(f"resampled: crops of {rows} pixels, each of {PATCH_PIXELS} taking the one under its centre")
        under = ((np.arange(PATCH_PIXELS) + 0.5) * rows / PATCH_PIXELS).astype(int)
        image = image[np.ix_(under, under)]
    if not image.any():
        raise data_error(path, "holds no measured pixel")
    return np.where(image == 0, np.inf, 1e-3 * image)
