"""Difficulty of a page: the grade of Flesch and Kincaid (Kincaid et al., 1975), of a page's sentences.

    grade = 0.39 words / sentences + 11.8 syllables / words - 15.59

is about the years of school that a reader needs. Code, formulas, tables, headings, pictures and addresses are no
sentences and do not count; a name of code counts as a word of two syllables and a symbol as one of one, because a
reader takes it as a whole.
"""

import re
from typing import NamedTuple

FENCE = re.compile(r"^```.*?^```[^\n]*$", re.M | re.S)
COMMENT = re.compile(r"<!--.*?-->", re.S)
PICTURE = re.compile(r"!\[[^\]]*\]\([^)]*\)")
FORMULA = re.compile(r"^\$\$.*?^\$\$$", re.M | re.S)
SYMBOL = re.compile(r"(?<![\\$\w])\$[^$\n]+\$(?!\w)")
LINK = re.compile(r"\[([^\]]*)\]\([^)]*\)")
SYMBOL_NAME = "x"  # in place of a symbol
CODE_NAME = "Widget"  # two syllables, in place of a name of code
WORD = re.compile(r"[A-Za-z]+(?:'[a-z]+)?")
# What ends a sentence is followed by a capital or a digit; the points of 1.5 and of e.g. are not.
END = re.compile(r"(?<=[.!?])[\"')*_]*\s+(?=[\"'(*_]*[A-Z0-9])")
VOWELS = re.compile(r"[aeiouy]+")
# An e at the end is silent, also in -ed and -es, but not where it alone makes the end speakable (table, added, edges).
SILENT = re.compile(r"(?<=[^aeiouylr])e$|(?<=[aeiouy][lr])e$|(?<=[^td])ed$|(?<=[aeiouy]l)es$|(?<=[^aeiouycgsxzhl])es$")
APART = re.compile(r"i[ao](?!us)|ie[nt]|ea$|iu|riou|viou|riet|[aeiou]ing|[^q]ua|u[eo]us|ism$")  # two syllables, not one
TOGETHER = re.compile(r"[tcs]i(?:on|al|ous|ent|an)|gion")  # one, of which APART or VOWELS make two
ITEM = re.compile(r"^\s*(?:[-*]|\d+\.)\s+", re.M)


class ReadingGrade(NamedTuple):
    """The grade of a text, and what it is made of."""

    grade: float
    sentences: list[str]


def sentences_of(page: str) -> list[str]:
    """The sentences of a page in Markdown.

    Args:
        page: Its text.

    Returns:
        Each sentence of its paragraphs and items, in plain words.
    """
    text = FORMULA.sub("\n\n", COMMENT.sub("", FENCE.sub("\n\n", page)))
    text = LINK.sub(r"\1", PICTURE.sub("", text))
    text = SYMBOL.sub(SYMBOL_NAME, re.sub(r"`[^`]*`", CODE_NAME, text))
    paragraphs = re.split(r"\n\s*\n", ITEM.sub("\n\n", text))
    found = []
    for paragraph in paragraphs:
        lines = [line for line in paragraph.splitlines() if not line.lstrip().startswith(("#", "|", "    "))]
        for sentence in END.split(" ".join(line.strip() for line in lines)):
            if len(WORD.findall(sentence)) > 2:
                found.append(sentence.strip())
    return found


def syllables(word: str) -> int:
    """Number of syllables of a word, by its groups of vowels.

    Args:
        word: In English.

    Returns:
        At least one.
    """
    word = re.sub(r"[^a-z]", "", word.lower())
    if len(word) <= 3:
        return 1
    stem = SILENT.sub("", word)
    return max(len(VOWELS.findall(stem)) + len(APART.findall(stem)) - len(TOGETHER.findall(stem)), 1)


def reading_grade(page: str) -> ReadingGrade:
    """The grade of a page in Markdown.

    Args:
        page: Its text.

    Returns:
        The grade of Flesch and Kincaid, and the sentences that count.
    """
    sentences = sentences_of(page)
    words = [word for sentence in sentences for word in WORD.findall(sentence)]
    if not words:
        return ReadingGrade(0.0, [])
    spoken = sum(map(syllables, words))
    return ReadingGrade(0.39 * len(words) / len(sentences) + 11.8 * spoken / len(words) - 15.59, sentences)
