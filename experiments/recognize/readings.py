"""Question: with a real sensor's readings, do more touches help, and are the probabilities calibrated?

    python -m experiments.recognize recorded --readings palm_45.csv.gz palm_down.csv.gz --label object --ignore slipped
    python -m experiments.recognize recorded --readings touches.csv --label material --group day

This tests the classification half of recognition: p(label | reading) is trained on examples, without geometry and
without predicted touches. Within each group, the first rows of each label are for training, and the later rows are
recognised in episodes of up to ten touches, drawn without replacement. Nothing is chosen by test rows. For comparison,
rows are also split at random, which puts the errors that a session's touches share on both sides. Methods and
calibration are in `experiments.recognize.reading_methods`. Finally, some labels are held out as unknown. The command
takes a few minutes. Results go to --out: metrics.json (95 % intervals over labels), config.json and a figure.
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
    CONFIG,
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

CALIBRATED_BELIEF, NOVELTY = "calibrated belief", "distance to the training readings"


class Group(NamedTuple):
    """Rows of one group, with labels numbered within it."""

    train: Labelled
    test: Labelled
    labels: np.ndarray  # number of each label in the table


class RecognizedEpisodes(NamedTuple):
    """Episodes of all groups."""

    truth: np.ndarray  # (e,) label in the table
    group: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, labels in the table) by method


def run(args: RecordedArgs) -> dict[str, Any]:
    """Recognise labels with both splits, and detect unknown labels."""
    table = read_table(args)
    refuse_counters(table, args.readings[0])
    require_rows(table, 5, args.readings[0])  # three for training and two for the test
    close_share = close_followers(table)
    begin(args, CONFIG)
    print(
        f"{len(table.label)} readings of {len(table.columns)} values, {len(table.labels)} labels in "
        f"{len(table.groups)} groups; the first {args.train_share:.0%} of each label's rows are for training"
    )
    for sentence in [*table.notes, *describe_touches(table, args.touch, close_share)]:
        print(sentence)
    groups = len(table.groups)
    makers = {
        args.out / f"{split.replace(' ', '_')}-{i}.npz": partial(make_part, args, split, i)
        for split in SPLITS
        for i in range(groups)
    }
    all_parts = make_parts(makers, args.workers, bar="groups")
    summary: dict[str, Any] = {
        "source": "recorded", "readings": [path.name for path in args.readings], "labels": table.labels,
        "groups": table.groups, "rows": len(table.label), "columns": len(table.columns), "intervals": "over labels",
        "seed": args.seed, "samples": table.samples or None, "close_to_the_row_before": close_share,
        "touches_asked": args.max_touches, "splits": {},
    }  # fmt: skip
    for split, parts in zip(SPLITS, (all_parts[:groups], all_parts[groups:]), strict=True):
        choice = choose([Fold(**fold) for part in parts for fold in part["folds"].values()])
        episodes = recognise(parts, choice, len(table.labels))
        summary["splits"][split] = score(episodes, choice, table)
        played = summary["splits"][split]["touches"]
        if split == IN_ORDER:
            figure = figures.accuracy(accuracies(episodes), f"Real readings, split {split}", simulated=False)
            viz.save_figure(figure, args.out / "accuracy.png")
            summary["unknown"] = score_unknown(parts, choice)
    write_json(args.out / METRICS, summary)
    print_tables(summary)
    if shortfall := describe_shortfall(table, args.max_touches, played, args.train_share):
        print(shortfall)
    return summary


def read_table(args: RecordedArgs) -> ReadingTable:
    """Read the tables of the options."""
    return read_reading_table(
        args.readings, label=args.label, group=args.group, ignore=args.ignore, touch=args.touch
    )  # fmt: skip


def describe_touches(table: ReadingTable, column: str | None, close_share: float) -> list[str]:
    """State how many samples were averaged, and whether rows may be samples of one touch.

    Args:
        table: The readings.
        column: Column that numbers the touches; None if each row is a touch.
        close_share: Share of rows close to the previous row, from `close_followers`.

    Returns:
        A list of at most two sentences.
    """
    sentences = []
    if table.samples:
        touches = f"{len(table.label)} touches by column {column}"
        sentences.append(f"{table.samples} rows are samples of {touches}; the samples of a touch are averaged")
    if close_share:
        sentences.append(
            f"warning: {close_share:.0%} of the readings are far closer to the previous one than is usual for their "
            "label, like samples of one touch, which are not independent; unless every row is a touch, name the column "
            "that numbers touches (--touch COLUMN), or keep one row of each touch"
        )
    return sentences


def describe_shortfall(table: ReadingTable, asked: int, played: int, train_share: float) -> str:
    """Warn that episodes have fewer touches than asked for; empty if they have not."""
    if played >= asked:
        return ""
    rows = min(rows_of_labels(table), key=lambda rows: len(rows) - count_for_training(len(rows), train_share))
    label, group = table.labels[table.label[rows[0]]], table.groups[table.group[rows[0]]]
    return (
        f"warning: episodes have {played} touches, and {asked} were asked for (--max-touches): label {label} in group "
        f"{group} has {len(rows)} touches, of which {count_for_training(len(rows), train_share)} are for training"
    )


def group_of(table: ReadingTable, split: str, i: int, args: RecordedArgs) -> Group:
    """Select one group with its own labels, in file order or shuffled for the random split."""
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
    """Predict log probabilities of the touches in one group's episodes with every classifier: of the folds, of the
    test, and of the test without some labels in training.
    """
    table = read_table(args)
    group = group_of(table, split, i, args)
    series = draw_series(group.test.label, args.episodes, args.max_touches, args.seed)

    def predict(train: Labelled) -> Part:
        log_p = all_log_probabilities(train, group.test.reading, args.seed)
        return {name: values[series.rows] for name, values in log_p.items()}

    folds = judge_folds(group.train, args.train_share, args.episodes, args.max_touches, args.seed)
    part: Part = {
        "labels": group.labels, "truth": series.truth, "log_p": predict(group.train),
        "folds": {str(k): fold._asdict() for k, fold in enumerate(folds)}, "unknown": {},
    }  # fmt: skip
    for k, draw in enumerate(unknown_draws(table, args) if split == IN_ORDER else []):
        out = np.flatnonzero(np.isin(group.labels, draw))
        if len(out) and len(group.labels) - len(out) > 1:
            train = group.train.without(out)
            far = novelty(train, group.test.reading)[series.rows]
            part["unknown"][str(k)] = {"out": out, "far": far, "log_p": predict(train)}
    return part


def unknown_draws(table: ReadingTable, args: RecordedArgs) -> list[np.ndarray]:
    """Draw the labels that are held out as unknown, at most a third of all at a time."""
    count = min(args.unknown, len(table.labels) // 3)
    rng = np.random.default_rng(args.seed)
    return [rng.choice(len(table.labels), count, replace=False) for _ in range(args.draws)] if count else []


def recognise(parts: Sequence[Part], choice: ClassifierChoice, labels: int) -> RecognizedEpisodes:
    """Compute the beliefs of every method in all episodes, for the number of touches that all groups have."""
    count = min(part["log_p"][KNN].shape[1] for part in parts)
    by_group = []
    for i, part in enumerate(parts):
        log_p, knn = (part["log_p"][name][:, :count] for name in (choice.classifier, KNN))
        beliefs = {
            "nearest neighbours": loop.beliefs(-knn, "average"),
            "votes": loop.beliefs(-log_p, "votes"),
            "average": loop.beliefs(-log_p, "average"),
            "product": product(log_p),
            CALIBRATED_BELIEF: calibrated_beliefs(product(log_p), choice.temperature),
        }
        over_table = {}
        for name, p in beliefs.items():
            over_table[name] = np.zeros((*p.shape[:2], labels))
            over_table[name][..., part["labels"]] = p
        by_group.append(RecognizedEpisodes(part["labels"][part["truth"]], np.full(len(part["truth"]), i), over_table))
    return RecognizedEpisodes(
        np.concatenate([part.truth for part in by_group]),
        np.concatenate([part.group for part in by_group]),
        {name: np.concatenate([part.beliefs[name] for part in by_group]) for name in by_group[0].beliefs},
    )


# --- scores ---


def accuracies(episodes: RecognizedEpisodes) -> dict[str, metrics.Estimate]:
    """Compute the accuracy of each method after each touch, with intervals over labels."""
    truth = episodes.truth
    return {name: metrics.accuracy(p, truth, clusters=[truth]) for name, p in episodes.beliefs.items()}


def score(episodes: RecognizedEpisodes, choice: ClassifierChoice, table: ReadingTable) -> dict[str, Any]:
    """Compute the scores of every method over all groups, and accuracies in each group."""
    truth = episodes.truth
    session = episodes.group * len(table.labels) + truth
    methods = {}
    for name, p in episodes.beliefs.items():
        hit = metrics.hits(p, truth)
        shape = hit.shape
        # The touches of a session are one cluster.
        clusters = np.broadcast_to(session[:, None], shape)
        error = metrics.calibration_error(metrics.confidence(p), hit, cluster=clusters)
        stops = [metrics.stopping(p, truth, e, clusters=[truth]) for e in REQUESTED_ERRORS]
        methods[name] = {
            "accuracy": to_json(metrics.accuracy(p, truth, clusters=[truth])),
            "log_loss": to_json(metrics.mean_interval(metrics.log_loss(p, truth), [truth])),
            "calibration_error": to_json(error),
            "stopping": [to_json(stop) for stop in stops],
            "by_group": {
                group: to_json(metrics.accuracy(p[rows], truth[rows], clusters=[truth[rows]]))
                for i, group in enumerate(table.groups)
                for rows in [episodes.group == i]
            },
        }
    return {
        "episodes": len(truth), "touches": int(shape[1]), "classifier": choice.classifier,
        "temperature": choice.temperature._asdict(), "fold_losses": choice.losses, "methods": methods,
    }  # fmt: skip


def score_unknown(parts: Sequence[Part], choice: ClassifierChoice) -> dict[str, Any] | None:
    """Compute the area under the ROC curve for detecting labels that are absent from training, by the belief's
    uncertainty and by the mean distance of touches from the training readings; None if no label was held out.

    The belief's temperature is fitted to the folds without these labels.
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
    touches = table_touches(min(doubt.shape[2] for doubt in doubts))
    doubt = np.concatenate([doubt[:, :, np.array(touches) - 1] for doubt in doubts], axis=1)
    truth, missing = np.concatenate(truths), np.concatenate(unknown)
    return {"touches": touches, "episodes": len(truth), "unknown": int(missing.sum())} | {
        name: to_json(metrics.auroc(values, missing, clusters=[truth]))
        for name, values in zip((CALIBRATED_BELIEF, NOVELTY), doubt, strict=True)
    }


def table_touches(count: int) -> list[int]:
    """Choose the numbers of touches in tables."""
    return sorted({min(touch, count) for touch in (1, 3, 5, 10)})


# --- tables ---


def print_tables(summary: dict[str, Any]) -> None:
    """Print the scores of every method in both splits, early stopping, and detection of unknown labels."""
    for name, entry in summary["splits"].items():
        shown = table_touches(entry["touches"])
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
        for stop in entry["methods"][CALIBRATED_BELIEF]["stopping"]:
            print(
                f"  stopping at an error of {stop['requested_error']:.0%}: {cell(stop['stopped'])} stop early, of "
                f"which {cell(stop['stopped_error'])} are wrong"
            )
    unknown = summary["unknown"]
    if unknown is not None:
        print(
            f"\n{unknown['unknown']} of {unknown['episodes']} episodes with labels held out; area under the ROC curve"
        )
        rows = [
            [name, *(cell({part: x[i] for part, x in unknown[name].items()}) for i in range(len(unknown["touches"])))]
            for name in (CALIBRATED_BELIEF, NOVELTY)
        ]
        print(text_table(["by", *(f"after {t}" for t in unknown["touches"])], rows))
