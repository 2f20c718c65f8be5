"""Reports of studies: the parts of all pads pooled, and tables in one form, as the documents show them."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.common.runs import Part
from i2t.intervals import MIN_CLUSTERS, estimate_at
from i2t.recognition import metrics
from i2t.recognition.calibrated import calibrated_beliefs
from i2t.recognition.metrics import to_json


class Column(NamedTuple):
    """A column of a study's table: how its numbers are written."""

    name: str
    decimals: int = 3
    signed: bool = False
    percent: bool = False


def make_table(columns: Sequence[Any], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """A table as `metrics.json` holds it and `tools.reproduce` writes it: the same form for all studies.

    Args:
        columns: `Column`, or a name alone.
        rows: Words, numbers, and means with their intervals (`Estimate`, or the dict of its JSON).
    """
    described = [column if isinstance(column, Column) else Column(column) for column in columns]
    return {
        "columns": [column._asdict() for column in described],
        "rows": [[cell if isinstance(cell, str) else to_json(cell) for cell in row] for row in rows],
    }


def clusters_of(parts: Sequence[Part], pads: Sequence[str], *, objects: str | None = None) -> list[np.ndarray]:
    """Clusters of the pooled episodes, for their intervals: by pad, by the draw of their sites where parts tell it, and
    with `objects`, a column's name, by the object that was there. Without them intervals are for these very objects.
    """
    counts = [len(part["truth"]) for part in parts]
    labels = [np.repeat(np.asarray(pads), counts)]
    if all("pool" in part for part in parts):
        run = np.repeat(np.arange(len(parts)), counts)
        labels.append(np.stack([run, np.concatenate([part["pool"] for part in parts])]))
    if objects is not None:
        labels.append(np.concatenate([part[objects] for part in parts]))
    numbers = [np.unique(label, axis=-1, return_inverse=True)[1].reshape(-1) for label in labels]
    # Nothing tells episodes of one or two clusters apart: their interval is for these very ones.
    return numbers if any(number.max() >= MIN_CLUSTERS - 1 for number in numbers) else []


def pool_parts(parts: Sequence[Part]) -> dict[str, np.ndarray]:
    """Arrays of several pads and seeds as one, by name. Raises ValueError where the pads were not asked the same."""
    for part in parts:
        if differing := sorted(set(part) ^ set(parts[0])):
            raise ValueError(
                f"the parts of this study are not of one version ({differing[0]!r} is in some of them only); "
                "delete its folder and run it again"
            )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def report_settings(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Accuracy of every "evidence, setting" on the same episodes, and its paired difference to the first setting; the
    temperature is that of the recogniser.
    """
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    truth, _ = columns.pop("truth"), columns.pop("pool")
    first: dict[str, np.ndarray] = {}  # whether right, by evidence, in the first setting
    rows: list[list[Any]] = []
    for name, beliefs in columns.items():
        p = calibrated_beliefs(beliefs.astype(np.float64))
        evidence, _, setting = name.partition(", ")
        hits = metrics.hits(p, truth)
        lost = metrics.compare_paired(hits, first.setdefault(evidence, hits), clusters=clusters)
        accuracy, mean = (rate(p, truth, clusters=clusters) for rate in (metrics.accuracy, metrics.mean_accuracy))
        log_loss = float(metrics.log_loss(p, truth).mean(0).mean())
        rows.append([setting, evidence, estimate_at(accuracy, -1), lost.last, mean, lost.mean, log_loss])
    touches, reference = p.shape[1], rows[0][0]
    head = [
        "setting", "evidence", Column(f"after {touches} [95 %]"), Column(f"minus {reference}", signed=True),
        Column(f"mean of 1 to {touches} [95 %]"), Column(f"minus {reference}", signed=True),
        Column("log loss", decimals=2),
    ]  # fmt: skip
    return {"episodes": len(truth), "tables": {"methods": make_table(head, rows)}}
