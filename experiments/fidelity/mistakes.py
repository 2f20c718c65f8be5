"""Mistakes put into parts of a recording, one at a time: which does `i2t.unknowns` find?

The parts are presses of the recording as the checks put it right, drawn at random and in the order of time; the same
parts without a mistake show whether a sound recording is accused.
"""

from typing import Any, NamedTuple

import numpy as np

from experiments.fidelity.config import FidelityPreset
from experiments.fidelity.describe import recorded_presses
from experiments.fidelity.forward import one_tip
from experiments.fidelity.sections import CannotTellError, Section
from i2t.calibration.recordings import SkinRecording
from i2t.types import Board
from i2t.unknowns import Finding, RecordedPresses, estimate_labels, estimate_unknowns, find
from i2t.unknowns.chip_field import STAGE, STAGES
from i2t.unknowns.heights import HEIGHT_ZERO
from i2t.unknowns.labels import FORCE_SIGN, HEIGHT_AXIS, LAG, UNITS

PART_PRESSES = 160
SHIFT_M, ZERO_TOLERANCE_M = 1.2e-3, 0.05e-3  # of a height zero, and how near it must be found
MAX_LAG = 3


class Answer(NamedTuple):
    """What was found of a mistake."""

    found: bool  # it is named exactly
    known: bool  # the recording can tell
    accused: bool  # the part without it


class Mistake(NamedTuple):
    """A recording with a mistake, and the finding that names it."""

    presses: RecordedPresses
    unknown: str
    correction: dict[str, Any]


def with_mistakes(one: RecordedPresses, board: Board | None, rng: np.random.Generator) -> dict[str, Mistake]:
    """The presses with one mistake at a time.

    Args:
        one: Sound presses.
        board: That read them; without one it is not turned.
        rng: Draws the lag and the stage.

    Returns:
        Mistakes by their names: those that presses of this kind can have.
    """
    rows = int(rng.integers(1, MAX_LAG + 1)) * int(rng.choice([-1, 1]))
    labels = {name: values for name, values in one._asdict().items() if values is not None and name != "readings"}
    late = one._replace(**{name: np.roll(values, rows, axis=0) for name, values in labels.items()})
    found = {
        "labels of another row": Mistake(late, LAG, {"label_lag_rows": rows}),
        "positions in millimetres": Mistake(one._replace(position=1e3 * one.position), UNITS, {"length_factor": 1e-3}),
        "readings in millitesla": Mistake(one._replace(readings=1e-3 * one.readings), UNITS, {"field_factor": 1e3}),
    }
    if one.force is not None:
        found["forces that pull"] = Mistake(one._replace(force=-one.force), FORCE_SIGN, {"force_sign": -1.0})
    if one.height is not None:
        found["heights into the skin"] = Mistake(one._replace(height=-one.height), HEIGHT_AXIS, {"height_sign": -1.0})
        higher = one._replace(height=one.height + SHIFT_M)
        found["another height zero"] = Mistake(higher, HEIGHT_ZERO, {"height_zero_m": SHIFT_M})
    if board is not None and len(board.chips) > 2:
        matrix = STAGES[list(STAGES)[int(rng.integers(1, len(STAGES)))]]
        turned = one._replace(position=one.position @ np.linalg.inv(matrix).T)
        found["a stage turned or mirrored"] = Mistake(turned, STAGE, {"board_from_stage": matrix})
    return found


def mistake_section(recording: SkinRecording, preset: FidelityPreset, seed: int, section: Section) -> None:
    """Count, for each mistake, in how many parts of the recording it is found, can be told and is seen falsely."""
    one_tip(recording)
    if not recording.known("position").any():
        raise CannotTellError("Mistakes are put into presses whose positions are known.")
    whole, board = recorded_presses(recording.rows(recording.known("position"))), recording.board
    if len(whole.position) < PART_PRESSES:
        raise CannotTellError(f"{len(whole.position)} presses are too few; {PART_PRESSES} make a part.")
    answers: dict[str, list[Answer]] = {}
    for draw in range(preset.draws):
        part = np.random.default_rng((seed, draw)).permutation(len(whole.position))[:PART_PRESSES]
        sound = whole.rows(np.sort(part))
        before = estimate_unknowns(sound, board)
        for name, mistake in with_mistakes(sound, board, np.random.default_rng((seed, draw))).items():
            of_labels = mistake.unknown in (LAG, UNITS, FORCE_SIGN, HEIGHT_AXIS)  # which are asked first
            after = estimate_labels(mistake.presses) if of_labels else estimate_unknowns(mistake.presses, board)
            answers.setdefault(name, []).append(_answer(mistake, before, after))
    rows = [["mistake", "found", "can tell", "false alarms"]]
    for name, found in answers.items():
        rows.append([name, *(f"{sum(counted)} of {len(found)}" for counted in zip(*found, strict=True))])
    section.numbers["mistakes"] = {name: [one._asdict() for one in found] for name, found in answers.items()}
    section.tables[f"parts of {PART_PRESSES} presses each"] = rows


def _answer(mistake: Mistake, before: list[Finding], after: list[Finding]) -> Answer:
    was, found = find(before, mistake.unknown), find(after, mistake.unknown)
    if was is None or found is None:
        return Answer(False, False, False)
    todo = dict(found.correction)
    if mistake.unknown == HEIGHT_ZERO and was.estimate is not None and found.estimate is not None:
        todo = {"height_zero_m": found.estimate - was.estimate}  # a number: it must move as the heights do
    named = todo.keys() == mistake.correction.keys() and all(
        np.allclose(todo[key], value, rtol=1e-6, atol=ZERO_TOLERANCE_M) for key, value in mistake.correction.items()
    )
    return Answer(bool(named and found.identifiable), found.identifiable, was.wrong)
