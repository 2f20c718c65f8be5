"""Reader of STL, binary or text."""

import codecs
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from i2t.errors import DataError
from i2t.objects.formats.text import TRAILING_PADDING, parse_numbers, plain_text

HEADER_BYTES = 84  # size of a binary STL's header: any text, and the number of facets in the last four bytes
# facet of a binary STL file
FACET_DTYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def is_binary_stl(data: bytes) -> bool:
    """Test whether a file has exactly the size that the header of binary STL announces.

    Args:
        data: The file's bytes.

    Returns:
        Whether the size fits.
    """
    return len(data) == HEADER_BYTES + FACET_DTYPE.itemsize * int.from_bytes(data[80:HEADER_BYTES], "little")


def read_stl(path: Path, data: bytes) -> tuple[NDArray, NDArray, tuple[str, ...]]:
    """Read STL, binary or text, as in `i2t.objects.formats.faces.MeshReader`."""
    if not is_binary_stl(data) and (data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" not in data):
        corners = _text_facets(path, plain_text(path, data).lower())
    else:
        corners = _binary_facets(path, data)
    return corners, np.arange(len(corners)).reshape(-1, 3), ()


def _binary_facets(path: Path, data: bytes) -> NDArray:
    """Read the corners `(3 n, 3)` of the n facets of binary STL."""
    announced = int.from_bytes(data[80:HEADER_BYTES], "little")
    room, rest = divmod(len(data) - HEADER_BYTES, FACET_DTYPE.itemsize)
    # Programs that stream the facets write one of these numbers, and never correct it.
    if announced in (0, 2**31 - 1, 2**32 - 1) and room >= 0 and rest == 0:
        announced = room
    if announced > room:
        holds = f"it holds {max(room, 0)} facets where its header announces {announced}"
        raise DataError(f"{path}: is cut off or not an STL file: {holds}; export or copy it again")
    tail = data[HEADER_BYTES + FACET_DTYPE.itemsize * announced :]
    if len(tail) >= FACET_DTYPE.itemsize and tail.strip(TRAILING_PADDING):
        raise DataError(
            f"{path}: has {len(tail)} bytes after the {announced} facets that its header announces, perhaps another "
            "body; export it again, each body as a file"
        )
    return np.frombuffer(data, FACET_DTYPE, announced, HEADER_BYTES)["corners"].reshape(-1, 3).astype(np.float64)


def _text_facets(path: Path, text: bytes) -> NDArray:
    """Read the corners `(3 n, 3)` of the n facets of all solids of STL as text, in lower case."""
    if re.search(rb"\bend +(loop|facet)\b", text[:8192]):
        text = re.sub(rb"\bend +(loop|facet)\b", rb"end\1", text)
    text, ends = _without_titles(text)
    words, facet_words = text.split(), 21
    whole = len(words) // facet_words
    reason = ""
    if not ends:
        reason = "it does not begin with 'solid'"
    elif not ends[-1]:
        reason = f"it ends within a solid, after {whole} facets, without 'endsolid'"
    elif 2 * sum(ends) != len(ends):
        reason = "one of its solids has no 'endsolid'"
    if reason:
        raise DataError(f"{path}: is cut off or not an STL file: {reason}; export or copy it again")
    keywords = {0: b"facet", 1: b"normal", 5: b"outer", 6: b"loop", 7: b"vertex", 11: b"vertex", 15: b"vertex",
                19: b"endloop", 20: b"endfacet"}  # fmt: skip
    wrong = [i for place, word in keywords.items() for i in _first_mismatch(words[place::facet_words], word)]
    if wrong or len(words) % facet_words:
        raise DataError(
            f"{path}: facet {min([*wrong, whole]) + 1} is not written as a normal and a loop of three vertices; export "
            "it again, as triangles"
        )
    numbers = [
        parse_numbers(path, b" ".join(words[first + axis :: facet_words]), whole)
        for first in (8, 12, 16)
        for axis in range(3)
    ]
    return np.stack(numbers, 1).reshape(-1, 3)


def _without_titles(text: bytes) -> tuple[bytes, list[bool]]:
    """Remove the lines that begin or end a solid from STL as text, and return whether each of them ends one."""
    first, *others = text.split(b"solid")
    facets, ends, in_title = [first], [], False
    for part in others:
        if not in_title:
            before = facets[-1].rstrip(b" ")
            ends.append(before.endswith(b"end"))
            facets[-1] = before.removesuffix(b"end")
        title, line_end, rest = part.partition(b"\n")
        _, facet, row = title.partition(b" facet normal ")  # if everything is in one line
        in_title = not (facet or line_end)
        facets.append(facet + row + line_end + rest)
    return b"".join(facets), ends


def _first_mismatch(words: list[bytes], word: bytes) -> list[int]:
    """List the index of the first word that differs from the given one; empty if there is none."""
    if words.count(word) == len(words):
        return []
    return [next(i for i, other in enumerate(words) if other != word)]
