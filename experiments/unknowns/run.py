"""Question: which mistakes of a recording are found, which are not, and is a sound recording ever accused?

    python -m experiments.unknowns                    10 skins of each kind, about 40 minutes on one core
    python -m experiments.unknowns --cases 2          a few minutes, too few to mean much
    python -m experiments.unknowns --seed 1           other skins, to choose something on
    python -m experiments.unknowns --kinds bonded lattice --questions lag height

Skins of five kinds are simulated (`experiments.calibrate.skins`: bonded, loose, uniform, weak, lattice) and
pressed at random, 15 % of the presses above first contact. Each is damaged in one way at a time, and `i2t.unknowns` is
asked:

  lag       labels shifted by one to three rows
  height    another height zero: found within 0.05 mm (not asked of the lattices, whose readings jump at first contact)
  swap      two chips exchanged, judged within the recording alone
  stage     axes of the stage mirrored, exchanged or turned
  flip      one axis of one chip turned, judged within the recording alone
  since     two chips exchanged and one chip turned over since an earlier session of the same skin, from 20 presses

`found` is the share of damaged recordings whose mistake is named exactly, `known` the share of which the estimator says
that it can tell, `false alarms` the share of sound recordings that are accused of it. Results go to --out:
metrics.json with counts and exact 95 % intervals.
"""

import os
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

# Factors of a few hundred rows are too small to share, as in experiments.train.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from scipy.stats import beta

from experiments.calibrate.skins import PressedSkinOfKind, simulate_skins
from experiments.common.runs import begin, write_json
from experiments.unknowns.arguments import QUESTIONS, UnknownsArgs
from i2t import unknowns
from i2t.progress import progress
from i2t.skin.boards import eflesh_board, reskin_board
from i2t.types import Board
from i2t.unknowns import RecordedPresses
from i2t.unknowns.chip_field import STAGES

NOT_ASKED = (("height", "lattice"),)  # its readings jump at first contact, as no skin's do
FREE_SHARE = 0.15  # of presses above first contact
HEIGHT_TOLERANCE_M = 0.05e-3
NOISE_OF_FREE_UT = 2.0
SINCE_PRESSES = 20
GROWTH = 1.6  # power of the depth by which readings are taken to grow


class Answer(NamedTuple):
    """Findings on one damaged recording and on the sound one."""

    found: bool
    known: bool
    accused: bool  # the sound recording
    error: float = float("nan")  # of the estimate, where it is a number


def run(args: UnknownsArgs) -> dict[str, Any]:
    """The experiment: prepare, evaluate, report."""
    begin(args.out, args, args, None, args.overwrite)
    started = time.perf_counter()
    answers: dict[str, dict[str, list[Answer]]] = {question: {} for question in args.questions}
    for kind in args.kinds:
        skins = simulate_skins(kind, args.seed, args.cases, args.presses)
        for i, skin in enumerate(progress(skins, desc=kind, unit="skin")):
            recorded = as_recorded(skin, np.random.default_rng((args.seed, i)))
            for question in args.questions:
                if (question, kind) in NOT_ASKED:
                    continue
                rng = np.random.default_rng((args.seed, i, QUESTIONS.index(question)))
                answers[question].setdefault(kind, []).append(ASK[question](recorded, board_of(skin), rng))
    metrics = {
        "source": "simulated",
        "seed": args.seed,
        "presses": args.presses,
        "questions": {name: {kind: summary(found) for kind, found in by.items()} for name, by in answers.items()},
        "seconds": round(time.perf_counter() - started, 1),
    }
    write_json(args.out / "metrics.json", metrics)
    print_table(metrics)
    return metrics


def as_recorded(skin: PressedSkinOfKind, rng: np.random.Generator) -> RecordedPresses:
    """A skin's presses as a stage records them: heights count from 0 at first contact, some presses do not reach it."""
    height, readings = skin.zero - skin.depth, skin.readings.copy()
    free = rng.random(len(height)) < FREE_SHARE
    height[free] = rng.uniform(0, 0.3 * skin.depth.max(), free.sum())
    readings[free] = rng.normal(0, NOISE_OF_FREE_UT, (int(free.sum()), readings.shape[1]))
    return RecordedPresses(skin.position, readings, height=height, force=np.where(free, 0.0, skin.force))


def board_of(skin: PressedSkinOfKind) -> Board:
    """The board that a skin was simulated on."""
    return eflesh_board() if skin.kind == "lattice" else reskin_board()


def ask_lag(one: RecordedPresses, board: Board, rng: np.random.Generator) -> Answer:
    """Labels shifted by some rows."""
    rows = int(rng.integers(1, 4)) * int(rng.choice([-1, 1]))
    assert one.height is not None
    late = one._replace(position=np.roll(one.position, rows, 0), height=np.roll(one.height, rows), force=None)
    found, sound = unknowns.find_lag(late), unknowns.find_lag(one)
    return Answer(found.wrong and found.estimate == rows, found.identifiable, sound.wrong)


def ask_height(one: RecordedPresses, board: Board, rng: np.random.Generator) -> Answer:
    """Heights counted from another zero."""
    assert one.height is not None
    zero = float(rng.uniform(-0.1, 0.1))
    found = unknowns.find_height_zero(one._replace(height=one.height + zero))
    error = np.nan if found.estimate is None else found.estimate - zero
    within = found.identifiable and abs(error) <= HEIGHT_TOLERANCE_M
    return Answer(bool(within), found.identifiable, bool(found.identifiable and not within), 1e3 * float(error))


def ask_board(kind: str, one: RecordedPresses, board: Board, rng: np.random.Generator) -> Answer:
    """Chips swapped, a stage mirrored, an axis of a chip turned."""
    assert one.height is not None
    growth = np.maximum(-one.height, 0) ** GROWTH
    index, damaged, key, expected = DAMAGE[kind](one, rng)
    found = unknowns.find_board(damaged, board, growth=growth)
    sound = unknowns.find_board(one, board, growth=growth)
    named = found[index].wrong and np.allclose(found[index].correction[key], expected)
    return Answer(bool(named), found[index].identifiable, any(finding.wrong for finding in sound))


def ask_since(one: RecordedPresses, board: Board, rng: np.random.Generator) -> Answer:
    """Chips swapped and one turned over since an earlier session."""
    assert one.height is not None
    deep = np.flatnonzero(one.height < 0)
    before, after = deep[:-SINCE_PRESSES], deep[-SINCE_PRESSES:]
    session = unknowns.fit_session_map(one.position[before], -one.height[before], one.readings[before])
    chips = one.readings.shape[1] // 3
    order, signs = np.arange(chips), np.ones((chips, 3))
    pair = rng.choice(chips, 2, replace=False)
    order[pair], signs[int(rng.integers(chips))] = order[pair[::-1]], -1
    readings = one.readings[after].reshape(len(after), chips, 3)
    where = one.position[after], -one.height[after]
    damaged = (readings * signs)[:, order].reshape(len(after), -1)
    found = unknowns.lay_over(session, *where, damaged)[2][-1]
    sound = unknowns.lay_over(session, *where, one.readings[after])[2][-1]
    named = found.wrong and np.array_equal(found.correction["chip_order"], order)
    named = named and np.array_equal(np.reshape(found.correction["channel_signs"], (chips, 3)), signs)
    return Answer(bool(named), found.identifiable, sound.wrong)


def swap(one: RecordedPresses, rng: np.random.Generator) -> tuple[int, RecordedPresses, str, np.ndarray]:
    """Two chips in each other's place."""
    chips = one.readings.shape[1] // 3
    order = np.arange(chips)
    pair = rng.choice(chips, 2, replace=False)
    order[pair] = order[pair[::-1]]
    readings = one.readings.reshape(-1, chips, 3)[:, order].reshape(one.readings.shape)
    return 1, one._replace(readings=readings), "chip_order", order


def turn_stage(one: RecordedPresses, rng: np.random.Generator) -> tuple[int, RecordedPresses, str, np.ndarray]:
    """Axes of the stage that are not the board's."""
    matrix = STAGES[list(STAGES)[int(rng.integers(1, len(STAGES)))]]
    return 0, one._replace(position=one.position @ np.linalg.inv(matrix).T), "board_from_stage", matrix


def flip(one: RecordedPresses, rng: np.random.Generator) -> tuple[int, RecordedPresses, str, np.ndarray]:
    """One axis of one chip the other way."""
    signs = np.ones(one.readings.shape[1])
    signs[int(rng.integers(len(signs)))] = -1
    return 2, one._replace(readings=one.readings * signs), "channel_signs", signs


DAMAGE = {"swap": swap, "stage": turn_stage, "flip": flip}
ASK: dict[str, Callable[[RecordedPresses, Board, np.random.Generator], Answer]] = {
    "lag": ask_lag, "height": ask_height, "swap": partial(ask_board, "swap"), "stage": partial(ask_board, "stage"),
    "flip": partial(ask_board, "flip"), "since": ask_since,
}  # fmt: skip


def summary(answers: list[Answer]) -> dict[str, Any]:
    """Shares with counts and exact 95 % intervals (Clopper and Pearson)."""
    n = len(answers)
    shares: dict[str, Any] = {"cases": n}
    for name in ("found", "known", "accused"):
        count = sum(bool(getattr(answer, name)) for answer in answers)
        low = float(beta.ppf(0.025, count, n - count + 1)) if count else 0.0
        high = float(beta.ppf(0.975, count + 1, n - count)) if count < n else 1.0
        shares[name] = {"count": count, "share": count / n, "low": low, "high": high}
    errors = [answer.error for answer in answers if answer.known and np.isfinite(answer.error)]
    return shares | ({"errors_mm": errors} if errors else {})


def print_table(metrics: dict[str, Any]) -> None:
    """Found, known and falsely accused, by question and kind."""
    print(f"\n{'question':10s}{'kind':10s}{'found':>12s}{'can tell':>12s}{'false alarms':>14s}")
    for question, by_kind in metrics["questions"].items():
        for kind, one in by_kind.items():
            cells = [f"{one[name]['count']} of {one['cases']}" for name in ("found", "known", "accused")]
            print(f"{question:10s}{kind:10s}{cells[0]:>12s}{cells[1]:>12s}{cells[2]:>14s}")
