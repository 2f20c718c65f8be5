"""The licences of what i2t needs: each direct dependency of pyproject.toml, with what its own package says.

    python -m experiments.licences --page docs/licences.md --index

Asks the packages that are installed. With `--index` pip asks the package index for what the others say of themselves
(pip 25 or newer; nothing is installed); without it they are named as not installed, and no network is needed.
"""

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any, NamedTuple

from experiments.common.commands import run_command

PROJECT = Path(__file__).parents[1] / "pyproject.toml"
MAX_LICENCE_TEXT = 40  # characters; longer is the licence's whole text
NOT_INSTALLED = "not installed where this was made"
PIP_VERSION = 25
UNSTATED = "stated in its files only"
# What the texts of licences say, most particular first: BSD's third clause is what two-clause BSD lacks.
TEXTS = (
    ("Permission is hereby granted, free of charge", "MIT"),
    ("Neither the name", "BSD-3-Clause"),
    ("Redistribution and use in source and binary forms", "BSD-2-Clause"),
)


@dataclass(frozen=True)
class LicencesArgs:
    """Write the licences of the dependencies."""

    page: Path | None = None  # to write; printed by default
    index: bool = False  # ask the package index about packages that are not installed

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
    found = dependencies(tomllib.loads(PROJECT.read_text())["project"])
    if args.index:
        asked = ask_index([each.name for each in found if each.licence == NOT_INSTALLED])
        found = [each._replace(licence=asked.get(each.name.lower(), each.licence)) for each in found]
    page = page_of(found)
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
    """Licence that an installed package states.

    Args:
        name: Of the package.

    Returns:
        An SPDX expression where there is one, else its own word, its classifiers, or what its file of the licence is.
    """
    try:
        package = distribution(name)
    except PackageNotFoundError:
        return NOT_INSTALLED
    about = package.metadata
    expression, *_ = about.get_all("License-Expression") or [""]
    said = said_of(expression, "".join(about.get_all("License") or ()), about.get_all("Classifier") or ())
    return said or _in_files(package) or UNSTATED


def ask_index(names: Sequence[str]) -> dict[str, str]:
    """Licences of packages that are not installed, as the package index states them.

    Args:
        names: Of the packages.

    Returns:
        What each says, by its name in lower case.

    Raises:
        ValueError: pip is too old or cannot tell; its last line says why.
    """
    if not names:
        return {}
    if int(version("pip").split(".")[0]) < PIP_VERSION:  # earlier ones leave licences out of their reports
        raise ValueError(f"--index: pip {PIP_VERSION} or newer is needed, and this one is older")
    ask = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--no-deps"]
    done = subprocess.run([*ask, "--report", "-", *names], capture_output=True, text=True)
    if done.returncode:
        why = done.stderr.strip().splitlines() or ["pip says nothing"]
        raise ValueError(f"--index: pip found no licences of {', '.join(names)}: {why[-1]}")
    return read_report(json.loads(done.stdout))


def read_report(report: dict[str, Any]) -> dict[str, str]:
    """The licences in a report of pip's.

    Args:
        report: Of `pip install --report`.

    Returns:
        What each package says, by its name in lower case.
    """
    abouts = [each["metadata"] for each in report["install"]]
    return {
        about["name"].lower(): said_of(
            about.get("license_expression", ""), about.get("license", ""), about.get("classifier", [])
        )
        or UNSTATED
        for about in abouts
    }


def said_of(expression: str, text: str, classifiers: Sequence[str]) -> str:
    """The licence that a package's metadata state.

    Args:
        expression: SPDX, or nothing.
        text: The field `License`: a word, a whole text, or nothing.
        classifiers: All of them.

    Returns:
        The expression, else the word, else the classifiers; empty where none is stated.
    """
    kinds = [each.split(" :: ")[-1] for each in classifiers if each.startswith("License :: ")]
    kinds = [kind for kind in kinds if kind != "OSI Approved"]
    word = text.strip() if len(text.strip()) <= MAX_LICENCE_TEXT and "\n" not in text.strip() else ""
    return expression or word or ", ".join(kinds)


def kind_of(text: str) -> str:
    """Name the licence of a text.

    Args:
        text: Of the whole licence.

    Returns:
        Its SPDX name; empty where it is none of `TEXTS`.
    """
    plain = " ".join(text.split())
    return next((name for words, name in TEXTS if words in plain), "")


def _in_files(package: Distribution) -> str:
    """Licence in the file that a package names as its licence."""
    named = package.metadata.get_all("License-File") or []
    files = [file for file in package.files or () if file.name in {Path(each).name for each in named}]
    kinds = dict.fromkeys(filter(None, (kind_of(file.read_text()) for file in files)))
    return f"{', '.join(kinds)} (its file {files[0].name})" if kinds else ""


def page_of(found: Sequence[Dependency]) -> str:
    """Page of the licences.

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
        "itself or an extra needs one. What each says of its licence is asked of the installed packages,",
        "and of the package index for those that are not installed, by",
        "",
        "```",
        "python -m experiments.licences --page docs/licences.md --index",
        "```",
        "",
        "| package | needed by | licence |",
        "| --- | --- | --- |",
    ]
    return "\n".join([*head, *rows]) + "\n"


if __name__ == "__main__":
    sys.exit(main())
