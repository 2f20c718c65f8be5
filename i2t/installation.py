"""Where i2t runs, in a checkout of its repository or as a wheel, and the advice that works there.

The distribution is not on the package index: `pip install` finds the packages of an extra by their own names only.
"""

from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

DISTRIBUTION = "imagine2touch"
ROOT = Path(__file__).parents[1]  # folder that holds the package `i2t`


def checkout() -> Path | None:
    """Find the checkout of the repository from which this i2t is imported.

    Returns:
        The root folder of the checkout, or None if i2t was installed as a wheel.
    """
    return ROOT if (ROOT / "pyproject.toml").is_file() and (ROOT / "experiments").is_dir() else None


def training_command() -> str:
    """Name the command that trains a predictor.

    Returns:
        The experiment in a checkout, which also compares methods; otherwise, the command of the wheel.
    """
    return "python -m experiments.train" if checkout() else "i2t fit"


def training_commands() -> str:
    """Name all commands that train a predictor, for messages about the folders that they write.

    Returns:
        `i2t fit`, and the experiment in a checkout.
    """
    return "i2t fit" + (f" or {training_command()}" if checkout() else "")


def extra_advice(extra: str, package: str = "") -> str:
    """Word how to install an extra.

    Args:
        extra: Name of the extra, as in `pyproject.toml`.
        package: The only package of the extra that is needed, by its name on the index; by default, all are needed.

    Returns:
        A command: in a checkout it installs the extra, elsewhere the needed packages by their own names.
    """
    if checkout():
        return f'python -m pip install -e ".[{extra}]"'
    requirements = [Requirement(line) for line in metadata.requires(DISTRIBUTION) or ()]
    of_extra = [r for r in requirements if r.marker and r.marker.evaluate({"extra": extra})]
    if package:
        named = [r for r in of_extra if canonicalize_name(r.name) == canonicalize_name(package)]
        # An extra may leave a package out for this version of Python.
        of_extra = named or [Requirement(package)]
    return " ".join(["python -m pip install", *(f'"{r.name}{r.specifier}"' for r in of_extra)])
