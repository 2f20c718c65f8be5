"""The card of a data set: a README.md in its folder for people. Readers of the data set ignore it."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from i2t.dataset.sets import NOT_STATED, Dataset, source_phrase
from i2t.errors import printable
from i2t.files.writing import replacing

CARD = "README.md"  # name of the file, in a data set's folder, that describes the data set to people


def card_of(dataset: Dataset, *, board_name: str = "", max_notes: int = 40) -> str:
    """Describe a data set as a page of Markdown, its card.

    Args:
        dataset: The data set.
        board_name: Name of the data set's board (`i2t.skin.boards.name_of_board`), if it has one.
        max_notes: Maximum number of notes listed.

    Returns:
        The text of the card: whether the touches are simulated or real, how many there are, objects, skins, board, rig,
        measured quantities, notes and provenance.
    """
    summary, n, meta = dataset.summary(), len(dataset), dict(dataset.meta)
    rig, notes = meta.pop("rig", ""), [note for note in meta.pop("notes", "").split(" | ") if note]
    chips = ", ".join(f"({1e3 * x:.1f}, {1e3 * y:.1f})" for x, y in np.asarray(dataset.board.chips)[:, :2])
    board = f"{board_name or 'one without a name'}: {dataset.board.num_chips} chips"
    patches = f"{summary['patch_pixels']} x {summary['patch_pixels']} pixels over {1e3 * dataset.window:g} mm"
    measured = {name: n - count for name, count in summary["missing"].items() if name != "chips" and count < n}
    contents = {
        "objects": _counted(summary["objects"]),
        "skins": _counted(summary["pads"]),
        "sessions": _counted(summary["sessions"]),
        "board": f"{board}, at {chips} mm from the skin's centre",
        "patches": f"{patches}, to {1e3 * dataset.reach:g} mm behind the nearest point",
        "rig": rig or "not stated",
        "measured": _counted({"readings": n, **measured}),
    }
    blocks = [
        f"# {n} touches, {source_phrase(dataset.source)}",
        f"Written by i2t; `i2t.load_dataset` reads the folder. {_source_sentence(dataset.source)}",
        _table(contents),
    ]
    if notes:
        lines = [f"- {_plain(note)}" for note in notes[:max_notes]]
        more = [f"- and {len(notes) - max_notes} more, in the set's `meta`"] if len(notes) > max_notes else []
        blocks += ["## Notes", "\n".join(lines + more)]
    # The notes already state the findings on a session's unknowns.
    others = {key: text for key, text in meta.items() if text and not key.startswith("unknowns of ")}
    if others:
        blocks += ["## How it was made", _table(others)]
    return "\n\n".join(blocks) + "\n"


def write_card(folder: Path | str, dataset: Dataset, *, board_name: str = "") -> Path:
    """Write the card of a data set (`card_of`) to the folder's README.md; an earlier one is replaced.

    Args:
        folder: Folder of the data set.
        dataset: The data set.
        board_name: Name of the data set's board, if it has one.

    Returns:
        The path of the card's file.

    Raises:
        DataError: The card cannot be written.
    """
    path = Path(folder) / CARD
    with replacing(path) as temporary:
        temporary.write_text(card_of(dataset, board_name=board_name), encoding="utf-8")
    return path


def _source_sentence(source: str) -> str:
    if source == NOT_STATED:
        return "Whether it is real or simulated is **not stated**."
    return f"All of it is **{source}**."


def _counted(counts: Mapping[str, int], max_names: int = 20) -> str:
    """List names with their numbers of touches."""
    names = [f"{_plain(name)} ({count})" for name, count in counts.items() if count]
    more = f", and {len(names) - max_names} more" if len(names) > max_names else ""
    return ", ".join(names[:max_names]) + more


def _table(rows: Mapping[str, str]) -> str:
    lines = [f"| {_plain(name)} | {_plain(text)} |" for name, text in rows.items()]
    return "\n".join(["| | |", "| --- | --- |", *lines])


def _plain(text: str, max_characters: int = 1000) -> str:
    """Make a text fit into one cell of a table: one line, without |, cut at the end of a word."""
    plain = printable(" ".join(str(text).split()).replace("|", "/"))
    return plain if len(plain) <= max_characters else plain[:max_characters].rsplit(" ", 1)[0] + " ..."
