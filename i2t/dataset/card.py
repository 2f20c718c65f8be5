"""The card of a data set: README.md in its folder, which says to a person what is there. No reader depends on it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from i2t.dataset.sets import NOT_STATED, Dataset, source_words
from i2t.errors import printable
from i2t.files.writing import replacing

CARD = "README.md"
MAX_NAMES = 20  # listed of each kind
MAX_NOTES = 40
MAX_TEXT = 1000  # characters of a remark, which ends at a word
FINDINGS_KEY, NOTES_KEY, RIG_KEY = "unknowns of ", "notes", "rig"  # of a data set's meta; notes say the findings
NOTES_BETWEEN = " | "  # notes in one text


def card_of(dataset: Dataset, *, board_name: str = "") -> str:
    """Card of a data set, as a page of Markdown.

    Args:
        dataset: Any.
        board_name: Of its board, where it has one (`i2t.skin.boards.name_of_board`).

    Returns:
        The text: whether simulated or real, how many touches of what, which skins, which board, which rig, and what was
        measured; notes; and how it was made.
    """
    said, n = dataset.summary(), len(dataset)
    chips = ", ".join(f"({1e3 * x:.1f}, {1e3 * y:.1f})" for x, y in np.asarray(dataset.board.chips)[:, :2])
    board = f"{board_name or 'one without a name'}: {dataset.board.num_chips} chips"
    patches = f"{said['patch_pixels']} x {said['patch_pixels']} pixels over {1e3 * dataset.window:g} mm"
    known = {name: n - count for name, count in said["missing"].items() if name != "chips" and count < n}
    contents = {
        "objects": _counted(said["objects"]),
        "skins": _counted(said["pads"]),
        "sessions": _counted(said["sessions"]),
        "board": f"{board}, at {chips} mm from the skin's centre",
        "patches": f"{patches}, to {1e3 * dataset.reach:g} mm behind the nearest point",
        "rig": dataset.meta.get(RIG_KEY) or "not stated",
        "measured": _counted({"readings": n, **known}),
    }
    blocks = [
        f"# {n} touches, {source_words(dataset.source)}",
        f"Written by i2t; `i2t.load_dataset` reads the folder. {_source_sentence(dataset.source)}",
        _table(contents),
    ]
    notes = [f"- {_plain(note)}" for note in dataset.meta.get(NOTES_KEY, "").split(NOTES_BETWEEN) if note]
    if notes:
        more = [f"- and {len(notes) - MAX_NOTES} more, in the set's `meta`"] if len(notes) > MAX_NOTES else []
        blocks += ["## Notes", "\n".join(notes[:MAX_NOTES] + more)]
    told = (NOTES_KEY, RIG_KEY)
    others = {k: v for k, v in dataset.meta.items() if v and k not in told and not k.startswith(FINDINGS_KEY)}
    if others:
        blocks += ["## How it was made", _table(others)]
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
    with replacing(path) as temporary:
        temporary.write_text(card_of(dataset, board_name=board_name), encoding="utf-8")
    return path


def _source_sentence(source: str) -> str:
    if source == NOT_STATED:
        return "Whether it is real or simulated is **not stated**."
    return f"All of it is **{source}**."


def _counted(counts: Mapping[str, int]) -> str:
    """Names with their numbers of touches."""
    said = [f"{_plain(name)} ({count})" for name, count in counts.items() if count]
    more = f", and {len(said) - MAX_NAMES} more" if len(said) > MAX_NAMES else ""
    return ", ".join(said[:MAX_NAMES]) + more


def _table(rows: Mapping[str, str]) -> str:
    lines = [f"| {_plain(name)} | {_plain(text)} |" for name, text in rows.items()]
    return "\n".join(["| | |", "| --- | --- |", *lines])


def _plain(text: str) -> str:
    """A text that ends no line and no cell of a table, of at most so many characters."""
    plain = printable(" ".join(str(text).split()).replace("|", "/"))
    return plain if len(plain) <= MAX_TEXT else plain[:MAX_TEXT].rsplit(" ", 1)[0] + " ..."
