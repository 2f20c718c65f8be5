"""Question: how many presses of one skin are needed to predict all others, and which method needs the fewest?

    python -m experiments.calibrate --dataset DIR                  20 draws of 5 to 1000 presses
    python -m experiments.calibrate --dataset DIR --preset short   the same up to 300 presses, in a quarter of the time
    python -m experiments.calibrate --dataset DIR --preset debug   2 draws of up to 20 presses, too few for conclusions
    python -m experiments.calibrate --dataset DIR --presses 1000 --draws 5  one column of the table
    python -m experiments.calibrate --simulated                    the same methods on simulated skins of several kinds
    python -m experiments.calibrate --recovery                     how often the ranges of a fitted pad hold the truth
    python -m experiments.calibrate --prior                        make the prior over kernels in the package
    python -m experiments.calibrate --dataset DIR --save-pad FILE           fit a pad to the presses, for --pad FILE
    python -m experiments.calibrate --dataset DIR --targets position force  heads that predict these from readings

DIR is any recording of one tip on one skin (see i2t convert). All draws hold out the same presses: 1000 at
random (a quarter of fewer than 4000), and whole blocks of 6 mm. Nothing is chosen by held-out presses. All methods use
the same presses, so differences are paired. Intervals are over draws. Because neighbouring presses are not independent,
`i2t.calibrate` also has intervals over 6 mm blocks of the held-out presses. `experiments.fidelity` measures the value
of an earlier session.

With 8 to 59 presses, each press, and each block or place, is left out in turn and predicted from all others, or from
fewer with --presses. The command states how presses were held out and the limits of that: presses at one place show
nothing about other places.

--simulated compares methods on skins of its own seed (`experiments.calibrate.skins`). --prior makes prior.npz from
skins of another seed (`experiments.calibrate.prior_search`); the package holds it as i2t/skin_models/tip_gp/prior.npz.

Results go to --out: metrics.json, config.json, curves.png, and calibration.npz for `i2t.load_calibration`, which
`i2t.calibrate` made from all presses (1500 at random if there are more).
"""

import time
from typing import Any

import numpy as np

from experiments.calibrate import pad, prior_search, recovery, report, simulated, targets
from experiments.calibrate.arguments import CalibrateArgs, Preset, preset_of
from experiments.calibrate.evaluate import gains, learning_curves, over_blocks, summarise
from experiments.calibrate.held_out import HeldOut, hold_out
from experiments.common.runs import begin
from i2t import dataset as data
from i2t.dataset import Dataset
from i2t.errors import printable
from i2t.recordings.diagnose import check_presses, repeated_rows
from i2t.recordings.loads import loaded_presses
from i2t.recordings.presses import LoadedPresses
from i2t.skin_models import calibrate


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Run the part of the experiment that the options select."""
    others = {
        simulated.run: args.simulated, recovery.run: args.recovery, prior_search.run: args.prior,
        pad.run: args.save_pad, targets.run: args.targets,
    }  # fmt: skip
    return next((part for part, selected in others.items() if selected), compare)(args)


def compare(args: CalibrateArgs) -> dict[str, Any]:
    """Compute and report the learning curves of all methods on a recording."""
    assert args.dataset is not None
    started, cfg = time.perf_counter(), preset_of(args)
    dataset = data.load_dataset(args.dataset, skin=args.skin_name)
    recording = loaded_presses(dataset, args.load)
    for note in recording.notes:
        print(printable(f"note: {note}"))
    warnings = check_presses(recording.position, recording.load, recording.readings, by_force=recording.by_force)
    new = ~repeated_rows(recording.readings)
    held_out = hold_out(recording, cfg, args.seed, new, str(args.dataset))
    counts, draws = counts_and_draws(args, cfg, held_out)
    begin(args, cfg)
    for finding in warnings:
        if finding.wrong:
            print(f"warning: {finding.sentence}")
    for sentence in held_out.sentences:
        print(f"held out: {sentence}")
    scores = learning_curves(recording, held_out.splits, counts=counts, draws=draws, seed=args.seed)
    kept = save_calibration(args, cfg, dataset, recording, new)
    tests = held_out.tests
    metrics = {
        "source": dataset.source,
        "seed": args.seed,
        "draws": draws,
        "load": recording.load_kind,
        "tip": pad.tip_of(dataset),
        "notes": recording.notes,
        "kept": kept,
        **report.warning_metrics(warnings),
        "presses": len(recording.load),
        "held_out": {name: len(rows) for name, rows in tests.items()},
        "held_out_in_turn": held_out.in_turn,
        "about_held_out": held_out.sentences,
        "r2": {name: summarise(curves) for name, curves in scores.r2.items()},
        "inside_90": {name: summarise(curves) for name, curves in scores.coverage.items()},
        "differences": {name: summarise(gains(curves)) for name, curves in scores.r2.items()},
        "calibrate_over_blocks": {
            name: over_blocks(recording.readings[rows], scores.errors[name], held_out.clusters.of_press[rows])
            for name, rows in tests.items()
        },
        "clusters": held_out.clusters.plural(),
        "seconds": round(time.perf_counter() - started, 1),
    }
    report.write(args.out, metrics)
    return metrics


def counts_and_draws(args: CalibrateArgs, cfg: Preset, held_out: HeldOut) -> tuple[tuple[int, ...], int]:
    """Choose the numbers of training presses and of draws (ValueError: there are too few presses).

    If each press is left out in turn, one draw uses all others by default.
    """
    most = max(len(split.pool) for split in held_out.splits)
    if held_out.in_turn and not args.presses:
        return (most,), 1
    counts = tuple(n for n in cfg.counts if n <= most)
    if not counts:
        raise ValueError(
            f"{args.dataset} leaves {most} presses for training, fewer than the {min(cfg.counts)} asked for; pass "
            f"--presses {most} or less, or add presses"
        )
    return counts, cfg.draws


def save_calibration(
    args: CalibrateArgs, cfg: Preset, dataset: Dataset, recording: LoadedPresses, usable: np.ndarray
) -> dict[str, Any]:
    """Calibrate on all presses, write calibration.npz, and print the board that leave-one-out errors favour."""
    rows = np.random.default_rng(args.seed).permutation(np.flatnonzero(usable))[: cfg.saved_presses]
    calibration = calibrate(
        recording.position[rows],
        recording.load[rows],
        recording.readings[rows],
        load_kind=recording.load_kind,
        board=recording.unnamed_board,
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
