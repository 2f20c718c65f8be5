"""Tables of any program give the same table, with a note on each conversion."""

import gzip
import io
import pickle
import zipfile

import numpy as np
import pytest
from helpers.recordings import READING_NAMES, converted, refused, write_table
from helpers.skin_presses import presses_of_a_skin

from i2t.dataset import load_dataset
from i2t.errors import DataError
from i2t.recordings.loads import loaded_presses
from i2t.recordings.read import read_recordings
from i2t.recordings.tables import read_text_table

SKIN = presses_of_a_skin(40)
NAMES = ["x_mm", "y_mm", "travel_mm", *READING_NAMES]
VALUES = np.column_stack([1e3 * SKIN.targets["position"], 1e3 * SKIN.targets["travel"], SKIN.readings])
OPTIONS = ("--indenter", "sphere:4", "--window-mm", "40", "--as-stated")
BARE = [name.rpartition("_")[0] for name in NAMES]


def renamed(old, new):
    return [name.replace(old, new) for name in NAMES]


def commas(text, between=";"):
    return text.replace(",", between).replace(".", ",")


def quoted(text):
    """Decimal commas between commas."""
    return "\n".join(",".join(f'"{cell}"' for cell in line.split(";")) for line in commas(text).splitlines())


def repeated(text):
    lines = text.splitlines()
    return "\n".join([*lines[:20], lines[0], "# the second file", *lines[20:], ""])


WAYS = {
    "semicolons and decimal commas": (NAMES, VALUES, commas),
    "tabs and a byte order mark": (NAMES, VALUES, lambda text: "\ufeff" + text.replace(",", "\t")),
    "Windows lines": (NAMES, VALUES, lambda text: text.replace("\n", "\r\n")),
    "capitals": ([name.upper() for name in NAMES], VALUES, str),
    "units in brackets": ([name.replace("_", " [") + "]" for name in NAMES], VALUES, str),
    "micro signs": (renamed("uT", "\u00b5T"), VALUES, str),
    "comments first": (NAMES, VALUES, lambda text: "# eFlesh, probe of 4 mm\n\n" + text),
    "a column of row numbers": (["", *NAMES], np.column_stack([np.arange(40), VALUES]), str),
    "a comma after each row": (NAMES, VALUES, lambda text: text.replace("\n", ",\n")),
    "metres": (renamed("_mm", "_m"), VALUES * np.r_[np.full(3, 1e-3), np.ones(15)], str),
    "gauss": (renamed("_uT", "_G"), VALUES * np.r_[np.ones(3), np.full(15, 1e-2)], str),
    "an Excel line that names the separator": (NAMES, VALUES, lambda text: "sep=;\n" + commas(text)),
    "quoted decimal commas": (NAMES, VALUES, quoted),
    "tabs and decimal commas": (NAMES, VALUES, lambda text: commas(text, "\t")),
    "spaces": (NAMES, VALUES, lambda text: text.replace(",", "   ")),
    "names in a comment": (NAMES, VALUES, lambda text: "# " + text),
    "names in a comment, between spaces": (NAMES, VALUES, lambda text: "# " + text.replace(",", " ")),
    "units below the names": (BARE, VALUES, lambda text: text.replace("\n", "\nmm,mm,mm" + 15 * ",[uT]" + "\n", 1)),
    "units below names that have them": (NAMES, VALUES, lambda t: t.replace("\n", "\nmm,mm,mm" + 15 * ",uT" + "\n", 1)),
    "two files one after the other": (NAMES, VALUES, repeated),
    "a comma after rows but not names": (NAMES, VALUES, lambda t: t.replace("\n", ",\n").replace(",\n", "\n", 1)),
    "old Mac lines": (NAMES, VALUES, lambda text: text.replace("\n", "\r")),
}


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-32", "cp1252"])
def test_a_table_is_the_same_in_any_encoding(tmp_path, encoding):
    path = write_table(tmp_path / "mine.csv", renamed("uT", "\u00b5T"), VALUES)
    path.write_bytes(path.read_text(encoding="utf-8").encode(encoding))
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.readings, SKIN.readings, rtol=1e-9)
    zipped = tmp_path / "zipped.csv"  # whatever its name
    zipped.write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(read_recordings(zipped)[0].readings, recording.readings)
    assert any("not in UTF-8" in note for note in recording.notes) == (encoding != "utf-8-sig")


def test_a_micro_sign_of_dos_is_read_with_a_warning(tmp_path):
    path = write_table(tmp_path / "mine.csv", renamed("uT", "\u00b5T"), VALUES)
    path.write_bytes(path.read_text(encoding="utf-8").encode("cp850"))
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.readings, SKIN.readings, rtol=1e-9)
    assert any("letters beyond ASCII in names may be wrong" in note for note in recording.notes)


def as_zip(name):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(name, "contents")
    return file.getvalue()


def as_npy(array):
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.parametrize(
    ("data", "kind"),
    [
        (as_zip("xl/workbook.xml"), "is an Excel workbook (.xlsx); save it as CSV in UTF-8"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(512), "is an old Excel workbook (.xls); save it as CSV"),
        (as_zip("a.npy"), "is a NumPy archive (.npz)"),
        (as_zip("log.csv"), "is a zip archive; unpack it"),
        (as_npy(np.eye(3)), "is a NumPy array (.npy); write its columns with numpy.savetxt"),
        (b"PAR1" + bytes(40), "is an Apache Parquet file"),
        (b"\x89MCAP0\r\n" + bytes(40), "is an MCAP recording"),
        (b"#ROSBAG V2.0\n" + bytes(40), "is a ROS bag"),
        (b"SQLite format 3\0" + bytes(40), "is an SQLite database"),
        (b"\x89HDF\r\n\x1a\n" + bytes(40), "is an HDF5 file"),
        (b'{"x_mm": [1, 2]}', "is a JSON document"),
        (b'[\n  {\n    "x_mm": 1', "is a JSON document"),
        (b"{\\rtf1\\ansi", "is a document in rich text (RTF)"),
        (gzip.compress(gzip.compress(b"x_mm")), "is a gzip archive; unpack it first"),
        (pickle.dumps([1.0]), "is a Python pickle"),
        (b"\n<!DOCTYPE html><html>", "is a web page (HTML); download the file itself"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer"),
        (b"x_mm,y_mm\n\x01\x02\x00\x03", "is binary data, not text"),
        ("x_mm,\u529b\n1,2\n".encode("gbk") + b"\x81\n", "is not text in UTF-8 or Windows-1252"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_file_of_another_kind_is_refused_by_its_kind(tmp_path, capsys, data, kind):
    path = tmp_path / "log.csv"
    path.write_bytes(data)
    for words in (("presses", path, tmp_path / "out", *OPTIONS), ("stream", path, tmp_path / "out.csv")):
        assert f"{path}: {kind}" in refused(capsys, *words)


@pytest.mark.parametrize(
    ("text", "change"),
    [
        ("1.234", commas),
        ("1.234,5", commas),
        ("1,234", lambda text: text),
        ("1,234.5", lambda text: text),
        ("-12,345", lambda text: text.replace(",", "\t")),
    ],
)
def test_an_ambiguous_decimal_sign_is_refused_with_row_and_column(tmp_path, capsys, text, change):
    path = write_table(tmp_path / "a.csv", NAMES, VALUES, change)
    lines = path.read_text().splitlines()
    between = next(sign for sign in ";\t," if sign in lines[0])
    cells = lines[6].split(between)
    lines[6] = between.join([*cells[:3], f'"{text}"', *cells[4:]])
    path.write_text("\n".join(lines) + "\n")
    words = ("presses", path, tmp_path / "out", *OPTIONS)
    sentence = refused(capsys, *words)
    assert f"line 7 has {text!r} in column b0x_uT, which may be decimal or grouped thousands" in sentence
    assert len(converted(*words, "--skip-bad").touches.reading) == 39


def test_three_decimals_and_names_with_a_point_are_not_grouped_thousands(tmp_path):
    rows = [[*(f"{value:.3f}" for value in row), "1.234"] for row in VALUES]
    path = write_table(tmp_path / "a.csv", [*NAMES, "session"], rows)
    dataset = converted("presses", path, tmp_path / "points", *OPTIONS)
    path.write_text(commas(path.read_text()).replace(";1,234\n", ";1.234\n"))
    other = converted("presses", path, tmp_path / "commas", *OPTIONS)
    np.testing.assert_array_equal(dataset.touches.reading, other.touches.reading)
    np.testing.assert_allclose(dataset.touches.reading, SKIN.readings, atol=1e-3)
    assert dataset.sessions == other.sessions == ("1.234",)


def test_a_unit_that_contradicts_the_name_above_it_is_refused(tmp_path, capsys):
    units = "\nm,mm,mm" + 15 * ",uT" + "\n"
    path = write_table(tmp_path / "a.csv", NAMES, VALUES, lambda text: text.replace("\n", units, 1))
    assert "column x_mm has the unit mm by its name and m below it" in refused(
        capsys, "presses", path, tmp_path / "out", *OPTIONS
    )


def test_decimal_commas_in_a_comma_separated_table_are_recognised(tmp_path, capsys):
    path = write_table(tmp_path / "a.csv", NAMES, VALUES)
    names, *lines = path.read_text().splitlines()
    path.write_text("\n".join([names, *(line.replace(".", ",") for line in lines)]))
    sentence = refused(capsys, "presses", path, tmp_path / "out", *OPTIONS)
    assert "line 2 has 36 fields instead of 18; if its numbers have decimal commas" in sentence


@pytest.mark.parametrize("way", WAYS)
def test_a_table_is_the_same_from_any_program(tmp_path, way):
    path = write_table(tmp_path / "mine.csv", *WAYS[way])
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.readings, SKIN.readings, rtol=1e-9)
    for name in ("position", "travel"):
        np.testing.assert_allclose(recording.targets[name], SKIN.targets[name], rtol=1e-9)
    touches = converted("presses", path, tmp_path / "out", *OPTIONS).touches
    np.testing.assert_allclose(touches.reading, SKIN.readings, rtol=1e-5)
    np.testing.assert_allclose(touches.travel, SKIN.targets["travel"][:, 0], rtol=1e-5)


def test_conversions_and_omissions_are_noted(tmp_path):
    path = write_table(tmp_path / "b.csv", ["x_m", "Time (ms)", "humidity", "x_mm"], [[1.0, 2, 3, 4]] * 2)
    table = read_text_table(path)
    assert table.header == ["x_mm", "time_s", "humidity", "x_mm"]
    assert table.rows[0][0] == 2
    assert [float(cell) for cell in table.rows[0][1]] == [1000.0, 0.002, 3.0, 4.0]
    assert "x_m, Time (ms) are in units other than" in table.notes[0]
    both = np.column_stack([VALUES, VALUES[:, 0] + 5, VALUES[:, 0]])
    (recording,) = read_recordings(write_table(tmp_path / "c.csv", [*NAMES, "x_mm", "humidity"], both))
    assert any("x_mm appear twice: the first" in note for note in recording.notes)
    assert any("humidity, which are not used" in note for note in recording.notes)
    np.testing.assert_allclose(recording.targets["position"], SKIN.targets["position"])


def test_an_unknown_table_is_refused_with_its_first_line(tmp_path):
    for names, sentence in ((["x", "y", "Bx0"], "its first line names x, y, Bx0"), ((), "holds numbers and no names")):
        with pytest.raises(DataError, match=sentence):
            read_recordings(write_table(tmp_path / "a.csv", names, np.ones((3, 3))))


@pytest.mark.parametrize(("name", "factor"), [("depth_mm", 1), ("Depth [mm]", 1), ("depth_m", 1e-3)])
def test_a_column_of_depths_is_the_travel(tmp_path, name, factor):
    """Tables of users, and those of earlier versions, call it depth."""
    values = VALUES * np.r_[1, 1, factor, np.ones(15)]
    path = write_table(tmp_path / "a.csv", renamed("travel_mm", name), values)
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.targets["travel"], SKIN.targets["travel"])
    touches = converted("presses", path, tmp_path / "out", *OPTIONS).touches
    np.testing.assert_allclose(touches.travel, SKIN.targets["travel"][:, 0], rtol=1e-5)


def test_heights_of_the_tip_replace_travels(tmp_path, capsys):
    heights = VALUES * np.r_[1, 1, -1, np.ones(15)] + np.r_[0, 0, 142.6, np.zeros(15)]
    path = write_table(tmp_path / "a.csv", renamed("travel", "z"), heights)
    expected = SKIN.targets["travel"] - SKIN.targets["travel"].min()
    (recording,) = read_recordings(path)
    np.testing.assert_allclose(recording.targets["travel"], expected, atol=1e-12)
    assert any("travel counts from its highest value" in note for note in recording.notes)
    touches = converted("presses", path, tmp_path / "out", *OPTIONS).touches
    np.testing.assert_allclose(touches.travel, expected[:, 0], atol=1e-9)
    assert "travel counts from its highest value" in capsys.readouterr().out


def test_presses_with_force_but_no_travel_are_converted(tmp_path, capsys):
    path = write_table(tmp_path / "a.csv", renamed("travel_mm", "force_g"), VALUES)
    dataset = converted("presses", path, tmp_path / "out", *OPTIONS)
    touches = dataset.touches
    np.testing.assert_allclose(touches.force, 9.80665 * SKIN.targets["travel"][:, 0], rtol=1e-6)
    assert np.isnan(touches.travel).all()
    np.testing.assert_allclose(touches.T_w_o[:, :2, 3], SKIN.targets["position"], atol=1e-8)
    assert "described by their force" in capsys.readouterr().out
    presses = loaded_presses(dataset, "auto")
    assert presses.by_force
    assert len(presses.load) == 40


def test_a_silent_chip_is_missing_but_its_press_is_kept(tmp_path, capsys):
    rows = [[str(value) for value in row] for row in VALUES]
    rows[2][9:12] = ["", "", ""]
    words = ("presses", write_table(tmp_path / "a.csv", NAMES, rows), tmp_path / "out", *OPTIONS)
    with pytest.raises(DataError):
        converted(*words)
    assert "in 1 presses a chip did not answer" in capsys.readouterr().out
    reading = load_dataset(tmp_path / "out", missing_chips=True).touches.reading
    missing = np.zeros((40, 15), bool)
    missing[2, 6:9] = True
    np.testing.assert_array_equal(np.isnan(reading), missing)
    np.testing.assert_allclose(reading[~missing], SKIN.readings[~missing], rtol=1e-5)
    rows[2][10] = "3.5"
    write_table(tmp_path / "a.csv", NAMES, rows)
    assert "line 4 has '' in column b2x_uT" in refused(capsys, *words, "--overwrite")


def test_each_skin_of_a_table_is_a_recording(tmp_path):
    rows = [[*row, "left" if i % 4 else "right"] for i, row in enumerate(VALUES)]
    left, right = read_recordings(write_table(tmp_path / "a.csv", [*NAMES, "pad"], rows))
    assert (left.name, right.name) == ("a (left)", "a (right)")
    assert (len(left), len(right)) == (30, 10)
    np.testing.assert_allclose(right.readings, SKIN.readings[::4])


# --- one decimal sign ----------------------------------------------------------------------------------------------


def whole_numbers(changes, between=";", rows=100):
    """A table of whole numbers with some other cells in column b0x_uT."""
    values = [["1", "2", "1", *(str(100 + 7 * i + j) for j in range(15))] for i in range(rows)]
    for row, text in changes.items():
        values[row][3] = text
    return between.join(NAMES) + "\n" + "".join(between.join(row) + "\n" for row in values)


@pytest.mark.parametrize("between", [";", " "])
@pytest.mark.parametrize(
    ("changes", "refused_row"),
    [
        ({30: "1.234"}, 30),
        ({30: "1,234"}, 30),
        ({80: "-12.345"}, 80),
        ({80: "1.234", 90: "2,5"}, 80),
        ({80: "1,234", 90: "2.5"}, 80),
        ({10: "1.234", 80: "1.234,5"}, 10),
    ],
)
def test_a_number_is_refused_if_no_other_resolves_it(tmp_path, capsys, changes, refused_row, between):
    (path := tmp_path / "a.csv").write_text(whole_numbers(changes, between))
    sentence = refused(capsys, "presses", path, tmp_path / "out", *OPTIONS)
    assert f"line {refused_row + 2} has {changes[refused_row]!r} in column b0x_uT, which may be decimal" in sentence


@pytest.mark.parametrize(
    ("changes", "between", "value"),
    [
        ({80: "1.234", 90: "2.5"}, ";", 1.234),
        ({80: "1,234", 90: "0,125"}, ";", 1.234),
        ({5: "1,2345", 80: "1,234"}, "\t", 1.234),
        ({80: "1.234"}, ",", 1.234),
    ],
)
def test_a_number_is_read_if_others_resolve_it(tmp_path, changes, between, value):
    (path := tmp_path / "a.csv").write_text(whole_numbers(changes, between))
    table = read_text_table(path)
    assert float(table.rows[80][1][3]) == value


def test_three_decimals_everywhere_are_decimals(tmp_path):
    rows = [[f"{2 + 0.125 * i:.3f}" for _ in NAMES] for i in range(4)]
    for change in (lambda text: text.replace(",", ";"), commas):
        table = read_text_table(write_table(tmp_path / "a.csv", NAMES, rows, change))
        assert [float(cells[5]) for _, cells in table.rows] == [2, 2.125, 2.25, 2.375]


def test_seconds_with_three_decimals_are_read_next_to_whole_readings(tmp_path):
    text = "time_s\tb0x_uT\n" + "".join(f"{5 + i / 100:.3f}\t{i}\n" for i in range(100))
    (path := tmp_path / "a.csv").write_text(text)
    np.testing.assert_allclose([float(cells[0]) for _, cells in read_text_table(path).rows], 5 + np.arange(100) / 100)
    path.write_text(text.replace("time_s", "time_ms"))  # 5.010 may be 5010 ms
    assert not any(cells[0].replace(".", "").isdigit() for _, cells in read_text_table(path).rows)


def test_a_decimal_sign_that_contradicts_earlier_rows_is_refused(tmp_path):
    (path := tmp_path / "a.csv").write_text(whole_numbers({3: "0.5", 70: "1.234", 80: "2,5", 90: "3,5"}))
    with pytest.raises(DataError, match="line 82 has '2,5', but points seemed to be decimal"):
        read_text_table(path)
    quoted_late = whole_numbers({70: "1.234", 80: '"2,5"'}, ",")
    path.write_text(quoted_late)
    with pytest.raises(DataError, match="line 82 has '2,5', but points"):
        read_text_table(path)


def test_underscores_are_not_part_of_a_number(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text(whole_numbers({4: "3_2"}, ","))
    assert "line 6 has '3_2' in column b0x_uT, which is not a plausible number" in refused(
        capsys, "presses", path, tmp_path / "out", *OPTIONS
    )
    (recording,) = read_recordings(path)
    assert len(recording) == 99


# --- lines that are no rows ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text + ",,,\n" * 3,
        lambda text: text + "   \n\t\n",
        lambda text: text + "\x1a",
        lambda text: text + "\0" * 100_000,
        lambda text: text.replace("\n", "\n" + "," * 17 + "\n"),
        lambda text: "My measurement\n\n" + text,
        lambda text: "My measurement" + "," * 17 + "\n" + text,
        lambda text: "Operator,Bob\nDate,2025-10-20\n" + text,
        lambda text: "% made by a program, version 5\n" + text,
        lambda text: "sep=\t\n" + text.replace(",", "\t"),
        lambda text: text.replace("x_mm", '"x\n(mm)"', 1),
        lambda text: text.replace("_mm", "/mm"),
    ],
)
def test_empty_lines_and_titles_are_not_rows(tmp_path, change):
    path = write_table(tmp_path / "a.csv", NAMES, VALUES, change)
    touches = converted("presses", path, tmp_path / "out", *OPTIONS).touches
    np.testing.assert_allclose(touches.reading, SKIN.readings, rtol=1e-5)


def test_lines_above_the_names_are_counted(tmp_path):
    table = read_text_table(write_table(tmp_path / "a.csv", NAMES, VALUES, lambda text: "Mine\n\n" + text))
    assert "left out: 2 lines above the names of the columns" in table.notes
    assert table.rows[0][0] == 4


OTHER_NAMES = [
    ",".join(reversed(NAMES)),
    "# " + ",".join(reversed(NAMES)),
    ",".join(renamed("_mm", "_m")),
    ",".join(["time_ms", *NAMES]),
    ";".join(NAMES),
    ",".join(f"column {i}" for i in range(18)),
]


@pytest.mark.parametrize("names", OTHER_NAMES)
def test_a_table_that_continues_with_other_columns_is_refused(tmp_path, capsys, names):
    path = write_table(tmp_path / "a.csv", NAMES, VALUES)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, names, *lines[1:]]))
    sentence = refused(capsys, "presses", path, tmp_path / "out", *OPTIONS, "--skip-bad")
    assert "line 42 names other columns" in sentence
    assert "split the file there" in sentence


def test_repeated_names_and_units_are_not_rows(tmp_path):
    text = ",".join(BARE) + "\n" + "mm,mm,mm" + 15 * ",uT" + "\n" + "1" + 17 * ",2" + "\n"
    (path := tmp_path / "a.csv").write_text(text + "# " + text)
    assert [line for line, _ in read_text_table(path).rows] == [3, 6]


def test_unused_columns_may_share_a_name(tmp_path):
    rows = [[*row, "a", "b"] for row in VALUES]
    path = write_table(tmp_path / "a.csv", [*NAMES, "note", "note"], rows)
    assert len(converted("presses", path, tmp_path / "out", *OPTIONS)) == 40


# --- times ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "unit"),
    [("Timestamp (ms)", 1e-3), ("timestamp_us", 1e-6), ("time_ns", 1e-9), ("epoch_s", 1), ("Time [sec]", 1)],
)
def test_a_time_column_is_recognised_by_its_unit(tmp_path, name, unit):
    (path := tmp_path / "a.csv").write_text(f"{name},b0x_uT\n5000,1\n6000,2\n")
    table = read_text_table(path)
    assert table.header[0] == "time_s"
    np.testing.assert_allclose([float(cells[0]) for _, cells in table.rows], [5000 * unit, 6000 * unit])


def test_only_one_of_two_clocks_is_the_time(tmp_path):
    (path := tmp_path / "a.csv").write_text("timestamp_ms,time_s,b0x_uT\n5000,1,1\n")
    assert read_text_table(path).header == ["timestamp_ms", "time_s", "b0x_uT"]


def test_a_damaged_first_stamp_does_not_condemn_later_ones(tmp_path):
    path = tmp_path / "a.csv"
    for bad, good in (("0", "1760961600.25"), ("n/a", "2025-10-20 12:00:00.25")):
        path.write_text(f"timestamp,b0x_uT\n{bad},1\n" + f"{good},2\n" * 5)
        table = read_text_table(path)
        assert table.header[0] == "time_s"
        assert float(table.rows[3][1][0]) == 1760961600.25


@pytest.mark.parametrize("stamp", ["31.12.2025 24:00", "2025-10-9 9h", "20/Oct/2025", "45950.5000{:02d}"])
def test_an_unknown_stamp_is_refused_with_the_accepted_formats(tmp_path, capsys, stamp):
    rows = "".join(f"{stamp.format(i)},{','.join('1' * 15)}\n" for i in range(20))
    (path := tmp_path / "a.csv").write_text(f"timestamp,{','.join(READING_NAMES)}\n{rows}")
    sentence = refused(capsys, "stream", path, tmp_path / "out.csv")
    assert f"line 2 has {stamp.format(0)!r} in column time_s, which is not a time in ISO 8601" in sentence
    assert "write it as 2025-10-20 12:00:00.010, or in seconds" in sentence
    assert ("may count days" in sentence) == ("{" in stamp)
