"""Check that each result in a sentence appears in a table.

A result is a number without a unit of size, a percentage, a time, a ratio, or a count of at least a thousand. It must
appear, rounded to as many decimals, in a table of the sentence's section or of the page or section that the paragraph
links to. Exempt are whole numbers below a thousand, sizes of at most one decimal ("0.5 mm") or of images ("48 x 48"),
years, versions, and the levels 90 % and 95 %. In the README, rows of tables that are not generated from docs/results
count as sentences.
"""

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tools.check_docs.pages import BLOCK, PageProblem, blank, pages_of
from tools.reproduce.tables import MARK

LINK = re.compile(r"\]\(([\w./]+\.md)?(?:#([\w-]+))?\)")
HEADING = re.compile(r"^(#+) (.*)$", re.M)
EXEMPT = re.compile("|".join(f"(?:{pattern})" for pattern in (
    r"^```.*?^```", r"<!--.*?-->", r"\$\$.*?\$\$", r"\$[^$\n]+\$", r"`[^`]*`", r"^#.*?$", r"!\[[^\]]*\]",
    r"(?<=\])\([^)]*\)", r"\d+ x \d+(?: x \d+)*", r"Python \d\.\d+(?:(?:,| and| or| to) \d\.\d+)*",
    r"\bv?\d+\.\d+\.\d+\b", r"\b(?:19|20)\d\d\b", r"^ *\d+\. ", r"[A-Za-z_]\w*[-\d]\d[\w.]*", r"\b9[05] %",
)), re.M | re.S)  # fmt: skip
NUMBER = re.compile(
    r"(?<![\w.])(\d[\d  ]*\.?\d*|\.\d+)"
    r"(?=(?: to [\d.]+)? ?-? ?(%|points?|times|ms|s|minutes?|min|hours?|MB|GB)(?!\w)|)"  # makes it a result
    r"(?: (mm²|mm|cm|m|[uµ]m|[uµ]T|mT|nT|N|Nm|N/m|kPa|MPa|kg|g|[kM]?Hz|degrees?|deg|°|pixels?|bits?|V|m/s|bytes?|"
    r"threads?)(?!\w))?"  # makes it a size
)
PARAGRAPH = re.compile(r"^\|.*$|(?:^(?!\|).*\S.*$\n?)+", re.M)  # each row of a table is a paragraph
TABLE_ROW = re.compile(r"^\|.*$", re.M)


def findings(root: Path) -> Iterator[PageProblem]:
    """Find results in sentences of the pages that no table contains; the list of changes is history and exempt."""
    for page in pages_of(root):
        if page.stem != "CHANGELOG":
            yield from numbers(page, page.read_text())


def numbers(page: Path, text: str) -> Iterator[PageProblem]:
    """Find results in sentences of one page that no table contains."""
    prose = MARK.sub(blank, text) if page.stem == "README" else TABLE_ROW.sub(blank, text)
    prose = EXEMPT.sub(blank, prose)
    code = BLOCK.sub(blank, text)  # comments in code look like headings
    starts = [match.start() for match in HEADING.finditer(code) if len(match[1]) <= 2]
    for paragraph in PARAGRAPH.finditer(text):
        begin = max((start for start in starts if start <= paragraph.start()), default=0)
        places = [text[begin : min((start for start in starts if start > paragraph.start()), default=len(text))]]
        for name, anchor in LINK.findall(paragraph[0]):
            other = page.parent / name if name else page
            if other.is_file():
                places.append(_section(text if other == page else other.read_text(), anchor))
        tabulated = frozenset().union(*(_tabulated(place, page.stem == "README" and place in text) for place in places))
        for match in NUMBER.finditer(prose, paragraph.start(), paragraph.end()):
            if _is_result(match) and not _is_tabulated(match, tabulated):
                line = text.count("\n", 0, match.start()) + 1
                number = " ".join(filter(None, (match[1].strip(), match[2])))
                yield PageProblem(page, line, f"no table holds the number {number}")


def slug(heading: str) -> str:
    """Anchor of a heading on the site."""
    return re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-")


def _section(text: str, anchor: str) -> str:
    """Section of a page at an anchor, up to the next heading of its level; the whole page without an anchor."""
    headings = list(HEADING.finditer(BLOCK.sub(blank, text)))
    start = next((heading for heading in headings if slug(heading[2]) == anchor), None)
    if start is None:
        return text
    later = (
        heading.start() for heading in headings if heading.start() > start.start() and len(heading[1]) <= len(start[1])
    )
    return text[start.start() : next(later, len(text))]


def _value(match: re.Match[str]) -> tuple[float, int]:
    """Parse a number and count its decimals."""
    digits = re.sub(r"\s", "", match[1]).rstrip(".")
    return float(digits), len(digits.partition(".")[2])


def _is_result(match: re.Match[str]) -> bool:
    value, decimals = _value(match)
    return bool(match[2]) or value >= 1000 or decimals > (1 if match[3] else 0)


def _is_tabulated(match: re.Match[str], tabulated: frozenset[float]) -> bool:
    value, decimals = _value(match)
    forms = [(value, decimals)]
    if match[2] in ("%", "point", "points"):
        forms.append((value / 100, decimals + 2))
    return any(
        abs(tabulated_value - number) <= 0.5 * 10**-digits + 1e-9
        for number, digits in forms
        for tabulated_value in tabulated
    )


@cache
def _tabulated(text: str, marked_only: bool) -> frozenset[float]:
    """Numbers in the tables of a text, or in its generated tables only."""
    text = "\n".join(match[0] for match in MARK.finditer(text)) if marked_only else text
    return frozenset(_value(match)[0] for row in TABLE_ROW.findall(text) for match in NUMBER.finditer(row))
