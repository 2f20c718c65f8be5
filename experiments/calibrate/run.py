"""Question: how many presses of one skin does it take to predict all others, and which method takes the fewest?

    python -m experiments.calibrate --dataset DIR                  20 draws of 5 to 1000 presses
    python -m experiments.calibrate --dataset DIR --preset short   the same up to 300 presses, in a quarter of the time
    python -m experiments.calibrate --dataset DIR --preset debug   2 draws of up to 20 presses, too few to mean much
    python -m experiments.calibrate --dataset DIR --presses 1000 --draws 5  one column of the table
    python -m experiments.calibrate --simulated                    the same methods on simulated skins of several kinds
    python -m experiments.calibrate --prior                        the prior over kernels that the package holds
    python -m experiments.calibrate --dataset DIR --save-pad FILE           a pad fitted to the presses, for --pad FILE
    python -m experiments.calibrate --dataset DIR --targets position force  heads: these from readings

DIR is any recording of one tip on one skin (see python -m i2t.convert). Held out, for all draws alike: 1000 random
presses, and whole blocks of 6 mm; nothing is chosen by them. Every method sees the same presses, so that differences
are paired. Intervals are over draws; as neighbouring presses are no independent tests, `i2t.calibrate` also
has intervals over 6 mm blocks of what is held out. What an earlier session is worth is for `experiments.fidelity`.

--simulated tries them on skins of its own seed (`experiments.calibrate.skins`), and --prior makes prior.npz from others
(`experiments.calibrate.prior_search`), which becomes i2t/calibration/prior.npz.

Results go to --out: metrics.json, config.json, curves.png, and calibration.npz for `i2t.load_calibration`: the skin as
calibrated on all presses (of more than 1500, that many at random) by `i2t.calibrate`.
"""

import time
from typing import Any

import numpy as np

from experiments.calibrate import pad, prior_search, report, simulated, targets
from experiments.calibrate.arguments import CalibrateArgs, Preset, preset_of
from experiments.calibrate.data import PressRecording, hold_out, read_presses, split_presses
from experiments.calibrate.evaluate import gains, learning_curves, over_blocks, summarise
from experiments.common.runs import begin
from i2t import dataset as data
from i2t.calibration import calibrate
from i2t.dataset import Dataset
from i2t.terminal import printable


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Run what the options ask for: methods compared, the prior, heads, or a pad."""
    others = {
        simulated.run: args.simulated, prior_search.run: args.prior, pad.run: args.save_pad, targets.run: args.targets,
    }  # fmt: skip
    return next((each for each, asked in others.items() if asked), compare)(args)


def compare(args: CalibrateArgs) -> dict[str, Any]:
    """Learning curves within one session: prepare, evaluate, report."""
    assert args.dataset is not None
    started, cfg = time.perf_counter(), preset_of(args)
    dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    recording = read_presses(dataset, args.load)
    for note in recording.notes:
        print(printable(f"note: {note}"))
    held, blocks = hold_out(recording, cfg.held_out_presses, cfg.block_mm, cfg.block_share, args.seed)
    refuse_too_few(args, cfg, held, blocks)
    begin(args.out, args, cfg, None, args.overwrite)
    warnings = report.warn(recording)
    split = split_presses(held, blocks, ~warnings.repeated, cfg.block_mm)
    scores = learning_curves(recording, split, counts=cfg.counts, draws=cfg.draws, seed=args.seed)
    kept = save_calibration(args, cfg, dataset, recording, ~warnings.repeated)
    block = recording.blocks(cfg.block_mm)
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": cfg.draws,
        "load": recording.load_kind,
        "tip": pad.tip_of(dataset),
        "notes": recording.notes,
        "kept": kept,
        **report.warning_metrics(warnings),
        "presses": len(held),
        "held_out": {name: len(rows) for name, rows in split.tests.items()},
        "r2": {name: summarise(curves) for name, curves in scores.r2.items()},
        "inside_90": {name: summarise(curves) for name, curves in scores.coverage.items()},
        "differences": {name: summarise(gains(curves)) for name, curves in scores.r2.items()},
        "calibrate_over_blocks": {
            name: over_blocks(recording.readings[rows], scores.errors[name], block[rows])
            for name, rows in split.tests.items()
        },
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.write(args.out, metrics)
    return metrics


def refuse_too_few(args: CalibrateArgs, cfg: Preset, held: np.ndarray, blocks: np.ndarray) -> None:
    """ValueError where presses are missing to learn from or to test on."""
    pool = np.flatnonzero(~held & ~blocks)
    if len(pool) < 2 * min(cfg.counts) or min((held & ~blocks).sum(), blocks.sum()) < 2:
        placed = "" if len(pool) else f", all in {cfg.block_mm:g} mm that are held out as one block"
        raise ValueError(
            f"{args.dataset} has {len(held)} usable presses{placed}, too few to calibrate on and to hold out"
        )


def save_calibration(
    args: CalibrateArgs, cfg: Preset, dataset: Dataset, recording: PressRecording, usable: np.ndarray
) -> dict[str, Any]:
    """Calibrate on all presses, write calibration.npz and say on which board, by what presses left out say."""
    rows = np.random.default_rng(args.seed).permutation(np.flatnonzero(usable))[: cfg.saved_presses]
    calibration = calibrate(
        recording.position[rows],
        recording.load[rows],
        recording.readings[rows],
        load_kind=recording.load_kind,
        board=recording.own_board,
        metadata={
            "dataset": str(args.dataset),
            "source": dataset.source,
            "pad": dataset.pads[int(dataset.touches.pad[0])],
            "tip": pad.tip_of(dataset) or dataset.objects[int(dataset.touches.object[0])],
        },
    )
    calibration.save(args.out / "calibration.npz")
    print(f"kept in calibration.npz: {calibration.about_board}")
    return {"board_shares": calibration.board_shares}
