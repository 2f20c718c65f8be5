"""Advice fits where i2t runs, in a checkout or as a wheel; the distribution itself is not on the package index."""

import re
import sys
import tomllib
from pathlib import Path

import pytest

from i2t import installation
from i2t.errors import EXTRAS, MissingExtraError, require_extra
from i2t.hardware.ur.access import explain_missing_library

ROOT = Path(__file__).parents[1]
NAMES = {  # of the distributions that each extra brings to this version of Python
    extra: {
        re.split(r"[^\w-]", line)[0]
        for line in lines
        if "python_version" not in line or sys.version_info < (3, int(re.search(r"'3\.(\d+)'", line)[1]))
    }
    for extra, lines in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].items()
}


@pytest.fixture
def wheel(monkeypatch, tmp_path):
    """Nothing but the package is there."""
    monkeypatch.setattr(installation, "ROOT", tmp_path)


def test_a_checkout_is_advised_to_install_the_extra_and_to_train_by_the_experiment():
    assert installation.checkout() == ROOT
    assert installation.extra_advice("hardware", "pyserial") == 'python -m pip install -e ".[hardware]"'
    assert installation.training_command() == "python -m experiments.train"


def test_a_wheel_is_advised_to_install_packages_by_their_names_and_to_train_by_its_own_command(wheel):
    assert installation.checkout() is None
    assert installation.training_command() == "i2t fit"
    for extra in ("hardware", "view", "reconstruct", "lerobot"):
        advice = installation.extra_advice(extra)
        assert advice.startswith("python -m pip install ")
        assert set(re.findall(r'"([\w-]+)[<>=]', advice)) == NAMES[extra]


def test_a_wheel_is_advised_to_install_only_the_package_that_is_missing(wheel, monkeypatch):
    assert re.fullmatch(r'python -m pip install "rerun-sdk>=[\d.]+"', installation.extra_advice("view", "Rerun_SDK"))
    # An extra of another version of Python does not bring the package.
    assert installation.extra_advice("hardware", "some-driver") == 'python -m pip install "some-driver"'
    assert re.search(r'pip install "ur-rtde[>=\d.]*" on Python 3.11 or 3.12$', explain_missing_library())
    for module, (_, extra) in EXTRAS.items():
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match="which is missing: python -m pip install ") as error:
            require_extra(module, "it")
        assert "imagine2touch" not in str(error.value), extra
        assert str(error.value).count('"') == 2  # one package
