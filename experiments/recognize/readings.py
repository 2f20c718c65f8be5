"""Question: does it help to touch again, and does one know when one is sure, with a real sensor's readings?

    python -m experiments.recognize recorded --readings palm_45.csv.gz palm_down.csv.gz --label object --ignore slipped
    python -m experiments.recognize recorded --readings touches.csv --label material --group day

The second half of recognition alone: no geometry and no prediction of touches, but p(label | reading) taught by
examples. Within each group the first rows of each label teach, the later ones are recognised in episodes of up to ten,
drawn without replacement; no row of the test is used for a choice. Next to this stands the same with rows that are
split at random, which puts the errors that a session's touches share on both sides. Methods and calibration are in
`experiments.recognize.reading_methods`. At last some labels are held out altogether, as unknown ones. It takes a few
minutes. Results go to --out: metrics.json (95 % intervals over labels), config.json and a figure.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from experiments.common.reading_tables import (
    AT_RANDOM,
    IN_ORDER,
    SPLITS,
    ReadingTable,
    close_followers,
    count_for_training,
    read_reading_table,
    refuse_counters,
    require_rows,
    rows_of_labels,
    training_rows,
)
from experiments.common.runs import METRICS, Part, begin, write_json
from experiments.common.tables import cell, text_table
from experiments.common.tasks import make_parts
from experiments.recognize import figures
from experiments.recognize.arguments import RecordedArgs
from experiments.recognize.reading_methods import (
    FIXED,
    KNN,
    ClassifierChoice,
    Fold,
    Labelled,
    all_log_probabilities,
    choose,
    draw_series,
    judge_folds,
    novelty,
    product,
)
from experiments.recognize.report import REQUESTED_ERRORS
from i2t import viz
from i2t.paper import loop
from i2t.recognition import metrics
from i2t.recognition.calibrated import calibrated_beliefs
from i2t.recognition.metrics import to_json

LEAST_ROWS = 5  # of a label in a group: three that teach, two to recognise
SHOWN_TOUCHES = (1, 3, 5, 10)
VOTES, AVERAGE, PRODUCT, BELIEF = "votes", "average", "product", "calibrated belief"
NEIGHBOURS, NOVELTY = "nearest neighbours", "distance from what was taught"


class Group(NamedTuple):
    """Rows of one group, with labels counted within it."""

    train: Labelled
    test: Labelled
    labels: np.ndarray  # index in the table of each of its labels


class RecognizedEpisodes(NamedTuple):
    """Episodes of all groups."""

    truth: np.ndarray  # (e,) label of the table
    group: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, labels of the table) by method


def run(args: RecordedArgs) -> dict[str, Any]:
    """Recognise in file order and at random, and unknown labels."""
    table = read_table(args)
    refuse_counters(table, args.readings[0])
    require_rows(table, LEAST_ROWS, args.readings[0])
    alike = close_followers(table)
    begin(args, FIXED)
    print(
        f"{len(table.label)} readings of {len(table.columns)} values, {len(table.labels)} labels in "
        f"{len(table.groups)} groups; the first {args.train_share:.0%} of each label's rows teach"
    )
    for sentence in [*table.notes, *describe_touches(table, args.touch, alike)]:
        print(sentence)
    groups = len(table.groups)
    makers = {
        args.out / f"{split.replace(' ', '_')}-{i}.npz": partial(make_part, args, split, i)
        for split in SPLITS
        for i in range(groups)
    }
    made = make_parts(makers, args.workers, bar="groups")
    summary: dict[str, Any] = {
        "source": "recorded", "readings": [path.name for path in args.readings], "labels": table.labels,
        "groups": table.groups, "rows": len(table.label), "columns": len(table.columns), "intervals": "over labels",
        "seed": args.seed, "samples": table.samples or None, "close_to_the_row_before": alike,
        "touches_asked": args.max_touches, "splits": {},
    }  # fmt: skip
    for split, parts in zip(SPLITS, (made[:groups], made[groups:]), strict=True):
        choice = choose([Fold(**fold) for part in parts for fold in part["folds"].values()])
        found = recognise(parts, choice, len(table.labels))
        summary["splits"][split] = score(found, choice, table)
        played = summary["splits"][split]["touches"]
        if split == IN_ORDER:
            figure = figures.accuracy(accuracies(found), f"Real readings, split {split}", simulated=False)
            viz.save_figure(figure, args.out / "accuracy.png")
            summary["unknown"] = score_unknown(parts, choice)
    write_json(args.out / METRICS, summary)
    print_tables(summary)
    if shortfall := describe_shortfall(table, args.max_touches, played, args.train_share):
        print(shortfall)
    return summary


def read_table(args: RecordedArgs) -> ReadingTable:
    """The readings that the options name."""
    return read_reading_table(
        args.readings, label=args.label, group=args.group, ignore=args.ignore, touch=args.touch
    )  # fmt: skip


def describe_touches(table: ReadingTable, column: str | None, alike: float) -> list[str]:
    """Sentences on what a touch is: how many samples were merged, and whether rows may be samples of one touch.

    Args:
        table: As it was read.
        column: That numbers the touches; None where each row is one.
        alike: Share of rows close to the row before, as `close_followers` gives it.

    Returns:
        One sentence for each.
    """
    sentences = []
    if table.samples:
        sentences.append(
            f"{table.samples} rows are samples of {len(table.label)} touches, as column {column} says; each touch is "
            "the mean of its samples"
        )
    if alike:
        sentences.append(
            f"warning: {alike:.0%} of the readings are far closer to the one before than readings of a label are "
            "otherwise, as samples of one touch are, which are no independent touches; name the column that numbers "
            "touches (--touch COLUMN), or keep one row of each, unless every row is a touch of its own"
        )
    return sentences


def describe_shortfall(table: ReadingTable, asked: int, played: int, train_share: float) -> str:
    """Sentence where episodes have fewer touches than asked; "" otherwise."""
    if played >= asked:
        return ""
    rows = min(rows_of_labels(table), key=lambda rows: len(rows) - count_for_training(len(rows), train_share))
    label, group = table.labels[table.label[rows[0]]], table.groups[table.group[rows[0]]]
    return (
        f"warning: episodes have {played} touches, and {asked} were asked for (--max-touches): label {label} in group "
        f"{group} has {len(rows)} touches, of which {count_for_training(len(rows), train_share)} teach"
    )


def group_of(table: ReadingTable, split: str, i: int, args: RecordedArgs) -> Group:
    """One group with its own labels; rows in file order, or shuffled where the split is at random."""
    rows = np.flatnonzero(table.group == i)
    train = training_rows(table, args.train_share, args.seed)[split]
    if split == AT_RANDOM:
        rows = np.random.default_rng(args.seed).permutation(rows)
    labels, own = np.unique(table.label[rows], return_inverse=True)
    data = Labelled(table.reading[rows], own)
    first, later = (data.at(np.flatnonzero(side)) for side in (train[rows], ~train[rows]))
    return Group(first, later, labels)


# --- episodes ---


def make_part(args: RecordedArgs, split: str, i: int) -> Part:
    """Log probabilities, by every classifier, of the touches of one group's episodes: of the folds, of the test, and of
    the test where some labels were not taught.
    """
    table = read_table(args)
    group = group_of(table, split, i, args)
    series = draw_series(group.test.label, args.episodes, args.max_touches, args.seed)

    def judged(train: Labelled) -> Part:
        found = all_log_probabilities(train, group.test.reading, args.seed)
        return {name: values[series.rows] for name, values in found.items()}

    folds = judge_folds(group.train, args.train_share, args.episodes, args.max_touches, args.seed)
    part: Part = {
        "labels": group.labels, "truth": series.truth, "log_p": judged(group.train),
        "folds": {str(k): fold._asdict() for k, fold in enumerate(folds)}, "unknown": {},
    }  # fmt: skip
    for k, draw in enumerate(unknown_draws(table, args) if split == IN_ORDER else []):
        out = np.flatnonzero(np.isin(group.labels, draw))
        if len(out) and len(group.labels) - len(out) > 1:
            train = group.train.without(out)
            far = novelty(train, group.test.reading)[series.rows]
            part["unknown"][str(k)] = {"out": out, "far": far, "log_p": judged(train)}
    return part


def unknown_draws(table: ReadingTable, args: RecordedArgs) -> list[np.ndarray]:
    """Labels that are held out as unknown ones, at most a third of all at a time."""
    count = min(args.unknown, len(table.labels) // 3)
    rng = np.random.default_rng(args.seed)
    return [rng.choice(len(table.labels), count, replace=False) for _ in range(args.draws)] if count else []


def recognise(parts: Sequence[Part], choice: ClassifierChoice, labels: int) -> RecognizedEpisodes:
    """Beliefs of every method about the episodes of every group, of as many touches as all have."""
    count = min(part["log_p"][KNN].shape[1] for part in parts)
    each = []
    for i, part in enumerate(parts):
        log_p, knn = (part["log_p"][name][:, :count] for name in (choice.classifier, KNN))
        beliefs = {
            NEIGHBOURS: loop.beliefs(-knn, "average"),
            **{rule: loop.beliefs(-log_p, rule) for rule in (VOTES, AVERAGE)},
            PRODUCT: product(log_p),
            BELIEF: calibrated_beliefs(product(log_p), choice.temperature),
        }
        wide = {}
        for name, p in beliefs.items():
            wide[name] = np.zeros((*p.shape[:2], labels))
            wide[name][..., part["labels"]] = p
        each.append(RecognizedEpisodes(part["labels"][part["truth"]], np.full(len(part["truth"]), i), wide))
    return RecognizedEpisodes(
        np.concatenate([part.truth for part in each]),
        np.concatenate([part.group for part in each]),
        {name: np.concatenate([part.beliefs[name] for part in each]) for name in each[0].beliefs},
    )


# --- scores ---


def accuracies(found: RecognizedEpisodes) -> dict[str, metrics.Estimate]:
    """Accuracy of each method after each touch, with intervals over labels."""
    return {name: metrics.accuracy(p, found.truth, clusters=[found.truth]) for name, p in found.beliefs.items()}


def score(found: RecognizedEpisodes, choice: ClassifierChoice, table: ReadingTable) -> dict[str, Any]:
    """Scores of every method over all groups, and accuracies in each group."""
    session = found.group * len(table.labels) + found.truth
    methods = {}
    for name, p in found.beliefs.items():
        hit = metrics.hits(p, found.truth)
        shape = hit.shape
        error = metrics.calibration_error(
            metrics.confidence(p), hit, cluster=np.broadcast_to(session[:, None], shape)
        )  # of all touches of a session at once
        stops = [metrics.stopping(p, found.truth, e, clusters=[found.truth]) for e in REQUESTED_ERRORS]
        methods[name] = {
            "accuracy": to_json(metrics.accuracy(p, found.truth, clusters=[found.truth])),
            "log_loss": to_json(metrics.mean_interval(metrics.log_loss(p, found.truth), [found.truth])),
            "calibration_error": to_json(error),
            "stopping": [to_json(stop) for stop in stops],
            "by_group": {
                group: to_json(metrics.accuracy(p[rows], found.truth[rows], clusters=[found.truth[rows]]))
                for i, group in enumerate(table.groups)
                for rows in [found.group == i]
            },
        }
    return {
        "episodes": len(found.truth), "touches": int(shape[1]), "classifier": choice.classifier,
        "temperature": choice.temperature._asdict(), "fold_losses": choice.losses, "methods": methods,
    }  # fmt: skip


def score_unknown(parts: Sequence[Part], choice: ClassifierChoice) -> dict[str, Any] | None:
    """Area under the curve of detecting labels that were not taught, by the belief's doubt and by the mean distance of
    touches from what was taught; None where none was held out.

    The belief's temperature is of the folds without these labels.
    """
    doubts, truths, unknown = [], [], []
    for part in parts:
        folds = [Fold(**fold) for fold in part["folds"].values()]
        for held in part.get("unknown", {}).values():
            temperature = choose([fold.without(held["out"]) for fold in folds], [choice.classifier]).temperature
            p = calibrated_beliefs(product(held["log_p"][choice.classifier]), temperature)
            far = np.cumsum(held["far"], 1) / np.arange(1, held["far"].shape[1] + 1)
            doubts.append(np.stack([1 - metrics.confidence(p), far]))
            truths.append(part["labels"][part["truth"]])
            unknown.append(np.isin(part["truth"], held["out"]))
    if not doubts:
        return None
    touches = shown_touches(min(doubt.shape[2] for doubt in doubts))
    doubt = np.concatenate([doubt[:, :, np.array(touches) - 1] for doubt in doubts], axis=1)
    truth, missing = np.concatenate(truths), np.concatenate(unknown)
    return {"touches": touches, "episodes": len(truth), "unknown": int(missing.sum())} | {
        name: to_json(metrics.auroc(each, missing, clusters=[truth]))
        for name, each in zip((BELIEF, NOVELTY), doubt, strict=True)
    }


def shown_touches(count: int) -> list[int]:
    """Numbers of touches that tables show."""
    return sorted({min(touch, count) for touch in SHOWN_TOUCHES})


# --- tables ---


def print_tables(summary: dict[str, Any]) -> None:
    """Every method in either split, stopping, and unknown labels."""
    for name, entry in summary["splits"].items():
        shown = shown_touches(entry["touches"])
        growth = entry["temperature"]
        print(
            f"\nsplit {name}: {entry['episodes']} episodes; {entry['classifier']}, temperature "
            f"{growth['initial']:.2f} (1 + {growth['growth']:.2f} (n - 1)); intervals over labels"
        )
        rows = []
        for method, values in entry["methods"].items():
            cells = [cell({part: x[t - 1] for part, x in values["accuracy"].items()}) for t in shown]
            error = values["calibration_error"]
            ece = f"{error['error']:.3f} (chance {error['chance']:.3f}, below {error['chance_high']:.3f})"
            rows.append([method, *cells, f"{np.mean(values['log_loss']['mean']):.3f}", ece])
        print(text_table(["method", *(f"after {t}" for t in shown), "log loss", "ECE"], rows))
        for stop in entry["methods"][BELIEF]["stopping"]:
            print(
                f"  stop at an error of {stop['requested_error']:.0%}: {cell(stop['stopped'])} stop early, of whom "
                f"{cell(stop['stopped_error'])} err"
            )
    unknown = summary["unknown"]
    if unknown is not None:
        print(f"\n{unknown['unknown']} of {unknown['episodes']} episodes with labels held out; area under the curve")
        rows = [
            [name, *(cell({part: x[i] for part, x in unknown[name].items()}) for i in range(len(unknown["touches"])))]
            for name in (BELIEF, NOVELTY)
        ]
        print(text_table(["by", *(f"after {t}" for t in unknown["touches"])], rows))
