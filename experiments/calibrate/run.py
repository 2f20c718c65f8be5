"""Question: how many presses of one skin does it take to predict all others, and which method takes the fewest?

    python -m experiments.calibrate --dataset DIR                  20 draws of 5 to 1000 presses
    python -m experiments.calibrate --dataset DIR --preset short   the same up to 300 presses, in a quarter of the time
    python -m experiments.calibrate --dataset DIR --preset debug   2 draws of up to 20 presses, too few to mean much
    python -m experiments.calibrate --dataset DIR --previous-session DIR    only what an earlier session is worth
    python -m experiments.calibrate --dataset DIR --presses 1000 --draws 5  one column of the table
    python -m experiments.calibrate --dataset DIR --save-pad FILE           a pad fitted to the presses, for --pad FILE
    python -m experiments.calibrate --calibration FILE --save-pad FILE      the same from calibration.npz
    python -m experiments.calibrate --dataset DIR --targets position force  heads: these from readings

DIR is any recording of one tip on one skin (see python -m i2t.convert). Held out, for all draws alike: 1000 random
presses, and whole blocks of 6 mm; nothing is chosen by them. Random presses inside the blocks have no press near them
that methods may learn from, so those outside are also scored alone. A last part asks what an earlier session is worth:
the first half in time predicts the second; with --previous-session a session recorded before predicts the second half
of this one, and presses are drawn from the first half, so that one position or few are enough. Every method sees the
same presses, so that differences are paired. Intervals are over draws; as neighbouring presses are no independent
tests, `i2t.calibrate` also has intervals over 6 mm blocks of what is held out. The pretrained network was trained on
generated skins of four magnets only.

Results go to --out: metrics.json, config.json, curves.png, and calibration.npz for `i2t.load_calibration`: the skin as
calibrated on all presses (of more than 1500, that many at random) by `i2t.calibrate`.
"""

import os
import time
from typing import Any

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from experiments.calibrate import fitted_pad, previous_session, report, targets
from experiments.calibrate.config import CalibrateArgs, Preset, preset_of
from experiments.calibrate.data import PressRecording, hold_out, read_presses, split_presses
from experiments.calibrate.evaluate import learning_curves
from experiments.calibrate.methods import Predictors, pretrain_network
from experiments.common.runs import begin
from i2t import dataset as data
from i2t.calibration import calibrate
from i2t.calibration.model import hyperparameters_to_json
from i2t.dataset import Dataset

M_PER_MM = 1e-3


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Run what the options ask for: methods compared, an earlier session's worth, heads, or a pad."""
    if args.save_pad:
        return fitted_pad.run(args)
    return (previous_session.run if args.previous_session else targets.run if args.targets else compare)(args)


def compare(args: CalibrateArgs) -> dict[str, Any]:
    """Learning curves within one session: prepare, evaluate, report."""
    assert args.dataset is not None
    started, cfg = time.perf_counter(), preset_of(args)
    dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    recording = read_presses(dataset, args.load)
    for note in recording.notes:
        print(f"note: {note}")
    held, blocks = hold_out(recording, cfg.held_out_presses, cfg.block_mm, cfg.block_share, args.seed)
    refuse_too_few(args, cfg, held, blocks)
    begin(args.out, args, cfg, None, args.overwrite)
    warnings = report.warn(recording)
    unknowns = report.unknowns_of(dataset, recording)
    split = split_presses(held, blocks, ~warnings.repeated, cfg.block_mm)
    predictors = Predictors(recording, args.period_mm * M_PER_MM, cfg.scratch_steps)
    if not recording.by_force and recording.load.max() > 0:
        network = pretrain_network(recording, cfg.generated_skins, cfg.pretraining_steps)
        predictors = predictors.with_network(network)

    scores = learning_curves(predictors, split, counts=cfg.counts, draws=cfg.draws, seed=args.seed)

    kept = save_calibration(args, cfg, dataset, recording, ~warnings.repeated)
    block = recording.blocks(cfg.block_mm)
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": cfg.draws,
        "load": recording.load_kind,
        "tip": fitted_pad.tip_of(dataset),
        "notes": recording.notes,
        "kept": kept,
        **report.warning_metrics(warnings),
        "unknowns": unknowns,
        "presses": len(held),
        "hyperparameters": hyperparameters_to_json(predictors.hyperparameters),
        "held_out": split.sizes,
        "r2": {name: report.summarise(curves) for name, curves in scores.r2.items()},
        "inside_90": {name: report.summarise(curves) for name, curves in scores.coverage.items()},
        "differences": {name: report.differences(curves) for name, curves in scores.r2.items()},
        "calibrate_over_blocks": {
            name: report.over_blocks(recording.readings[rows], scores.errors[name], block[rows])
            for name, rows in split.tests.items()
        },
        "presses_for_the_same_r2": {name: report.equivalent_presses(curves) for name, curves in scores.r2.items()},
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.write(args.out, metrics)
    return metrics


def refuse_too_few(args: CalibrateArgs, cfg: Preset, held: np.ndarray, blocks: np.ndarray) -> None:
    """ValueError where presses are missing to learn from or to test on."""
    pool = np.flatnonzero(~held & ~blocks)
    later = np.arange(len(held)) >= len(held) // 2
    learnable = min(len(pool), 2 * int(later[pool].sum()))
    if learnable < 2 * min(cfg.counts) or min((held & ~blocks).sum(), blocks.sum(), (held & later).sum()) < 2:
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
            "board": fitted_pad.board_to_json(dataset.board),
            "pad": dataset.pads[int(dataset.touches.pad[0])],
            "tip": fitted_pad.tip_of(dataset) or dataset.objects[int(dataset.touches.object[0])],
        },
    )
    calibration.save(args.out / "calibration.npz")
    print(f"kept in calibration.npz: {calibration.about_board}")
    return {"board_shares": calibration.board_shares}
