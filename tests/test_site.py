"""The site is built from the pages without a warning, every page is in it, and its code is of this checkout."""

import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from docutils.utils.math.latex2mathml import tex2mathml
from helpers.reading_grade import FENCE, FORMULA

from experiments import licences
from experiments.licences import Dependency, dependencies, page_of
from i2t.convert.commands import main as convert

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES_OF_INTEREST = ("reference_api", "reference_commands", "physics")
FIGURE = re.compile(r"!\[([^\]]*)\]\(([^)]+)\)")


def test_every_page_is_in_the_list_of_pages():
    listed = set(re.findall(r"^([\w*]+)$", (DOCS / "index.md").read_text(), re.M))
    patterns = [re.compile(line.replace("*", r"\w*") + "$") for line in listed]
    missing = [page.stem for page in DOCS.glob("*.md") if not any(p.match(page.stem) for p in patterns)]
    assert missing in ([], ["index"])
    assert all("*" in name or (DOCS / f"{name}.md").is_file() for name in listed)


def test_every_figure_has_a_text_for_those_who_cannot_see_it():
    for page in DOCS.glob("*.md"):
        for text, path in FIGURE.findall(page.read_text()):
            assert len(text) > 20, f"{page.name}: {path} has no text"


def test_every_formula_can_be_drawn_without_a_network():
    """As MathML. Arguments stand in braces, without which \\frac12 \\log is read as 12 over log."""
    formulas = [
        (page.name, formula)
        for page in DOCS.glob("*.md")
        for formula in FORMULA.findall(FENCE.sub("", page.read_text()))
    ]
    assert len({page for page, _ in formulas}) > 7
    for page, formula in formulas:
        assert "<mfrac" in tex2mathml(formula.strip("$"), as_block=True) or "\\frac" not in formula, page
        assert not re.search(r"\\(?:frac|hat|sqrt)\s*[^{\s]", formula), f"{page}: {formula}"


def test_the_readme_names_the_command_of_the_site():
    command = "python -m sphinx -W --keep-going docs build/site"
    assert command in (ROOT / "README.md").read_text()
    assert command in (DOCS / "conf.py").read_text()


def test_the_page_of_licences_names_every_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    found = dependencies(project)
    page = (DOCS / "licences.md").read_text()
    assert [each.name for each in found if f"| {each.name} | {each.needed_by} |" not in page] == []
    assert {each.licence for each in found if each.name == "numpy"} != {""}
    assert page_of([Dependency("numpy", "i2t", "BSD")]).endswith("| numpy | i2t | BSD |\n")
    assert licences.NOT_INSTALLED not in page
    assert licences.UNSTATED not in page


def test_a_licence_is_what_a_package_says_of_it_or_its_text():
    report = {
        "install": [
            {"metadata": {"name": "Torch", "license_expression": "MIT AND Zlib", "license": "long"}},
            {"metadata": {"name": "open3d", "license": "MIT"}},
            {"metadata": {"name": "lab", "license": "a\nb", "classifier": ["License :: OSI Approved :: BSD License"]}},
            {"metadata": {"name": "silent"}},
        ]
    }
    said = {"torch": "MIT AND Zlib", "open3d": "MIT", "lab": "BSD License", "silent": licences.UNSTATED}
    assert licences.read_report(report) == said
    assert licences.kind_of((ROOT / "LICENSE").read_text()) == "MIT"
    two = "Redistribution and use in source and\n   binary forms, with or without modification"
    assert licences.kind_of(two) == "BSD-2-Clause"
    assert licences.kind_of(f"{two} ... Neither the name of the holder") == "BSD-3-Clause"
    assert licences.kind_of("All rights reserved.") == ""


def test_licences_of_the_index_need_a_pip_that_tells_them(monkeypatch):
    monkeypatch.setattr(licences, "version", lambda name: "24.3.1")
    assert licences.ask_index([]) == {}
    with pytest.raises(ValueError, match="pip 25 or newer"):
        licences.ask_index(["torch"])


def test_advice_to_install_names_the_distribution():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["name"] == "imagine2touch"
    advice = re.compile(r"""pip install -?e? ?["'](\.|[\w.-]+)\[([\w,]+)\]""")
    pages = [*ROOT.glob("*.md"), *DOCS.glob("*.md")]
    code = [path for folder in ("i2t", "experiments") for path in (ROOT / folder).rglob("*.py")]
    found = [(path, *match) for path in [*pages, *code] for match in advice.findall(path.read_text())]
    assert len(found) > 10
    for path, name, extras in found:
        assert name in (".", "imagine2touch"), f"{path} advises {name}"
        assert set(extras.split(",")) <= project["optional-dependencies"].keys(), f"{path}: {extras}"


BARE = re.compile(
    r"pip install (?:-[\w-]+ )*(?!-|\.|[\"']?(?:\.|imagine2touch)\[|examples/|[\"']?\{)([\"']?[\w][\w.-]*)"
)


def test_no_advice_installs_a_single_library():
    """What a feature needs is an extra, whose versions go together; a library by itself may be too old or too new."""
    assert BARE.findall("pip install pyvista; pip install -U 'opencv>=4.8'") == ["pyvista", "'opencv"]
    for good in ("pip install -e .", 'pip install -e ".[view]"', "pip install -U 'imagine2touch[hardware]'"):
        assert not BARE.search(good)
    folders = ("i2t", "experiments", "examples", "notebooks", "docs")
    files = [
        path for folder in folders for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md", ".ipynb")
    ]
    assert len(files) > 300
    bare = [(path.name, each) for path in [ROOT / "README.md", *files] for each in BARE.findall(path.read_text())]
    assert bare == []


def test_packages_of_the_examples_need_the_distribution_by_its_name():
    files = sorted((ROOT / "examples").rglob("pyproject.toml"))
    assert files
    for path in files:
        needed = tomllib.loads(path.read_text())["project"]["dependencies"]
        names = {re.match(r"[\w.-]+", each)[0] for each in needed}
        assert "imagine2touch" in names, f"{path} does not need i2t's distribution"
        assert "i2t" not in names, f"{path} needs another's distribution"


@pytest.mark.full
@pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("sphinx", "furo", "myst_nb")), reason="the extra docs"
)
def test_the_site_is_built_without_a_warning(tmp_path):
    words = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "docs", str(tmp_path / "site")]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    made = {name: (tmp_path / "site" / f"{name}.html").read_text() for name in PAGES_OF_INTEREST}
    assert "load_predictor" in made["reference_api"]
    assert "Signed" in made["reference_api"] or "signed" in made["reference_api"]
    assert "--max-touches" in made["reference_commands"]
    for option in ("--square", "--dictionary", "--indenter"):  # of sub-commands
        assert option in made["reference_commands"], option
    assert "<math" in made["physics"]
    assert not re.search(r"<script[^>]*src=.https?:", made["physics"])
    assert 'src="_images/overview.png"' in (tmp_path / "site" / "index.html").read_text()


@pytest.mark.full
@pytest.mark.parametrize(
    "page", ["../README", "tutorial_own_object", "tutorial_own_skin", "tutorial_own_camera", "tutorial_recognise"]
)
def test_python_of_a_tutorial_runs_as_printed(page, tmp_path, monkeypatch):
    shutil.copytree(ROOT / "examples" / "data", tmp_path / "examples" / "data")  # and leaves nothing in the checkout
    monkeypatch.chdir(tmp_path)
    text = (DOCS / f"{page}.md").read_text()
    for command in re.findall(r"python -m i2t\.convert (presses [^`\n]*)", text):
        assert convert(command.split()) == 0
    blocks = re.findall(r"^```python\n(.*?)^```", text, re.M | re.S)
    assert len(blocks) == (3 if page == "../README" else 1)
    names: dict[str, Any] = {}
    for block in blocks:
        exec(block, names)
        if page == "tutorial_recognise":
            assert names["site"].T_w_t.shape == (4, 4)
            continue
        for name in ("reading", "std", "mean"):
            value = np.asarray(names.get(name, np.ones(15)))
            assert value.shape[-1] == 15
            assert np.isfinite(value).all()
    assert names.keys() & {"reading", "mean", "site"}
