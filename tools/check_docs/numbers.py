"""Numbers in sentences: a result that a sentence names stands in a table.

A result is a number without a unit of size, a percentage, a time, a ratio or a count of a thousand and more. It is held
if a table of the sentence's section has it, or a table of the page or section that the paragraph links to, rounded to
as many decimals. Free are whole numbers below a thousand, sizes of at most one decimal ("0.5 mm") or of images
("48 x 48"), years, versions, and the levels 90 % and 95 %.
In the README, rows of a table that is not written from docs/results are sentences too.
"""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tools.check_docs.pages import BLOCK, PageProblem, blank, pages_of
from tools.reproduce.tables import MARK

LINK = re.compile(r"\]\(([\w./]+\.md)?(?:#([\w-]+))?\)")
HEADING = re.compile(r"^(#+) (.*)$", re.M)
UNSPOKEN = (
    r"^```.*?^```", r"<!--.*?-->", r"\$\$.*?\$\$", r"\$[^$\n]+\$", r"`[^`]*`", r"^#.*?$", r"!\[[^\]]*\]",
    r"(?<=\])\([^)]*\)", r"\d+ x \d+(?: x \d+)*", r"Python \d\.\d+(?:(?:,| and| or| to) \d\.\d+)*",
    r"\bv?\d+\.\d+\.\d+\b", r"\b(?:19|20)\d\d\b", r"^ *\d+\. ", r"[A-Za-z_]\w*[-\d]\d[\w.]*", r"\b9[05] %",
)  # fmt: skip
UNSPOKEN_PATTERN = re.compile("|".join(f"(?:{each})" for each in UNSPOKEN), re.M | re.S)
UNITS = (
    r"mm²|mm|cm|m|[uµ]m|[uµ]T|mT|nT|N|Nm|N/m|kPa|MPa|kg|g|[kM]?Hz|degrees?|deg|°|pixels?|bits?|V|m/s|bytes?|threads?"
)
RESULTS = r"%|points?|times|ms|s|minutes?|min|hours?|MB|GB"
NUMBER = re.compile(
    rf"(?<![\w.])(\d[\d  ]*\.?\d*|\.\d+)(?=(?: to [\d.]+)? ?-? ?({RESULTS})(?!\w)|)(?: ({UNITS})(?!\w))?"
)
PARAGRAPH = re.compile(r"^\|.*$|(?:^(?!\|).*\S.*$\n?)+", re.M)  # a row of a table is one
TABLE_ROW = re.compile(r"^\|.*$", re.M)
SMALL = 1000  # whole numbers below it are free


def findings(root: Path) -> Iterator[PageProblem]:
    """Results that sentences of the pages name and no table holds; the list of changes tells history."""
    for page in pages_of(root):
        if page.stem != "CHANGELOG":
            yield from numbers(page, page.read_text())


def numbers(page: Path, text: str) -> Iterator[PageProblem]:
    """Results that sentences of one page name and no table holds."""
    spoken = MARK.sub(blank, text) if page.stem == "README" else TABLE_ROW.sub(blank, text)
    spoken = UNSPOKEN_PATTERN.sub(blank, spoken)
    code = BLOCK.sub(blank, text)  # a comment in it is no heading
    ends = [found.start() for found in HEADING.finditer(code) if len(found[1]) <= 2]
    for paragraph in PARAGRAPH.finditer(text):
        begin = max((end for end in ends if end <= paragraph.start()), default=0)
        places = [text[begin : min((end for end in ends if end > paragraph.start()), default=len(text))]]
        for name, anchor in LINK.findall(paragraph[0]):
            other = page.parent / name if name else page
            if other.is_file():
                places.append(_section(text if other == page else other.read_text(), anchor))
        held = frozenset().union(*(_held(said, page.stem == "README" and said in text) for said in places))
        for found in NUMBER.finditer(spoken, paragraph.start(), paragraph.end()):
            if _is_result(found) and not _is_held(found, held):
                line = text.count("\n", 0, found.start()) + 1
                number = " ".join(filter(None, (found[1].strip(), found[2])))
                yield PageProblem(page, line, f"no table holds the number {number}")


def slug(heading: str) -> str:
    """The anchor that a heading has on the site."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _section(text: str, anchor: str) -> str:
    """The section of a page with an anchor, to the next heading of its level; the page where there is no anchor."""
    headings = list(HEADING.finditer(BLOCK.sub(blank, text)))
    found = next((each for each in headings if slug(each[2]) == anchor), None)
    if found is None:
        return text
    later = (each.start() for each in headings if each.start() > found.start() and len(each[1]) <= len(found[1]))
    return text[found.start() : next(later, len(text))]


def _value(found: re.Match[str]) -> tuple[float, int]:
    """A number, and its decimals."""
    digits = re.sub(r"\s", "", found[1]).rstrip(".")
    return float(digits), len(digits.partition(".")[2])


def _is_result(found: re.Match[str]) -> bool:
    value, decimals = _value(found)
    return bool(found[2]) or value >= SMALL or decimals > (1 if found[3] else 0)


def _is_held(found: re.Match[str], held: frozenset[float]) -> bool:
    value, decimals = _value(found)
    asked = [(value, decimals)]
    if found[2] in ("%", "point", "points"):
        asked.append((value / 100, decimals + 2))
    return any(abs(each - of) <= 0.5 * 10**-to + 1e-9 for of, to in asked for each in held)


@cache
def _held(text: str, marked_only: bool) -> frozenset[float]:
    """All numbers in the tables of a text."""
    text = "\n".join(found[0] for found in MARK.finditer(text)) if marked_only else text
    return frozenset(_value(found)[0] for row in TABLE_ROW.findall(text) for found in NUMBER.finditer(row))
