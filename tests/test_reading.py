"""Pages can be read: their grade stays below 12, and pages explain or link each term of the glossary."""

import re
from pathlib import Path

import pytest
from helpers.reading_grade import COMMENT, FENCE, FORMULA, PICTURE, SYMBOL, reading_grade, sentences_of, syllables

DOCS = Path(__file__).parents[1] / "docs"
LISTS = ("glossary.md", "licences.md", "reference_api.md", "reference_commands.md")  # tables, or made from the code
PAGES = [DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md"]
PAGES += [path for path in sorted(DOCS.glob("*.md")) if path.name not in LISTS]
FIRST_PAGES = [DOCS / "start.md", *sorted(DOCS.glob("tutorial_*.md"))]
MAIN_PAGES = [*PAGES[:2], *FIRST_PAGES]  # those of a method may enumerate
MAIN_PAGES += [
    DOCS / f"{name}.md" for name in ("choosing", "collecting", "data", "gallery", "hardware", "index", "limits")
]
HIGHEST_GRADE = 12
LONGEST_SENTENCE = 50  # words, numbers and names included
# Those that a reader looks things up in, who knows the words by then.
REFERENCE = ("architecture", "compiled", "scaling", "testing")
EXPLAINED_PAGES = [PAGES[0], *(path for path in PAGES[2:] if path.stem not in REFERENCE)]
WRITTEN = re.compile(r"<!-- table: .*?<!-- end of table -->", re.S)  # from what was measured, which links nothing
# Terms that these pages use in their everyday sense: a depth image, what was measured, the nearest point, its peers.
EVERYDAY = {"depth", "measured", "nearest", "peer"}
# And these on pages that say more: a hammer's head, a surface's normal, what a method reaches.
OFTEN_EVERYDAY = {"block", "head", "normal", "product", "reach", "shear", "spatial", "target", "travel"}
INDENTED_CODE = re.compile(r"^ {4,}\S.*$", re.M)

COUNTED = {
    1: "the skin touched are trained sites size scale noise whole curve rules called chips",
    2: "reading pressure object surface measured edges tables samples pushes image cycle people quiet being region",
    3: "recording predicted area idea various previous radius beautiful example",
    4: "registration calibration simulated experiment variety",
    5: "magnetisation probability",
}


@pytest.mark.parametrize("count", COUNTED)
def test_syllables_are_counted_as_they_are_spoken(count):
    assert {word: syllables(word) for word in COUNTED[count].split()} == dict.fromkeys(COUNTED[count].split(), count)


def test_the_grade_is_that_of_the_formula():
    assert reading_grade("The cat sat on the mat.").grade == pytest.approx(0.39 * 6 + 11.8 - 15.59)
    two = reading_grade("A camera looks. The surface in front of it is measured.")
    assert two.grade == pytest.approx(0.39 * 11 / 2 + 11.8 * 15 / 11 - 15.59)
    hard = (
        "Notwithstanding considerable methodological disagreement, contemporary investigators characteristically "
        "acknowledge that probabilistic interpretation necessitates extraordinarily comprehensive documentation."
    )
    assert reading_grade(hard).grade > 20


def test_only_sentences_count():
    page = """
# An extraordinarily complicated heading

| a | table |
| --- | --- |

![An alternative text of a picture](figure.png)

The skin is soft, 1.5 mm thick. [It rests](there.md) on `i2t.types.Board`.

- An item is one.
<!-- nobody reads this -->

$$
E = m c^2 \\quad \\text{This is no sentence. Nor is this.}
$$

The mass $m$ is known.

```
python -m i2t.imagine
```
"""
    assert sentences_of(page) == [
        "The skin is soft, 1.5 mm thick.",
        "It rests on Widget.",
        "An item is one.",
        "The mass x is known.",
    ]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_a_page_reads_below_grade_12(path):
    found = reading_grade(path.read_text())
    assert found.sentences
    assert found.grade < HIGHEST_GRADE


@pytest.mark.parametrize("path", MAIN_PAGES, ids=lambda path: path.name)
def test_a_main_page_has_no_endless_sentence(path):
    found = sentences_of(path.read_text())
    assert [sentence for sentence in found if len(sentence.split()) > LONGEST_SENTENCE] == []


def _terms() -> list[str]:
    """The terms of the glossary, longest first."""
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \|$", (DOCS / "glossary.md").read_text(), re.M)[1:]
    terms = {term.strip(" `") for row in rows for term in re.sub(r" \([^)]*\)", "", row).split(", ")}
    return sorted(terms - EVERYDAY - {"---"}, key=len, reverse=True)


def _unexplained(page: str, everyday: frozenset[str] | set[str] = frozenset()) -> list[str]:
    """Terms whose first use is neither the text of a link nor emphasised, as what is explained there is."""
    text = page
    for unread in (FENCE, INDENTED_CODE, WRITTEN, COMMENT, PICTURE, FORMULA, SYMBOL):
        text = unread.sub("", text)
    text = re.sub(r"`[^`]*`|^#.*$|\]\([^)]*\)", lambda found: "]" if found[0].startswith("]") else "", text, flags=re.M)
    wrong = []
    for term in _terms():
        if term in everyday:
            continue
        use = re.compile(rf"(?<!\w){re.escape(term)}(?:s|es)?(?!\w)", re.I)
        if first := use.search(text):
            before, after = text[: first.start()], text[first.end() :]
            linked = before.rfind("[") > before.rfind("]") and after.find("]") >= 0
            emphasised = before.endswith("*") and after.startswith("*")
            if not (linked or emphasised):
                wrong.append(term)
        text = use.sub(lambda found: "_" * len(found[0]), text)  # a part of it is no term of its own
    return wrong


def test_the_glossary_is_read():
    assert {"depth patch", "pad", "skin", "R²", "belief"} <= set(_terms())


def test_a_first_use_that_explains_nothing_is_seen():
    assert _unexplained("# A skin\n\nThe skin has `pad` and [chips](glossary.md).") == ["skin"]
    assert (
        _unexplained("A [depth patch](glossary.md) shows what the *skin*, a soft layer, meets. The skin is soft.") == []
    )
    assert _unexplained("A depth patch, then a [depth patch](glossary.md).") == ["depth patch"]


@pytest.mark.parametrize("path", EXPLAINED_PAGES, ids=lambda path: path.name)
def test_pages_explain_or_link_each_term_at_its_first_use(path):
    everyday = set() if path in FIRST_PAGES else OFTEN_EVERYDAY
    assert _unexplained(path.read_text(), everyday) == []
