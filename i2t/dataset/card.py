"""The card of a data set: README.md in its folder, which says to a person what is there. No reader depends on it.

A table says what the set holds. What travels with a set as JSON, such as what was found out about a session, its rig's
settings and its camera, is written as sentences and tables; notes are a list.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from i2t import files
from i2t.dataset.sets import Dataset

CARD = "README.md"
MAX_NAMES = 20  # listed of each kind
MAX_LINES = 40  # of a list
MAX_TEXT = 1000  # characters of a remark, which ends at a word
FINDINGS_KEY, NOTES_KEY, RIG_KEY = "unknowns of ", "notes", "rig"  # of a data set's meta
NOTES_BETWEEN, SESSIONS_BETWEEN = " | ", "; "  # notes, and what several parts of a set say, in one text


def card_of(dataset: Dataset, *, board_name: str = "") -> str:
    """Card of a data set, as a page of Markdown.

    Args:
        dataset: Any.
        board_name: Of its board, where it has one (`i2t.skin.boards.name_of_board`).

    Returns:
        The text: whether simulated or real, how many touches of what, which skins, which board, which rig; what was
        found out about its sessions, notes, and how it was recorded.
    """
    blocks = [
        f"# {len(dataset)} touches, {dataset.source}",
        f"Written by i2t; `i2t.load_dataset` reads the folder. All of it is **{dataset.source}**.",
        _table(_contents(dataset, board_name)),
    ]
    found = {key.removeprefix(FINDINGS_KEY): text for key, text in dataset.meta.items() if key.startswith(FINDINGS_KEY)}
    if any(found.values()):
        blocks += ["## What was found in the recording", *_findings(found)]
    if notes := _notes(dataset.meta.get(NOTES_KEY, ""), found):
        blocks += ["## Notes", _list(notes)]
    others = {
        key: text
        for key, text in dataset.meta.items()
        if text and key not in (NOTES_KEY, RIG_KEY) and not key.startswith(FINDINGS_KEY)
    }
    if others:
        blocks += ["## How it was made", _table(_rows(others))]
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
    missing = {name: count for name, count in said["missing"].items() if name != "chips"}
    complete = ["readings", *(name for name, count in missing.items() if not count)]
    partly = [f"{name} of {len(dataset) - count}" for name, count in missing.items() if 0 < count < len(dataset)]
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
        ("measured", ", ".join([", ".join(complete) + " of all touches", *partly])),
    ]


def _findings(found: dict[str, str]) -> list[str]:
    """Findings about each session, as the sentences that were said then."""
    blocks = []
    for session, text in list(found.items())[:MAX_NAMES]:
        said = _sentences(text)
        blocks += [f"{_plain(session)}:", _list(said)] if said else []
    if len(found) > MAX_NAMES:
        blocks.append(f"{len(found) - MAX_NAMES} more sessions have theirs in the set's `meta`.")
    return blocks


def _notes(text: str, found: dict[str, str]) -> list[str]:
    """Notes, without those that say what was found once more."""
    listed = tuple(_plain(sentence) for text in found.values() for sentence in _sentences(text))
    notes = text.split(NOTES_BETWEEN) if text else []
    return [note for note in notes if not (listed and _plain(note).endswith(listed))]


def _sentences(findings: str) -> list[str]:
    """The sentences of findings that are written as JSON."""
    entries = [entry for part in _parsed(findings) or [] for entry in (part if isinstance(part, list) else [part])]
    return [entry["sentence"] for entry in entries if isinstance(entry, dict) and entry.get("sentence")]


def _rows(texts: dict[str, str]) -> list[tuple[str, str]]:
    """Remarks by name; those that are JSON with a row for each of their parts."""
    rows: list[tuple[str, str]] = []
    for key, text in texts.items():
        parts = _parsed(text)
        if parts is None:
            rows.append((key, text))
            continue
        rows += dict.fromkeys(leaf for part in parts for leaf in _leaves(key, part))
    return rows


def _leaves(name: str, value: Any) -> Iterator[tuple[str, str]]:
    """Leaves of a JSON value as text, by the names on the way to them."""
    if isinstance(value, dict):
        for key, part in value.items():
            yield from _leaves(f"{name}: {key}", part)
    elif isinstance(value, list):
        yield name, ", ".join(_said(part) for part in value) or "none"
    else:
        yield name, _said(value)


def _said(value: Any) -> str:
    if value is None:
        return "not known"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _parsed(text: str) -> list[Any] | None:
    """The objects and lists of JSON in a text, one or several of them; None where it is anything else."""
    decoder, at = json.JSONDecoder(), 0
    values: list[Any] = []
    while at < len(text):
        if text[at] not in "{[":
            return values if values and text[at:].startswith("and ") else None
        try:
            value, at = decoder.raw_decode(text, at)
        except ValueError:
            return None
        values.append(value)
        if text[at:] and not text[at:].startswith(SESSIONS_BETWEEN):
            return None
        at += len(SESSIONS_BETWEEN)
    return values


def _counted(names: Sequence[str], indices: np.ndarray) -> str:
    """Names with their numbers of touches."""
    counts = np.bincount(indices, minlength=len(names))
    said = [f"{_plain(name)} ({count})" for name, count in zip(names, counts, strict=True) if count]
    more = f", and {len(said) - MAX_NAMES} more" if len(said) > MAX_NAMES else ""
    return ", ".join(said[:MAX_NAMES]) + more


def _table(rows: list[tuple[str, str]]) -> str:
    return "\n".join(["| | |", "| --- | --- |", *(f"| {_plain(name)} | {_plain(text)} |" for name, text in rows)])


def _list(texts: Sequence[str]) -> str:
    lines = [f"- {_plain(text)}" for text in texts[:MAX_LINES]]
    more = [f"- and {len(texts) - MAX_LINES} more, in the set's `meta`"] if len(texts) > MAX_LINES else []
    return "\n".join(lines + more)


def _plain(text: str) -> str:
    """A text that ends no line and no cell of a table, of at most so many characters."""
    plain = " ".join(str(text).split()).replace("|", "/")
    if len(plain) <= MAX_TEXT:
        return plain
    return plain[:MAX_TEXT].rsplit(" ", 1)[0] + " ..."
