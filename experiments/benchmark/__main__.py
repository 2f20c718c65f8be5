"""`python -m experiments.benchmark --help`.

What the sections need takes seconds to import, and their settings are options: names of sections are judged before.
"""

import sys
from collections.abc import Sequence

from i2t.cli import WRONG_USE

SECTION_NAMES = ("training", "rendering", "skin", "policy", "environment", "startup", "scaling", "logs")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    named = words[words.index("--sections") + 1 :] if "--sections" in words else []
    end = next((i for i, word in enumerate(named) if word.startswith("-")), len(named))
    unknown = [name for name in named[:end] if name not in SECTION_NAMES]
    if unknown or ("--sections" in words and not end):
        print(
            f"error: --sections is {' '.join(named[:end])!r}; choose from {', '.join(SECTION_NAMES)}", file=sys.stderr
        )
        return WRONG_USE
    from experiments.benchmark.run import main as measure

    return measure(words)


if __name__ == "__main__":
    sys.exit(main())
