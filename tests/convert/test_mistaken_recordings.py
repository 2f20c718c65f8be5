"""Recordings whose units, signs or axes are mistaken come out right, with a sentence; on request, as they stand."""

import gzip
import json

import numpy as np
import pytest
import tifffile
from helpers import authors_layout
from helpers.damage import VARIANTS, Recorded, press
from scipy.spatial.transform import Rotation

from i2t import unknowns
from i2t.convert.commands import main
from i2t.dataset import load_dataset
from i2t.types import ReturnCode

N = 12
POSES = "star/star_poses/experiment_1"
FORCES = "star/star_forces/experiment_1_forces_torques"


def converted(source, target, *options, command="imagine2touch"):
    assert main([command, str(source), str(target), *map(str, options)]) == 0
    return load_dataset(target)


def change(path, how):
    authors_layout.save(path, how(np.load(path)))


def images_of_tenths(source):
    for path in sorted((source / "star/star_images/depth").iterdir()):
        tifffile.imwrite(path, (10 * tifffile.imread(path)).astype(np.uint16))


def scalar_first(quaternions):
    return np.roll(quaternions, 1, axis=1)


def turned_over(quaternions):
    return (Rotation.from_quat(quaternions) * Rotation.from_euler("x", 180, degrees=True)).as_quat()


def millimetres(source):
    for name in ("final", "prepare"):
        change(source / f"{POSES}_{name}_contact", lambda at: 1e3 * (at + np.array([0, 0, 0.4])))


MISTAKES = {
    "forces that pull": (lambda s: change(s / FORCES, np.negative), "as if they pulled"),
    "forces in the tool's axes": (None, "along the tool's they do not"),
    "positions in millimetres": (millimetres, "they are read as millimetres"),
    "quaternions wxyz": (lambda s: change(s / f"{POSES}_rotations", scalar_first), "the scalar first"),
    "tool z away from the object": (lambda s: change(s / f"{POSES}_rotations", turned_over), "turned over"),
    "rotation vectors in degrees": (
        lambda s: change(s / f"{POSES}_rotations", lambda q: Rotation.from_quat(q).as_rotvec(degrees=True)),
        "vectors in degrees",
    ),
    "images in tenths": (images_of_tenths, "0.1 mm"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_in_the_authors_layout_is_found_and_put_right(tmp_path, capsys, mistake):
    truth = authors_layout.write(tmp_path / "src", "star", "1", N)
    sound = converted(tmp_path / "src", tmp_path / "sound").touches
    assert "corrected" not in capsys.readouterr().out
    damage, sentence = MISTAKES[mistake]
    if damage is None:
        wrench = np.zeros((N, 6))
        wrench[:, 2] = -truth.force - 1
        authors_layout.save(tmp_path / "src" / FORCES, wrench)
    else:
        damage(tmp_path / "src")
    found = converted(tmp_path / "src", tmp_path / "found").touches
    said = capsys.readouterr().out
    assert "corrected" in said
    assert sentence in said
    np.testing.assert_allclose(found.force, truth.force + (damage is None), atol=1e-5)
    np.testing.assert_allclose(found.nearest, sound.nearest, atol=2e-6)
    np.testing.assert_allclose(found.patch, sound.patch, atol=2e-6)
    np.testing.assert_allclose(found.T_w_t[:, :3, 2], sound.T_w_t[:, :3, 2], atol=1e-5)


def test_a_recording_is_taken_as_stated_on_request(tmp_path, capsys):
    truth = authors_layout.write(tmp_path / "src", "star", "1", N)
    change(tmp_path / "src" / FORCES, np.negative)
    found = converted(tmp_path / "src", tmp_path / "dst", "--as-stated")
    np.testing.assert_allclose(found.touches.force, -truth.force, atol=1e-5)
    assert "corrected" not in capsys.readouterr().out


def table(path, recorded: Recorded, sign=1.0):
    names = [f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz"]
    columns = ["x_mm", "y_mm", "depth_mm", "force_N", *names]
    depth = sign * np.maximum(-1e3 * recorded.height, 0)
    rows = np.column_stack([1e3 * recorded.position, depth, recorded.force, recorded.readings])
    lines = [",".join(columns), *(",".join(repr(float(value)) for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n")


OPTIONS = ("--indenter", "sphere:4", "--window-mm", 40)


@pytest.mark.parametrize("mistake", ["force that pulls", "depths negative", "readings in millitesla"])
def test_a_mistake_in_a_table_of_presses_is_found_and_put_right(tmp_path, capsys, mistake):
    sound = press(0, 28, free=0.0)
    table(tmp_path / "sound.csv", sound)
    if mistake == "depths negative":
        table(tmp_path / "wrong.csv", sound, sign=-1.0)
    else:
        table(tmp_path / "wrong.csv", VARIANTS[mistake](sound))
    expected = converted(tmp_path / "sound.csv", tmp_path / "a", *OPTIONS, command="presses")
    assert "corrected" not in capsys.readouterr().out
    found = converted(tmp_path / "wrong.csv", tmp_path / "b", *OPTIONS, command="presses")
    assert "corrected" in capsys.readouterr().out
    for name in ("reading", "force", "depth", "T_w_o"):
        np.testing.assert_allclose(
            getattr(found.touches, name), getattr(expected.touches, name), rtol=1e-5, atol=1e-5, err_msg=name
        )
    (findings,) = unknowns.findings_from_meta(found.meta).values()
    assert {finding.name for finding in findings} >= {"units", "height zero"}


def session(folder, height_mm, n=60):
    """A session in eFlesh's layout with these heights of the robot."""
    recorded = press(6, n, free=0.0)
    time = 1.7e9 + 4.25 * np.arange(n)
    place = np.column_stack([1e3 * recorded.position + [289, -100], height_mm])
    folder.mkdir(parents=True)
    for name, columns in (("states", place), ("sensor_post_baselines", recorded.readings)):
        lines = (",".join(repr(float(value)) for value in row) for row in np.column_stack([time, columns]))
        (folder / f"{name}.csv").write_text("\n".join(lines))


def test_times_of_a_session_are_kept(tmp_path):
    """In float64: a float32 tells Unix time to two minutes."""
    session(tmp_path / "src" / "late", np.full(60, 142.6))
    dataset = converted(tmp_path / "src", tmp_path / "dst", "--as-stated", command="eflesh")
    np.testing.assert_array_equal(dataset.touches.time, 1.7e9 + 4.25 * np.arange(60))
    assert "time of all touches" in " ".join((tmp_path / "dst" / "README.md").read_text().split())
    table(tmp_path / "presses.csv", recorded := press(0, 28, free=0.0))
    lines = (tmp_path / "presses.csv").read_text().splitlines()
    stamped = [f"{lines[0]},time_s", *(f"{line},{1.7e9 + i}" for i, line in enumerate(lines[1:]))]
    (tmp_path / "presses.csv").write_text("\n".join(stamped))
    pressed = converted(tmp_path / "presses.csv", tmp_path / "b", "--as-stated", *OPTIONS, command="presses")
    np.testing.assert_array_equal(pressed.touches.time, 1.7e9 + np.arange(len(recorded.position)))


def test_times_of_the_authors_samples_are_kept(tmp_path):
    authors_layout.write(tmp_path / "src", "star", "1", N)
    stored = np.load(tmp_path / "src/star/star_tactile/experiment_1_reskin", allow_pickle=True)
    found = converted(tmp_path / "src", tmp_path / "dst").touches
    np.testing.assert_array_equal(found.time, [sample[0] for sample in stored[:, 0]])


@pytest.mark.full
def test_presses_to_one_height_have_no_depth_and_the_robot_frame_is_kept(tmp_path, capsys):
    session(tmp_path / "src" / "late", np.full(60, 142.6))
    dataset = converted(tmp_path / "src", tmp_path / "dst", command="eflesh")
    assert np.isnan(dataset.touches.depth).all()
    assert (dataset.touches.code == ReturnCode.UNDEFINED).all()
    assert "all presses go to one height" in capsys.readouterr().out
    reference = json.loads(dataset.meta["reference of late"])
    assert reference["zero_m"] is None
    np.testing.assert_allclose(reference["lowest_z_m"], 0.1426)
    (findings,) = unknowns.findings_from_meta(dataset.meta).values()
    assert not unknowns.find(findings, "height zero").identifiable
    given = converted(tmp_path / "src", tmp_path / "given", "--z0-mm", 145, command="eflesh")
    np.testing.assert_allclose(given.touches.depth, 2.4e-3, atol=1e-8)


@pytest.mark.full
def test_the_real_one_height_presses_of_a_session_have_no_depth(shared_data, tmp_path):
    folder = next((shared_data / "eflesh" / "spatial").iterdir())
    tables = {
        name: np.loadtxt(gzip.decompress((folder / f"{name}.csv.gz").read_bytes()).decode().splitlines(), delimiter=",")
        for name in ("states", "sensor_post_baselines")
    }
    one = np.abs(tables["states"][:, 3] - 142.6) < 0.15
    tables["states"][:, 3] = 142.6
    (tmp_path / "src" / "late").mkdir(parents=True)
    for name, values in tables.items():
        np.savetxt(tmp_path / "src" / "late" / f"{name}.csv", values[one], delimiter=",", fmt="%.9f")
    dataset = converted(tmp_path / "src", tmp_path / "dst", command="eflesh")
    assert len(dataset) == one.sum()
    assert np.isnan(dataset.touches.depth).all()


def sets_of_folders(source, order, seed=1):
    """Six folders of an arm that goes straight up with a tool a few degrees off, so that both orders of a quaternion
    tell about the same axis; `order` is how quaternions are written.
    """
    rng = np.random.default_rng(seed)
    for number in range(6):
        name = f"object{number}"
        authors_layout.write(source, name, "1", N, seed=number)
        tilt = Rotation.from_euler("xyz", rng.normal(0, 1, (N, 3)) * [2.5, 0.5, 0], degrees=True)
        poses = source / name / f"{name}_poses" / "experiment_1"
        final = rng.uniform(-0.3, 0.3, (N, 3))
        moved = np.tile([0, 0, 0.05], (N, 1))
        for stem, values in (("final_contact", final), ("prepare_contact", final - moved)):
            authors_layout.save(poses.with_name(f"experiment_1_{stem}"), values)
        authors_layout.save(poses.with_name("experiment_1_rotations"), order(tilt.as_quat()))
    return source


def test_a_set_whose_quaternions_fit_either_order_is_read_as_documented_and_nothing_is_said(tmp_path, capsys):
    source = sets_of_folders(tmp_path / "src", lambda q: q)
    found = converted(source, tmp_path / "dst").touches
    assert "scalar" not in capsys.readouterr().out
    stored = np.concatenate([np.load(path) for path in sorted(source.glob("*/*_poses/experiment_1_rotations"))])
    np.testing.assert_allclose(found.T_w_t[:, :3, :3], Rotation.from_quat(stored).as_matrix(), atol=1e-5)


def test_the_order_of_quaternions_is_decided_once_for_a_whole_set(tmp_path, capsys):
    """One folder of a set would not tell; with the others it does, and all are read alike."""
    source = tmp_path / "src"
    truth = [authors_layout.write(source, name, "1", N, seed=i) for i, name in enumerate(("cube", "star"))]
    for name in ("cube", "star"):
        change(source / name / f"{name}_poses/experiment_1_rotations", scalar_first)
    few = [source / "cube/cube_poses" / f"experiment_1_{name}" for name in ("prepare_contact", "final_contact")]
    final = np.load(few[1])
    authors_layout.save(few[0], np.where(np.arange(N)[:, None] < 2, np.load(few[0]), final))  # two touches move at all
    found = converted(source, tmp_path / "dst").touches
    said = [line for line in capsys.readouterr().out.splitlines() if "scalar first" in line]
    assert said == [
        "corrected: quaternions have the scalar first, as 14 of 14 touches of 2 runs move along tool z so, and 0 as "
        "documented"
    ]
    rotations = np.concatenate([one.rotation for one in truth])
    np.testing.assert_allclose(found.T_w_t[:, :3, :3], rotations, atol=1e-5)
