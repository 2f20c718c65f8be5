"""The card of a data set: README.md in its folder, which says to a person what is there. No reader depends on it.

A table says what the set holds. What was found out about its sessions is listed in sentences; what else travels with
the set (its rig's settings, its camera) is a table.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from i2t import files
from i2t.dataset.sets import Dataset

CARD = "README.md"
MAX_NAMES = 20  # listed of each kind
MAX_TEXT = 1000  # characters of a remark, which ends at a word
FINDINGS_KEY, NOTES_KEY, RIG_KEY = "unknowns of ", "notes", "rig"  # of a data set's meta
NOTES_BETWEEN = " | "


def card_of(dataset: Dataset, *, board_name: str = "") -> str:
    """Card of a data set, as a page of Markdown.

    Args:
        dataset: Any.
        board_name: Of its board, where it has one (`i2t.skin.boards.name_of_board`).

    Returns:
        The text: whether simulated or real, how many touches of what, which skins, which board, which rig; what was
        found out about its sessions, notes, and how it was recorded.
    """
    found = {key: text for key, text in dataset.meta.items() if key.startswith(FINDINGS_KEY)}
    notes = dataset.meta.get(NOTES_KEY, "")
    others = {key: text for key, text in dataset.meta.items() if text and key not in {*found, NOTES_KEY, RIG_KEY}}
    blocks = [
        f"# {len(dataset)} touches, {dataset.source}",
        f"Written by i2t; `i2t.load_dataset` reads the folder. All of it is **{dataset.source}**.",
        _table(_contents(dataset, board_name)),
    ]
    for session, sentences in {key.removeprefix(FINDINGS_KEY): _sentences(text) for key, text in found.items()}.items():
        blocks += [f"Found in {_plain(session)}:", _list(sentences)] if sentences else []
    blocks += ["## Notes", _list(notes.split(NOTES_BETWEEN))] if notes else []
    blocks += ["## How it was made", _table(list(others.items()))] if others else []
    return "\n\n".join(blocks) + "\n"


def write_card(folder: Path | str, dataset: Dataset, *, board_name: str = "") -> Path:
    """Write the card of a data set, in place of an earlier one.

    Args:
        folder: Of the data set.
        dataset: What it holds.
        board_name: Of its board, where it has one.

    Returns:
        The file.

    Raises:
        DataError: It cannot be written.
    """
    path = Path(folder) / CARD
    with files.replacing(path) as temporary:
        temporary.write_text(card_of(dataset, board_name=board_name), encoding="utf-8")
    return path


def _contents(dataset: Dataset, board_name: str) -> list[tuple[str, str]]:
    """Contents of a data set, by name."""
    said = dataset.summary()
    chips = ", ".join(f"({1e3 * x:.1f}, {1e3 * y:.1f})" for x, y in np.asarray(dataset.board.chips)[:, :2])
    missing = ", ".join(f"{name} of {count}" for name, count in said["missing"].items() if count)
    return [
        ("objects", _counted(dataset.objects, dataset.touches.object)),
        ("skins", _counted(dataset.pads, dataset.touches.pad)),
        ("sessions", _counted(dataset.sessions, dataset.touches.session)),
        (
            "board",
            f"{board_name or 'one without a name'}: {dataset.board.num_chips} chips, at {chips} mm from the skin's "
            "centre",
        ),
        (
            "patches",
            f"{said['patch_pixels']} x {said['patch_pixels']} pixels over {1e3 * dataset.window:g} mm, to "
            f"{1e3 * dataset.reach:g} mm behind the nearest point",
        ),
        ("rig", dataset.meta.get(RIG_KEY, "") or "not stated"),
        ("not measured", missing or "nothing"),
    ]


def _sentences(findings: str) -> list[str]:
    """The sentences of findings (`i2t.unknowns.findings_to_meta`), or the text as it is."""
    try:
        return [finding["sentence"] for finding in json.loads(findings)]
    except (ValueError, LookupError, TypeError):
        return [findings]


def _counted(names: Sequence[str], indices: np.ndarray) -> str:
    """Names with their numbers of touches."""
    counts = np.bincount(indices, minlength=len(names))
    said = [f"{_plain(name)} ({count})" for name, count in zip(names, counts, strict=True) if count]
    more = f", and {len(said) - MAX_NAMES} more" if len(said) > MAX_NAMES else ""
    return ", ".join(said[:MAX_NAMES]) + more


def _table(rows: list[tuple[str, str]]) -> str:
    return "\n".join(["| | |", "| --- | --- |", *(f"| {_plain(name)} | {_plain(text)} |" for name, text in rows)])


def _list(texts: Sequence[str]) -> str:
    more = [f"- and {len(texts) - MAX_NAMES} more, in the set's `meta`"] if len(texts) > MAX_NAMES else []
    return "\n".join([f"- {_plain(text)}" for text in texts[:MAX_NAMES]] + more)


def _plain(text: str) -> str:
    """A text that ends no line and no cell of a table, of at most so many characters."""
    plain = " ".join(str(text).split()).replace("|", "/")
    return plain if len(plain) <= MAX_TEXT else plain[:MAX_TEXT].rsplit(" ", 1)[0] + " ..."
