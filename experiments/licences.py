"""The licences of what i2t needs: each direct dependency of pyproject.toml, with what its own package says.

    python -m experiments.licences --page docs/licences.md

Asks the packages that are installed, and names those that are not. Nothing is loaded from a network.
"""

import re
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any, NamedTuple

from experiments.common.commands import run_command

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
MAX_LICENCE_TEXT = 40  # characters; longer is the licence's whole text
NOT_INSTALLED = "not installed where this was made"


@dataclass(frozen=True)
class LicencesArgs:
    """Write the licences of the dependencies."""

    page: Path | None = None  # to write; printed by default

    def check(self) -> None:
        """Refuse a folder in the page's place."""
        if self.page is not None and self.page.is_dir():
            raise ValueError(f"--page {self.page}: is a folder; name the page")
        if self.page is not None and not self.page.parent.is_dir():
            raise ValueError(f"--page {self.page}: there is no folder {self.page.parent}; check the name")


class Dependency(NamedTuple):
    """A package that pyproject.toml names."""

    name: str
    needed_by: str  # "i2t" itself, or its extras
    licence: str


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    return run_command(LicencesArgs, argv, "experiments.licences", work=run)


def run(args: LicencesArgs) -> None:
    """Look up and write."""
    page = page_of(dependencies(tomllib.loads(PROJECT.read_text())["project"]))
    if args.page is None:
        print(page, end="")
        return
    args.page.write_text(page)
    print(f"wrote {args.page}")


def dependencies(project: dict[str, Any]) -> list[Dependency]:
    """The direct dependencies of a project.

    Args:
        project: The table of pyproject.toml.

    Returns:
        Each once, in the order of their names.
    """
    needed: dict[str, list[str]] = {}
    groups = {"i2t": project["dependencies"], **project["optional-dependencies"]}
    for group, requirements in groups.items():
        for requirement in requirements:
            name = re.match(r"[\w.-]+", requirement)
            if name is not None:
                needed.setdefault(name[0], []).append(group)
    return [
        Dependency(name, "i2t" if "i2t" in by else ", ".join(dict.fromkeys(by)), licence_of(name))
        for name, by in sorted(needed.items(), key=lambda item: item[0].lower())
    ]


def licence_of(name: str) -> str:
    """What an installed package says of its licence.

    Args:
        name: Of the package.

    Returns:
        An SPDX expression where there is one, else its own word or its classifiers.
    """
    try:
        about = distribution(name).metadata
    except PackageNotFoundError:
        return NOT_INSTALLED
    expression, *_ = about.get_all("License-Expression") or [""]
    kinds = [each.split(" :: ")[-1] for each in about.get_all("Classifier") or () if each.startswith("License :: ")]
    kinds = [kind for kind in kinds if kind != "OSI Approved"]
    text = "".join(about.get_all("License") or ()).strip()
    named = text if len(text) <= MAX_LICENCE_TEXT and "\n" not in text else ""
    return expression or named or ", ".join(kinds) or "stated in its files only"


def page_of(found: Sequence[Dependency]) -> str:
    """The page.

    Args:
        found: Dependencies.

    Returns:
        Markdown.
    """
    rows = [f"| {each.name} | {each.needed_by} | {each.licence} |" for each in found]
    head = [
        "# Licences of the dependencies",
        "",
        "i2t is under the MIT licence. It needs these packages and contains none of them; a column says whether i2t",
        "itself or an extra needs one. What each says of its licence is asked of the installed packages by",
        "",
        "```",
        "python -m experiments.licences --page docs/licences.md",
        "```",
        "",
        "| package | needed by | licence |",
        "| --- | --- | --- |",
    ]
    return "\n".join([*head, *rows]) + "\n"


if __name__ == "__main__":
    sys.exit(main())
