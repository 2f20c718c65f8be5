"""Question: where was the tip of a recorded press, and how deep, by its reading alone?

    python -m experiments.reconstruct tip --dataset eflesh/spatial

Blocks of 6 mm of the skin are held out, in turn. The skin is calibrated (`i2t.calibrate`) on presses in the others, and
imagined with the tip at every place and depth (`i2t.reconstruction.tip`); what a head of the skin
(`i2t.calibration.heads`), which learned positions from readings, says is pooled with that. Temperature, degrees of
freedom and the head's weight are chosen on validation blocks, with a calibration and a head that have not seen them.
Baselines are the head alone, nearest neighbours on readings, whose number is chosen there too, and the middle of the
skin. What the tip is stays as it was in calibration: presses of one tip do not say what another would read.

Ten minutes on two cores for 1200 presses; real recordings come to real results.
"""

from functools import partial
from itertools import product
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
from experiments.reconstruct.arguments import TIP_PRESETS, TipArgs, TipSizes
from experiments.reconstruct.patch_scores import MM, numbers, score_table, weighted_quantile
from i2t import viz
from i2t.calibration.heads import fit_head
from i2t.calibration.recordings import SkinRecording, read_recordings
from i2t.dataset import square_blocks
from i2t.progress import progress
from i2t.recognition.intervals import bootstrap_clusters, cluster_interval, rate_interval
from i2t.reconstruction.tip import TipModel, credible_level, imagine_tip, infer_tip
from i2t.viz import style

BLOCK_M = 6e-3
VALIDATION_SHARE = 0.2  # of the blocks that are not judged
FEWEST_BLOCKS = 8
REGION_LEVELS = (0.5, 0.7, 0.9)  # of credible regions
TEMPERATURES_TRIED, DOFS_TRIED, HEAD_WEIGHTS_TRIED = (0.1, 0.2, 0.4, 0.7, 1.0), (3.0, 8.0, 30.0), (0.1, 0.25, 0.5)
NEAREST_TRIED = (1, 3, 6, 12)
MIDDLE, NEIGHBOURS, HEAD = "middle of the skin", "nearest neighbours", "head"
POOLED = "by imagination, with the head"
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
    load: Float[np.ndarray, " n"]  # m or N
    std: Float[np.ndarray, "n 2"] | None = None  # m, of the position
    credible: Float[np.ndarray, " n"] | None = None  # share of the posterior at more probable places
    bits: Float[np.ndarray, " n"] | None = None


class FoldRows(NamedTuple):
    """Rows to learn from, to choose by and to judge by, in blocks that they do not share."""

    train: Int[np.ndarray, " a"]
    validation: Int[np.ndarray, " b"]
    test: Int[np.ndarray, " c"]


class TipConstants(NamedTuple):
    """What validation blocks choose."""

    temperature: float  # of the likelihood of readings
    dof: float
    head: float  # weight of what the head says
    neighbours: int = 0


class FoldAnswer(NamedTuple):
    """Estimates of the presses of one part of the blocks."""

    test: Int[np.ndarray, " c"]
    learnt: int  # presses
    chosen: TipConstants
    found: dict[str, TipsFound]
    places: Float[np.ndarray, "p 2"]  # m, of the candidates
    weight: Float[np.ndarray, "c p"]  # of the places


def run(args: TipArgs) -> dict[str, Any]:
    """Tell where recorded presses were; print a table, write metrics.json, config.json and a figure."""
    sizes = TIP_PRESETS[args.preset]
    recording, presses, kind = read(args.dataset)
    blocks = blocks_of(presses.position)
    begin(args.out, args, sizes, None, args.overwrite)
    answers = [answer(recording, presses, kind, rows) for rows in progress(folds(blocks, sizes, args.seed))]
    tested = np.concatenate([each.test for each in answers])
    asked, groups = presses.rows(tested), [blocks[tested]]
    found = {name: _joined([each.found[name] for each in answers]) for name in answers[0].found}
    report: dict[str, Any] = {
        "source": recording.source,
        "recording": recording.name,
        "notes": list(recording.notes),
        "load_kind": kind,
        "presses": {"learnt": answers[0].learnt, "test": len(tested)},
        "blocks": len(np.unique(groups[0])),
        "folds": len(answers),
        "seed": args.seed,
        "chosen": [each.chosen._asdict() for each in answers],
        "methods": {name: judge(each, asked, kind, groups) for name, each in found.items()},
    }
    write_json(args.out / "metrics.json", report)
    viz.save_figure(draw_tips(answers[0], presses.position, recording.source), args.out / "tips.png")
    columns = {
        "position_mm_median": "median mm", "position_mm_90": "90 % mm", "within_1mm": "within 1 mm",
        f"{kind}_error": f"{kind} {'mm' if kind == 'depth' else 'N'}", "coverage_90": "cover 90 %", "bits": "bits",
    }  # fmt: skip
    print(score_table(f"{recording.name} ({recording.source})", columns, report["methods"]))
    return report


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
        position, reading = recording.targets["position"][rows], recording.readings[rows]
        return recording, LabelledPresses(position, load[rows], reading, rows), kind
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


def folds(blocks: Int[np.ndarray, " n"], sizes: TipSizes, seed: int) -> list[FoldRows]:
    """Every block is judged once, by what was learned in the blocks of the other parts."""
    rng = np.random.default_rng(seed)
    parts = np.array_split(rng.permutation(int(blocks.max()) + 1), sizes.folds)
    made = []
    for i, part in enumerate(parts):
        other = rng.permutation(np.concatenate(parts[:i] + parts[i + 1 :]))
        count = max(round(VALIDATION_SHARE * len(other)), 1)
        train, validation, test = (
            rng.permutation(np.flatnonzero(np.isin(blocks, some))) for some in (other[count:], other[:count], part)
        )
        most = round(sizes.learnt * len(validation) / (len(validation) + len(train)))
        made.append(FoldRows(train[: sizes.learnt - most], validation[:most], test[: sizes.test // sizes.folds]))
    return made


def answer(recording: SkinRecording, presses: LabelledPresses, kind: str, rows: FoldRows) -> FoldAnswer:
    """Every method on the presses of one part of the blocks."""
    chosen = choose(recording, presses, kind, rows)
    given, asked = presses.rows(np.concatenate([rows.train, rows.validation])), presses.rows(rows.test)
    model, head = imagined(given, kind), by_head(recording, given, asked, kind)
    pooled, weight = by_imagination(model, asked, head, chosen)
    count = len(asked.load)
    found = {
        MIDDLE: TipsFound(np.tile(given.position.mean(0), (count, 1)), np.full(count, given.load.mean())),
        NEIGHBOURS: neighbours(given, asked.reading, chosen.neighbours),
        HEAD: head,
        POOLED: pooled,
    }
    return FoldAnswer(rows.test, len(given.load), chosen, found, np.asarray(model.places), weight)


def choose(recording: SkinRecording, presses: LabelledPresses, kind: str, rows: FoldRows) -> TipConstants:
    """Choose by the weight of true places for the posterior, by squared error for the neighbours."""
    given, asked = presses.rows(rows.train), presses.rows(rows.validation)
    model, head = imagined(given, kind), by_head(recording, given, asked, kind)
    near = KDTree(np.asarray(model.places)).query(asked.position)[1]

    def worth(constants: TipConstants) -> float:
        weight = by_imagination(model, asked, head, constants)[1]
        return float(np.mean(np.log(weight[np.arange(len(near)), near])))

    def missed(count: int) -> float:
        off = neighbours(given, asked.reading, count).position - asked.position
        return float(np.mean(np.sum(off**2, axis=1)))

    tried = (TipConstants(*each) for each in product(TEMPERATURES_TRIED, DOFS_TRIED, HEAD_WEIGHTS_TRIED))
    return max(tried, key=worth)._replace(neighbours=min(NEAREST_TRIED, key=missed))


def imagined(given: LabelledPresses, kind: str) -> TipModel:
    """Model of the skin's readings of its tip, from presses."""
    calibration = i2t.calibrate(given.position, given.load, given.reading, load_kind=kind)  # type: ignore[arg-type]
    return imagine_tip(calibration, given.position, given.load)


def by_imagination(
    model: TipModel, asked: LabelledPresses, head: TipsFound, constants: TipConstants
) -> tuple[TipsFound, Float[np.ndarray, "n p"]]:
    """The posterior of each reading, pooled with what the head says, and its weights of the places; the true position
    is only asked how much of the posterior is more probable.
    """
    likelihood = model.likelihood._replace(temperature=constants.temperature, dof=constants.dof)
    presses = (jnp.float32(part) for part in (asked.reading, asked.position, head.position, head.std))
    found = jax.device_get(_infer(model._replace(likelihood=likelihood), jnp.float32(constants.head), *presses))
    position, load, credible, bits, weight = found
    return TipsFound(position, load, None, credible, bits), weight


@jax.jit
def _infer(
    model: TipModel, head_weight: jax.Array, readings: jax.Array, positions: jax.Array, *head: jax.Array
) -> tuple[jax.Array, ...]:
    def one(press: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
        reading, position, mean, std = press
        found = infer_tip(reading, model, head=(mean, std), head_weight=head_weight)
        credible = credible_level(found, model, position)
        return found.position, found.load, credible, found.bits, jnp.sum(found.weight, axis=1)

    return jax.lax.map(one, (readings, positions, *head))


def neighbours(given: LabelledPresses, readings: Float[np.ndarray, "n c"], count: int) -> TipsFound:
    """The mean of the presses with the nearest readings."""
    near = KDTree(given.reading).query(readings, k=min(count, len(given.load)))[1].reshape(len(readings), -1)
    return TipsFound(given.position[near].mean(1), given.load[near].mean(1))


def by_head(recording: SkinRecording, given: LabelledPresses, asked: LabelledPresses, kind: str) -> TipsFound:
    """Estimates of the skin's heads."""
    known = recording.rows(given.row)
    position, load = (fit_head(known, target).predict(asked.reading) for target in ("position", kind))
    return TipsFound(position.mean, load.mean[:, 0], position.std)


def _joined(parts: list[TipsFound]) -> TipsFound:
    """Estimates of the presses of all parts."""
    columns: list[Any] = [None if column[0] is None else np.concatenate(column) for column in zip(*parts, strict=True)]
    return TipsFound(*columns)


def judge(found: TipsFound, asked: LabelledPresses, kind: str, groups: list[np.ndarray]) -> dict[str, Any]:
    """Errors, and how honest the posterior's regions are, with intervals over blocks."""
    error = MM * np.linalg.norm(found.position - asked.position, axis=1)
    off = (MM if kind == "depth" else 1.0) * np.abs(found.load - asked.load)
    said: dict[str, Any] = {
        f"position_mm_{name}": numbers(bootstrap_clusters(partial(weighted_quantile, error, level), groups, len(error)))
        for name, level in (("median", 0.5), ("90", 0.9))
    }
    said["within_1mm"] = numbers(rate_interval(error <= 1, groups))
    said["position_mm_rmse_per_axis"] = round(float(np.sqrt(np.mean(error**2) / 2)), 4)
    said[f"{kind}_error"] = numbers(cluster_interval(off, groups))
    if found.credible is not None and found.bits is not None:
        for level in REGION_LEVELS:
            said[f"coverage_{100 * level:.0f}"] = numbers(rate_interval(found.credible <= level, groups))
        said["bits"] = numbers(cluster_interval(found.bits, groups))
    return said


def draw_tips(part: FoldAnswer, positions: Float[np.ndarray, "n 2"], source: str) -> Figure:
    """Likely places of the tip at a few presses, by their readings, and the true one."""
    some = np.linspace(0, len(part.test) - 1, min(SHOWN_TIPS, len(part.test))).astype(int)
    columns = -(-len(some) // 2)
    figure = Figure(figsize=(2.4 * columns + 1, 5.2), layout="constrained")
    x, y = (MM * np.unique(part.places[:, i]) for i in range(2))
    weights, true = part.weight[some], positions[part.test[some]]
    for axes, weight, at in zip(figure.subplots(2, columns).ravel(), weights, true, strict=False):
        most = np.sqrt(weight.reshape(len(x), len(y)).T / weight.max())  # roots: what is less probable shows too
        image = axes.pcolormesh(x, y, most, cmap="Blues", vmin=0, vmax=1, shading="nearest", rasterized=True)
        axes.plot(*(MM * at), "+", color=style.RED, ms=9, mew=1.5)
        axes.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
        axes.label_outer()
        axes.tick_params(labelsize=7)
    figure.colorbar(image, ax=figure.axes, label="root of the share of\nthe most probable place", shrink=0.7)
    figure.suptitle(f"Where the tip was, by one reading ({source}); cross: where it was", fontsize=11)
    return figure
