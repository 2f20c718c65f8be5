"""Triangles of STL, binary or text."""

import codecs
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.formats.text import PADDING, parse_numbers, plain_text

STL_HEADER, FACET_BYTES = 84, 50  # of binary STL
PLACEHOLDER_COUNTS = (0, 2**31 - 1, 2**32 - 1)  # that programs write which stream the facets and never go back
FACET = ((0, b"facet"), (1, b"normal"), (5, b"outer"), (6, b"loop"), (7, b"vertex"), (11, b"vertex"),
         (15, b"vertex"), (19, b"endloop"), (20, b"endfacet"))  # fmt: skip
FACET_WORDS = 21


def read_stl(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    """Read STL, binary or text, as in `i2t.objects.formats.faces.MeshReader`."""
    announced = int.from_bytes(data[80:84], "little")
    text = len(data) < STL_HEADER or len(data) != STL_HEADER + FACET_BYTES * announced
    if text and (data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" not in data):
        corners = _text_facets(path, plain_text(path, data).lower())
    else:
        corners = _binary_facets(path, data, announced)
    return corners, np.arange(len(corners)).reshape(-1, 3), ()


def _binary_facets(path: Path, data: bytes, announced: int) -> NDArray:
    """Corners `(3 n, 3)` of the n facets of binary STL."""
    room, rest = divmod(len(data) - STL_HEADER, FACET_BYTES)
    if announced in PLACEHOLDER_COUNTS and room >= 0 and rest == 0:
        announced = room
    if announced > room:
        holds = f"it holds {max(room, 0)} facets where its header announces {announced}"
        raise DataError(f"{path}: is cut off or no STL file: {holds}; export or copy it again")
    tail = data[STL_HEADER + FACET_BYTES * announced :]
    if len(tail) >= FACET_BYTES and tail.strip(PADDING):
        raise DataError(
            f"{path}: has {len(tail)} bytes after the {announced} facets that its header announces, perhaps another "
            "body; export it again, each body as a file"
        )
    facet = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    return np.frombuffer(data, facet, announced, STL_HEADER)["corners"].reshape(-1, 3).astype(np.float64)


def _text_facets(path: Path, text: bytes) -> NDArray:
    """Corners `(3 n, 3)` of the n facets of all solids of STL as text, in small letters."""
    if re.search(rb"\bend +(loop|facet)\b", text[:8192]):
        text = re.sub(rb"\bend +(loop|facet)\b", rb"end\1", text)
    text, ends = _without_titles(text)
    words = text.split()
    whole = len(words) // FACET_WORDS
    reason = ""
    if not ends:
        reason = "it begins with no 'solid'"
    elif not ends[-1]:
        reason = f"it ends within a solid, after {whole} facets, without 'endsolid'"
    elif 2 * sum(ends) != len(ends):
        reason = "one of its solids has no 'endsolid'"
    if reason:
        raise DataError(f"{path}: is cut off or no STL file: {reason}; export or copy it again")
    wrong = [i for place, word in FACET for i in _unlike_words(words[place::FACET_WORDS], word)]
    if wrong or len(words) % FACET_WORDS:
        raise DataError(
            f"{path}: facet {min([*wrong, whole]) + 1} is not written as a normal and a loop of three vertices; export "
            "it again, as triangles"
        )
    numbers = [
        parse_numbers(path, b" ".join(words[first + axis :: FACET_WORDS]), whole)
        for first in (8, 12, 16)
        for axis in range(3)
    ]
    return np.stack(numbers, 1).reshape(-1, 3)


def _without_titles(text: bytes) -> tuple[bytes, list[bool]]:
    """The facets of STL as text, without the lines that begin and end a solid; and which of these lines end one."""
    first, *others = text.split(b"solid")
    facets, ends, in_title = [first], [], False
    for part in others:
        if not in_title:
            before = facets[-1].rstrip(b" ")
            ends.append(before.endswith(b"end"))
            facets[-1] = before.removesuffix(b"end")
        title, line_end, rest = part.partition(b"\n")
        _, facet, row = title.partition(b" facet normal ")  # where all is in one line
        in_title = not (facet or line_end)
        facets.append(facet + row + line_end + rest)
    return b"".join(facets), ends


def _unlike_words(words: list[bytes], word: bytes) -> list[int]:
    """The place of the first of the words that is another; none where all are alike."""
    if words.count(word) == len(words):
        return []
    return [next(i for i, other in enumerate(words) if other != word)]
