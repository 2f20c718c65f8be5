"""Are the documents true, and is the house in order?

    python -m tools.check_docs             all of it, a minute
    python -m tools.check_docs --no-site   without building the site

Each finding is one line, `file:line: sentence`, or a linter's own report. The exit code is 1 if there is any.

Pages: files, tests, commands and their options exist; tables repeat what was measured (docs/results), and results that
sentences name stand in tables. mypy checks their Python, and Sphinx, which builds the site, their links and names.
Code: floors, circles and forbidden imports are contracts of import-linter; docstrings say what is taken and given, and
ruff compares them with the signature. pyproject.toml and docs/conf.py configure these.
"""

import sys
import tempfile
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
    from tools.check_docs import code, linters, numbers, pages

    with tempfile.TemporaryDirectory() as folder:
        running = linters.start(ROOT, Path(folder), site=args.site)
        mistakes = [*pages.findings(ROOT), *numbers.findings(ROOT), *code.findings(ROOT)]
        reports = linters.finish(running, Path(folder))
    for path, line, sentence in mistakes:
        print(f"{path.relative_to(ROOT)}:{line}: {sentence}")
    print(*reports, sep="\n", end="\n" if reports else "")
    if not mistakes and not reports:
        print("documents and house are in order")
    return 1 if mistakes or reports else 0


main = command(CheckDocsArgs, "tools.check_docs.__main__")

if __name__ == "__main__":
    sys.exit(main())
