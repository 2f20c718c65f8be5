"""Converters: known contents come out unchanged, real recordings as other readers read them, damage as a sentence."""

import csv
import gzip
import io
import json
import os
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
import trimesh
from helpers import authors_layout
from helpers.authors_layout import ReSkinData, write
from helpers.random_touches import make
from helpers.recordings import READING_NAMES, converted, refused, run, write_columns, write_session, write_table
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from i2t.convert import imagine2touch, npy
from i2t.dataset import save_dataset
from i2t.errors import DataError
from i2t.skin.boards import reskin_board
from i2t.types import ReturnCode

UT = 1e-3  # uT: fields of up to 2000 uT in float32, whose spacing there is 1.2e-4


# --- Imagine2touch -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "order", "ambient", "size"),
    [
        (36, "binary", "means", 53),
        (36, "ascii", "vectors", 48),
        (36, "binary", "records", 48),
        (36, "ascii", "tuples", 48),
        (1, "ascii", "tens", 12),
        (36, "binary", "tens of records", 12),
    ],
)
def test_the_authors_layout_is_converted_unchanged(tmp_path, n, order, ambient, size):
    truth = write(tmp_path / "src", "star", "1", n, order=order, ambient=ambient, size=size)
    dataset = converted("imagine2touch", tmp_path / "src", tmp_path / "dst")
    touches = dataset.touches
    assert len(dataset) == n
    assert (dataset.objects, dataset.sessions) == (("star",), ("star/experiment_1",))
    np.testing.assert_allclose(touches.reading, truth.reading, atol=UT)
    np.testing.assert_array_equal(touches.code, truth.code)
    # Each pixel takes the crop's pixel under its centre: (k + 1/2) / 48 of the way, counted in halves of pixels.
    under = [(2 * k + 1) * size // 96 for k in range(48)]
    depth = 1e-3 * truth.depth[:, under][:, :, under].astype(float)
    closest = depth.min((1, 2))
    np.testing.assert_allclose(touches.patch, np.minimum(depth - closest[:, None, None], 4e-3), atol=1e-9)
    np.testing.assert_allclose(touches.nearest, closest - 64e-3 - truth.approach, atol=1e-8)  # float32 of 0.05 m
    np.testing.assert_allclose(touches.T_w_t[:, :3, 3], truth.final, atol=1e-7)
    np.testing.assert_allclose(touches.T_w_t[:, :3, :3], truth.rotation, atol=1e-6)
    np.testing.assert_allclose(touches.force, truth.force, atol=1e-6)
    for unknown in (touches.T_w_o, touches.travel, touches.view):
        assert np.isnan(unknown).all()
    assert dataset.meta["remarks on star 1"] == "skin 3, warm day"


def test_a_layout_without_a_source_is_not_declared_real(tmp_path, capsys):
    write(tmp_path / "src", "star", "1", 2, size=8)
    words = ("imagine2touch", tmp_path / "src")
    assert converted(*words, tmp_path / "unsaid").source == "not stated"
    assert "state it with --source" in capsys.readouterr().out
    assert run("summary", tmp_path / "unsaid") == 0
    assert "2 touches, source not stated" in capsys.readouterr().out
    assert "is **not stated**" in (tmp_path / "unsaid" / "README.md").read_text()
    for source in ("real", "simulated"):
        assert converted(*words, tmp_path / source, "--source", source).source == source


def test_a_chip_that_sends_zeros_loses_only_its_samples(tmp_path, capsys):
    """Of ten samples a touch, in one every chip is silent; in another touch one chip is silent in all samples."""
    write(tmp_path / "src", "star", "1", 8, size=8)
    field = np.random.default_rng(0).normal(0, 400, (8, 10, 5, 3))
    field[2, 3] = 0
    field[5, :, 4] = 0
    warm = np.where((field == 0).all(-1, keepdims=True), 0.0, 27.0)
    nested = np.concatenate([warm, field], -1).reshape(8, 10, 1, 20)
    tactile = tmp_path / "src/star/star_tactile/experiment_1_reskin"
    authors_layout.save(tactile, nested)
    authors_layout.save(tactile.with_name(tactile.name + "_ambient"), np.ones((8, 15)))
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "dst", "--as-stated").touches
    heard = np.delete(np.arange(10), 3)
    mean = field.mean(1)
    mean[2] = field[2, heard].mean(0)
    np.testing.assert_allclose(touches.reading, mean.reshape(8, 15)[np.arange(8) != 5] - 1, atol=UT)
    printed = capsys.readouterr().out
    assert "left out: 1 touches in which a chip did not answer" in printed
    assert "chip 4 in 1" in printed


def test_objects_and_runs_keep_their_names_and_the_order_of_counting(tmp_path):
    for name, runs in (("star", ("1", "2", "10")), ("hammer", ("a",))):
        for seed, experiment in enumerate(runs):
            write(tmp_path / "src", name, experiment, 2, seed=seed, size=8)
    (tmp_path / "src" / "notes").mkdir()
    dataset = converted("imagine2touch", tmp_path / "src", tmp_path / "all")
    assert dataset.objects == ("hammer", "star")
    assert dataset.sessions == ("hammer/experiment_a", *(f"star/experiment_{run}" for run in (1, 2, 10)))
    for file in list((tmp_path / "src").rglob("experiment_*")):
        if not file.suffix:  # as np.save names them itself
            file.rename(file.with_name(file.name + ".npy"))
    star = converted("imagine2touch", tmp_path / "src" / "star", tmp_path / "one")
    np.testing.assert_array_equal(star.touches.reading, dataset.touches.reading[2:])


def test_images_turn_and_forces_change_axes_on_request(tmp_path):
    truth = write(tmp_path / "src", "star", "1", 3)
    options = ("--quarter-turns", 1, "--tool-forces", "--reach-mm", 50)
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "dst", *options).touches
    depth = 1e-3 * np.rot90(truth.depth.astype(float), axes=(1, 2))
    np.testing.assert_allclose(touches.patch, depth - depth.min((1, 2), keepdims=True), atol=1e-8)
    wrench = np.load(tmp_path / "src/star/star_forces/experiment_1_forces_torques")
    np.testing.assert_allclose(touches.force, -wrench[:, 2], atol=1e-6)


def test_a_hole_of_65535_is_not_a_surface_and_images_in_another_unit_are_noted(tmp_path, capsys):
    truth = write(tmp_path / "src", "star", "1", 2)
    files = [tmp_path / f"src/star/star_images/depth/experiment_1_depth_{k}.tif" for k in (1, 2)]
    for file, image in zip(files, truth.depth, strict=True):
        image[:, 10] = 65535
        tifffile.imwrite(file, image)
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "right").touches
    assert (touches.patch[:, :, 10] == np.float32(4e-3)).all()
    assert "correct --camera" not in capsys.readouterr().out
    for file, image in zip(files, truth.depth, strict=True):
        tifffile.imwrite(file, np.where(image < 65535, 10 * image, image).astype(np.uint16))
    tenths = converted("imagine2touch", tmp_path / "src", tmp_path / "tenths").touches
    printed = capsys.readouterr().out
    assert f"begins {1e3 * np.median(tenths.nearest):.3g} mm in front of the skin at the touches" in printed


def test_missing_files_give_unknown_values_and_notes(tmp_path, capsys):
    truth = write(tmp_path / "src", "star", "1", 2)
    image = truth.depth[0].copy()
    image[:, 10] = 0  # not measured, so no surface
    tifffile.imwrite(tmp_path / "src/star/star_images/depth/experiment_1_depth_1.tif", image)
    aside = truth.final - truth.approach[:, None] * truth.rotation[:, :, 2] + 3e-3 * truth.rotation[:, :, 0]
    authors_layout.save(tmp_path / "src/star/star_poses/experiment_1_prepare_contact", aside)
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "aside").touches
    assert (touches.patch[0, :, 10] == np.float32(4e-3)).all()
    assert np.isnan(touches.nearest).all()
    for folder in ("star_poses", "star_forces", "meta_data"):
        shutil.rmtree(tmp_path / "src/star" / folder)
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "less").touches
    np.testing.assert_allclose(touches.reading, truth.reading, atol=UT)
    for unknown in (touches.nearest, touches.force, touches.T_w_t):
        assert np.isnan(unknown).all()
    assert (touches.code == ReturnCode.UNDEFINED).all()
    output = capsys.readouterr().out
    assert all(name in output for name in ("final_contact", "rotations", "forces_torques", "contact_returns"))


# --- pickles -------------------------------------------------------------------------------------------------------


def as_npy(payload, shape=(1, 1, 4)):
    """An .npy file of an object array whose pickle is `payload`."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": shape})
    return stream.getvalue() + payload


class Hostile:
    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def test_hostile_pickles_are_refused_and_not_executed(tmp_path):
    """Each pickle would leave a file if any part of it were executed."""
    marker = tmp_path / "executed"
    touch = f"touch {marker}"
    command = touch.encode()
    array = np.empty((1, 1, 4), object)
    array[0, 0] = [1.0, 0.0, Hostile(os.system, touch), 0]
    for payload in (
        *(pickle.dumps(Hostile(os.system, touch), protocol) for protocol in range(6)),
        pickle.dumps(array, protocol=4),
        pickle.dumps(Hostile(eval, f"open({str(marker)!r}, 'w')")),
        pickle.dumps(Hostile(open, str(marker), "w")),
        pickle.dumps(Hostile(np.save, str(marker), 1)),
        b"cposix\nsystem\n(V" + command + b"\ntR.",
        b"(S'" + command + b"'\nios\nsystem\n.",  # INST
        b"(cos\nsystem\nS'" + command + b"'\no.",  # OBJ
        b"\x80\x02\x82\x01.",  # an extension code
        b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c" + bytes([len(command)]) + command + b"\x85R.",
        b"\x80\x02Pname\n.",  # a persistent identifier
    ):
        (tmp_path / "file").write_bytes(as_npy(payload))
        with pytest.raises(DataError, match="file: refused, because it asks for"):
            npy.read(tmp_path / "file")
    assert not marker.exists()
    os.system(touch)  # the payloads' command does leave the mark where it runs
    assert marker.exists()


def test_implausible_pickles_are_refused(tmp_path):
    loop = []
    loop.append(loop)
    laughs = [1.0] * 10  # lists that share one another: 10 ** 10 values in a few hundred bytes
    for _ in range(9):
        laughs = [laughs] * 10
    odd = (np.zeros(3, "M8[s]"), np.zeros(3, [("a", "f4")]), np.ma.masked_array([1.0]), np.zeros(3, "U5"))
    for payload in (
        *(pickle.dumps(value) for value in (laughs, loop, 2**20000, {"a": 1}, b"text", *odd)),
        b"\x80\x02r\xff\xff\xff\x7f.",  # a memo of 2^31 entries
        b"\x80\x02cnumpy\ndtype\n(X\x02\x00\x00\x00f8K\x00K\x01tR.",
        *(b"", b".", b"\x80\x04N"),
    ):
        (tmp_path / "file").write_bytes(as_npy(payload))
        with pytest.raises(DataError, match=r"file: "):
            npy.read(tmp_path / "file")


def test_arrays_of_any_age_are_read(tmp_path):
    contents = np.empty((2, 3), object)
    contents[0] = [1.5, None, "text"]
    matrix = np.asfortranarray(np.eye(2, 3, 1, ">i4"))
    contents[1] = [[np.float32(2.5), np.int64(-3), True], np.arange(6.0).reshape(2, 3), matrix]
    expected = [[1.5, None, "text"], [[2.5, -3, True], [[0, 1, 2], [3, 4, 5]], [[0, 1, 0], [0, 0, 1]]]]
    new, old = b"numpy._core.multiarray", b"numpy.core.multiarray"
    payloads = [pickle.dumps(contents, protocol) for protocol in range(5)]
    # Up to protocol 3 the name stands as text, and its length does not.
    for payload in (*payloads, *(payload.replace(new, old) for payload in payloads[:4])):
        (tmp_path / "file").write_bytes(as_npy(payload, (2, 3)))
        assert npy.read(tmp_path / "file") == expected
    (tmp_path / "file").write_bytes(as_npy(pickle.dumps(contents, 5), (2, 3)))
    with pytest.raises(DataError, match="refused"):  # NumPy's buffers of protocol 5 are never written by np.save
        npy.read(tmp_path / "file")


def test_a_named_tuple_is_read_by_its_name_and_no_pickle_affects_later_ones(tmp_path):
    authors_layout.save(tmp_path / "file", np.array([{"a": 1}], dtype=object))
    with pytest.raises(DataError, match="asks for a dict"):
        npy.read(tmp_path / "file")
    # BUILD with a state for slots sets attributes of what is on the stack, here of a stand-in class itself.
    (tmp_path / "poison").write_bytes(as_npy(b"\x80\x02cx\nReSkinData\n(N}X\x07\x00\x00\x00__new__Nstb."))
    with pytest.raises(DataError):
        npy.read(tmp_path / "poison")
    listed = np.empty(1, object)
    listed[0] = ReSkinData(1.0, 2.0, [3.0], 4)
    authors_layout.save(tmp_path / "file", listed)
    assert b"reskin_sensor" in (tmp_path / "file").read_bytes()
    assert npy.read(tmp_path / "file") == [[1.0, 2.0, [3.0], 4]]


@given(data=st.data())
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_mutated_files_are_read_or_refused(tmp_path, data):
    path = tmp_path / "file"
    listed = np.empty((1, 2), object)
    listed[0] = [ReSkinData(1.0, 2.0, [3.0, np.float64(2)], 4), np.zeros(2)]
    authors_layout.save(path, listed)
    contents = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, len(contents) - 1))
        contents[place : place + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=3))
    path.write_bytes(contents)
    try:
        assert isinstance(npy.read(path), list | np.ndarray)
    except DataError as error:
        assert str(error).startswith(str(path))  # noqa: PT017 - either outcome is right, and only these two


# --- damage --------------------------------------------------------------------------------------------------------

IMAGE = "star/star_images/depth/experiment_1_depth_2.tif"
TACTILE = "star/star_tactile/experiment_1_reskin"
POSES = "star/star_poses/experiment_1_"
FORCES = "star/star_forces/experiment_1_"
STATES, VALUES = "a/states.csv", "a/sensor_post_baselines.csv"
TABLE = "table.csv"


def cut(path):
    path.write_bytes(path.read_bytes()[: int(0.6 * path.stat().st_size)])


SOUND = [value for chip in range(5) for value in (27.0, 100 * chip, -50 * chip, 300 - 90 * chip)]


def samples(values=SOUND, changed=None):
    """Tactile samples of 12 touches, the second perhaps with another field."""
    items = [[[0.0, 0.0, list(values), 2]] for _ in range(12)]
    items[1][0][2][2] = values[2] if changed is None else changed
    return np.array(items, dtype=object)


def image(shape, kind=np.uint16, value=1):
    return lambda path: tifffile.imwrite(path, np.full(shape, value, kind))


def stored(values):
    return lambda path: authors_layout.save(path, values)


def holds(data):
    return lambda path: path.write_bytes(data)


def edit(old, new):
    return lambda path: path.write_bytes(path.read_bytes().replace(old, new, 1))


def swap_lines(path):
    first, second, *rest = path.read_text().splitlines()
    path.write_text("\n".join([second, first, *rest]))


DAMAGE = [
    ("imagine2touch", IMAGE, Path.unlink, "is missing"),
    ("imagine2touch", IMAGE, cut, "not a readable TIF"),
    ("imagine2touch", IMAGE, image((48, 48), np.float32), "crop of uint16"),
    ("imagine2touch", IMAGE, image((48, 40)), "should be square"),
    ("imagine2touch", IMAGE, image((48, 48), value=0), "no pixel was measured"),
    ("imagine2touch", IMAGE.replace("_2.", "_13."), image((48, 48)), "one image more"),
    ("imagine2touch", TACTILE, cut, "damaged"),
    ("imagine2touch", TACTILE, edit(b"(12, 1, 4)", b"(13, 1, 4)"), "where its header says"),
    ("imagine2touch", TACTILE, stored(np.empty((0, 1, 4), object)), "holds no touch"),
    ("imagine2touch", TACTILE, stored(samples([1.0] * 19)), "a list of 19 where a sample"),
    ("imagine2touch", TACTILE, stored(samples(changed=np.nan)), "item 2 holds a value that is not a field"),
    ("imagine2touch", TACTILE, stored(samples(changed=10**400)), "an integer of absurd size"),
    ("imagine2touch", TACTILE, stored(samples([27.0] * 20)), "pass --order"),
    ("imagine2touch", TACTILE, holds(as_npy(pickle.dumps(Hostile(os.system, "true")))), "refused, because it asks for"),
    ("imagine2touch", TACTILE + "_ambient", stored(np.ones((5, 15))), "holds 5 groups for 12 touches"),
    ("imagine2touch", POSES + "rotations", stored(np.zeros((12, 3))), "(12, 3) where 12 touches"),
    ("imagine2touch", POSES + "rotations", stored(np.tile([0, 0, 0, 2.0], (12, 1))), "not of length 1"),
    ("imagine2touch", POSES + "prepare_contact", stored(np.full((12, 3), 1e300)), "not finite"),
    ("imagine2touch", FORCES + "contact_returns", stored(np.full(12, 0.5)), "not a return code"),
    ("imagine2touch", FORCES + "forces_torques", stored(np.full((12, 6), np.inf)), "not finite"),
    ("eflesh", VALUES, Path.unlink, "is missing"),
    ("eflesh", STATES, edit(b",", b",word"), "is not a table of numbers"),
    ("eflesh", VALUES, edit(b"1700000000.0,", b"nan,"), "not finite"),
    ("eflesh", STATES, swap_lines, "time does not increase at row 2"),
    ("eflesh", STATES, lambda path: path.write_text(path.read_text().rstrip().rpartition("\n")[0]), "no partner"),
    ("eflesh", "b/states.csv.gz", cut, "states.csv.gz: "),
    ("presses", TABLE, edit(b"travel_mm", b"travel"), "column travel_mm is missing"),
    ("presses", TABLE, edit(b"x_mm,y_mm", b"x_mm,y_mm,x_mm"), "appears twice"),
    ("presses", TABLE, edit(b"b4z_uT", b"b4z_uT,a0x_uT"), "give all or none"),
    ("presses", TABLE, edit(b"b4z_uT", b"b4z_uT,b5x_uT,b5y_uT,b5z_uT"), "belongs to no chip of the board, which has 5"),
    ("presses", TABLE, lambda path: path.write_text(path.read_text() + "1,2\n"), "line 8 has 2 fields instead of 18"),
    ("presses", TABLE, holds(b"\xff\xfe\x00"), "is not text"),
]
LEFT = {"imagine2touch": (3, 3 + 11), "eflesh": (20, 20 + 19)}  # another run, and what is good of the damaged one


def made_up_session(folder, n=20, ending="csv"):
    """A spatial session in eFlesh's layout with positions (n, 3) mm and values (n, 15) uT."""
    rng = np.random.default_rng(3)
    place = np.column_stack([rng.uniform(270, 300, n), rng.uniform(-110, -90, n), rng.uniform(141, 145, n)])
    values = rng.normal(0, 100, (n, 15))
    write_session(folder, place, values, ending)
    return place, values


def presses_table(path, n=6, ambient=False, chips=5, **more):
    """The columns of a table of presses."""
    names = [f"b{chip}{axis}_uT" for chip in range(chips) for axis in "xyz"]
    rng = np.random.default_rng(5)
    columns = {"x_mm": rng.uniform(-8, 8, n), "y_mm": rng.uniform(-8, 8, n), "travel_mm": rng.uniform(0, 2, n)}
    columns |= {name: rng.normal(0, 50, n) for name in names}
    columns |= {"a" + name[1:]: rng.normal(0, 50, n) for name in names if ambient}
    return write_columns(path, columns | more)


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    """A small recording of each kind."""
    root = tmp_path_factory.mktemp("intact")
    for seed, n in enumerate((12, 3)):
        write(root / "imagine2touch", "star", str(seed + 1), n, size=8, seed=seed)
    made_up_session(root / "eflesh" / "a")
    made_up_session(root / "eflesh" / "b", ending="csv.gz")
    presses_table(root / "presses" / TABLE)
    return root


def test_a_damaged_touch_ends_a_conversion_unless_it_is_skipped(intact, tmp_path):
    source = shutil.copytree(intact / "imagine2touch", tmp_path / "src")
    stored(samples(changed=np.nan))(source / TACTILE)
    with pytest.raises(DataError, match="item 2"):
        imagine2touch.convert(source, board=reskin_board())


@pytest.mark.parametrize(("command", "name", "damage", "problem"), DAMAGE)
def test_each_damage_is_one_sentence_that_names_the_file_and_can_be_skipped(
    intact, tmp_path, capsys, command, name, damage, problem
):
    source = shutil.copytree(intact / command, tmp_path / "src")
    path = source / name
    damage(path)
    words = (source, tmp_path / "dst") if command in LEFT else (path, tmp_path / "dst", "--indenter", "sphere:4")
    sentence = refused(capsys, command, *words)
    assert problem in sentence
    # Of several files of poses that disagree, and of the two files of a session, what they share is named.
    together = f"{path.parent / 'experiment_1'}: " if command == "imagine2touch" else str(path.parent)
    assert str(path) in sentence or together in sentence
    assert not (tmp_path / "dst").exists()
    if command in LEFT:
        assert len(converted(command, *words, "--skip-bad")) in LEFT[command]
        assert "left out: " in capsys.readouterr().out


def test_each_wrong_number_is_one_sentence_and_its_row_can_be_skipped(tmp_path, capsys):
    words = ("presses", tmp_path / TABLE, tmp_path / "dst", "--indenter", "sphere:4")
    for name, value in (
        ("b0x_uT", "nan"),
        ("b0x_uT", ""),
        ("b0x_uT", "NA"),
        ("x_mm", "#N/A"),
        ("force_N", "inf"),
        ("x_mm", "1e300"),
    ):
        presses_table(tmp_path / TABLE, **{name: [value] + [0.0] * 5})
        assert f"line 2 has {value!r} in column {name}" in refused(capsys, *words)
    assert len(converted(*words, "--skip-bad")) == 5


def test_invalid_options_are_refused_in_one_sentence(intact, tmp_path, capsys):
    sphere = ("--indenter", "sphere:4")
    for options, problem in (
        (("--indenter", "cube:3"), "its shape 'cube' is unknown; give sphere:RADIUS"),
        (("--indenter", "sphere:-1"), "its radius is -1, and must be positive"),
        (("--indenter", "sphere:0"), "its radius is 0, and must be positive"),
        (("--indenter", "sphere:nan"), "its radius is nan, and must be positive"),
        (("--indenter", "sphere"), "its radius is missing; give it in mm, such as sphere:4"),
        (("--indenter", "cylinder:"), "its radius is missing; give it in mm, such as cylinder:4"),
        (("--indenter", "sphere:4mm"), "without a unit, such as sphere:4"),
        (("--indenter", "sphere:2,5"), "without a unit, such as sphere:2.5"),
        (("--indenter", "sphere:4000"), "its radius of 4000 mm is larger than 100 mm"),
        (("--indenter", "sphere:inf"), "its radius of inf mm is larger than 100 mm"),
        (("--indenter", "sphere:0.004"), "smaller than 0.1 mm; give it in mm, not in m"),
        (("--indenter", "spere:4"), "its shape 'spere' is unknown; did you mean sphere?"),
        (("--indenter", "flat"), "its shape 'flat' is unknown; give sphere:RADIUS"),
        (("--indenter", "tip.stl", "--unit", "mm"), "a mesh is given by its file, as mesh:tip.stl"),
        (("--indenter", "mesh:", "--unit", "mm"), "a mesh is given by its file, as mesh:FILE"),
        (("--indenter", "mesh:none.stl", "--unit", "mm"), "none.stl"),
        ((*sphere, "--board", "five"), "--board five: Board 'five' is not known"),
        ((*sphere, "--window-mm", 0.01), "no press lies inside the window of 0.01 mm; widen"),
        ((*sphere, "--reach-mm", "nan"), "--reach-mm"),
    ):
        assert problem in refused(capsys, "presses", intact / "presses" / TABLE, tmp_path / "dst", *options)
    assert not (tmp_path / "dst").exists()


# --- eFlesh --------------------------------------------------------------------------------------------------------


def table(path):
    """A table as plain text and float() read it."""
    with gzip.open(path, "rt") as file:
        return np.array([[float(cell) for cell in row] for row in csv.reader(file)])


def test_real_spatial_presses_are_converted_unchanged(shared_data, tmp_path):
    source = shared_data / "eflesh" / "spatial"
    folder = next(source.iterdir())
    dataset = converted("eflesh", source, tmp_path / "dst", "--as-stated")
    states, values = table(folder / "states.csv.gz"), table(folder / "sensor_post_baselines.csv.gz")
    touches = dataset.touches
    assert (len(dataset), dataset.source, dataset.window) == (4805, "real", 0.04)
    np.testing.assert_array_equal(touches.reading, values[:, 1:].astype(np.float32))
    # The tip in the tool frame is where T_w_o puts it: the robot's place, from the middle of its range and its top.
    place = 1e-3 * (states[:, 1:] - [289, -100, states[:, 3].max()])
    np.testing.assert_allclose(touches.T_w_o[:, :3, 3], place, atol=1e-8)
    np.testing.assert_array_equal(touches.T_w_t, np.tile(np.eye(4), (4805, 1, 1)))
    np.testing.assert_allclose(touches.travel, -place[:, 2], atol=1e-9)
    np.testing.assert_allclose(touches.nearest, place[:, 2], atol=1e-9)
    assert touches.travel.min() == 0
    assert np.isnan(touches.force).all()
    # A ray up tool z through a pixel first meets the sphere |p - c| = R, c = (x, y, R), where its quadratic says so.
    rng = np.random.default_rng(0)
    pixel = ((np.arange(48) + 0.5) / 48 - 0.5) * 40e-3
    radius = 4e-3
    for k in rng.choice(4805, 200, replace=False):
        row, column = (int(np.argmin(np.abs(pixel - p))) for p in (place[k, 1], place[k, 0]))
        assert touches.patch[k].min() == touches.patch[k, row, column]
        i, j = np.clip(np.array([row, column]) + rng.integers(-4, 5, 2), 0, 47)
        r2 = (pixel[j] - place[k, 0]) ** 2 + (pixel[i] - place[k, 1]) ** 2
        roots = np.roots([1, -2 * radius, r2])  # z^2 - 2 R z + r^2 = 0
        met = min(roots.real) if np.isreal(roots).all() else np.inf
        np.testing.assert_allclose(touches.patch[k, i, j], min(met, 4e-3), atol=1e-9)


def test_real_normal_presses_carry_their_load_and_strokes(shared_data, tmp_path):
    source = shared_data / "eflesh" / "normal"
    options = ("--pad", "one skin", "--z0-mm", 286.5, "--reach-mm", 2, "--as-stated")
    dataset = converted("eflesh", source, tmp_path / "dst", *options)
    states = np.concatenate([table(folder / "states.csv.gz") for folder in sorted(source.iterdir())])
    force = np.where(states[:, 4] == -1, np.nan, states[:, 4] * 1e-3 * 9.80665)
    np.testing.assert_allclose(dataset.touches.force, force, rtol=1e-6)
    assert (len(dataset), dataset.pads) == (7200, ("one skin",))
    assert set(dataset.summary()["sessions"].values()) == {360}  # 10 strokes of each session, none torn
    assert len(dataset.sessions) == 20
    height = states[:, 3].reshape(20, 360)
    assert (height[:, [0, -1]] > 287.9).all()  # each begins and ends at the top
    np.testing.assert_array_equal(dataset.touches.code == ReturnCode.FREE, states[:, 3] > 286.5)
    np.testing.assert_allclose(dataset.touches.travel, np.maximum(0, 286.5 - states[:, 3]) * 1e-3, atol=1e-8)


@pytest.mark.full
def test_real_shear_recordings_are_two_pads(shared_data, tmp_path, capsys):
    source = shared_data / "eflesh" / "shear"
    dataset = converted("eflesh", source, tmp_path / "dst")
    values = table(next(source.iterdir()) / "sensor_post_baselines.csv.gz")
    assert len(dataset.pads) == 2
    for i in (0, 1):
        mine = dataset.select(dataset.touches.pad == i)
        np.testing.assert_array_equal(mine.touches.reading, values[:, 1 + 15 * i : 16 + 15 * i].astype(np.float32))
    assert np.isnan(dataset.touches.force).all()
    assert np.isnan(dataset.touches.travel).all()
    assert "shear force" in capsys.readouterr().out


def test_a_row_with_zeros_of_a_chip_is_left_out_and_a_difference_of_zero_is_kept(tmp_path, capsys):
    place, values = made_up_session(tmp_path / "src" / "a")
    values[4] = 0  # every chip of the differences
    raw = values + np.linspace(20, 40, 15)
    raw[7, 3:6] = 0
    write_session(tmp_path / "src" / "a", place, values)
    words = ("eflesh", tmp_path / "src")
    assert len(converted(*words, tmp_path / "alone")) == 19
    time = 1.7e9 + 4.25 * np.arange(20)
    write_table(tmp_path / "src/a/sensor.csv", (), np.column_stack([time, raw]))
    values[7, 3:6] = 0 - np.linspace(20, 40, 15)[3:6]
    write_session(tmp_path / "src" / "a", place, values)
    touches = converted(*words, tmp_path / "raw", "--as-stated").touches
    np.testing.assert_allclose(touches.reading, np.delete(values, 7, 0), rtol=1e-6)
    assert "chip 1 in 1" in capsys.readouterr().out


# --- tables of presses ---------------------------------------------------------------------------------------------


def test_a_table_of_presses_is_converted_unchanged(tmp_path):
    more = {"force_N": ["1", "", "2.5", "3", "4", "5"], "run": list("aabbcc"), "pad": list("xyxyxy")}
    columns = presses_table(tmp_path / TABLE, ambient=True, **more)
    dataset = converted("presses", tmp_path / TABLE, tmp_path / "dst", "--indenter", "sphere:4.0")
    touches = dataset.touches
    reading = np.column_stack([columns[name] - columns["a" + name[1:]] for name in READING_NAMES])
    np.testing.assert_allclose(touches.reading, reading, atol=UT)
    np.testing.assert_allclose(touches.force, [1, np.nan, 2.5, 3, 4, 5])
    np.testing.assert_allclose(touches.travel, 1e-3 * columns["travel_mm"], rtol=1e-6)
    np.testing.assert_allclose(touches.nearest, -touches.travel)
    place = 1e-3 * np.column_stack([columns["x_mm"], columns["y_mm"], -columns["travel_mm"]])
    np.testing.assert_allclose(touches.T_w_o[:, :3, 3], place, atol=1e-9)
    assert [dataset.sessions[i] for i in touches.session] == more["run"]
    assert [dataset.pads[i] for i in touches.pad] == more["pad"]
    assert (dataset.objects, dataset.source) == (("sphere:4.0",), "real")


def test_presses_of_a_silent_board_are_left_out_and_counted(tmp_path, capsys):
    words = (tmp_path / TABLE, tmp_path / "dst", "--indenter", "sphere:4", "--overwrite", "--as-stated")
    for zero in (0.0, "", "0.00"):
        columns = presses_table(tmp_path / TABLE, n=60)
        silent = np.arange(60) % 6 == 2
        quiet = {name: np.where(silent, str(zero), columns[name].astype(str)) for name in READING_NAMES}
        write_columns(tmp_path / TABLE, columns | quiet)
        touches = converted("presses", *words).touches
        kept = np.column_stack([columns[name][~silent] for name in READING_NAMES])
        np.testing.assert_allclose(touches.reading, kept, atol=UT)
        assert "left out: 10 presses in which a chip did not answer" in capsys.readouterr().out
    write_columns(tmp_path / TABLE, columns | {name: np.zeros(60) for name in READING_NAMES[3:6]})
    assert "chip 1 does not answer in any of its 60 presses" in refused(capsys, "presses", *words)
    write_columns(tmp_path / TABLE, columns | dict.fromkeys(READING_NAMES, np.zeros(60)))
    assert "no chip answers in any of its 60 presses" in refused(capsys, "presses", *words)


def test_a_small_difference_that_was_rounded_to_zero_is_a_press(tmp_path):
    """Rounded negative numbers are -0.0, which no chip sends; coarse steps give two zeros more often than three."""
    columns = presses_table(tmp_path / TABLE, n=60)
    columns |= {name: np.where(np.arange(60) == 3, -0.0, columns[name]) for name in READING_NAMES[:3]}
    steps = np.random.default_rng(0).integers(-1, 2, (60, 3))
    write_columns(tmp_path / TABLE, columns | dict(zip(READING_NAMES[3:6], steps.T, strict=True)))
    assert (steps == 0).all(1).any()
    assert len(converted("presses", tmp_path / TABLE, tmp_path / "dst", "--indenter", "sphere:4", "--as-stated")) == 60


def test_zero_ambient_subtracts_nothing_unless_only_a_chip_or_row_has_it(tmp_path, capsys):
    columns = presses_table(tmp_path / TABLE, n=20, ambient=True)
    words = (tmp_path / TABLE, tmp_path / "dst", "--indenter", "sphere:4", "--overwrite")
    ambient = ["a" + name[1:] for name in READING_NAMES]
    write_columns(tmp_path / TABLE, columns | {n: np.where(np.arange(20) == 3, 0.0, columns[n]) for n in ambient})
    assert len(converted("presses", *words)) == 19
    write_columns(tmp_path / TABLE, columns | dict.fromkeys(ambient, np.zeros(20)))
    raw = np.column_stack([columns[name] for name in READING_NAMES])
    np.testing.assert_allclose(converted("presses", *words, "--as-stated").touches.reading, raw, atol=UT)
    write_columns(tmp_path / TABLE, columns | dict.fromkeys(ambient[:3], np.zeros(20)))
    sentence = refused(capsys, "presses", *words)
    assert "the ambient field of chip 0 is zero in every row; correct its columns a0x_uT" in sentence


def test_an_option_cannot_contradict_the_column_source(tmp_path, capsys):
    presses_table(tmp_path / TABLE, source=["simulated"] * 6)
    words = ("presses", tmp_path / TABLE, tmp_path / "dst", "--indenter", "sphere:4")
    assert "--source real: the column source" in refused(capsys, *words, "--source", "real")
    assert converted(*words).source == "simulated"
    presses_table(tmp_path / TABLE)
    assert converted(*words, "--source", "simulated", "--overwrite").source == "simulated"


def test_the_same_presses_in_two_layouts_give_the_same_touches(tmp_path):
    place, values = made_up_session(tmp_path / "src" / "a")
    middle = (place.min(0) + place.max(0)) / 2
    travel = place[:, 2].max() - place[:, 2]
    columns = {"x_mm": place[:, 0] - middle[0], "y_mm": place[:, 1] - middle[1], "travel_mm": travel}
    write_columns(tmp_path / TABLE, columns | dict(zip(READING_NAMES, values.T, strict=True)))
    options = ("--window-mm", 40, "--reach-mm", 3)
    a = converted("eflesh", tmp_path / "src", tmp_path / "a", *options, "--tip-radius-mm", 5).touches
    b = converted("presses", tmp_path / TABLE, tmp_path / "b", *options, "--indenter", "sphere:5").touches
    for name in ("patch", "nearest", "reading", "travel", "T_w_t", "T_w_o"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-8 if name != "reading" else UT)


def test_a_cylinder_s_patch_is_a_disk(tmp_path):
    """The area of pixels at depth 0 is that of the disk, within a ring of one pixel's diagonal about its edge."""
    columns = presses_table(tmp_path / TABLE, x_mm=np.linspace(-2, 3, 6), y_mm=np.linspace(1, -2, 6))
    patch = converted("presses", tmp_path / TABLE, tmp_path / "dst", "--indenter", "cylinder:3").touches.patch
    pixel = 17 / 48
    centres = ((np.arange(48) + 0.5) / 48 - 0.5) * 17
    assert set(np.unique(patch)) == {0, np.float32(4e-3)}
    for image, x, y in zip(patch == 0, columns["x_mm"], columns["y_mm"], strict=True):
        assert abs(image.sum() * pixel**2 - np.pi * 9) < 2 * np.pi * 3 * pixel * np.sqrt(2)
        assert abs((image.sum(0) @ centres) / image.sum() - x) < pixel / 2
        assert abs((image.sum(1) @ centres) / image.sum() - y) < pixel / 2


@pytest.mark.full
def test_a_mesh_is_pressed_with_its_lowest_point_first(tmp_path):
    """A cone frustum on its small end, 2 mm below its frame's origin: a flat disk in a slope of 45 degrees."""
    mesh = trimesh.creation.revolve([(0, -2), (2, -2), (5, 1), (0, 1)], sections=256)
    mesh.export(tmp_path / "tip.stl")
    presses_table(tmp_path / TABLE, n=3, x_mm=[0, 1, -2], y_mm=[0, 2, 1], travel_mm=[0, 1, 2])
    options = ("--indenter", f"mesh:{tmp_path / 'tip.stl'}", "--unit", "mm")
    dataset = converted("presses", tmp_path / TABLE, tmp_path / "dst", *options)
    centres = ((np.arange(48) + 0.5) / 48 - 0.5) * 17e-3
    for k, (x, y) in enumerate(((0, 0), (1e-3, 2e-3), (-2e-3, 1e-3))):
        r = np.hypot(centres[None] - x, centres[:, None] - y)
        slope = np.where(r < 5e-3, np.maximum(r - 2e-3, 0), 4e-3)
        away = np.abs(r - 5e-3) > 1e-5  # of the rim, where a ray may pass on either side
        # 256 sections stay within 5 mm (1 - cos(pi / 256)) = 0.4 um of the cone; float32 adds less.
        np.testing.assert_allclose(dataset.touches.patch[k][away], slope[away], atol=1e-6)
    np.testing.assert_allclose(dataset.touches.T_w_o[:, 2, 3], [2e-3, 1e-3, 0], atol=1e-8)
    assert dataset.objects == ("tip",)


# --- the commands --------------------------------------------------------------------------------------------------


def test_the_summary_for_a_program_and_for_a_person(tmp_path, capsys):
    dataset = make(9, truth=True)
    save_dataset(tmp_path / "set.h5", dataset)
    (tmp_path / "bad.h5").write_bytes(b"bad")
    assert "bad.h5: not an i2t-touches file" in refused(capsys, "summary", tmp_path)
    assert run("summary", tmp_path, "--skip-bad", "--json") == 0
    printed = capsys.readouterr()
    whole = json.loads(printed.out)
    assert whole == json.loads(json.dumps(dataset.summary()))
    assert "bad.h5" in printed.err
    assert run("summary", tmp_path / "set.h5") == 0
    page = capsys.readouterr().out
    assert "9 touches, simulated" in page
    assert all(f"{name} " in page for name in dataset.objects)


def test_nothing_is_overwritten_or_mixed_by_default(tmp_path, capsys):
    write(tmp_path / "src", "star", "1", 1, size=8)
    touches = tmp_path / "dst/touches.h5"
    words = ("imagine2touch", tmp_path / "src", tmp_path / "dst")
    assert run(*words) == 0
    before = touches.read_bytes()
    assert "pass --overwrite" in refused(capsys, *words)
    assert touches.read_bytes() == before
    assert run(*words, "--overwrite") == 0
    assert touches.read_bytes() != before  # its time of creation
    (tmp_path / "dst/mine.txt").write_text("mine")
    assert "holds mine.txt" in refused(capsys, *words, "--overwrite")


def tactile_of(values, ambient, folder):
    """Write samples (n, 5, 3) uT with their temperature, and ambient samples, in place of those of a run."""
    tactile = folder / "star/star_tactile/experiment_1_reskin"
    for path, field in ((tactile, values), (tactile.with_name(tactile.name + "_ambient"), ambient)):
        warm = np.where(
            (field == 0).all(-1, keepdims=True), 0.0, 27.0 + np.random.default_rng(0).random(field[..., :1].shape)
        )
        authors_layout.save(path, np.concatenate([warm, field], -1).reshape(len(field), 1, 1, 20))


@pytest.mark.parametrize(
    ("chips", "sentence"), [([2], "chip 2 does not answer in any"), (range(5), "no chip answers in any")]
)
def test_a_dead_chip_is_reported_instead_of_a_wrong_order_of_values(tmp_path, capsys, chips, sentence):
    write(tmp_path / "src", "star", "1", 8, size=8)
    field = np.random.default_rng(0).normal(0, 400, (8, 5, 3))
    field[:, list(chips)] = 0
    tactile_of(field, field, tmp_path / "src")
    assert sentence in refused(capsys, "imagine2touch", tmp_path / "src", tmp_path / "dst")


def test_an_ambient_field_of_zeros_subtracts_nothing_and_one_of_a_chip_is_named(tmp_path, capsys):
    write(tmp_path / "src", "star", "1", 8, size=8)
    field, ambient = np.random.default_rng(0).normal(0, 400, (8, 5, 3)), np.zeros((8, 5, 3))
    tactile_of(field, ambient, tmp_path / "src")
    touches = converted("imagine2touch", tmp_path / "src", tmp_path / "dst", "--as-stated").touches
    np.testing.assert_allclose(touches.reading, field.reshape(8, 15), atol=UT)
    assert "ambient is zero in every row: nothing is subtracted" in capsys.readouterr().out
    ambient[:, 1:] = 20.0
    tactile_of(field, ambient, tmp_path / "src")
    sentence = refused(capsys, "imagine2touch", tmp_path / "src", tmp_path / "no")
    assert "reskin_ambient: the ambient field of chip 0 is zero in every row" in sentence


@pytest.mark.parametrize(
    ("name", "value"),
    [("forces_torques", np.nan), ("rotations", 0.0), ("final_contact", np.inf), ("contact_returns", 9)],
)
def test_one_damaged_touch_does_not_lose_the_run(tmp_path, capsys, name, value):
    truth = write(tmp_path / "src", "star", "1", 8, size=8)
    folder = "forces" if name in ("forces_torques", "contact_returns") else "poses"
    path = tmp_path / f"src/star/star_{folder}/experiment_1_{name}"
    numbers = np.load(path).astype(float)
    numbers[3] = value
    authors_layout.save(path, numbers)
    words = ("imagine2touch", tmp_path / "src")
    assert "4" in refused(capsys, *words, tmp_path / "no")
    touches = converted(*words, tmp_path / "dst", "--skip-bad", "--as-stated").touches
    np.testing.assert_allclose(touches.reading, np.delete(truth.reading, 3, 0), atol=UT)
    assert np.isfinite(touches.force).all()
