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

from typing import Any, NamedTuple

import numpy as np

from experiments.common.intervals import with_interval
from experiments.common.reading_tables import (
    ReadingTable,
    read_reading_table,
    require_rows,
    split_at_random,
    split_in_order,
)
from experiments.common.runs import METRICS, begin, write_json
from experiments.common.tables import text_table
from experiments.recognize import figures
from experiments.recognize.arguments import RecordedArgs
from experiments.recognize.reading_methods import (
    KNN,
    Choice,
    Fold,
    Labelled,
    choose,
    draw_series,
    judge_folds,
    log_probabilities,
    novelty,
    product,
)
from i2t import viz
from i2t.paper import loop
from i2t.progress import progress
from i2t.recognition import metrics
from i2t.recognition.calibrated import calibrated_beliefs
from i2t.recognition.metrics import to_json

LEAST_ROWS = 5  # of a label in a group: three that teach, two to recognise
REQUESTED_ERRORS = (0.01, 0.05, 0.10)
SHOWN_TOUCHES = (1, 3, 5, 10)
IN_ORDER, AT_RANDOM = "in file order", "at random"
VOTES, AVERAGE, PRODUCT, BELIEF = "votes", "average", "product", "calibrated belief"
NEIGHBOURS, NOVELTY = "nearest neighbours", "distance from what was taught"


class Group(NamedTuple):
    """Rows of one group, with labels counted within it."""

    train: Labelled
    test: Labelled
    labels: np.ndarray  # index in the table of each of its labels


class Episodes(NamedTuple):
    """Episodes of all groups."""

    truth: np.ndarray  # (e,) label of the table
    group: np.ndarray  # (e,)
    beliefs: dict[str, np.ndarray]  # (e, t, labels of the table) by method


def run(args: RecordedArgs) -> dict[str, Any]:
    """Recognise in file order and at random, and unknown labels."""
    table = read_reading_table(args.readings, label=args.label, group=args.group, ignore=args.ignore)
    require_rows(table, LEAST_ROWS)
    begin(args.out, args, args, None, args.overwrite)
    print(
        f"{len(table.label)} readings of {len(table.columns)} values, {len(table.labels)} labels in "
        f"{len(table.groups)} groups; the first {args.train_share:.0%} of each label's rows teach"
    )
    summary: dict[str, Any] = {
        "source": "recorded", "readings": [path.name for path in args.readings], "labels": table.labels,
        "groups": table.groups, "rows": len(table.label), "columns": len(table.columns), "intervals": "over labels",
        "seed": args.seed, "splits": {},
    }  # fmt: skip
    splits = {
        IN_ORDER: groups_of(table, split_in_order(table, args.train_share)),
        AT_RANDOM: groups_of(table, split_at_random(table, args.train_share, args.seed), shuffled=args.seed),
    }
    for name, groups in splits.items():
        folds = [judge_folds(g.train, args.episodes, args.max_touches, args.seed) for g in progress(groups, desc=name)]
        choice = choose([fold for each in folds for fold in each])
        found = recognise(groups, choice, len(table.labels), args)
        summary["splits"][name] = score(found, choice, table)
        if name == IN_ORDER:
            figure = figures.accuracy(accuracies(found), f"Real readings, split {name}", simulated=False)
            viz.save_figure(figure, args.out / "accuracy.png")
            summary["unknown"] = score_unknown(groups, folds, choice, args)
    write_json(args.out / METRICS, summary)
    print_tables(summary)
    return summary


def groups_of(table: ReadingTable, train: np.ndarray, shuffled: int | None = None) -> list[Group]:
    """The groups, each with its own labels; rows in file order, or shuffled by a seed."""
    found = []
    for i in range(len(table.groups)):
        rows = np.flatnonzero(table.group == i)
        if shuffled is not None:
            rows = np.random.default_rng(shuffled).permutation(rows)
        labels, own = np.unique(table.label[rows], return_inverse=True)
        data = Labelled(table.reading[rows], own)
        first, later = (data.at(np.flatnonzero(side)) for side in (train[rows], ~train[rows]))
        found.append(Group(first, later, labels))
    return found


# --- episodes ---


def recognise(groups: list[Group], choice: Choice, labels: int, args: RecordedArgs) -> Episodes:
    """Episodes of every group, judged by every method."""
    each = []
    count = min(args.max_touches, *(int(np.bincount(g.test.label).min()) for g in groups))
    for i, group in enumerate(groups):
        series = draw_series(group.test.label, args.episodes, count, args.seed)
        log_p = log_probabilities(choice.classifier, group.train, group.test.reading, args.seed)[series.rows]
        knn = log_probabilities(KNN, group.train, group.test.reading, args.seed)[series.rows]
        beliefs = {
            NEIGHBOURS: loop.beliefs(-knn, "average"),
            **{rule: loop.beliefs(-log_p, rule) for rule in (VOTES, AVERAGE)},
            PRODUCT: product(log_p),
            BELIEF: calibrated_beliefs(product(log_p), choice.temperature),
        }
        wide = {}
        for name, p in beliefs.items():
            wide[name] = np.zeros((*p.shape[:2], labels))
            wide[name][..., group.labels] = p
        each.append(Episodes(group.labels[series.truth], np.full(len(series.truth), i), wide))
    return Episodes(
        np.concatenate([part.truth for part in each]),
        np.concatenate([part.group for part in each]),
        {name: np.concatenate([part.beliefs[name] for part in each]) for name in each[0].beliefs},
    )


# --- scores ---


def accuracies(found: Episodes) -> dict[str, metrics.Estimate]:
    """Accuracy of each method after each touch, with intervals over labels."""
    return {name: metrics.accuracy(p, found.truth, clusters=[found.truth]) for name, p in found.beliefs.items()}


def score(found: Episodes, choice: Choice, table: ReadingTable) -> dict[str, Any]:
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


def score_unknown(
    groups: list[Group], folds: list[list[Fold]], choice: Choice, args: RecordedArgs
) -> dict[str, Any] | None:
    """Area under the curve of detecting labels that were held out, by the belief's doubt and by the distance of
    readings from all that were taught; None where there are fewer than three labels.
    """
    labels = np.unique(np.concatenate([g.labels for g in groups]))
    held_out = min(args.unknown, len(labels) // 3)
    if not held_out:
        return None
    rng = np.random.default_rng(args.seed)
    draws = [rng.choice(labels, held_out, replace=False) for _ in range(args.draws)]
    parts = [
        doubts(group, each, np.flatnonzero(np.isin(group.labels, draw)), choice.classifier, args)
        for draw in progress(draws, desc="unknown labels", unit="draw")
        for group, each in zip(groups, folds, strict=True)
        if np.isin(group.labels, draw).any() and np.sum(~np.isin(group.labels, draw)) > 1
    ]
    count = min(part[0].shape[2] for part in parts)
    truth, unknown = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
    doubt = np.concatenate([part[0][:, :, :count] for part in parts], axis=1)
    at = np.array(shown_touches(count)) - 1
    return {"held_out": held_out, "draws": args.draws, "touches": shown_touches(count)} | {
        name: to_json(metrics.auroc(each[:, at], unknown, clusters=[truth]))
        for name, each in zip((BELIEF, NOVELTY), doubt, strict=True)
    }


def doubts(
    group: Group, folds: list[Fold], out: np.ndarray, classifier: str, args: RecordedArgs
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Doubt (2, e, t) by the belief and by distance, where labels `out` of a group were not taught; the label of each
    episode, and whether it was out. Its temperature is of the folds without them.
    """
    known = np.flatnonzero(~np.isin(group.train.label, out))
    train = Labelled(group.train.reading[known], np.unique(group.train.label[known], return_inverse=True)[1])
    temperature = choose([fold.without(out) for fold in folds], [classifier]).temperature
    series = draw_series(group.test.label, args.episodes, args.max_touches, args.seed)
    log_p = log_probabilities(classifier, train, group.test.reading, args.seed)[series.rows]
    far = np.cumsum(novelty(train, group.test.reading)[series.rows], 1) / np.arange(1, series.rows.shape[1] + 1)
    doubt = np.stack([1 - metrics.confidence(calibrated_beliefs(product(log_p), temperature)), far])
    return doubt, group.labels[series.truth], np.isin(series.truth, out)


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
            cells = [_cell({part: x[t - 1] for part, x in values["accuracy"].items()}) for t in shown]
            error = values["calibration_error"]
            ece = f"{error['error']:.3f} (chance {error['chance']:.3f}, below {error['chance_high']:.3f})"
            rows.append([method, *cells, f"{np.mean(values['log_loss']['mean']):.3f}", ece])
        print(text_table(["method", *(f"after {t}" for t in shown), "log loss", "ECE"], rows))
        for stop in entry["methods"][BELIEF]["stopping"]:
            print(
                f"  stop at an error of {stop['requested_error']:.0%}: {_cell(stop['stopped'])} stop early, of whom "
                f"{_cell(stop['stopped_error'])} err"
            )
    unknown = summary["unknown"]
    if unknown is not None:
        print(f"\n{unknown['held_out']} labels held out as unknown, {unknown['draws']} draws; area under the curve")
        rows = [
            [name, *(_cell({part: x[i] for part, x in unknown[name].items()}) for i in range(len(unknown["touches"])))]
            for name in (BELIEF, NOVELTY)
        ]
        print(text_table(["by", *(f"after {t}" for t in unknown["touches"])], rows))


def _cell(estimate: dict[str, Any]) -> str:
    return with_interval(estimate["mean"], estimate["low"], estimate["high"])
