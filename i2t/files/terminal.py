"""Texts from files of somebody else, as a terminal may show them: one line that moves no cursor and rings no bell."""

import re

# Controls, ends of lines and paragraphs, marks that turn the direction of writing, and halves of characters.
_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: object) -> str:
    """A text in one line, with its control characters escaped; letters of every script stay.

    Args:
        text: A name, a path or a message.

    Returns:
        The text, with `\\x1b` for an escape and `\\n` for the end of a line.
    """
    return _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode(), str(text))
