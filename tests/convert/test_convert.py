"""Converters: known contents come out as written, real recordings as read by other means, damage as one sentence."""

import csv
import gzip
import io
import json
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import trimesh
from helpers import authors_layout
from helpers.authors_layout import AMBIENT, ReSkinData, write
from helpers.random_touches import assert_equal, make
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from i2t.convert import npy
from i2t.convert.commands import main
from i2t.dataset import Record, load_dataset, save_dataset, write_touch
from i2t.errors import DataError
from i2t.types import ReturnCode

ROOT = Path(__file__).parents[2]
UT = 1e-3  # uT: fields of up to 2000 uT in float32, whose spacing there is 1.2e-4


def run(*args):
    return main([str(arg) for arg in args])


def converted(source, target, *options, command="imagine2touch"):
    assert run(command, source, target, *options) == 0
    return load_dataset(target)


def refused(capsys, *args):
    """The one sentence with which a command ends."""
    capsys.readouterr()
    assert run(*args) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    sentence = printed.err.removesuffix("\n")
    assert sentence
    assert "\n" not in sentence
    assert "Traceback" not in sentence
    return sentence


# --- Imagine2touch -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("n", "order", "ambient", "size"),
    [
        *((36, "binary", ambient, 48) for ambient in AMBIENT),
        *((36, "ascii", ambient, 48) for ambient in ("records", "tuples", "tens of records")),
        (1, "ascii", "tens", 12),
        (1, "binary", "means", 53),
        (400, "binary", "tens of records", 12),
    ],
)
def test_the_authors_layout_comes_out_as_written(tmp_path, n, order, ambient, size):
    truth = write(tmp_path / "src", "star", "1", n, order=order, ambient=ambient, size=size)
    dataset = converted(tmp_path / "src", tmp_path / "dst")
    touches = dataset.touches
    assert len(dataset) == n
    assert (dataset.source, dataset.objects, dataset.sessions) == ("real", ("star",), ("star/experiment_1",))
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
    assert np.isnan(touches.T_w_o).all()
    assert np.isnan(touches.depth).all()
    assert np.isnan(touches.wide).all()
    assert dataset.meta["remarks on star 1"] == "skin 3, warm day"


def test_objects_and_runs_keep_their_names_and_the_order_of_counting(tmp_path):
    for name, runs in (("star", ("1", "2", "10")), ("hammer", ("a",))):
        for seed, experiment in enumerate(runs):
            write(tmp_path / "src", name, experiment, 2, seed=seed, size=8)
    (tmp_path / "src" / "notes").mkdir()
    dataset = converted(tmp_path / "src", tmp_path / "all")
    assert dataset.objects == ("hammer", "star")
    assert dataset.sessions == tuple(
        f"{o}/experiment_{e}" for o, e in (("hammer", "a"), ("star", 1), ("star", 2), ("star", 10))
    )
    assert dataset.summary()["objects"] == {"hammer": 2, "star": 6}
    one = converted(tmp_path / "src" / "star", tmp_path / "one")
    np.testing.assert_array_equal(one.touches.reading, dataset.touches.reading[2:])


def test_images_turn_and_forces_change_axes_on_request(tmp_path):
    truth = write(tmp_path / "src", "star", "1", 3)
    dataset = converted(tmp_path / "src", tmp_path / "dst", "--quarter-turns", 1, "--tool-forces", "--reach-mm", 50)
    depth = 1e-3 * np.rot90(truth.depth.astype(float), axes=(1, 2))
    np.testing.assert_allclose(dataset.touches.patch, depth - depth.min((1, 2), keepdims=True), atol=1e-8)
    wrench = np.load(tmp_path / "src/star/star_forces/experiment_1_forces_torques")
    np.testing.assert_allclose(dataset.touches.force, -wrench[:, 2], atol=1e-6)


def test_what_was_not_recorded_is_unknown_and_said(tmp_path, capsys):
    truth = write(tmp_path / "src", "star", "1", 3)
    for folder in ("star_poses", "star_forces", "meta_data"):
        for file in (tmp_path / "src/star" / folder).iterdir():
            file.unlink()
    dataset = converted(tmp_path / "src", tmp_path / "dst")
    np.testing.assert_allclose(dataset.touches.reading, truth.reading, atol=UT)
    for name in ("nearest", "force", "T_w_t"):
        assert np.isnan(getattr(dataset.touches, name)).all()
    assert (dataset.touches.code == ReturnCode.UNDEFINED).all()
    said = capsys.readouterr().out
    assert all(name in said for name in ("final_contact", "rotations", "forces_torques", "contact_returns"))


def test_unmeasured_pixels_are_no_surface_and_a_look_from_aside_leaves_nearest_unknown(tmp_path):
    truth = write(tmp_path / "src", "star", "1", 2)
    image = truth.depth[0].copy()
    image[:, 10] = 0
    tifffile.imwrite(tmp_path / "src/star/star_images/depth/experiment_1_depth_1.tif", image)
    aside = truth.final - truth.approach[:, None] * truth.rotation[:, :, 2] + 3e-3 * truth.rotation[:, :, 0]
    authors_layout.save(tmp_path / "src/star/star_poses/experiment_1_prepare_contact", aside)
    dataset = converted(tmp_path / "src", tmp_path / "dst")
    assert (dataset.touches.patch[0, :, 10] == np.float32(4e-3)).all()
    assert np.isnan(dataset.touches.nearest).all()


def test_files_that_np_save_named_itself_are_found(tmp_path):
    truth = write(tmp_path / "src", "star", "1", 2)
    for file in list((tmp_path / "src").rglob("experiment_1_*")):
        if not file.suffix:
            file.rename(file.with_name(file.name + ".npy"))
    np.testing.assert_allclose(converted(tmp_path / "src", tmp_path / "dst").touches.reading, truth.reading, atol=UT)


# --- pickles -------------------------------------------------------------------------------------------------------


def as_npy(payload, shape=(1, 1, 4)):
    """An .npy file of an object array whose pickle is `payload`."""
    stream = io.BytesIO()
    header = {"descr": "|O", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, header)
    return stream.getvalue() + payload


class Hostile:
    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def hostile_payloads(marker):
    """Pickles that would leave a file behind if anything in them were executed."""
    command = f"touch {marker}"
    array = np.empty((1, 1, 4), object)
    array[0, 0] = [1.0, 0.0, Hostile(os.system, command), 0]
    yield pickle.dumps(array, protocol=4)
    for protocol in range(6):
        yield pickle.dumps(Hostile(os.system, command), protocol)
    yield pickle.dumps(Hostile(eval, f"open({str(marker)!r}, 'w')"))
    yield pickle.dumps(Hostile(exec, f"open({str(marker)!r}, 'w')"))
    yield pickle.dumps(Hostile(open, str(marker), "w"))
    yield pickle.dumps(Hostile(subprocess.run, ["touch", str(marker)]))
    yield pickle.dumps(Hostile(np.save, str(marker), 1))
    yield b"cposix\nsystem\n(V" + command.encode() + b"\ntR."
    yield b"(S'" + command.encode() + b"'\nios\nsystem\n."  # INST
    yield b"(cos\nsystem\nS'" + command.encode() + b"'\no."  # OBJ
    yield b"\x80\x02\x82\x01."  # an extension code
    yield b"\x80\x04\x8c\x02os\x8c\x06system\x93\x8c" + bytes([len(command)]) + command.encode() + b"\x85R."
    yield b"\x80\x02Pname\n."  # a persistent identifier


def test_hostile_pickles_are_refused_and_not_executed(tmp_path, capsys):
    marker = tmp_path / "executed"
    count = 0
    for payload in hostile_payloads(marker):
        write(tmp_path / "src", "star", "1", 1, size=8)
        (tmp_path / "src/star/star_tactile/experiment_1_reskin").write_bytes(as_npy(payload))
        sentence = refused(capsys, "imagine2touch", tmp_path / "src", tmp_path / "dst")
        assert "experiment_1_reskin: refused, for it asks for" in sentence
        count += 1
    assert count == 18
    assert not marker.exists()
    assert not (tmp_path / "dst").exists()
    os.system(f"touch {marker}")  # the payloads' command does leave the mark where it runs
    assert marker.exists()


def laughs(levels):
    """Lists that share one another: 10 ** levels values in a few hundred bytes."""
    inner = [1.0] * 10
    for _ in range(levels):
        inner = [inner] * 10
    return pickle.dumps(inner)


def recursive():
    loop = []
    loop.append(loop)
    return pickle.dumps(loop)


@pytest.mark.parametrize(
    "payload",
    [
        laughs(9),
        recursive(),
        b"\x80\x02r\xff\xff\xff\x7f.",  # a memo of 2^31 entries
        b"\x80\x02K\x01r\xff\xff\xff\x7f.",
        pickle.dumps(2**20000),
        pickle.dumps({"a": 1}),
        pickle.dumps(b"text"),
        pickle.dumps(np.zeros(3, "M8[s]")),
        pickle.dumps(np.zeros(3, [("a", "f4")])),
        pickle.dumps(np.ma.masked_array([1.0])),
        pickle.dumps(np.zeros(3, "U5")),
        b"\x80\x02cnumpy\ndtype\n(X\x02\x00\x00\x00f8K\x00K\x01tR.",
        b"",
        b".",
        b"\x80\x04N",
    ],
)
def test_absurd_pickles_are_refused_quickly(tmp_path, payload):
    (tmp_path / "file").write_bytes(as_npy(payload))
    with pytest.raises(DataError, match=r"file: "):
        npy.read(tmp_path / "file")


@pytest.mark.parametrize("protocol", [0, 1, 2, 3, 4, 5])
@pytest.mark.parametrize("module", [b"numpy._core.multiarray", b"numpy.core.multiarray"])
def test_arrays_of_any_age_are_read(tmp_path, protocol, module):
    contents = np.empty((2, 3), object)
    contents[0] = [1.5, None, "text"]
    contents[1] = [
        [np.float32(2.5), np.int64(-3), True],
        np.arange(6.0).reshape(2, 3),
        np.asfortranarray(np.eye(2, 3, 1, ">i4")),
    ]
    payload = pickle.dumps(contents, protocol)
    if protocol < 4:  # there the name stands as text, and its length does not
        payload = payload.replace(b"numpy._core.multiarray", module)
    (tmp_path / "file").write_bytes(as_npy(payload, (2, 3)))
    expected = [[1.5, None, "text"], [[2.5, -3, True], [[0, 1, 2], [3, 4, 5]], [[0, 1, 0], [0, 0, 1]]]]
    if protocol == 5:  # NumPy's buffers of protocol 5 are never written by np.save
        with pytest.raises(DataError, match="refused"):
            npy.read(tmp_path / "file")
    else:
        assert npy.read(tmp_path / "file") == expected


def test_a_named_tuple_of_any_module_is_read_and_only_by_its_name(tmp_path):
    authors_layout.save(tmp_path / "file", np.array([{"a": 1}], dtype=object))
    with pytest.raises(DataError, match="asks for a dict"):
        npy.read(tmp_path / "file")
    listed = np.empty(1, object)
    listed[0] = ReSkinData(1.0, 2.0, [3.0], 4)
    authors_layout.save(tmp_path / "file", listed)
    assert b"reskin_sensor" in (tmp_path / "file").read_bytes()
    assert npy.read(tmp_path / "file") == [[1.0, 2.0, [3.0], 4]]


def test_a_pickle_cannot_change_what_later_ones_meet(tmp_path):
    """BUILD with a state for slots sets attributes of what is on the stack, here of a stand-in class itself."""
    poison = b"\x80\x02cx\nReSkinData\n(N}X\x07\x00\x00\x00__new__Nstb."
    (tmp_path / "poison").write_bytes(as_npy(poison))
    with pytest.raises(DataError):
        npy.read(tmp_path / "poison")
    test_a_named_tuple_of_any_module_is_read_and_only_by_its_name(tmp_path)


@given(data=st.data())
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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

STAR = "star/star_"
IMAGE = STAR + "images/depth/experiment_1_depth_2.tif"
TACTILE = STAR + "tactile/experiment_1_reskin"
AMBIENT_FILE = TACTILE + "_ambient"
POSES = STAR + "poses/experiment_1_"
FORCES = STAR + "forces/experiment_1_"
FIELD = np.ones((12, 15))


def cut(path, share=0.6):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


def samples(values=(), n=12, **changed):
    """Tactile samples of n touches, the one at index 1 changed."""
    values = list(values or [value for chip in range(5) for value in (27.0, 100 * chip, -50 * chip, 300 - 90 * chip)])
    items = [[[0.0, 0.0, list(values), 2]] for _ in range(n)]
    for place, value in changed.items():
        items[1][0][2][int(place[1:])] = value
    return np.array(items, dtype=object)


def image(values):
    return lambda path: tifffile.imwrite(path, values)


def stored(values):
    return lambda path: authors_layout.save(path, values)


def contents(data):
    return lambda path: path.write_bytes(data)


def changed_header(path):
    path.write_bytes(path.read_bytes().replace(b"(12, 1, 4)", b"(13, 1, 4)", 1))


DAMAGE = {
    "missing image": (IMAGE, Path.unlink, "is missing"),
    "truncated image": (IMAGE, cut, "no readable TIF"),
    "empty image": (IMAGE, contents(b""), "no readable TIF"),
    "text for an image": (IMAGE, contents(b"hello"), "no readable TIF"),
    "image of floats": (IMAGE, image(np.ones((48, 48), np.float32)), "crop of uint16"),
    "colour image": (IMAGE, image(np.ones((48, 48, 3), np.uint16)), "with a single channel of depth"),
    "oblong image": (IMAGE, image(np.ones((48, 40), np.uint16)), "should be square"),
    "tiny image": (IMAGE, image(np.ones((2, 2), np.uint16)), "crop of uint16"),
    "huge image": (IMAGE, image(np.ones((2000, 2000), np.uint16)), "crop of uint16"),
    "image without a measured pixel": (IMAGE, image(np.zeros((48, 48), np.uint16)), "no measured pixel"),
    "one image more than touches": (
        IMAGE.replace("_2.", "_13."),
        image(np.ones((48, 48), np.uint16)),
        "one image more",
    ),
    "truncated tactile file": (TACTILE, cut, "damaged"),
    "tactile file cut in its header": (TACTILE, lambda path: cut(path, 0.001), "no output of np.save"),
    "empty tactile file": (TACTILE, contents(b""), "no output of np.save"),
    "text for a tactile file": (TACTILE, contents(b"0.1, 0.2\n"), "no output of np.save"),
    "header of another shape": (TACTILE, changed_header, "where its header says"),
    "missing tactile file": (TACTILE, Path.unlink, "is missing"),
    "no touch": (TACTILE, stored(np.empty((0, 1, 4), object)), "holds no touch"),
    "one number for all": (TACTILE, stored(np.array(3.0)), "one number instead of touches"),
    "sample of 19 values": (TACTILE, stored(samples([1.0] * 19)), "a list of 19 where a sample"),
    "sample without temperatures": (TACTILE, stored(samples([1.0] * 15)), "not 20 values"),
    "sample of texts": (TACTILE, stored(samples(_3="warm")), "where a sample"),
    "NaN in a field": (TACTILE, stored(samples(_2=np.nan)), "item 2 holds a value that is no field"),
    "absurd field": (TACTILE, stored(samples(_2=1e30)), "item 2 holds a value that is no field"),
    "absurd integer": (TACTILE, stored(samples(_2=10**400)), "an integer of absurd size"),
    "order that does not show": (TACTILE, stored(samples([27.0] * 20)), "say --order"),
    "no plausible temperature": (TACTILE, stored(samples([500.0] * 20)), "say --order"),
    "structured array": (TACTILE, stored(np.zeros(12, [("a", "f4")])), "instead of numbers"),
    "hostile pickle": (TACTILE, contents(as_npy(pickle.dumps(Hostile(os.system, "true")))), "refused"),
    "missing ambient": (AMBIENT_FILE, Path.unlink, "is missing"),
    "wrong count of ambient groups": (AMBIENT_FILE, stored(FIELD[:5]), "holds 5 groups for 12 touches"),
    "ambient of 14 values": (AMBIENT_FILE, stored(FIELD[:, :14]), "a list of 14 where a sample"),
    "NaN in the ambient": (AMBIENT_FILE, stored(FIELD * np.nan), "no field"),
    "truncated ambient": (AMBIENT_FILE, cut, "bytes for an array"),
    "too long an ambient": (
        AMBIENT_FILE,
        lambda path: path.write_bytes(path.read_bytes() + b"1"),
        "bytes for an array",
    ),
    "wrong count of rotations": (
        POSES + "rotations",
        stored(np.tile([0, 0, 0, 1.0], (11, 1))),
        "(11, 4) where 12 touches",
    ),
    "rotation of length 2": (POSES + "rotations", stored(np.tile([0, 0, 0, 2.0], (12, 1))), "not of length 1"),
    "rotations as angles": (POSES + "rotations", stored(np.zeros((12, 3))), "(12, 3) where 12 touches"),
    "NaN in a rotation": (POSES + "rotations", stored(np.full((12, 4), np.nan)), "not finite at touch 1"),
    "truncated positions": (POSES + "final_contact", cut, "bytes for an array"),
    "texts for positions": (
        POSES + "final_contact",
        stored(np.array([["a"] * 3] * 12, object)),
        "does not hold numbers",
    ),
    "absurd position": (POSES + "prepare_contact", stored(np.full((12, 3), 1e300)), "not finite"),
    "unknown return code": (FORCES + "contact_returns", stored(np.full(12, 9)), "no return code"),
    "half a return code": (FORCES + "contact_returns", stored(np.full(12, 0.5)), "no return code"),
    "force without torque": (FORCES + "forces_torques", stored(np.zeros((12, 3))), "(12, 3) where 12 touches"),
    "infinite force": (FORCES + "forces_torques", stored(np.full((12, 6), np.inf)), "not finite"),
}


@pytest.fixture(scope="module")
def intact(tmp_path_factory):
    """A small tree in the authors' layout, as its files."""
    root = tmp_path_factory.mktemp("intact")
    write(root, "star", "1", 12, size=8)
    write(root, "star", "2", 3, size=8, seed=1)
    return {file.relative_to(root): file.read_bytes() for file in root.rglob("*") if file.is_file()}


@pytest.fixture
def tree(tmp_path, intact):
    for name, data in intact.items():
        (tmp_path / "src" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / name).write_bytes(data)
    return tmp_path / "src"


@pytest.mark.parametrize("kind", DAMAGE)
def test_each_damage_is_one_sentence_that_names_the_file_and_can_be_skipped(tree, tmp_path, capsys, kind):
    name, damage, problem = DAMAGE[kind]
    damage(tree / name)
    sentence = refused(capsys, "imagine2touch", tree, tmp_path / "dst")
    assert problem in sentence
    stem = str(tree / name).rsplit("_", 2 if "contact" in name else 1)[0]  # of several pose files that disagree
    assert str(tree / name) in sentence or f"{stem}: " in sentence
    assert not (tmp_path / "dst").exists()
    skipped = converted(tree, tmp_path / "dst", "--skip-bad")
    assert len(skipped) in (3, 3 + 11)  # the other run, and what is good of this one
    assert "left out: " in capsys.readouterr().out


def test_a_source_without_runs_is_one_sentence(tree, tmp_path, capsys):
    for file in (*(tree / "star/star_tactile").iterdir(), *(tree / "star/star_images/depth").iterdir()):
        file.unlink()
    assert "star: holds no run" in refused(capsys, "imagine2touch", tree, tmp_path / "dst")
    assert "holds no folder O/O_tactile" in refused(capsys, "imagine2touch", tmp_path, tmp_path / "dst")


# --- eFlesh --------------------------------------------------------------------------------------------------------


def table(path):
    """A table as plain text and float() read it."""
    with gzip.open(path, "rt") as file:
        return np.array([[float(cell) for cell in row] for row in csv.reader(file)])


def test_real_spatial_presses_come_out_as_the_files_hold_them(shared_data, tmp_path):
    source = shared_data / "eflesh" / "spatial"
    folder = next(source.iterdir())
    dataset = converted(source, tmp_path / "dst", "--as-stated", command="eflesh")
    states, values = table(folder / "states.csv.gz"), table(folder / "sensor_post_baselines.csv.gz")
    touches = dataset.touches
    assert len(dataset) == 4805
    assert dataset.source == "real"
    assert dataset.window == 0.04
    np.testing.assert_array_equal(touches.reading, values[:, 1:].astype(np.float32))
    # The tip in the tool frame is where T_w_o puts it: the robot's place, from the middle of its range and its top.
    place = 1e-3 * (states[:, 1:] - [289, -100, states[:, 3].max()])
    np.testing.assert_allclose(touches.T_w_o[:, :3, 3], place, atol=1e-8)
    np.testing.assert_array_equal(touches.T_w_t, np.tile(np.eye(4), (4805, 1, 1)))
    np.testing.assert_allclose(touches.depth, -place[:, 2], atol=1e-9)
    np.testing.assert_allclose(touches.nearest, place[:, 2], atol=1e-9)
    assert touches.depth.min() == 0
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
    dataset = converted(source, tmp_path / "dst", "--pad", "one skin", "--as-stated", command="eflesh")
    states = np.concatenate([table(folder / "states.csv.gz") for folder in sorted(source.iterdir())])
    force = [math_nan if grams == -1 else grams * 1e-3 * 9.80665 for grams in states[:, 4]]
    np.testing.assert_allclose(dataset.touches.force, force, rtol=1e-6)
    assert len(dataset) == 7200
    assert dataset.pads == ("one skin",)
    assert set(dataset.summary()["sessions"].values()) == {360}  # 10 strokes of each session, none torn
    assert len(dataset.sessions) == 20
    height = states[:, 3].reshape(20, 360)
    assert (height[:, [0, -1]] > 287.9).all()  # each begins and ends at the top
    lower = converted(source, tmp_path / "lower", "--z0-mm", 286.5, "--reach-mm", 2, "--as-stated", command="eflesh")
    np.testing.assert_array_equal(lower.touches.code == ReturnCode.FREE, states[:, 3] > 286.5)
    np.testing.assert_allclose(lower.touches.depth, np.maximum(0, 286.5 - states[:, 3]) * 1e-3, atol=1e-8)


math_nan = float("nan")


@pytest.mark.full
def test_real_shear_recordings_are_two_pads(shared_data, tmp_path, capsys):
    source = shared_data / "eflesh" / "shear"
    dataset = converted(source, tmp_path / "dst", command="eflesh")
    values = table(next(source.iterdir()) / "sensor_post_baselines.csv.gz")
    assert len(dataset.pads) == 2
    for i in (0, 1):
        mine = dataset.select(dataset.touches.pad == i)
        np.testing.assert_array_equal(mine.touches.reading, values[:, 1 + 15 * i : 16 + 15 * i].astype(np.float32))
    assert np.isnan(dataset.touches.force).all()
    assert np.isnan(dataset.touches.depth).all()
    assert "shear force" in capsys.readouterr().out
    second = converted(source, tmp_path / "second", "--board", 1, command="eflesh")
    assert len(second) == 7200
    np.testing.assert_array_equal(second.touches.reading, mine.touches.reading)


def session(folder, n=20, gz=False, zs=None):
    """A made-up spatial session; returns places (n, 3) mm and values (n, 15)."""
    rng = np.random.default_rng(3)
    place = np.column_stack([rng.uniform(270, 300, n), rng.uniform(-110, -90, n), rng.uniform(141, 145, n)])
    values = rng.normal(0, 100, (n, 15))
    time = 1.7e9 + 4.25 * np.arange(n)
    folder.mkdir(parents=True, exist_ok=True)
    for name, columns in (
        ("states", np.column_stack([time + 1e-3, place])),
        ("sensor_post_baselines", np.column_stack([time, values])),
    ):
        text = "\n".join(",".join(repr(float(value)) for value in row) for row in columns)
        if gz:
            (folder / f"{name}.csv.gz").write_bytes(gzip.compress(text.encode()))
        else:
            (folder / f"{name}.csv").write_text(text)
    return place, values


def test_presses_beside_the_window_are_left_out_and_counted(tmp_path, capsys):
    place, values = session(tmp_path / "src" / "a")
    dataset = converted(
        tmp_path / "src", tmp_path / "dst", "--window-mm", 10, "--centre-mm", 285, -100, command="eflesh"
    )
    inside = (np.abs(place[:, :2] - [285, -100]) <= 5).all(1)
    assert 0 < inside.sum() < 20
    np.testing.assert_allclose(dataset.touches.reading, values[inside], atol=UT)
    assert f"{20 - inside.sum()} presses outside the window" in capsys.readouterr().out


def edit(old, new, count=1):
    return lambda path: path.write_text(path.read_text().replace(old, new, count))


def drop_line(path):
    path.write_text("\n".join(path.read_text().splitlines()[:-1]))


def swap_lines(path):
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[1], lines[0], *lines[2:]]))


EFLESH_DAMAGE = {
    "missing states": ("states.csv", lambda path: path.rename(path.with_name("states.csv.gz.old")), "is missing"),
    "missing values": ("sensor_post_baselines.csv", Path.unlink, "is missing"),
    "empty": ("states.csv", contents(b""), "is empty"),
    "a word": ("states.csv", edit(",", ",word", 1), "no table of numbers"),
    "a short row": ("states.csv", edit(",", "", 1), "no table of numbers"),
    "another table": ("states.csv", contents(b"1,2,3\n"), "has 3 columns, not 4 or 5"),
    "NaN": (
        "sensor_post_baselines.csv",
        edit("1700000000.0,", "nan,"),
        "not finite",
    ),
    "time that stands still": ("states.csv", swap_lines, "time does not increase at row 2"),
    "a row less": ("states.csv", drop_line, "1 rows have no partner"),
    "bytes": ("states.csv", contents(b"\xff\xfe\x00\x01"), "is no text"),
}


@pytest.mark.parametrize("kind", EFLESH_DAMAGE)
def test_each_damaged_session_is_one_sentence_and_can_be_skipped(tmp_path, capsys, kind):
    name, damage, problem = EFLESH_DAMAGE[kind]
    session(tmp_path / "src" / "a")
    session(tmp_path / "src" / "b", gz=True)
    damage(tmp_path / "src" / "a" / name)
    sentence = refused(capsys, "eflesh", tmp_path / "src", tmp_path / "dst")
    assert problem in sentence
    assert str(tmp_path / "src" / "a") in sentence
    assert len(converted(tmp_path / "src", tmp_path / "dst", "--skip-bad", command="eflesh")) in (20, 39)


@pytest.mark.parametrize("damage", [cut, contents(b"plain"), contents(b"")])
def test_damaged_archives_are_one_sentence(tmp_path, capsys, damage):
    session(tmp_path / "src" / "a", gz=True)
    damage(tmp_path / "src" / "a" / "states.csv.gz")
    assert "states.csv.gz: " in refused(capsys, "eflesh", tmp_path / "src", tmp_path / "dst")


# --- tables of presses ---------------------------------------------------------------------------------------------

READING_NAMES = [f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz"]


def presses_table(path, n=6, ambient=False, more=None, chips=5):
    names = [f"b{chip}{axis}_uT" for chip in range(chips) for axis in "xyz"]
    rng = np.random.default_rng(5)
    columns = {"x_mm": rng.uniform(-8, 8, n), "y_mm": rng.uniform(-8, 8, n), "depth_mm": rng.uniform(0, 2, n)}
    columns |= {name: rng.normal(0, 50, n) for name in names}
    columns |= {"a" + name[1:]: rng.normal(0, 50, n) for name in names if ambient}
    columns |= more or {}
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))
    return columns


def test_a_table_of_presses_comes_out_as_written(tmp_path, capsys):
    more = {"force_N": [1, "", 2.5, 3, 4, 5], "run": list("aabbcc"), "pad": list("xyxyxy"), "humidity": [50] * 6}
    columns = presses_table(tmp_path / "table.csv", ambient=True, more=more)
    dataset = converted(tmp_path / "table.csv", tmp_path / "dst", "--indenter", "sphere:4.0", command="presses")
    touches = dataset.touches
    reading = np.column_stack([columns[name] - columns["a" + name[1:]] for name in READING_NAMES])
    np.testing.assert_allclose(touches.reading, reading, atol=UT)
    np.testing.assert_allclose(touches.force, [1, np.nan, 2.5, 3, 4, 5])
    np.testing.assert_allclose(touches.depth, 1e-3 * columns["depth_mm"], rtol=1e-6)
    np.testing.assert_allclose(touches.nearest, -touches.depth)
    place = 1e-3 * np.column_stack([columns["x_mm"], columns["y_mm"], -columns["depth_mm"]])
    np.testing.assert_allclose(touches.T_w_o[:, :3, 3], place, atol=1e-9)
    assert [dataset.sessions[i] for i in touches.session] == more["run"]
    assert [dataset.pads[i] for i in touches.pad] == more["pad"]
    assert (dataset.objects, dataset.source) == (("sphere:4.0",), "real")
    assert "humidity" in capsys.readouterr().out


def rewritten(path, columns, *, delimiter, decimal, units):
    """The same table as other programs write it."""
    names = {name: name.rpartition("_")[0] + "_" + units[name][0] if name in units else name for name in columns}
    factors = {name: units[name][1] if name in units else 1.0 for name in columns}
    rows = zip(*(values * factors[name] for name, values in columns.items()), strict=True)
    lines = [delimiter.join(names.values())]
    lines += [delimiter.join(repr(float(value)).replace(".", decimal) for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("delimiter", "decimal", "said"), [(";", ",", "semicolons"), ("\t", ".", "tabs")])
def test_a_table_of_other_separators_and_units_is_the_same_table(tmp_path, capsys, delimiter, decimal, said):
    options = ("--indenter", "sphere:4.0", "--as-stated")
    columns = presses_table(tmp_path / "table.csv")
    plain = converted(tmp_path / "table.csv", tmp_path / "plain", *options, command="presses")
    units = {"x_mm": ("m", 1e-3), "depth_mm": ("um", 1e3), **dict.fromkeys(READING_NAMES, ("mT", 0.001))}
    rewritten(tmp_path / "other.csv", columns, delimiter=delimiter, decimal=decimal, units=units)
    other = converted(tmp_path / "other.csv", tmp_path / "other", *options, command="presses")
    for one, two in zip(plain.touches[:6], other.touches[:6], strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-9)
    printed = capsys.readouterr().out
    assert said in printed
    assert "x_m, depth_um, b0x_mT" in printed


@pytest.mark.parametrize(("board", "chips"), [("grid-2x2", 4), ("grid-4x4", 16), ("grid-1x1", 1)])
def test_a_table_of_any_board_comes_out_as_written(tmp_path, capsys, board, chips):
    columns = presses_table(tmp_path / "table.csv", chips=chips, more={"session": list("aabbcc")})
    options = ("--indenter", "sphere:4.0", "--board", board)
    dataset = converted(tmp_path / "table.csv", tmp_path / "dst", *options, command="presses")
    reading = np.column_stack([columns[f"b{chip}{axis}_uT"] for chip in range(chips) for axis in "xyz"])
    np.testing.assert_allclose(dataset.touches.reading, reading, atol=UT)
    assert dataset.board.chips.shape == (chips, 3)
    assert dataset.sessions == ("a", "b", "c")
    assert run("npz", tmp_path / "dst", tmp_path / "dst.npz") == 0
    with np.load(tmp_path / "dst.npz", allow_pickle=False) as back:
        np.testing.assert_array_equal(back["reading"], dataset.touches.reading)
        np.testing.assert_array_equal(back["board_chips"], dataset.board.chips)
    many = refused(capsys, "presses", tmp_path / "table.csv", tmp_path / "other", *options[:2], "--board", "grid-5x5")
    assert "column b" in many
    assert "is missing" in many


def test_a_table_of_more_chips_than_the_board_has_is_refused(tmp_path, capsys):
    presses_table(tmp_path / "table.csv", chips=6)
    args = ("presses", tmp_path / "table.csv", tmp_path / "dst", "--indenter", "sphere:4")
    assert "b5x_uT, b5y_uT, b5z_uT is of no chip of the board, which has 5; name it with --board" in refused(
        capsys, *args
    )
    assert "--board five: Board 'five' is not known" in refused(capsys, *args, "--board", "five")


def test_the_same_presses_come_out_the_same_from_two_layouts(tmp_path):
    place, values = session(tmp_path / "src" / "a")
    middle = (place.min(0) + place.max(0)) / 2
    columns = {
        "x_mm": place[:, 0] - middle[0],
        "y_mm": place[:, 1] - middle[1],
        "depth_mm": place[:, 2].max() - place[:, 2],
    }
    columns |= dict(zip(READING_NAMES, values.T, strict=True))
    presses_table(tmp_path / "table.csv", n=20, more=columns)
    options = ("--window-mm", 40, "--reach-mm", 3)
    a = converted(tmp_path / "src", tmp_path / "a", *options, "--tip-radius-mm", 5, command="eflesh").touches
    b = converted(tmp_path / "table.csv", tmp_path / "b", *options, "--indenter", "sphere:5", command="presses").touches
    for name in ("patch", "nearest", "reading", "depth", "T_w_t", "T_w_o"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), atol=1e-8 if name != "reading" else UT)


def test_a_cylinder_leaves_its_disk(tmp_path):
    """The area of pixels at depth 0 is that of the disk, within a ring of one pixel's diagonal about its edge."""
    columns = presses_table(tmp_path / "table.csv", more={"x_mm": np.linspace(-2, 3, 6), "y_mm": np.linspace(1, -2, 6)})
    patch = converted(
        tmp_path / "table.csv", tmp_path / "dst", "--indenter", "cylinder:3", command="presses"
    ).touches.patch
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
    columns = presses_table(
        tmp_path / "table.csv", n=3, more={"x_mm": [0, 1, -2], "y_mm": [0, 2, 1], "depth_mm": [0, 1, 2]}
    )
    for name in READING_NAMES:
        columns[name] = columns[name][:3]
    dataset = converted(
        tmp_path / "table.csv",
        tmp_path / "dst",
        "--indenter",
        f"mesh:{tmp_path / 'tip.stl'}",
        "--unit",
        "mm",
        command="presses",
    )
    centres = ((np.arange(48) + 0.5) / 48 - 0.5) * 17e-3
    for k, (x, y) in enumerate(((0, 0), (1e-3, 2e-3), (-2e-3, 1e-3))):
        r = np.hypot(centres[None] - x, centres[:, None] - y)
        slope = np.where(r < 5e-3, np.maximum(r - 2e-3, 0), 4e-3)
        away = np.abs(r - 5e-3) > 1e-5  # of the rim, where a ray may pass on either side
        # 256 sections stay within 5 mm (1 - cos(pi / 256)) = 0.4 um of the cone; float32 adds less.
        np.testing.assert_allclose(dataset.touches.patch[k][away], slope[away], atol=1e-6)
    np.testing.assert_allclose(dataset.touches.T_w_o[:, 2, 3], [2e-3, 1e-3, 0], atol=1e-8)
    assert dataset.objects == ("tip",)


PRESSES_DAMAGE = {
    "missing column": (edit("depth_mm", "depth"), "column depth_mm is missing"),
    "column twice": (edit("x_mm,y_mm", "x_mm,y_mm,x_mm"), "stands twice"),
    "some ambient columns": (edit("b4z_uT", "b4z_uT,a0x_uT"), "give all or none"),
    "a word": (lambda path: path.write_text(path.read_text().replace("\n", "\nword", 1)), "'word"),
    "a field more": (lambda path: path.write_text(path.read_text().rstrip() + ",1\n"), "line 7 has not 18 fields"),
    "a field less": (lambda path: path.write_text(path.read_text() + "1,2\n"), "line 8 has not 18 fields"),
    "only names": (lambda path: path.write_text(path.read_text().splitlines()[0]), "holds no press"),
    "empty": (contents(b""), "is missing"),
    "no text": (contents(b"\xff\xfe\x00"), "is no text"),
    "missing file": (Path.unlink, "no such file"),
}


@pytest.mark.parametrize("kind", PRESSES_DAMAGE)
def test_each_damaged_table_is_one_sentence(tmp_path, capsys, kind):
    damage, problem = PRESSES_DAMAGE[kind]
    presses_table(tmp_path / "table.csv")
    damage(tmp_path / "table.csv")
    sentence = refused(capsys, "presses", tmp_path / "table.csv", tmp_path / "dst", "--indenter", "sphere:4")
    assert problem in sentence
    assert str(tmp_path / "table.csv") in sentence


@pytest.mark.parametrize(
    ("more", "problem"),
    [
        ({"depth_mm": [-1.0] + [0.0] * 5}, "line 2 has the negative depth"),
        ({"b0x_uT": ["nan"] + [0.0] * 5}, "line 2 has 'nan' in column b0x_uT"),
        ({"b0x_uT": [""] + [0.0] * 5}, "line 2 has '' in column b0x_uT"),
        ({"force_N": ["inf"] + [0.0] * 5}, "line 2 has 'inf' in column force_N"),
        ({"x_mm": ["1e300"] + [0.0] * 5}, "line 2 has '1e300' in column x_mm"),
    ],
)
def test_each_wrong_number_is_one_sentence_and_its_row_can_be_skipped(tmp_path, capsys, more, problem):
    presses_table(tmp_path / "table.csv", more=more)
    args = ("presses", tmp_path / "table.csv", tmp_path / "dst", "--indenter", "sphere:4")
    assert problem in refused(capsys, *args)
    assert run(*args, "--skip-bad") == 0
    assert len(load_dataset(tmp_path / "dst")) == 5


@pytest.mark.parametrize("indenter", ["cube:3", "sphere", "sphere:", "sphere:-1", "sphere:wide", "mesh:", "sphere:nan"])
def test_an_unknown_indenter_is_one_sentence(tmp_path, capsys, indenter):
    presses_table(tmp_path / "table.csv")
    sentence = refused(capsys, "presses", tmp_path / "table.csv", tmp_path / "dst", "--indenter", indenter)
    assert f"--indenter {indenter}: is unknown; give sphere:RADIUS" in sentence


@pytest.mark.parametrize("contents", [None, b"", b"solid\n"])
def test_an_unreadable_mesh_is_one_sentence(tmp_path, capsys, contents):
    presses_table(tmp_path / "table.csv")
    if contents is not None:
        (tmp_path / "tip.stl").write_bytes(contents)
    indenter = f"mesh:{tmp_path / 'tip.stl'}"
    options = ("--indenter", indenter, "--unit", "mm")
    assert "tip.stl" in refused(capsys, "presses", tmp_path / "table.csv", tmp_path / "dst", *options)


@pytest.mark.parametrize(
    "options", [("--tip-radius-mm", -1), ("--window-mm", 0), ("--window-mm", "nan"), ("--reach-mm", -4)]
)
def test_lengths_that_are_none_are_one_sentence(tmp_path, capsys, options):
    session(tmp_path / "src" / "a")
    refused(capsys, "eflesh", tmp_path / "src", tmp_path / "dst", *options)
    assert not (tmp_path / "dst").exists()


def test_a_window_without_presses_is_one_sentence(tmp_path, capsys):
    presses_table(tmp_path / "table.csv", more={"x_mm": [9.0] * 6})
    sentence = refused(capsys, "presses", tmp_path / "table.csv", tmp_path / "dst", "--indenter", "sphere:4")
    assert "no press lies inside the window of 17 mm; widen --window-mm" in sentence


# --- the commands --------------------------------------------------------------------------------------------------


def test_the_summary_for_a_program_and_for_a_person(tmp_path, capsys):
    dataset = make(9, truth=True)
    save_dataset(tmp_path / "set.h5", dataset)
    assert run("summary", tmp_path, "--json") == 0
    assert json.loads(capsys.readouterr().out) == json.loads(json.dumps(dataset.summary()))
    assert run("summary", tmp_path, "--json", "--quick") == 0
    quick = json.loads(capsys.readouterr().out)
    assert quick == {key: dataset.summary()[key] for key in quick}
    assert quick.keys() >= {"touches", "objects", "source"}
    for options in ((), ("--quick",)):
        assert run("summary", tmp_path, *options) == 0
        page = capsys.readouterr().out
        assert "9 touches, simulated" in page
        assert all(f"{name} " in page for name in dataset.objects)


def test_the_summary_skips_bad_files_on_request(tmp_path, capsys):
    save_dataset(tmp_path / "set.h5", make(2))
    (tmp_path / "bad.h5").write_bytes(b"bad")
    assert "bad.h5: not an i2t-touches file" in refused(capsys, "summary", tmp_path)
    assert run("summary", tmp_path, "--skip-bad", "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["touches"] == 2
    assert "bad.h5" in printed.err


def test_packing_keeps_every_touch(tmp_path):
    parts = [make(1, seed) for seed in range(3)]
    for part in parts:
        write_touch(tmp_path / "recorded", Record(part))
    assert run("pack", tmp_path / "recorded", tmp_path / "packed") == 0
    assert_equal(load_dataset(tmp_path / "packed"), load_dataset(tmp_path / "recorded"))
    assert [file.name for file in (tmp_path / "packed").glob("*.h5")] == ["touches.h5"]


@pytest.mark.parametrize("truth", [False, True])
def test_the_way_back_holds_everything_and_no_pickle(tmp_path, truth):
    dataset = make(4, truth=truth, wide=truth)
    save_dataset(tmp_path / "set.h5", dataset)
    assert run("npz", tmp_path / "set.h5", tmp_path / "out" / "set.npz") == 0
    with np.load(tmp_path / "out" / "set.npz", allow_pickle=False) as arrays:
        for name, values in dataset.touches._asdict().items():
            if name != "truth" and values is not None:
                np.testing.assert_array_equal(arrays[name], values)
                assert arrays[name].dtype == values.dtype
        for name, values in dataset.touches.truth._asdict().items() if truth else ():
            np.testing.assert_array_equal(arrays[f"truth_{name}"], values)
        assert ("truth_wide" in arrays) == truth
        for kind in ("objects", "pads", "sessions"):
            assert tuple(arrays[kind]) == getattr(dataset, kind)
        np.testing.assert_array_equal(arrays["board_chips"], dataset.board.chips)
        np.testing.assert_array_equal(arrays["board_rotations"], dataset.board.rotations)
        assert (float(arrays["window"]), float(arrays["reach"]), str(arrays["source"])) == (0.017, 0.004, "simulated")
        assert dict(zip(arrays["meta_keys"], arrays["meta_values"], strict=True)) == dataset.meta
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["set.npz"]


def test_nothing_is_overwritten_or_mixed_unasked(tmp_path, capsys):
    write(tmp_path / "src", "star", "1", 1, size=8)
    args = ("imagine2touch", tmp_path / "src", tmp_path / "dst")
    assert run(*args) == 0
    before = (tmp_path / "dst/touches.h5").read_bytes()
    assert "pass --overwrite" in refused(capsys, *args)
    assert (tmp_path / "dst/touches.h5").read_bytes() == before
    assert run(*args, "--overwrite") == 0
    assert (tmp_path / "dst/touches.h5").read_bytes() != before  # its time of creation
    (tmp_path / "dst/mine.txt").write_text("mine")
    assert "holds mine.txt" in refused(capsys, *args, "--overwrite")
    assert "is a file" in refused(capsys, *args[:2], tmp_path / "dst/mine.txt")
    assert run("npz", tmp_path / "dst/touches.h5", tmp_path / "set.npz") == 0
    assert "pass --overwrite" in refused(capsys, "npz", tmp_path / "dst/touches.h5", tmp_path / "set.npz")
    assert ".npz; name the file so" in refused(capsys, "npz", tmp_path / "dst/touches.h5", tmp_path / "set")
    assert "is missing" not in refused(capsys, "imagine2touch", tmp_path / "nowhere", tmp_path / "new")
    assert "no such file" in refused(capsys, "eflesh", tmp_path / "nowhere", tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_the_module_runs_as_a_command():
    command = [sys.executable, "-m", "i2t.convert"]
    helped = subprocess.run([*command, "--help"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "python -m i2t.convert presses TABLE.csv DATA --indenter sphere:4.0" in helped.stdout
    failed = subprocess.run([*command, "summary", "nowhere"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (failed.returncode, failed.stderr) == (2, "error: nowhere: no such file or folder; check the path\n")
