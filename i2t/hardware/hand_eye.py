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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from PIL import Image

from i2t.cli.exit_codes import command
from i2t.depth.camera import read_image
from i2t.files.reading import read_text
from i2t.files.writing import file_in, replacing
from i2t.geometry import inverse
from i2t.hardware.camera_folder import DESCRIPTION, lens_text, read_lens
from i2t.hardware.hand_eye_fit import MIN_CORNERS, BoardView, HandEyeResult, fit, opencv, pixel_rays
from i2t.hardware.plugins import REALSENSE, DeviceSetup, ToolPose, check_device, colour_view, load_device
from i2t.hardware.poses import pose_difference, pose_from_vector, pose_to_vector
from i2t.hardware.protocols import ColourImage
from i2t.hardware.rig import Rig
from i2t.types import Array

PRINT_PIXELS_PER_MM = 300 / 25.4  # pixels per mm of a printed board: 300 dpi
COLOUR_SIZE = (640, 360)  # pixels of a RealSense's colour images, unless told otherwise
PICTURE_SUFFIXES = (".png", ".tif", ".pdf")  # in which the board's size on paper is kept


@dataclass(frozen=True, kw_only=True)
class CharucoBoard:
    """A ChArUco board; one that cannot be is refused (ValueError) when it is drawn or looked for."""

    columns: int = 8  # of squares
    rows: int = 6  # of squares
    square: float = 0.015  # m, edge of a square
    marker: float = 0.011  # m, edge of a marker
    dictionary: str = "4X4_50"  # of OpenCV; APRILTAG_36h11 makes a board of AprilTags

    def drawn(self, pixels_per_mm: float = PRINT_PIXELS_PER_MM) -> Array:
        """The board as an image to print, with a margin of a square.

        Args:
            pixels_per_mm: Scale of the image.

        Returns:
            (h, w) uint8.
        """
        edge = round(1e3 * self.square * pixels_per_mm)
        size = ((self.columns + 2) * edge, (self.rows + 2) * edge)
        return np.asarray(self._made().generateImage(size, marginSize=edge))

    def find(self, image: Array) -> tuple[Array, Array]:
        """The corners that are seen in an image.

        Args:
            image: (h, w, 3) uint8 RGB.

        Returns:
            (k, 3) m on the board and (k, 2) pixels; k may be 0.
        """
        cv2, board = opencv(), self._made()
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        places, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if numbers is None or not len(numbers):
            return np.zeros((0, 3)), np.zeros((0, 2))
        return np.array(board.getChessboardCorners(), float)[np.ravel(numbers)], np.reshape(places, (-1, 2)).astype(
            float
        )

    def _made(self) -> Any:
        if self.columns < 3 or self.rows < 3 or not 0 < self.marker < self.square < 1:
            raise ValueError(
                f"a board of {self.columns} x {self.rows} squares of {self.square:g} m with markers of {self.marker:g} "
                "m is none; give at least 3 x 3 squares, in metres, larger than their markers"
            )
        aruco = opencv().aruco
        code = getattr(aruco, f"DICT_{self.dictionary}", None)
        if code is None:
            raise ValueError(f"OpenCV has no dictionary {self.dictionary!r}; give one as 4X4_50 or APRILTAG_36h11")
        markers = aruco.getPredefinedDictionary(code)
        return aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)


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
    camera, given = read_lens(path, {"T_camera_image": np.eye(4)})
    T_c_image = np.array(given["T_camera_image"], object)
    if T_c_image.shape != (4, 4):
        raise ValueError(f"{path / DESCRIPTION}: T_camera_image is no matrix of four rows; see i2t.hardware.hand_eye")
    views, names = [], []
    for name, T_b_t in _poses(path / "poses.csv"):
        file = file_in(path / "images", name, path / "poses.csv")
        try:
            image = read_image(file, shape=(camera.height, camera.width), said_by=DESCRIPTION, mode="RGB")
        except OSError as error:
            raise ValueError(f"{file}: cannot be read ({error.strerror or error}); leave out its pose") from error
        corners, pixels = board.find(image)
        rays = pixel_rays(camera, pixels)
        seen = np.isfinite(rays).all(1)
        if seen.sum() >= MIN_CORNERS:
            views.append(BoardView(T_b_t, corners[seen], rays[seen]))
            names.append(name)
    try:
        return fit(views, (camera.fx + camera.fy) / 2), T_c_image.astype(float), names
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def capture(
    path: Path, take: Callable[[], tuple[Array, ColourImage]], more: Callable[[int], bool], board: CharucoBoard
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
                (path / DESCRIPTION).write_text(
                    lens_text(seen.camera, T_camera_image=seen.T_c_colour.tolist()), "utf-8"
                )
            found = len(board.find(seen.image)[0])
            print(f"view {number}: {found} corners{'; too few, it will not be used' * (found < MIN_CORNERS)}")
            Image.fromarray(seen.image).save(path / "images" / f"{number:03d}.png")
            rows.writerow([f"{number:03d}.png", *(f"{x:.9f}" for x in pose_to_vector(T_b_t))])
            file.flush()
            number += 1
    return number


def _poses(path: Path) -> Iterator[tuple[str, Array]]:
    try:
        rows = [row for row in csv.reader(read_text(path).splitlines()) if row]
    except (OSError, csv.Error) as error:
        raise ValueError(f"{path}: cannot be read ({error}); it holds one line for each image") from error
    for row in rows:
        try:
            numbers = np.array(row[1:], float)
        except ValueError:
            numbers = np.array(np.nan)
        if numbers.shape != (6,) or not (np.abs(numbers) <= 10).all():
            raise ValueError(f"{path}: {','.join(row)!r} is no pose; write NAME.png, x, y, z (m), rx, ry, rz (rad)")
        yield row[0].strip(), pose_from_vector(numbers.tolist())


@dataclass(frozen=True, kw_only=True)
class DrawArgs(CharucoBoard):
    """Draw the board."""

    file: tyro.conf.Positional[Path]  # the image that is written

    def run(self) -> None:
        """Write the image."""
        if self.file.is_dir() or self.file.suffix.lower() not in PICTURE_SUFFIXES:
            raise ValueError(f"{self.file}: is no name of a picture; let it end in {' or '.join(PICTURE_SUFFIXES)}")
        with replacing(self.file) as temporary:
            Image.fromarray(self.drawn()).save(temporary, dpi=(300, 300))
        print(f"{self.file}: print it at 100 %; a square must measure {1e3 * self.square:g} mm")


@dataclass(frozen=True, kw_only=True)
class CaptureArgs(CharucoBoard):
    """Take views with the camera on an arm that a person moves."""

    folder: tyro.conf.Positional[Path]  # for the views
    arm: str = "ur"  # or another package's: the name that it registers, or package.module:Class
    host: str | None = None  # address of the arm's controller; a UR arm needs one
    camera: str = REALSENSE  # or another package's
    serial: str | None = None  # which RealSense, if there are several; the address of another package's camera
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Pixels of a RealSense's images: 640 360 by default."""
    rig: Path | None = None  # the lab's calibration, which another package's devices need

    def run(self) -> None:
        """Take the views."""
        rig = Rig.read(self.rig) if self.rig is not None else None
        check_device("camera", self.camera, {"size": self.size})
        if rig is None and self.camera != REALSENSE:
            raise ValueError(f"--camera {self.camera} needs the lab's calibration; pass --rig FILE")
        tool, size = ToolPose(self.arm, self.host, rig), self.size or COLOUR_SIZE

        def take() -> tuple[Array, ColourImage]:
            with tool.now() as T_b_t:
                return T_b_t, colour_view(camera)

        with tool.now():  # whoever does not answer is said before anything is asked of a person
            pass
        setup = DeviceSetup(rig or Rig(), self.serial, tool.arm, size=size)
        with load_device("camera", self.camera, setup) as camera:
            count = capture(self.folder, take, _asked_for_more, self)
        print(f"{self.folder}: {count} views")


def _asked_for_more(number: int) -> bool:
    try:
        return input(f"pose {number}: Enter takes a view, q ends: ").strip() != "q"
    except EOFError:
        return False


@dataclass(frozen=True, kw_only=True)
class EstimateArgs(CharucoBoard):
    """Find the camera in the tool."""

    folder: tyro.conf.Positional[Path]  # of the views
    rig: Path | None = None  # a lab's calibration, to compare with
    write: bool = False  # put the estimate into it

    def run(self) -> None:
        """Print the estimate, and write it."""
        if self.write and self.rig is None:
            raise ValueError("--write needs the file to write into; give --rig")
        rig = Rig.read(self.rig) if self.rig is not None else None
        found, T_c_image, names = estimate(self.folder, self)
        T_t_c, worst = found.T_t_c @ inverse(T_c_image), int(found.view_rms.argmax())
        error, turn = 1e3 * found.position_error, math.degrees(found.rotation_error)
        print(f"{len(names)} views, {found.rms:.2f} pixels RMS; the worst is {names[worst]} with ", end="")
        print(f"{found.view_rms[worst]:.2f}\nstandard error {error:.2f} mm, {turn:.2f} degrees (jackknife over views)")
        with np.printoptions(precision=6, suppress=True):
            print(f"T_tool_camera =\n{T_t_c}")
        if rig is None or self.rig is None:
            return
        shift, turn = pose_difference(rig.T_tool_camera, T_t_c)
        print(f"{1e3 * shift:.1f} mm and {math.degrees(turn):.1f} degrees from what {self.rig} says")
        if self.write:
            replace(rig, T_tool_camera=T_t_c).write(self.rig)
            print(f"{self.rig}: written")


HandEyeArgs = (
    Annotated[DrawArgs, tyro.conf.subcommand(name="board")]
    | Annotated[CaptureArgs, tyro.conf.subcommand(name="capture")]
    | Annotated[EstimateArgs, tyro.conf.subcommand(name="estimate")]
)


main = command(HandEyeArgs, lambda asked: asked.run(), program="python -m i2t.hardware.hand_eye", description=__doc__)


if __name__ == "__main__":
    sys.exit(main())
