"""Tables as programs and people write them come out as one and the same table, with a sentence on what was undone."""

import numpy as np
import pytest
from helpers.skin_presses import presses_of_a_skin

from i2t.calibration.heads import read_recordings
from i2t.convert.commands import main
from i2t.convert.tables import read_text_table
from i2t.dataset import load_dataset
from i2t.errors import DataError

SKIN = presses_of_a_skin(40)
CHIPS = [f"b{chip}{axis}_uT" for chip in range(5) for axis in "xyz"]
NAMES = ["x_mm", "y_mm", "depth_mm", *CHIPS]
VALUES = np.column_stack([1e3 * SKIN.targets["position"], 1e3 * SKIN.targets["depth"], SKIN.readings])
PRESSES = ("--indenter", "sphere:4", "--window-mm", "40", "--as-stated")


def lines(names, values, delimiter=","):
    return [delimiter.join(names), *(delimiter.join(repr(float(value)) for value in row) for row in values)]


def written(path, names, values, **kwargs):
    path.write_text("\n".join(lines(names, values, **kwargs)) + "\n")
    return path


def converted(source, target, *options):
    assert main(["presses", str(source), str(target), *PRESSES, *options]) == 0
    return load_dataset(target)


WAYS = {
    "as it is": (NAMES, VALUES, lambda text: text),
    "tabs": (NAMES, VALUES, lambda text: text.replace(",", "\t")),
    "semicolons and decimal commas": (NAMES, VALUES, lambda text: text.replace(",", ";").replace(".", ",")),
    "a byte order mark and Windows lines": (NAMES, VALUES, lambda text: "\ufeff" + text.replace("\n", "\r\n")),
    "capitals": ([name.upper() for name in NAMES], VALUES, lambda text: text),
    "units in brackets": ([name.replace("_", " [") + "]" for name in NAMES], VALUES, lambda text: text),
    "micro signs": ([name.replace("uT", "\u00b5T") for name in NAMES], VALUES, lambda text: text),
    "comments first": (NAMES, VALUES, lambda text: "# eFlesh, probe of 4 mm\n\n" + text),
    "a column of row numbers": (["", *NAMES], np.column_stack([np.arange(40), VALUES]), lambda text: text),
    "a comma after each row": (NAMES, VALUES, lambda text: text.replace("\n", ",\n")),
    "metres and gauss": (
        [name.replace("_mm", "_m").replace("_uT", "_G") for name in NAMES],
        VALUES * np.r_[np.full(3, 1e-3), np.full(15, 1e-2)],
        lambda text: text,
    ),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_table_is_the_same_whoever_wrote_it(tmp_path, way):
    names, values, change = WAYS[way]
    path = tmp_path / "mine.csv"
    path.write_bytes(change("\n".join(lines(names, values)) + "\n").encode())
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.readings, SKIN.readings, rtol=1e-9)
    for name in ("position", "depth"):
        np.testing.assert_allclose(recording.targets[name], SKIN.targets[name], rtol=1e-9)
    touches = converted(path, tmp_path / "out").touches
    np.testing.assert_allclose(touches.reading, SKIN.readings, rtol=1e-5)
    np.testing.assert_allclose(touches.depth, SKIN.targets["depth"][:, 0], rtol=1e-5)


def test_what_was_undone_and_what_is_left_out_is_said(tmp_path):
    path = written(tmp_path / "b.csv", ["x_m", "Time (ms)", "humidity", "x_mm"], np.array([[1.0, 2, 3, 4]] * 2))
    table = read_text_table(path)
    assert table.header == ["x_mm", "time_s", "humidity", "x_mm"]
    assert [float(cell) for cell in table.rows[0][1]] == [1000.0, 0.002, 3.0, 4.0]
    assert table.rows[0][0] == 2
    assert "x_m, Time (ms) are in other units" in table.notes[0]
    both = np.column_stack([VALUES, VALUES[:, 0] + 5, VALUES[:, 0]])
    (recording,) = read_recordings(written(tmp_path / "c.csv", [*NAMES, "x_mm", "humidity"], both))
    assert any("x_mm stand twice: the first" in note for note in recording.notes)
    assert any("humidity, which have no meaning" in note for note in recording.notes)
    np.testing.assert_allclose(recording.targets["position"], SKIN.targets["position"])


def test_a_table_that_is_not_understood_is_refused_by_what_it_begins_with(tmp_path):
    path = written(tmp_path / "a.csv", ["x", "y", "z", "Bx0"], np.ones((3, 4)))
    with pytest.raises(DataError, match="its first line names x, y, z, Bx0"):
        read_recordings(path)
    path.write_text("1,2,3\n4,5,6\n")
    with pytest.raises(DataError, match="holds numbers and no names"):
        read_recordings(path)


def test_heights_of_the_tip_take_the_place_of_depths(tmp_path, capsys):
    names = ["x_mm", "y_mm", "z_mm", *CHIPS]
    path = written(tmp_path / "a.csv", names, VALUES * np.r_[1, 1, -1, np.ones(15)] + np.r_[0, 0, 142.6, np.zeros(15)])
    expected = SKIN.targets["depth"] - SKIN.targets["depth"].min()
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.targets["depth"], expected, atol=1e-12)
    assert any("depth counts from its highest value" in note for note in recording.notes)
    np.testing.assert_allclose(converted(path, tmp_path / "out").touches.depth, expected[:, 0], atol=1e-9)
    assert "depth counts from its highest value" in capsys.readouterr().out


def test_presses_that_are_known_by_their_force_alone_are_converted(tmp_path, capsys):
    path = written(tmp_path / "a.csv", ["x_mm", "y_mm", "force_g", *CHIPS], VALUES)
    dataset = converted(path, tmp_path / "out")
    touches = dataset.touches
    np.testing.assert_allclose(touches.force, 9.80665 * SKIN.targets["depth"][:, 0], rtol=1e-6)
    assert np.isnan(touches.depth).all()
    np.testing.assert_allclose(touches.T_w_o[:, :2, 3], SKIN.targets["position"], atol=1e-8)
    assert "known by their force" in capsys.readouterr().out
    from experiments.calibrate.data import read_presses

    presses = read_presses(dataset, "auto")
    assert presses.by_force
    assert len(presses.load) == 40


def test_a_chip_that_did_not_answer_is_missing_and_costs_no_press(tmp_path, capsys):
    rows = lines(NAMES, VALUES)
    cells = rows[3].split(",")
    cells[9:12] = ["", "", ""]
    (tmp_path / "a.csv").write_text("\n".join([*rows[:3], ",".join(cells), *rows[4:]]) + "\n")
    assert main(["presses", str(tmp_path / "a.csv"), str(tmp_path / "out"), *PRESSES]) == 0
    assert "in 1 presses a chip did not answer" in capsys.readouterr().out
    reading = load_dataset(tmp_path / "out", missing_chips=True).touches.reading
    missing = np.zeros((40, 15), bool)
    missing[2, 6:9] = True
    np.testing.assert_array_equal(np.isnan(reading), missing)
    np.testing.assert_allclose(reading[~missing], SKIN.readings[~missing], rtol=1e-5)
    cells[10] = "3.5"
    (tmp_path / "b.csv").write_text("\n".join([*rows[:3], ",".join(cells)]) + "\n")
    assert main(["presses", str(tmp_path / "b.csv"), str(tmp_path / "other"), *PRESSES]) == 2
    assert "line 4 has '' in column b2x_uT" in capsys.readouterr().err


def test_the_skins_of_a_table_are_apart(tmp_path):
    path = tmp_path / "a.csv"
    rows = lines(NAMES, VALUES)
    pads = ["pad", *("left" if i % 4 else "right" for i in range(40))]
    path.write_text("\n".join(f"{row},{pad}" for row, pad in zip(rows, pads, strict=True)))
    left, right = read_recordings(path)
    assert (left.name, right.name) == ("a (left)", "a (right)")
    assert (len(left), len(right)) == (30, 10)
    np.testing.assert_allclose(right.readings, SKIN.readings[::4])
