"""Reports of studies: pooled results of all pads, and tables in one form."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from experiments.common.runs import Part
from i2t.intervals import MIN_CLUSTERS, estimate_at
from i2t.recognition import metrics
from i2t.recognition.calibrated import calibrated_beliefs
from i2t.recognition.metrics import to_json


class Column(NamedTuple):
    """Heading and number format of a table column."""

    name: str
    decimals: int = 3
    signed: bool = False
    percent: bool = False


def make_table(columns: Sequence[Any], rows: Sequence[Sequence[Any]]) -> dict[str, Any]:
    """Build a table for `metrics.json`, in the form that `study_table` formats.

    Args:
        columns: Columns, or their headings alone.
        rows: Cells that are text, numbers, or means with their intervals (`Estimate`, or the dict of its JSON).

    Returns:
        A dict with the descriptions of the columns and the cells of the rows.
    """
    described = [column if isinstance(column, Column) else Column(column) for column in columns]
    return {
        "columns": [column._asdict() for column in described],
        "rows": [[cell if isinstance(cell, str) else to_json(cell) for cell in row] for row in rows],
    }


def clusters_of(parts: Sequence[Part], pads: Sequence[str], *, objects: str | None = None) -> list[np.ndarray]:
    """Clusters of the pooled episodes, over which intervals are computed.

    Args:
        parts: Results of the pads and seeds.
        pads: Name of each part's pad.
        objects: Name of the array of object indices; without it, intervals hold for these objects only.

    Returns:
        Cluster indices `(e,)` by pad, by pool of sites if recorded, and by object if wanted. The list is empty, and
        intervals hold for these episodes only, if every grouping has fewer clusters than an interval needs.
    """
    counts = [len(part["truth"]) for part in parts]
    labels = [np.repeat(np.asarray(pads), counts)]
    if all("pool" in part for part in parts):
        run = np.repeat(np.arange(len(parts)), counts)
        labels.append(np.stack([run, np.concatenate([part["pool"] for part in parts])]))
    if objects is not None:
        labels.append(np.concatenate([part[objects] for part in parts]))
    numbers = [np.unique(label, axis=-1, return_inverse=True)[1].reshape(-1) for label in labels]
    return numbers if any(number.max() >= MIN_CLUSTERS - 1 for number in numbers) else []


def pool_parts(parts: Sequence[Part]) -> dict[str, np.ndarray]:
    """Concatenate the arrays of several pads and seeds by name; `ValueError` if their names differ."""
    for part in parts:
        if differing := sorted(set(part) ^ set(parts[0])):
            raise ValueError(
                f"the parts of this study come from different versions ({differing[0]!r} is missing in some); "
                "delete its folder and run it again"
            )
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def report_settings(parts: Sequence[Part], pads: Sequence[str]) -> dict[str, Any]:
    """Report the accuracy of every "evidence, setting" and its paired difference from the first setting.

    The temperature is that of the recogniser.
    """
    columns, clusters = pool_parts(parts), clusters_of(parts, pads)
    truth, _ = columns.pop("truth"), columns.pop("pool")
    first: dict[str, np.ndarray] = {}  # (e, t) correct in the first setting, by evidence
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
        "setting", "evidence", Column(f"after {touches} [95 %]"), Column(f"difference from {reference}", signed=True),
        Column(f"mean over 1 to {touches} touches [95 %]"), Column(f"difference from {reference}", signed=True),
        Column("log loss", decimals=2),
    ]  # fmt: skip
    return {"episodes": len(truth), "tables": {"methods": make_table(head, rows)}}
