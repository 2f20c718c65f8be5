"""A session as a Rerun recording and as a page: both contain all recorded data."""

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from helpers.random_touches import make
from scipy.spatial.transform import Rotation

from i2t.collect.recorder import POSE_CHANNELS, WRENCH_CHANNELS
from i2t.dataset import Image, Record, Series, save_dataset, write_touch
from i2t.hardware.protocols import channel_names
from i2t.view import command
from i2t.view.contents import read_contents

LENS = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 15.5, "cy": 11.5}
BEGUN = 1.7e9
SAMPLES = 60


def touch(number, rng):
    """A recorded touch of the hexagon, with everything that `i2t.collect` keeps."""
    dataset = make(1, seed=number, objects=("hexagon",))
    dataset = replace(
        dataset,
        touches=dataset.touches._replace(T_w_o=np.eye(4)[None]),
        meta={"camera": json.dumps({**LENS, "model": "none", "coefficients": [0.0] * 5})},
    )
    time = BEGUN + 10 * number + np.arange(SAMPLES) / 100
    poses = np.tile(np.eye(4), (SAMPLES, 1, 1))
    poses[:, :3, :3], poses[:, 2, 3] = Rotation.from_euler("x", 180, degrees=True).as_matrix(), 0.05
    T_w_c = np.diag([1.0, -1.0, -1.0, 1.0])
    T_w_c[2, 3] = 0.1
    return Record(
        dataset,
        images={"depth": Image(np.full((24, 32), 1000, np.uint16), 1e-4, "m")},
        series={
            "tactile": Series(time, rng.normal(size=(SAMPLES, 15)) + 30, channel_names(5), "uT"),
            "ambient": Series(time[:1], np.full((1, 15), 30.0), channel_names(5), "uT"),
            "temperature": Series(time, np.full((SAMPLES, 5), 24.0), tuple("abcde"), "degrees Celsius"),
            "wrench": Series(time, rng.normal(size=(SAMPLES, 6)), WRENCH_CHANNELS, "N, Nm"),
            "pose": Series(time, poses.reshape(-1, 16), POSE_CHANNELS, "1, m"),
            "camera": Series(time[:1], T_w_c.reshape(1, 16), POSE_CHANNELS, "1, m"),
        },
        events=((float(time[3]), f"contact of touch {number}"),),
    )


@pytest.fixture
def session(tmp_path):
    rng = np.random.default_rng(0)
    for number in range(2):
        write_touch(tmp_path / "session", touch(number, rng), at=BEGUN + 10 * number)
    return tmp_path / "session"


def column(chunks, entity, component):
    """Values of a component of an entity, all rows in succession."""
    batches = [part.to_record_batch() for part in chunks if part.entity_path == entity]
    columns = [batch.column(component).to_pylist() for batch in batches if component in batch.schema.names]
    return [value for rows in columns for row in rows for value in row or ()]


@pytest.mark.full
def test_a_session_reads_back_from_its_recording(session, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    chunk = pytest.importorskip("rerun.chunk", reason="rerun-sdk is not installed")
    assert command.main([str(session), "--rerun", "--out", str(tmp_path / "out")]) == 0
    chunks = list(chunk.RrdReader(tmp_path / "out" / "session.rrd").stream())
    scalars = column(chunks, "/readings/chip0/x", "Scalars:scalars")
    contents = read_contents(session)
    expected = [record.series["tactile"].values[:, 0] - 30 for record in contents.records()]
    np.testing.assert_allclose(np.sort(scalars), np.sort(np.concatenate(expected)))
    assert len(column(chunks, "/force/z", "Scalars:scalars")) == 2 * SAMPLES
    assert {"contact of touch 0", "contact of touch 1"} <= set(column(chunks, "/events", "TextLog:text"))
    vertices = np.array(column(chunks, "/world/object", "Mesh3D:vertex_positions")).reshape(-1, 3)
    np.testing.assert_allclose(np.ptp(vertices, 0), np.ptp(contents.mesh.vertices, 0), rtol=1e-5)
    assert {part.entity_path for part in chunks} >= {
        *("/world/tool", "/world/tool/chips/field", "/world/camera", "/world/camera/image", "/patch", "/about")
    }


@pytest.mark.full
def test_a_page_holds_its_pictures_and_no_script(session, tmp_path, capsys):
    assert command.main([str(session), "--out", str(tmp_path / "out"), "--html"]) == 0
    page = (tmp_path / "out" / "session.html").read_text()
    assert page.count("<img") == 4  # readings, patches and two touches
    assert "simulated" in page
    assert "<script" not in page
    assert set(re.findall(r'src="(.{5})', page)) == {"data:"}
    assert not re.findall(r"https?://", page)
    for file in session.glob("touch-*.h5"):
        assert file.name in page
    assert command.main([str(session), "--out", str(tmp_path / "out"), "--html"]) == 2
    assert "exists already; pass --overwrite" in capsys.readouterr().err


@pytest.mark.full
def test_a_data_set_without_series_is_shown_too(tmp_path):
    save_dataset(tmp_path / "set.h5", make(3))
    assert command.main([str(tmp_path / "set.h5"), "--out", str(tmp_path), "--html", "--touches", "2"]) == 0
    page = (tmp_path / "set.html").read_text()
    assert page.count("<img") == 2
    assert "<td>2</td>" in page
    assert "<td>3</td>" not in page


def test_a_missing_package_is_reported_with_what_to_install(session, tmp_path, capsys, monkeypatch):
    for module, words in (("rerun", ["--rerun", "--out", str(tmp_path / "out")]), ("viser", [])):
        monkeypatch.setitem(sys.modules, module, None)
        assert command.main([str(session), *words]) == 2
        assert 'pip install -e ".[view]"' in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_invalid_mesh_options_are_refused(session, tmp_path, capsys):
    for options, why in (
        ([str(session), "--mesh", "nothing.stl"], "neither a mesh file"),
        (["star"], "need recorded touches"),
        ([str(session), "--unit", "cm"], "no effect"),
    ):
        assert command.main([*options, "--html", "--out", str(tmp_path / "out")]) == 2
        assert why in capsys.readouterr().err
