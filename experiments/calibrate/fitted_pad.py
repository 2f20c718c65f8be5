"""A pad file from recorded presses, or from a calibration that was made of them."""

from typing import Any

import numpy as np

from experiments.calibrate.config import CalibrateArgs
from experiments.calibrate.data import read_presses
from i2t import dataset as data
from i2t.calibration import check_presses, load_calibration
from i2t.calibration.files import PressedSkin, calibrated_presses, fit_pressed_pad, parse_tip, save_pressed_pad
from i2t.dataset import Dataset
from i2t.skin.boards import make_board
from i2t.types import Board

MAX_PAD_PRESSES = 300  # at random: a map is known by then (docs/calibration.md), and every press costs
POOR_R2 = 0.5  # below it the layer that is fitted is not what was pressed


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Fit a pad to presses and save it."""
    assert args.save_pad is not None
    if args.save_pad.exists() and not args.overwrite:
        raise ValueError(f"{args.save_pad} exists; choose another --save-pad, or pass --overwrite")
    pressed, about = _of_calibration(args) if args.calibration else _of_dataset(args)
    tip = args.tip or about["tip"]
    if tip is None:
        raise ValueError(f"{args.calibration} does not say what pressed; pass --tip sphere:RADIUS_IN_MM")
    found = fit_pressed_pad(pressed, parse_tip(tip))
    name = args.pad_name or about["pad"]
    save_pressed_pad(args.save_pad, found, pad=name, source=about["source"])
    load = "force" if pressed.by_force else "depth"
    print(
        f'pad of "{name}" fitted to {found.presses} {about["source"]} presses of {tip} by {load}: R2 {found.r2:.3f}, '
        f"{found.error_std:.1f} uT, each press left out"
    )
    if found.r2 < POOR_R2:
        print("warning: this pad explains its own presses poorly; it may be no even layer over this board")
    print(f"it is in {args.save_pad}")
    return {"presses": found.presses, "r2": found.r2, "error_std_uT": found.error_std, "pad": name, "tip": tip}


def board_to_json(board: Board) -> dict[str, Any]:
    """A board as a calibration's file keeps it."""
    return {name: np.asarray(part, float).tolist() for name, part in board._asdict().items()}


def _of_dataset(args: CalibrateArgs) -> tuple[PressedSkin, dict[str, Any]]:
    """Sound presses of a data set, at random, by force where it was measured."""
    assert args.dataset is not None
    dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    measured = np.isfinite(dataset.touches.force)
    load = args.load if args.load != "auto" else "force" if measured.any() else "depth"
    recording = read_presses(dataset, load)
    found = check_presses(recording.position, recording.load, recording.readings, by_force=recording.by_force)
    rows = np.random.default_rng(args.seed).permutation(np.flatnonzero(~found.repeated))[:MAX_PAD_PRESSES]
    pressed = PressedSkin(
        recording.position[rows], recording.load[rows], recording.readings[rows], dataset.board, recording.by_force
    )
    name, pad = dataset.objects[int(dataset.touches.object[0])], dataset.pads[int(dataset.touches.pad[0])]
    return pressed, {"tip": tip_of(dataset) or name, "pad": pad, "source": dataset.source}


def tip_of(dataset: Dataset) -> str | None:
    """The round tip that a data set says pressed, as --tip would; None where it says none."""
    name = dataset.objects[int(dataset.touches.object[0])]
    radius = dataset.meta.get("tip_radius_m")
    try:
        parse_tip(said := name if radius is None else f"sphere:{1e3 * float(radius):g}")
    except ValueError:
        return None
    return said


def _of_calibration(args: CalibrateArgs) -> tuple[PressedSkin, dict[str, Any]]:
    """The presses that a calibration holds."""
    assert args.calibration is not None
    calibration = load_calibration(args.calibration)
    about = calibration.metadata
    if args.board:
        board = make_board(args.board)
    elif "board" in about:
        board = Board(*(np.asarray(about["board"][name], np.float32) for name in Board._fields))
    else:
        raise ValueError(f"{args.calibration} does not say which board it is of; pass --board, for instance reskin")
    pressed = calibrated_presses(calibration, board)
    rows = np.random.default_rng(args.seed).permutation(len(pressed.load))[:MAX_PAD_PRESSES]
    pressed = pressed._replace(
        position=pressed.position[rows], load=pressed.load[rows], readings=pressed.readings[rows]
    )
    default = {"tip": None, "pad": args.calibration.stem, "source": "real"}
    return pressed, default | {key: about[key] for key in default if key in about}
