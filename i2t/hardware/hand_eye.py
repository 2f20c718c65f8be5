"""Camera in tool from views of a printed board: print it, lay it down, look at it from 15 tilted poses, estimate.

    python -m i2t.hardware.hand_eye board board.png                    # print it at 100 %, measure a square
    python -m i2t.hardware.hand_eye capture DIR --host 192.168.0.2     # move the arm by hand, press Enter, again
    python -m i2t.hardware.hand_eye estimate DIR --square 0.0152 --rig lab.toml --write

The board is a ChArUco board of OpenCV (`--dictionary APRILTAG_36h11` makes one of AprilTags). `capture` reads a
RealSense's colour image and the arm's pose, without controlling the arm; the TCP set on the pendant must be the rig's
T_flange_tool. Another package's arm and camera (`--arm`, `--camera`) need the rig too, and the arm is let go between
views. DIR may come from elsewhere:

    DIR/camera.toml      the images' lens in pixels (keys of `i2t.depth.camera.Camera`), and T_camera_image (4 rows),
                         the frame of the images in the depth camera's, where they were taken by another imager
    DIR/images/NAME.png  the board seen from one pose each
    DIR/poses.csv        NAME.png, x, y, z (m), rx, ry, rz (rotation vector, rad): T_base_tool as the pendant shows it

The estimate needs at least six views, tilted by 15 degrees or more about two axes; how it is found and what the error
that it states means is in `i2t.hardware.hand_eye_fit`.
"""

import csv
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from PIL import Image
from scipy.spatial.transform import Rotation

from i2t.cli import exit_code_of
from i2t.depth.camera import Camera, read_image
from i2t.errors import DataError, DeviceError
from i2t.files import file_in, read_text, read_toml, replacing
from i2t.geometry import inverse
from i2t.hardware.hand_eye_fit import MIN_CORNERS, BoardView, HandEyeResult, fit, pixel_rays
from i2t.hardware.named_devices import REALSENSE, ColourView, ToolPose, colour_view, named_camera, require_named
from i2t.hardware.rig import Rig
from i2t.options import read_options
from i2t.types import Array

PRINT_PIXELS_PER_MM = 300 / 25.4  # pixels per mm of a printed board: 300 dpi


@dataclass(frozen=True, kw_only=True)
class CharucoArgs:
    """Layout of a ChArUco board."""

    columns: int = 8  # of squares
    rows: int = 6  # of squares
    square: float = 0.015  # m, edge of a square
    marker: float = 0.011  # m, edge of a marker
    dictionary: str = "4X4_50"  # of OpenCV; APRILTAG_36h11 makes a board of AprilTags


@dataclass(frozen=True, kw_only=True)
class CharucoBoard(CharucoArgs):
    """A ChArUco board that can be drawn and found; one that cannot be is refused (ValueError)."""

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or not 0 < self.marker < self.square < 1:
            raise ValueError(
                f"a board of {self.columns} x {self.rows} squares of {self.square:g} m with markers of {self.marker:g} "
                "m is none; give at least 3 x 3 squares, in metres, larger than their markers"
            )

    def drawn(self, pixels_per_mm: float = PRINT_PIXELS_PER_MM) -> Array:
        """The board as an image to print, with a margin of a square.

        Args:
            pixels_per_mm: Scale of the image.

        Returns:
            (h, w) uint8.
        """
        edge = round(1e3 * self.square * pixels_per_mm)
        size = ((self.columns + 2) * edge, (self.rows + 2) * edge)
        return np.asarray(self._made()[1].generateImage(size, marginSize=edge))

    def find(self, image: Array) -> tuple[Array, Array]:
        """The corners that are seen in an image.

        Args:
            image: (h, w, 3) uint8 RGB.

        Returns:
            (k, 3) m on the board and (k, 2) pixels; k may be 0.
        """
        cv2, board = self._made()
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        places, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if numbers is None or not len(numbers):
            return np.zeros((0, 3)), np.zeros((0, 2))
        return np.array(board.getChessboardCorners(), float)[np.ravel(numbers)], np.reshape(places, (-1, 2)).astype(
            float
        )

    def _made(self) -> tuple[Any, Any]:
        try:
            import cv2
        except ImportError as error:
            raise DeviceError("boards are found by OpenCV: pip install 'imagine2touch[hardware]'") from error
        if not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "CharucoDetector"):
            raise DeviceError(
                f"OpenCV {cv2.__version__} finds no ChArUco boards: pip install -U 'imagine2touch[hardware]'"
            )
        code = getattr(cv2.aruco, f"DICT_{self.dictionary}", None)
        if code is None:
            raise ValueError(f"OpenCV has no dictionary {self.dictionary!r}; give one as 4X4_50 or APRILTAG_36h11")
        markers = cv2.aruco.getPredefinedDictionary(code)
        return cv2, cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)


def estimate(path: Path, board: CharucoBoard) -> tuple[HandEyeResult, Array, list[str]]:
    """The camera in the tool, from a folder of views.

    Args:
        path: The folder.
        board: That the images show.

    Returns:
        The estimate, T_camera_image (4, 4) of its images, and the names of the images that were used.

    Raises:
        ValueError: One sentence that names the file.
    """
    camera, T_c_image = _lens(path / "camera.toml")
    views, names = [], []
    for name, T_b_t in _poses(path / "poses.csv"):
        file = file_in(path / "images", name, path / "poses.csv")
        try:
            image = read_image(file, shape=(camera.height, camera.width), said_by="camera.toml", mode="RGB")
        except OSError as error:
            raise ValueError(
                f"{file}: cannot be read ({error.strerror or error}); restore it, or leave out its pose"
            ) from error
        corners, pixels = board.find(image)
        if len(corners) >= MIN_CORNERS:
            views.append(BoardView(T_b_t, corners, pixel_rays(camera, pixels)))
            names.append(name)
    try:
        return fit(views, (camera.fx + camera.fy) / 2), T_c_image, names
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def capture(
    path: Path, take: Callable[[], tuple[Array, ColourView]], more: Callable[[int], bool], board: CharucoBoard
) -> int:
    """Keep colour images and the tool's poses in a new folder.

    Args:
        path: The folder.
        take: Gives T_b_t (4, 4) now, and a colour image from there.
        more: Whether to take view number n.
        board: That the images show.

    Returns:
        How many views were taken.
    """
    (path / "images").mkdir(parents=True)
    number = 0
    with (path / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        while more(number):
            T_b_t, seen = take()
            if number == 0:
                (path / "camera.toml").write_text(_lens_text(seen.camera, seen.T_c_colour), "utf-8")
            found = len(board.find(seen.image)[0])
            print(
                f"view {number}: {found} corners" + ("" if found >= MIN_CORNERS else "; too few, it will not be used")
            )
            name = f"{number:03d}.png"
            Image.fromarray(seen.image).save(path / "images" / name)
            turn = Rotation.from_matrix(T_b_t[:3, :3]).as_rotvec()
            rows.writerow([name, *(f"{x:.9f}" for x in (*T_b_t[:3, 3], *turn))])
            file.flush()
            number += 1
    return number


def _poses(path: Path) -> Iterator[tuple[str, Array]]:
    try:
        rows = [row for row in csv.reader(read_text(path).splitlines()) if row]
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); it holds one line for each image") from error
    except csv.Error as error:
        raise ValueError(f"{path}: is no comma-separated table ({error}); it holds one line for each image") from error
    for row in rows:
        try:
            numbers = [float(x) for x in row[1:]]
        except ValueError:
            numbers = []
        if len(numbers) != 6 or not np.isfinite(numbers).all() or np.abs(numbers).max() > 10:
            raise ValueError(
                f"{path}: the line {','.join(row)!r} is no pose; write NAME.png, x, y, z (m), rx, ry, rz (rad)"
            )
        T = np.eye(4)
        T[:3, 3], T[:3, :3] = numbers[:3], Rotation.from_rotvec(numbers[3:]).as_matrix()
        yield row[0].strip(), T


def _lens(path: Path) -> tuple[Camera, Array]:
    try:
        table = read_toml(path)
        T = np.array(table.pop("T_camera_image", np.eye(4)), float)
        lens: Any = {key: float(table.pop(key)) for key in ("fx", "fy", "cx", "cy")}
        bent = tuple(float(each) for each in table.pop("coefficients", ()))
        known = {each.name for each in fields(Camera)}
        if T.shape != (4, 4) or not set(table) <= known:
            raise ValueError("it holds something else than a lens and T_camera_image")
        return Camera(**table, **lens, coefficients=bent), T
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); it holds the images' lens") from error
    except DataError:
        raise
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: is no lens ({' '.join(str(error).split())}); see i2t.hardware.hand_eye") from error


def _lens_text(camera: Camera, T: Array) -> str:
    lens = {**asdict(camera), "model": f'"{camera.model}"', "coefficients": list(camera.coefficients)}
    rows = ", ".join(str([float(x) for x in row]) for row in T)
    return "".join(f"{key} = {value}\n" for key, value in lens.items()) + f"T_camera_image = [{rows}]\n"


COLOUR_SIZE = (640, 360)  # pixels of a RealSense's colour images, unless told otherwise
PICTURE_SUFFIXES = (".png", ".tif", ".pdf")  # in which the board's size on paper is kept


@dataclass(frozen=True, kw_only=True)
class DrawArgs(CharucoArgs):
    """Draw the board."""

    file: tyro.conf.Positional[Path]  # the image that is written


@dataclass(frozen=True, kw_only=True)
class CaptureArgs(CharucoArgs):
    """Take views with the camera on an arm that a person moves."""

    folder: tyro.conf.Positional[Path]  # for the views
    arm: str = "ur"  # or another package's: the name that it registers, or package.module:Class
    host: str | None = None  # address of the arm's controller; a UR arm needs one
    camera: str = "realsense"  # or another package's
    serial: str | None = None  # which RealSense, if there are several; the address of another package's camera
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Pixels of a RealSense's images: 640 360 by default."""
    rig: Path | None = None  # the lab's calibration, which another package's devices need


@dataclass(frozen=True, kw_only=True)
class EstimateArgs(CharucoArgs):
    """Find the camera in the tool."""

    folder: tyro.conf.Positional[Path]  # of the views
    rig: Path | None = None  # a lab's calibration, to compare with
    write: bool = False  # put the estimate into it


HandEyeArgs = (
    Annotated[DrawArgs, tyro.conf.subcommand(name="board")]
    | Annotated[CaptureArgs, tyro.conf.subcommand(name="capture")]
    | Annotated[EstimateArgs, tyro.conf.subcommand(name="estimate")]
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Without the program's name; by default those of this process.

    Returns:
        The exit code.
    """
    commands: Any = HandEyeArgs  # a union is no type to mypy
    asked: DrawArgs | CaptureArgs | EstimateArgs = read_options(
        commands, arguments, program="python -m i2t.hardware.hand_eye", description=__doc__
    )
    return exit_code_of(lambda: _run(asked))


def _run(asked: DrawArgs | CaptureArgs | EstimateArgs) -> None:
    board = CharucoBoard(**{each.name: getattr(asked, each.name) for each in fields(CharucoArgs)})
    match asked:
        case DrawArgs():
            _draw(asked, board)
        case CaptureArgs():
            _capture(asked, board)
        case EstimateArgs():
            _estimate(asked, board)


def _draw(asked: DrawArgs, board: CharucoBoard) -> None:
    if asked.file.is_dir() or asked.file.suffix.lower() not in PICTURE_SUFFIXES:
        raise ValueError(f"{asked.file}: is no name of a picture; let it end in {' or '.join(PICTURE_SUFFIXES)}")
    with replacing(asked.file) as temporary:
        Image.fromarray(board.drawn()).save(temporary, dpi=(300, 300))
    print(f"{asked.file}: print it at 100 %; a square must measure {1e3 * board.square:g} mm")


def _capture(asked: CaptureArgs, board: CharucoBoard) -> None:
    rig = Rig.read(asked.rig) if asked.rig is not None else None
    require_named("camera", asked.camera, REALSENSE)
    own = asked.camera == REALSENSE
    if rig is None and not own:
        raise ValueError(f"--camera {asked.camera} needs the lab's calibration; pass --rig FILE")
    if asked.size is not None and not own:
        raise ValueError(f"--size is of a RealSense, and --camera is {asked.camera}; leave it out")
    tool = ToolPose(asked.arm, asked.host, rig)

    def more(number: int) -> bool:
        try:
            return input(f"pose {number}: Enter takes a view, q ends: ").strip() != "q"
        except EOFError:
            return False

    def take() -> tuple[Array, ColourView]:
        with tool.now() as T_b_t:
            return T_b_t, colour_view(camera)

    with tool.now():  # whoever does not answer is said before anything is asked of a person
        pass
    with named_camera(asked.camera, asked.serial, rig or Rig(), tool.arm, size=asked.size or COLOUR_SIZE) as camera:
        count = capture(asked.folder, take, more, board)
    print(f"{asked.folder}: {count} views")


def _estimate(asked: EstimateArgs, board: CharucoBoard) -> None:
    if asked.write and asked.rig is None:
        raise ValueError("--write needs the file to write into; give --rig")
    rig = Rig.read(asked.rig) if asked.rig is not None else None
    found, T_c_image, names = estimate(asked.folder, board)
    T_t_c = found.T_t_c @ inverse(T_c_image)
    print(
        f"{len(names)} views, {found.rms:.2f} pixels RMS; the worst is {names[int(found.view_rms.argmax())]} with ",
        end="",
    )
    print(f"{found.view_rms.max():.2f}")
    print(
        f"standard error {1e3 * found.position_error:.2f} mm, {math.degrees(found.rotation_error):.2f} degrees "
        "(jackknife over views)"
    )
    with np.printoptions(precision=6, suppress=True):
        print(f"T_tool_camera =\n{T_t_c}")
    if rig is not None:
        change = inverse(rig.T_tool_camera) @ T_t_c
        turn = math.degrees(Rotation.from_matrix(change[:3, :3]).magnitude())
        print(f"{1e3 * np.linalg.norm(change[:3, 3]):.1f} mm and {turn:.1f} degrees from what {asked.rig} says")
        if asked.write and asked.rig is not None:
            replace(rig, T_tool_camera=T_t_c).write(asked.rig)
            print(f"{asked.rig}: written")


if __name__ == "__main__":
    sys.exit(main())
