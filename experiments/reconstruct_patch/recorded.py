"""Recorded presses of one tip, real ones above all: where was the tip, and how deep, from the reading alone?

    python -m experiments.reconstruct_patch --dataset eflesh/spatial

Blocks of 6 mm of the skin are held out, in turn. The skin is calibrated (`i2t.calibrate`) on presses in the others, and
imagined with the tip at every place and depth (`i2t.reconstruction.tip`). Temperature and degrees of freedom of the
likelihood are chosen on validation blocks, with a calibration that has not seen them; so is how much a head of the skin
(`i2t.calibration.heads`), which learned positions from readings, counts too. Both are compared with nearest neighbours
on readings, whose number is chosen there too. What the tip is stays as it was in calibration: presses of one tip do not
say what another would read.
"""

from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from matplotlib.figure import Figure
from scipy.spatial import KDTree

import i2t
from experiments.common.runs import begin, write_json
from experiments.reconstruct_patch.arguments import RECORDED_PRESETS, PatchArgs, RecordedSizes
from experiments.reconstruct_patch.figures import draw_tips
from experiments.reconstruct_patch.scores import MM, numbers
from i2t import viz
from i2t.calibration import Calibration
from i2t.calibration.heads import SkinRecording, fit_head, read_recordings
from i2t.dataset import square_blocks
from i2t.progress import progress
from i2t.recognition.intervals import bootstrap_clusters, cluster_interval, rate_interval
from i2t.reconstruction.tip import TipModel, credible_level, imagine_tip, infer_tip

BLOCK_M = 6e-3
VALIDATION_SHARE = 0.2  # of the blocks that are not judged
FEWEST_BLOCKS = 8
REGION_LEVELS = (0.5, 0.7, 0.9)  # of credible regions
TEMPERATURES_TRIED, DOFS_TRIED = (0.1, 0.2, 0.4, 0.7, 1.0), (3.0, 8.0, 30.0)
NEAREST_TRIED = (1, 3, 6, 12)
HEAD_WEIGHTS_TRIED = (0.1, 0.25, 0.5)
MIDDLE, NEIGHBOURS, HEAD = "middle of the skin", "nearest neighbours", "head"
TIP, POOLED = "by imagination", "by imagination, with the head"
SHOWN_TIPS = 6


class LabelledPresses(NamedTuple):
    """Presses of one tip on one skin."""

    position: Float[np.ndarray, "n 2"]  # m
    load: Float[np.ndarray, " n"]  # m or N
    reading: Float[np.ndarray, "n c"]  # uT
    row: Int[np.ndarray, " n"]  # in the recording

    def rows(self, chosen: Int[np.ndarray, " k"] | Bool[np.ndarray, " n"]) -> "LabelledPresses":
        """Some of the presses."""
        return LabelledPresses(*(part[chosen] for part in self))


class TipsFound(NamedTuple):
    """Estimates of presses."""

    position: Float[np.ndarray, "n 2"]  # m
    load: Float[np.ndarray, " n"] | None = None  # m or N
    credible: Float[np.ndarray, " n"] | None = None  # share of the posterior at more probable places
    bits: Float[np.ndarray, " n"] | None = None
    weight: Float[np.ndarray, "n p"] | None = None  # of the places
    std: Float[np.ndarray, "n 2"] | None = None  # m, of the position


def run(args: PatchArgs) -> dict[str, Any]:
    """Tell where recorded presses were; print a table, write metrics.json, config.json and a figure."""
    assert args.dataset is not None
    sizes = RECORDED_PRESETS[args.preset]
    recording, presses, kind = read(args.dataset)
    blocks = blocks_of(presses.position)
    begin(args.out, args, sizes, None, args.overwrite)
    answers = [answer(recording, presses, kind, rows) for rows in progress(folds(blocks, sizes, args.seed))]
    asked = presses.rows(np.concatenate([each.test for each in answers]))
    groups = [blocks[np.concatenate([each.test for each in answers])]]
    found = {name: _joined([each.found[name] for each in answers]) for name in answers[0].found}
    report: dict[str, Any] = {
        "source": recording.source, "recording": recording.name, "notes": list(recording.notes), "load_kind": kind,
        "presses": {"learnt": answers[0].learnt, "test": len(asked.load)},
        "blocks": len(np.unique(groups[0])), "folds": len(answers), "seed": args.seed,
        "chosen": [each.chosen.as_json() for each in answers],
        "methods": {name: judge(each, asked, kind, groups) for name, each in found.items()},
    }  # fmt: skip
    write_json(args.out / "metrics.json", report)
    viz.save_figure(_drawn(report, answers[0], presses), args.out / "tips.png")
    print(table(report))
    return report


class FoldRows(NamedTuple):
    """Rows to learn from, to choose by and to judge by, in blocks that they do not share."""

    train: Int[np.ndarray, " a"]
    validation: Int[np.ndarray, " b"]
    test: Int[np.ndarray, " c"]


class FoldAnswer(NamedTuple):
    """Estimates of the presses of one part of the blocks."""

    test: Int[np.ndarray, " c"]
    learnt: int  # presses
    chosen: "Chosen"
    found: dict[str, TipsFound]
    places: Float[np.ndarray, "p 2"]  # m, of the candidates


def answer(recording: SkinRecording, presses: LabelledPresses, kind: str, rows: FoldRows) -> FoldAnswer:
    """Every method on the presses of one part of the blocks."""
    chosen = choose(recording, presses, kind, rows)
    given = presses.rows(np.concatenate([rows.train, rows.validation]))
    asked = presses.rows(rows.test)
    model, head = imagined(given, kind), by_head(recording, given, asked, kind)
    alone, pooled = (with_likelihood(model, each) for each in (chosen.alone, chosen.pooled))
    found = {
        MIDDLE: TipsFound(
            np.tile(given.position.mean(0), (len(asked.load), 1)), np.full(len(asked.load), given.load.mean())
        ),
        NEIGHBOURS: neighbours(given, asked.reading, chosen.neighbours),
        HEAD: head,
        TIP: by_imagination(alone, asked),
        POOLED: by_imagination(pooled, asked, head, chosen.pooled.head),
    }
    return FoldAnswer(rows.test, len(given.load), chosen, found, np.asarray(model.places))


def _joined(parts: list[TipsFound]) -> TipsFound:
    """Estimates of the presses of all parts; the weights of places, which differ, are left out."""

    def together(name: str) -> np.ndarray | None:
        column = [getattr(part, name) for part in parts]
        return None if column[0] is None else np.concatenate(column)

    position = np.concatenate([part.position for part in parts])
    return TipsFound(position, together("load"), together("credible"), together("bits"), None, together("std"))


def read(path: Path) -> tuple[SkinRecording, LabelledPresses, str]:
    """The first recording of a path with presses at several places, and its presses with depth or else force."""
    for recording in read_recordings(path):
        if not recording.varies("position"):
            continue
        kind = next((name for name in ("depth", "force") if recording.varies(name)), None)
        if kind is None:
            raise ValueError(
                f"{recording.name}: neither depth nor force of its presses is known and differs; a tip needs one"
            )
        known = recording.known("position") & recording.known(kind)
        load = np.where(known, recording.targets[kind][:, 0], -1.0)
        rows = np.flatnonzero(known & (load >= 0))
        return (
            recording,
            LabelledPresses(recording.targets["position"][rows], load[rows], recording.readings[rows], rows),
            kind,
        )
    raise ValueError(f"{path}: no recording in it has presses at several known places, so none says where its tip was")


def blocks_of(position: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
    """Number of the block of each press; ValueError where there are too few to hold some out."""
    blocks = square_blocks(position, BLOCK_M)
    if blocks.max() + 1 < FEWEST_BLOCKS:
        raise ValueError(
            f"the presses lie in {blocks.max() + 1} blocks of {MM * BLOCK_M:g} mm, and at least {FEWEST_BLOCKS} are "
            "needed to hold some out"
        )
    return blocks


def folds(blocks: Int[np.ndarray, " n"], sizes: RecordedSizes, seed: int) -> list[FoldRows]:
    """Every block is judged once, by what was learned in the blocks of the other parts."""
    rng = np.random.default_rng(seed)
    parts = np.array_split(rng.permutation(int(blocks.max()) + 1), sizes.folds)
    return [_fold(blocks, parts, i, sizes, rng) for i in range(len(parts))]


def _fold(
    blocks: np.ndarray, parts: list[np.ndarray], i: int, sizes: RecordedSizes, rng: np.random.Generator
) -> FoldRows:
    other = rng.permutation(np.concatenate(parts[:i] + parts[i + 1 :]))
    count = max(round(VALIDATION_SHARE * len(other)), 1)
    train, validation, test = (
        rng.permutation(np.flatnonzero(np.isin(blocks, some))) for some in (other[count:], other[:count], parts[i])
    )
    most = round(sizes.learnt * len(validation) / (len(validation) + len(train)))
    return FoldRows(train[: sizes.learnt - most], validation[:most], test[: sizes.test // sizes.folds])


class TipConstants(NamedTuple):
    """Constants of the likelihood of readings."""

    temperature: float
    dof: float
    head: float = 0.0  # weight of what the head says


class Chosen(NamedTuple):
    """Constants that validation blocks chose."""

    alone: TipConstants
    pooled: TipConstants
    neighbours: int

    def as_json(self) -> dict[str, Any]:
        """Constants by the names of the methods."""
        return {TIP: self.alone._asdict(), POOLED: self.pooled._asdict(), NEIGHBOURS: self.neighbours}


def choose(recording: SkinRecording, presses: LabelledPresses, kind: str, rows: FoldRows) -> Chosen:
    """Choose by the weight of true places for the posteriors, by squared error for the neighbours."""
    given, asked = presses.rows(rows.train), presses.rows(rows.validation)
    model, head = imagined(given, kind), by_head(recording, given, asked, kind)
    near = KDTree(np.asarray(model.places)).query(asked.position)[1]

    def worth(constants: TipConstants) -> float:
        weight = by_imagination(with_likelihood(model, constants), asked, head, constants.head).weight
        assert weight is not None
        return float(np.mean(np.log(weight[np.arange(len(near)), near])))

    errors = [
        np.mean(np.sum((neighbours(given, asked.reading, k).position - asked.position) ** 2, axis=1))
        for k in NEAREST_TRIED
    ]
    return Chosen(
        max((TipConstants(t, dof) for t in TEMPERATURES_TRIED for dof in DOFS_TRIED), key=worth),
        max(
            (TipConstants(t, dof, w) for t in TEMPERATURES_TRIED for dof in DOFS_TRIED for w in HEAD_WEIGHTS_TRIED),
            key=worth,
        ),
        NEAREST_TRIED[int(np.argmin(errors))],
    )


def imagined(given: LabelledPresses, kind: str) -> TipModel:
    """Model of the skin's readings of its tip, from presses."""
    calibration: Calibration = i2t.calibrate(given.position, given.load, given.reading, load_kind=kind)  # type: ignore[arg-type]
    return imagine_tip(calibration, given.position, given.load)


def with_likelihood(model: TipModel, constants: TipConstants) -> TipModel:
    """The same skin with another likelihood."""
    return model._replace(likelihood=model.likelihood._replace(temperature=constants.temperature, dof=constants.dof))


def by_imagination(
    model: TipModel, asked: LabelledPresses, head: TipsFound | None = None, head_weight: float = 0.0
) -> TipsFound:
    """The posterior of each reading; the true position is only asked how much of the posterior is more probable."""
    n = len(asked.load)
    said = (np.zeros((n, 2)), np.ones((n, 2))) if head is None else (head.position, head.std)
    presses = (jnp.float32(part) for part in (asked.reading, asked.position, *said))
    position, load, credible, bits, weight = jax.device_get(_infer(model, jnp.float32(head_weight), *presses))
    return TipsFound(position, load, credible, bits, weight)


@jax.jit
def _infer(
    model: TipModel, head_weight: jax.Array, readings: jax.Array, positions: jax.Array, loads: jax.Array, std: jax.Array
) -> tuple[jax.Array, ...]:
    def one(press: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        reading, position, *head = press
        found = infer_tip(reading, model, head=(head[0], head[1]), head_weight=head_weight)
        credible = credible_level(found, model, position)
        return found.position, found.load, credible, found.bits, jnp.sum(found.weight, axis=1)

    return jax.lax.map(one, (readings, positions, loads, std))


def neighbours(given: LabelledPresses, readings: Float[np.ndarray, "n c"], k: int) -> TipsFound:
    """The mean of the presses with the k nearest readings."""
    near = KDTree(given.reading).query(readings, k=min(k, len(given.load)))[1].reshape(len(readings), -1)
    return TipsFound(given.position[near].mean(1), given.load[near].mean(1))


def by_head(recording: SkinRecording, given: LabelledPresses, asked: LabelledPresses, kind: str) -> TipsFound:
    """Estimates of the skin's heads."""
    known = recording.rows(given.row)
    position, load = (fit_head(known, target).predict(asked.reading) for target in ("position", kind))
    return TipsFound(position.mean, load.mean[:, 0], std=position.std)


def judge(found: TipsFound, asked: LabelledPresses, kind: str, groups: list[np.ndarray]) -> dict[str, Any]:
    """Errors, and how honest the posterior's regions are, with intervals over blocks."""
    error = MM * np.linalg.norm(found.position - asked.position, axis=1)
    ordered = np.argsort(error)

    def quantile(level: float, weight: np.ndarray) -> float:
        share = np.cumsum(weight[ordered]) / weight.sum()
        return float(error[ordered][min(np.searchsorted(share, level), len(error) - 1)])

    said: dict[str, Any] = {
        f"position_mm_{name}": numbers(bootstrap_clusters(partial(quantile, level), groups, len(error)))
        for name, level in (("median", 0.5), ("90", 0.9))
    }
    said["within_1mm"] = numbers(rate_interval(error <= 1, groups))
    said["position_mm_rmse_per_axis"] = round(float(np.sqrt(np.mean(error**2) / 2)), 4)
    if found.load is not None:
        scale = MM if kind == "depth" else 1.0
        off = scale * np.abs(found.load - asked.load)
        said[f"{kind}_error"] = numbers(cluster_interval(off, groups))
    if found.credible is not None:
        said |= {f"coverage_{round(100 * level)}": numbers(rate_interval(found.credible <= level, groups))
                 for level in REGION_LEVELS}  # fmt: skip
    if found.bits is not None:
        said["bits"] = numbers(cluster_interval(found.bits, groups))
    return said


def table(report: dict[str, Any]) -> str:
    """The main numbers as text."""
    unit = "mm" if report["load_kind"] == "depth" else "N"
    columns: dict[str, str] = {
        "position_mm_median": "median mm", "position_mm_90": "90 % mm", "within_1mm": "within 1 mm",
        f"{report['load_kind']}_error": f"{report['load_kind']} {unit}", "coverage_90": "cover 90 %", "bits": "bits",
    }  # fmt: skip
    counts = report["presses"]
    lines = [
        f"{report['recording']} ({report['source']}): {counts['test']} presses in {report['blocks']} blocks, "
        f"{counts['learnt']} of other blocks learnt from",
        f"{'':30}" + "".join(f"{title:>13}" for title in columns.values()),
    ]
    for name, found in report["methods"].items():
        cells = [f"{found[column][0]:13.2f}" if column in found else f"{'-':>13}" for column in columns]
        lines.append(f"{name:30}" + "".join(cells))
    return "\n".join(lines)


def _drawn(report: dict[str, Any], part: FoldAnswer, presses: LabelledPresses) -> Figure:
    some = np.linspace(0, len(part.test) - 1, min(SHOWN_TIPS, len(part.test))).astype(int)
    weight = part.found[POOLED].weight
    assert weight is not None
    return draw_tips(part.places, weight[some], presses.position[part.test[some]], report)
