"""A missing extra or an unwritable folder is reported before any work."""

import sys
import tomllib
from pathlib import Path

import pytest

from experiments.recognize.arguments import RecordedArgs
from experiments.reconstruct.arguments import ReconstructArgs
from experiments.studies.arguments import StudyArgs
from i2t.cli.options import require_path, require_writable
from i2t.convert.commands import main as convert
from i2t.errors import EXTRAS, DeviceError, MissingExtraError
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.reskin.monitor import main as monitor
from i2t.objects import make_object, random_object

ROOT = Path(__file__).parents[1]


def test_every_extra_is_one_of_the_distribution_and_brings_its_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for package, extra in EXTRAS.values():
        words = " ".join(extras[extra]).lower()
        assert package.lower() in words, f"{extra} lacks {package}"


def test_an_experiment_looks_for_its_extra_before_it_works(tmp_path, monkeypatch):
    (tmp_path / "metrics.json").write_text("{}")  # of a finished run
    for module, asked in (
        ("skimage", ReconstructArgs()),
        ("skfem", StudyArgs("physics", pad_model=tmp_path)),
        ("sklearn", RecordedArgs((tmp_path / "metrics.json",), "label")),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match=r'pip install -e "\.\['):
            asked.check()


def test_a_command_checks_its_extra_before_it_works(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "touches").mkdir()
    assert convert(["lerobot", str(tmp_path / "touches"), str(tmp_path / "lerobot")]) == 2
    assert "needs pyarrow, which is missing: python -m pip install" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["touches"]


def test_a_device_without_its_driver_is_refused_like_any_missing_package(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "serial", None)
    assert monitor([]) == 2
    assert "the skin needs pyserial: python -m pip install" in capsys.readouterr().err
    with pytest.raises(DeviceError):
        ReSkin()


def test_a_random_object_is_refused_with_the_option_that_draws_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "manifold3d", None)
    assert len(make_object("hammer").mesh.faces) > 1000
    with pytest.raises(MissingExtraError, match=r'a random object needs manifold3d, .*"\.\[shapes\]"'):
        random_object(0)


def test_the_output_folder_is_checked(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="is a file; name a folder"):
        require_writable("--out", tmp_path / "file" / "below" / "it.png")
    with pytest.raises(ValueError, match=r"--views .*file: there is no such folder"):
        require_path("--views", tmp_path / "file", "folder")
    require_writable("--out", tmp_path / "new" / "it.png")
    monkeypatch.setattr("os.access", lambda path, mode: False)  # whoever tests may be allowed everything
    with pytest.raises(ValueError, match="is write-protected; name another place"):
        require_writable("--out", tmp_path / "new" / "it.png")
