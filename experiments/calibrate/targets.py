"""Heads that predict properties of presses from a skin's readings, tested on held-out rows and saved."""

import time
from pathlib import Path
from typing import Any

from experiments.calibrate.arguments import CalibrateArgs
from experiments.common.runs import begin, write_json
from experiments.common.tables import text_table
from experiments.fidelity.config import FIDELITY_PRESETS
from experiments.fidelity.heads import caption, compare_with_baselines, missed_ranges, table, test_heads, to_numbers
from i2t.errors import printable
from i2t.heads.heads import fit_head
from i2t.recordings.read import SkinRecording, read_recordings


def run(args: CalibrateArgs) -> dict[str, Any]:
    """Test a head of each target on held-out rows, then fit it to all rows and save it."""
    assert args.dataset is not None
    started, preset = time.perf_counter(), FIDELITY_PRESETS[args.preset]
    recording = one_recording(args.dataset)
    begin(args, preset)
    for note in recording.notes:
        print(printable(note))
    metrics: dict[str, Any] = {"source": recording.source, "seed": args.seed, "rows": len(recording), "heads": {}}
    for target in args.targets:
        tests = test_heads(recording, target, preset.heads, share=preset.held_out_share, seed=args.seed)
        about = {"recording": recording.name, "source": recording.source, "tests": to_numbers(tests)}
        fit_head(recording, target, budget=preset.heads, seed=args.seed, metadata=about).save(
            args.out / f"{target}.npz"
        )
        metrics["heads"][target] = to_numbers(tests)
        head, *rows = table(target, tests)
        print(f"  {caption(target)}\n{text_table(head, rows, '    ')}")
        kept = {name: test.kept for name, test in tests.items()}
        sentences = compare_with_baselines(target, tests) + missed_ranges(target, kept)
        print("\n".join(f"  {sentence}" for sentence in sentences))
    metrics["seconds"] = round(time.perf_counter() - started, 1)
    write_json(args.out / "metrics.json", metrics)
    print(f"\nheads are in {args.out}: i2t.heads.heads.load_head(FILE).predict(readings)")
    return metrics


def one_recording(path: Path) -> SkinRecording:
    """Read the only recording of a path (ValueError: there are several)."""
    recordings = read_recordings(path)
    if len(recordings) > 1:
        names = ", ".join(recording.name for recording in recordings[:3])
        raise ValueError(f"{path} holds {len(recordings)} recordings ({names} ...), but a head needs one; name it")
    return recordings[0]
