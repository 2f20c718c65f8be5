"""Question: how good is a recording of a skin, and what can be estimated from its readings?

    python -m experiments.fidelity --dataset A                  full report, minutes
    python -m experiments.fidelity --dataset A B                two sessions of one skin, with predictions across them
    python -m experiments.fidelity --dataset A --preset debug   every part once, seconds

A recording is a data set of i2t (a folder or a file), a session of eFlesh, or a table with one row for each reading
(docs/fidelity.md). Any content is accepted: where the recording lacks the data for a part, a sentence gives the reason.

Results go to --out: report.txt, calibration curves (.png), metrics.json and config.json.
"""

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from experiments.common.presets import choose_preset
from experiments.common.runs import begin, write_json
from experiments.fidelity import causes, curves, describe, dynamics, heads
from experiments.fidelity.arguments import FidelityArgs
from experiments.fidelity.config import FIDELITY_PRESETS, FidelityPreset
from experiments.fidelity.sections import Section, text_of, written
from i2t import viz
from i2t.errors import DataError
from i2t.files.writing import replacing
from i2t.recordings.diagnose import Finding
from i2t.recordings.read import SkinRecording, corrected_recording, is_dataset, read_recordings


def run(args: FidelityArgs) -> dict[str, Any]:
    """Read the recordings, write the report, and return its metrics."""
    started, preset = time.perf_counter(), choose_preset(FIDELITY_PRESETS, args.preset)
    read = _recordings(args.dataset)
    recordings = named_apart([recording for _, recording in read])
    begin(args, preset)
    chapters: dict[str, list[Section]] = {}
    for recording in recordings:
        print(f"\n{recording.name}: {len(recording)} readings")
        chapters[recording.name] = [_printed(section) for section in sections_of(recording, preset, args.seed)]
    if len(recordings) > 1:
        work = partial(curves.across_sessions, recordings, preset, args.seed)
        chapters["Across sessions"] = [_printed(written("Predictions across sessions", work))]
    of_path = {path: recording.name for (path, _), recording in zip(read, recordings, strict=True)}
    for path, name in of_path.items():
        if is_dataset(path):
            work = partial(causes.cause_section, path, preset, args.seed)
            chapters[name].append(_printed(written("Possible causes of a poor predictor", work)))
    metrics = {
        "source": sorted({recording.source for recording in recordings}),
        "seed": args.seed,
        "recordings": {
            name: {
                section.title: {"status": section.status, "sentences": section.sentences, **section.numbers}
                for section in sections
            }
            for name, sections in chapters.items()
        },
        "seconds": round(time.perf_counter() - started, 1),
    }
    with replacing(args.out / "report.txt") as temporary:
        lines = (line for name, sections in chapters.items() for line in ("", name, *map(text_of, sections)))
        temporary.write_text("\n".join(lines), encoding="utf-8")
    for number, sections in enumerate(chapters.values()):
        for section in sections:
            for name, figure in section.figures.items():
                viz.save_figure(figure, args.out / f"{name}_{number}.png")
    write_json(args.out / "metrics.json", metrics)
    return metrics


def _printed(section: Section) -> Section:
    print(text_of(section))
    return section


def named_apart(recordings: list[SkinRecording]) -> list[SkinRecording]:
    """Number recordings that share a name, so that all names differ."""
    copies, seen, result = Counter(recording.name for recording in recordings), Counter[str](), []
    for recording in recordings:
        seen[recording.name] += 1
        numbered = replace(recording, name=f"{recording.name} #{seen[recording.name]}")
        result.append(numbered if copies[recording.name] > 1 else recording)
    return result


def _recordings(paths: Sequence[Path]) -> list[tuple[Path, SkinRecording]]:
    """Read each recording, paired with its path."""
    pairs: list[tuple[Path, SkinRecording]] = []
    for path in paths:
        try:
            pairs += [(path, recording) for recording in read_recordings(path)]
        except DataError as error:
            if len(paths) == 1:
                raise
            print(f"left out: {error}", file=sys.stderr)
    if not pairs:
        raise ValueError("none of the recordings can be read")
    return pairs


def sections_of(recording: SkinRecording, preset: FidelityPreset, seed: int) -> Iterator[Section]:
    """Yield the sections of the report on one recording."""
    findings: list[Finding] = []
    about = written("Overview", partial(describe.describe, recording))
    checks = written("Checks", lambda section: describe.check(recording, section, findings))
    if findings:  # they repeat the findings that `i2t.convert` put into the notes
        about.sentences = [sentence for sentence in about.sentences if not sentence.startswith("found in ")]
    yield about
    yield checks
    recording = corrected_recording(recording, findings)
    parts: dict[str, Callable[[Section], None]] = {
        "Noise and drift": partial(dynamics.noise, recording),
        "Hysteresis and creep": partial(dynamics.hysteresis, recording, preset),
        "Repeatability": partial(dynamics.repeatability, recording, preset),
        "Calibration curves": partial(curves.calibration_curves, recording, preset, seed),
        "Heads": partial(heads.head_sections, recording, preset.heads, preset.held_out_share, seed),
    }
    for title, work in parts.items():
        yield written(title, work)
