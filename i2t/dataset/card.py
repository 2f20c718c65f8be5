"""The card of a data set: README.md in its folder, which says to a person what is there. No reader depends on it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from i2t import files
from i2t.dataset.sets import Dataset

CARD = "README.md"
MAX_NAMES = 20  # listed of each kind
MAX_TEXT = 300  # characters of a remark


def card_of(dataset: Dataset) -> str:
    """What a data set holds, as a page of Markdown.

    Args:
        dataset: Any.

    Returns:
        The text: whether simulated or real, how many touches of what, which skins, which board, which rig.
    """
    said = dataset.summary()
    chips = ", ".join(f"({1e3 * x:.1f}, {1e3 * y:.1f})" for x, y in np.asarray(dataset.board.chips)[:, :2])
    known = [name for name, missing in said["missing"].items() if name != "chips" and missing < len(dataset)]
    lines = [
        f"# {len(dataset)} touches, {dataset.source}",
        "",
        f"Written by i2t; `i2t.load_dataset` reads the folder. All of it is **{dataset.source}**.",
        "",
        "| | |",
        "| --- | --- |",
        f"| objects | {_counted(dataset.objects, dataset.touches.object)} |",
        f"| skins | {_counted(dataset.pads, dataset.touches.pad)} |",
        f"| sessions | {len(np.unique(dataset.touches.session))} |",
        f"| board | {dataset.board.num_chips} chips at {chips} mm from the skin's centre |",
        f"| patches | {said['patch_pixels']} x {said['patch_pixels']} pixels over {1e3 * dataset.window:g} mm, "
        f"to {1e3 * dataset.reach:g} mm behind the nearest point |",
        f"| rig | {_cell(dataset.meta.get('rig', 'not stated'))} |",
        f"| measured | readings, {', '.join(known)} |",
    ]
    lines += [f"| {_cell(key)} | {_cell(text)} |" for key, text in dataset.meta.items() if key != "rig" and text]
    return "\n".join(lines) + "\n"


def write_card(folder: Path | str, dataset: Dataset) -> Path:
    """Write the card of a data set, in place of an earlier one.

    Args:
        folder: Of the data set.
        dataset: What it holds.

    Returns:
        The file.

    Raises:
        DataError: It cannot be written.
    """
    path = Path(folder) / CARD
    with files.replacing(path) as temporary:
        temporary.write_text(card_of(dataset), encoding="utf-8")
    return path


def _counted(names: Sequence[str], indices: np.ndarray) -> str:
    """Names with their numbers of touches."""
    counts = np.bincount(indices, minlength=len(names))
    said = [f"{_cell(name)} ({count})" for name, count in zip(names, counts, strict=True) if count]
    more = f", and {len(said) - MAX_NAMES} more" if len(said) > MAX_NAMES else ""
    return ", ".join(said[:MAX_NAMES]) + more


def _cell(text: str) -> str:
    """A text that does not end the cell of a table."""
    plain = " ".join(str(text).split()).replace("|", "/")
    return plain if len(plain) <= MAX_TEXT else f"{plain[:MAX_TEXT]} ..."
