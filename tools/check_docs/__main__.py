"""Are the documents true, and is the house in order?

    python -m tools.check_docs             all of it, a minute
    python -m tools.check_docs --no-site   without building the site

Each finding is one line, `file:line: sentence`. The exit code is 1 if there is any.

Pages: links, files, tests, names, commands and their options exist; Python calls what exists; tables repeat what was
measured (docs/results), and results that sentences name stand in tables. Code: a package imports from lower floors
only, nothing imports itself in a circle, and docstrings say what is taken and given. The site is built, and a warning
is a finding.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

from experiments.common.commands import command

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class CheckDocsArgs:
    """Check documents and house rules."""

    site: bool = True  # build the site as well


def run(args: CheckDocsArgs) -> int:
    """Print what is wrong; returns the exit code."""
    from tools.check_docs import code, numbers, pages

    found = [*pages.findings(ROOT), *numbers.findings(ROOT), *code.findings(ROOT)]
    if args.site:
        found += pages.site(ROOT)
    for path, line, sentence in found:
        print(f"{path.relative_to(ROOT)}:{line}: {sentence}")
    if not found:
        print("documents and house are in order")
    return 1 if found else 0


main = command(CheckDocsArgs, "tools.check_docs.__main__")

if __name__ == "__main__":
    sys.exit(main())
