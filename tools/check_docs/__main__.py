"""Question: do the documents agree with the code and the results, and does the code follow the project's rules?

    python -m tools.check_docs             all checks, a minute
    python -m tools.check_docs --no-site   all checks without building the site

Each finding is one line, `file:line: sentence`, or a linter's own report. The exit code is 1 if there is a finding.

Pages: files, tests, commands and their options must exist; tables must match docs/results, and numbers in sentences
must appear in tables. mypy checks the Python of the pages; Sphinx builds the site and checks links and names.
Code: import-linter checks layers, cycles and forbidden imports; docstrings need their sections, which ruff compares
with the signature. pyproject.toml and docs/conf.py configure these tools.
"""

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from experiments.common.commands import command

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class CheckDocsArgs:
    """Check documents and code rules."""

    site: bool = True  # build the site too


def run(args: CheckDocsArgs) -> int:
    """Print all findings, and return the exit code."""
    from tools.check_docs import code, linters, numbers, pages

    with tempfile.TemporaryDirectory() as folder:
        running = linters.start(ROOT, Path(folder), site=args.site)
        mistakes = [*pages.findings(ROOT), *numbers.findings(ROOT), *code.findings(ROOT)]
        reports = linters.finish(running, Path(folder))
    for path, line, sentence in mistakes:
        print(f"{path.relative_to(ROOT)}:{line}: {sentence}")
    print(*reports, sep="\n", end="\n" if reports else "")
    if not mistakes and not reports:
        print("no findings")
    return 1 if mistakes or reports else 0


main = command(CheckDocsArgs, "tools.check_docs.__main__")

if __name__ == "__main__":
    sys.exit(main())
