"""Pose of the camera in the tool, from about 15 views of a printed board at different tilts.

    i2t hand-eye board board.png                    # print it at 100 %, measure a square
    i2t hand-eye capture DIR --host 192.168.0.2     # move the arm by hand, press Enter, repeat
    i2t hand-eye estimate DIR --square 0.0152 --rig lab.toml --write

The board is a ChArUco board of OpenCV (`--dictionary APRILTAG_36h11` makes one of AprilTags). `capture` reads a
RealSense's colour image and the arm's pose, without controlling the arm; the TCP set on the pendant must be the rig's
T_flange_tool. Arms and cameras of other packages (`--arm`, `--camera`) also need the rig, and such an arm is released
between views. Another program may also write DIR:

    DIR/camera.toml      lens of the images in pixels (keys of `i2t.depth.camera.Camera`), and T_camera_image (4 rows),
                         the frame of the images in the depth camera's, if another sensor took them
    DIR/images/NAME.png  images of the board, one from each pose
    DIR/poses.csv        NAME.png, x, y, z (m), rx, ry, rz (rotation vector, rad): T_base_tool as the pendant shows it

The estimate needs at least six views, tilted by 15 degrees or more about two axes. `i2t.hardware.hand_eye_fit` explains
the method and the stated error.
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
from i2t.hardware.hand_eye_fit import BoardView, HandEyeConfig, HandEyeResult, fit, opencv, pixel_rays
from i2t.hardware.plugins import REALSENSE, DeviceSetup, ToolPose, check_device, colour_view, load_device
from i2t.hardware.poses import pose_difference, pose_from_vector, pose_to_vector
from i2t.hardware.protocols import ColourImage
from i2t.hardware.rig import Rig
from i2t.types import Array


@dataclass(frozen=True, kw_only=True)
class CharucoBoard:
    """Geometry of a ChArUco calibration board: numbers of squares, edges (m) of squares and markers, and dictionary.

    Drawing or finding an impossible board raises ValueError.
    """

    columns: int = 8  # number of squares in a row
    rows: int = 6  # number of rows of squares
    square: float = 0.015  # edge (m) of a square
    marker: float = 0.011  # edge (m) of a marker
    dictionary: str = "4X4_50"  # OpenCV's dictionary of markers; APRILTAG_36h11 makes a board of AprilTags

    def image(self, pixels_per_mm: float = 300 / 25.4) -> Array:
        """Draw the board for printing, with a margin of a square.

        Args:
            pixels_per_mm: Scale of the image in pixels per mm; by default that of 300 dpi.

        Returns:
            (h, w) uint8 image.
        """
        edge = round(1e3 * self.square * pixels_per_mm)
        size = ((self.columns + 2) * edge, (self.rows + 2) * edge)
        return np.asarray(self._opencv_board().generateImage(size, marginSize=edge))

    def find(self, image: Array) -> tuple[Array, Array]:
        """Find the board's corners in an image of it.

        Args:
            image: (h, w, 3) uint8 RGB image.

        Returns:
            (k, 3) positions on the board in m of the k corners in view, and their (k, 2) pixels (column, row); k may
            be 0.
        """
        cv2, board = opencv(), self._opencv_board()
        grey = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        pixels, numbers, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(grey)
        if numbers is None or not len(numbers):
            return np.zeros((0, 3)), np.zeros((0, 2))
        corners = np.array(board.getChessboardCorners(), float)[np.ravel(numbers)]
        return corners, np.reshape(pixels, (-1, 2)).astype(float)

    def _opencv_board(self) -> Any:
        if self.columns < 3 or self.rows < 3 or not 0 < self.marker < self.square < 1:
            raise ValueError(
                f"a board of {self.columns} x {self.rows} squares of {self.square:g} m with markers of {self.marker:g} "
                "m is impossible; give at least 3 x 3 squares, in metres, larger than their markers"
            )
        aruco = opencv().aruco
        code = getattr(aruco, f"DICT_{self.dictionary}", None)
        if code is None:
            raise ValueError(f"OpenCV has no dictionary {self.dictionary!r}; give one such as 4X4_50 or APRILTAG_36h11")
        markers = aruco.getPredefinedDictionary(code)
        return aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)


def estimate(path: Path, board: CharucoBoard) -> tuple[HandEyeResult, Array, list[str]]:
    """Estimate the pose of the camera on the tool (hand-eye calibration) from a folder of views of a board.

    Args:
        path: Path of the folder.
        board: Board that the images show.

    Returns:
        The estimate, the pose T_camera_image (4, 4) of the colour images' frame in the depth camera's frame, and the
        names of the images that were used.

    Raises:
        ValueError: A file is invalid, or the views do not determine the pose; the message names the file.
    """
    camera, given = read_lens(path, {"T_camera_image": np.eye(4)})
    T_c_image = np.array(given["T_camera_image"], object)
    if T_c_image.shape != (4, 4):
        raise ValueError(
            f"{path / DESCRIPTION}: T_camera_image is not a matrix of four rows; see i2t.hardware.hand_eye"
        )
    views, names = [], []
    for name, T_b_t in _poses(path / "poses.csv"):
        file = file_in(path / "images", name, path / "poses.csv")
        try:
            image = read_image(file, shape=(camera.height, camera.width), required_by=DESCRIPTION, mode="RGB")
        except OSError as error:
            raise ValueError(f"{file}: cannot be read ({error.strerror or error}); omit its pose") from error
        corners, pixels = board.find(image)
        rays = pixel_rays(camera, pixels)
        valid = np.isfinite(rays).all(1)
        if valid.sum() >= HandEyeConfig.min_corners:
            views.append(BoardView(T_b_t, corners[valid], rays[valid]))
            names.append(name)
    try:
        return fit(views, (camera.fx + camera.fy) / 2), T_c_image.astype(float), names
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def capture(
    path: Path, take: Callable[[], tuple[Array, ColourImage]], more: Callable[[int], bool], board: CharucoBoard
) -> int:
    """Take colour images of a board from several tool poses and save both in a new folder, for `estimate`.

    Args:
        path: Path of the new folder.
        take: Function that returns the present T_b_t (4, 4), and a colour image from there.
        more: Function of the view's number that decides whether to take that view or to end.
        board: Board that the images show.

    Returns:
        The number of views that were taken.
    """
    (path / "images").mkdir(parents=True)
    number = 0
    with (path / "poses.csv").open("w", newline="") as file:
        rows = csv.writer(file)
        while more(number):
            T_b_t, colour = take()
            if number == 0:
                lens = lens_text(colour.camera, T_camera_image=colour.T_c_colour.tolist())
                (path / DESCRIPTION).write_text(lens, "utf-8")
            count = len(board.find(colour.image)[0])
            unused = "; too few, it will not be used" * (count < HandEyeConfig.min_corners)
            print(f"view {number}: {count} corners{unused}")
            Image.fromarray(colour.image).save(path / "images" / f"{number:03d}.png")
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
            raise ValueError(f"{path}: {','.join(row)!r} is not a pose; write NAME.png, x, y, z (m), rx, ry, rz (rad)")
        yield row[0].strip(), pose_from_vector(numbers.tolist())


@dataclass(frozen=True, kw_only=True)
class DrawArgs(CharucoBoard):
    """Draw a calibration board for printing."""

    file: tyro.conf.Positional[Path]  # image to write

    def run(self) -> None:
        """Draw the board and write its image."""
        suffixes = (".png", ".tif", ".pdf")  # of formats that keep the size on paper
        if self.file.is_dir() or self.file.suffix.lower() not in suffixes:
            raise ValueError(f"{self.file}: is not the name of a picture; use the ending {' or '.join(suffixes)}")
        with replacing(self.file) as temporary:
            Image.fromarray(self.image()).save(temporary, dpi=(300, 300))
        print(f"{self.file}: print it at 100 %; a square must measure {1e3 * self.square:g} mm")


@dataclass(frozen=True, kw_only=True)
class CaptureArgs(CharucoBoard):
    """Take views of a calibration board with the camera on an arm that is moved by hand."""

    folder: tyro.conf.Positional[Path]  # new folder for the views
    arm: str = "ur"  # ur, or an arm of another package by its registered name or as package.module:Class
    host: str | None = None  # address of the arm's controller; required for a UR arm
    camera: str = REALSENSE  # depth camera: realsense, or a camera of another package, named as for --arm
    # serial number of the RealSense, if several are plugged in; or the address of a camera of another package
    serial: str | None = None
    size: Annotated[tuple[int, int] | None, tyro.conf.arg(metavar="WIDTH HEIGHT")] = None
    """Image size of a RealSense in pixels; by default 640 360."""
    rig: Path | None = None  # the lab's calibration file; required for devices of other packages

    def run(self) -> None:
        """Connect the camera, take the views and save them."""
        rig = Rig.read(self.rig) if self.rig is not None else None
        check_device("camera", self.camera, {"size": self.size})
        if rig is None and self.camera != REALSENSE:
            raise ValueError(f"--camera {self.camera} needs the lab's calibration; pass --rig FILE")
        tool, size = ToolPose(self.arm, self.host, rig), self.size or (640, 360)

        def take() -> tuple[Array, ColourImage]:
            with tool.now() as T_b_t:
                return T_b_t, colour_view(camera)

        with tool.now():  # an arm that does not answer raises before a person has to do anything
            pass
        setup = DeviceSetup(rig or Rig(), self.serial, tool.arm, size=size)
        with load_device("camera", self.camera, setup) as camera:
            count = capture(self.folder, take, _confirm, self)
        print(f"{self.folder}: {count} views")


def _confirm(number: int) -> bool:
    try:
        return input(f"pose {number}: Enter takes a view, q ends: ").strip() != "q"
    except EOFError:
        return False


@dataclass(frozen=True, kw_only=True)
class EstimateArgs(CharucoBoard):
    """Estimate the pose of the camera on the tool from saved views of a calibration board."""

    folder: tyro.conf.Positional[Path]  # folder of the views
    rig: Path | None = None  # the lab's calibration file, with which the estimate is compared
    write: bool = False  # write the estimate to the calibration file

    def run(self) -> None:
        """Estimate and print the camera's pose, and write it to the rig if requested."""
        if self.write and self.rig is None:
            raise ValueError("--write needs the file to write into; give --rig")
        rig = Rig.read(self.rig) if self.rig is not None else None
        result, T_c_image, names = estimate(self.folder, self)
        T_t_c, worst = result.T_t_c @ inverse(T_c_image), int(result.view_rms.argmax())
        error, angle = 1e3 * result.position_error, math.degrees(result.rotation_error)
        print(f"{len(names)} views, {result.rms:.2f} pixels RMS; the worst is {names[worst]} with ", end="")
        print(f"{result.view_rms[worst]:.2f}\nstandard error {error:.2f} mm, {angle:.2f} degrees (jackknife)")
        with np.printoptions(precision=6, suppress=True):
            print(f"T_tool_camera =\n{T_t_c}")
        if rig is None or self.rig is None:
            return
        shift, angle = pose_difference(rig.T_tool_camera, T_t_c)
        print(f"{1e3 * shift:.1f} mm and {math.degrees(angle):.1f} degrees from the camera in {self.rig}")
        if self.write:
            replace(rig, T_tool_camera=T_t_c).write(self.rig)
            print(f"{self.rig}: written")


HandEyeArgs = (
    Annotated[DrawArgs, tyro.conf.subcommand(name="board")]
    | Annotated[CaptureArgs, tyro.conf.subcommand(name="capture")]
    | Annotated[EstimateArgs, tyro.conf.subcommand(name="estimate")]
)


main = command(HandEyeArgs, lambda args: args.run(), program="python -m i2t.hardware.hand_eye", description=__doc__)


if __name__ == "__main__":
    sys.exit(main())
