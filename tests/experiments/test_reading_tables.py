"""Tables of readings are read unchanged or refused by line and column, and are split within groups and labels."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from experiments.common.reading_tables import (
    AT_RANDOM,
    IN_ORDER,
    ReadingTable,
    close_followers,
    read_reading_table,
    refuse_counters,
    require_rows,
    rows_of_labels,
    training_rows,
)
from i2t.errors import DataError

GRASPS = Path(os.environ.get("I2T_DATA", "")) / "biotac_sp"


def written(path: Path, text: str) -> Path:
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path


def table_of(tmp_path: Path, count: int = 10):
    rows = "".join(f"{'ab'[i % 2]},{'xy'[i // count % 2]},{i},{-i}\n" for i in range(2 * count))
    return read_reading_table([written(tmp_path / "t.csv", f"what,day,u,v\n{rows}")], label="what", group="day")


def test_columns_that_are_neither_label_nor_group_nor_ignored_are_the_reading(tmp_path):
    text = "time_ms,Größe,x_cm,day,run\n7,10,1.5,a,2\n8,9,-2,b,3\n9,10,0,a,1e3\n"
    for name in ("one.csv", "one.csv.gz"):
        table = read_reading_table([written(tmp_path / name, text)], label="Größe", group="day", ignore=["time_ms"])
        assert table.columns == ("x_cm", "run")  # as named, in the units of the file
        assert table.labels == ("9", "10")  # by size
        assert table.groups == ("a", "b")
        np.testing.assert_array_equal(table.reading, [[1.5, 2], [-2, 3], [0, 1000]])
        np.testing.assert_array_equal(table.label, [1, 0, 1])
        np.testing.assert_array_equal(table.group, [0, 1, 0])


def test_several_files_are_groups_and_equal_names_are_distinguished(tmp_path):
    (tmp_path / "later").mkdir()
    first = written(tmp_path / "t.csv", "what,u\nb,1\na,2\n")
    second = written(tmp_path / "s.csv.gz", "what,u\na,3\n")
    table = read_reading_table([first, second], label="what")
    assert (table.labels, table.groups) == (("a", "b"), ("t", "s"))
    np.testing.assert_array_equal(table.group, [0, 0, 1])
    again = written(tmp_path / "later" / "t.csv", "what,u\na,3\n")
    assert len(read_reading_table([first, again], label="what").groups) == 2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("what,u\na,1\nb,\n", "line 3 has '' in column u, which is not a plausible number; .*--ignore"),
        ("what,u\na,1\nb,nan\n", "line 3 has 'nan' in column u, which is not a plausible number"),
        ("what,u\na,1\nb,-1e31\n", "line 3 has '-1e31' in column u, which is not a plausible number"),
        ("what,u\na,soft\nb,2\n", "line 2 has 'soft' in column u"),
        ("what,u\na,1\n ,2\n", "line 3 has nothing in column what"),
        ("what,u\na,1\nb,2,3\n", "line 3 has 3 fields instead of 2"),
        ("what,u\na,1\na,2\n", "holds a only"),
        ("what,u,u\na,1,2\nb,1,2\n", "two columns called u"),
        ("what\na\nb\n", "no column is left"),
        ("what,u\n", "holds no row"),
        ("which,u\na,1\n", "there is no column what"),
    ],
)
def test_a_table_that_is_damaged_is_refused_by_line_and_column(tmp_path, text, said):
    with pytest.raises(DataError, match=said):
        read_reading_table([written(tmp_path / "t.csv", text)], label="what")


def test_tables_of_other_columns_and_columns_named_twice_are_refused(tmp_path):
    paths = [written(tmp_path / f"{name}.csv", f"what,{name}\na,1\nb,2\n") for name in "uv"]
    with pytest.raises(DataError, match="have different columns"):
        read_reading_table(paths, label="what")
    with pytest.raises(ValueError, match="column what is named twice"):
        read_reading_table(paths[:1], label="what", ignore=["what"])


def test_training_rows_come_first_and_a_random_split_has_as_many(tmp_path):
    table = table_of(tmp_path)
    first, random = training_rows(table, 0.6, seed=0).values()
    none, all_but_none = (training_rows(table, share, seed=0)[IN_ORDER] for share in (0.01, 0.99))
    for rows in rows_of_labels(table):
        np.testing.assert_array_equal(first[rows], [1, 1, 1, 0, 0])
        assert random[rows].sum() == 3
        assert (none[rows].sum(), all_but_none[rows].sum()) == (1, 4)  # one at least on either side
    assert (first != random).any()
    np.testing.assert_array_equal(random, training_rows(table, 0.6, seed=0)[AT_RANDOM])


def test_labels_of_few_rows_and_groups_of_one_label_are_refused(tmp_path):
    path = tmp_path / "t.csv"
    require_rows(table_of(tmp_path), 5, path)
    with pytest.raises(DataError, match=r"t\.csv: label a has 5 of the 6 rows that are needed in group x"):
        require_rows(table_of(tmp_path), 6, path)
    text = "what,day,u\na,x,1\nb,y,2\n"
    alone = read_reading_table([written(tmp_path / "t.csv", text)], label="what", group="day")
    with pytest.raises(DataError, match="group x holds one label"):
        require_rows(alone, 1, path)


def test_one_table_given_twice_is_refused_and_copied_rows_are_reported(tmp_path):
    """A copy under another name counts too, because its rows would be both trained and tested on."""
    first = written(tmp_path / "t.csv", "what,u\nb,1\na,2\nb,3\n")
    (tmp_path / "link.csv").symlink_to(first)
    for again in (first, tmp_path / "." / "t.csv", tmp_path / "link.csv"):
        with pytest.raises(ValueError, match="is given twice"):
            read_reading_table([first, again], label="what")
    copies = written(tmp_path / "copies.csv", "what,u\nb,1\na,2\nb,1\na,1\n")
    with pytest.warns(UserWarning, match="1 of 4 rows repeat another exactly"):
        read_reading_table([copies], label="what")


@pytest.mark.parametrize("labels", [("1.234", "1,5"), ("#1", "#2"), ("1_000", "a"), ("b#", "1e3")])
def test_a_label_is_kept_unchanged(tmp_path, labels):
    text = "what;u;v\n" + "".join(f"{label};{i},5;2,25\n" for i, label in enumerate(labels * 2))
    table = read_reading_table([written(tmp_path / "t.csv", text)], label="what")
    assert set(table.labels) == set(labels)
    np.testing.assert_array_equal(table.reading[:, 0], [0.5, 1.5, 2.5, 3.5])
    text = "u,what\n" + "".join(f'{i},"{label}"\n' for i, label in enumerate(labels * 2))
    assert set(read_reading_table([written(tmp_path / "t.csv", text)], label="what").labels) == set(labels)


def test_a_line_that_may_be_a_label_or_a_comment_is_refused_and_comments_are_counted(tmp_path):
    text = "what,u\na,1\n# a pause\nb,2\n"
    table = read_reading_table([written(tmp_path / "t.csv", text)], label="what")
    assert any("1 lines of comments between the rows" in note for note in table.notes)
    with pytest.raises(DataError, match=r"up to line 5 \('#a'\) begin with # and others do not"):
        read_reading_table([written(tmp_path / "t.csv", text + "#a,3\n")], label="what")


def test_a_reading_that_may_be_grouped_is_refused_without_a_mark(tmp_path):
    with pytest.raises(DataError, match=r"line 3 has '1\.234' in column u, which may be decimal or grouped thousands"):
        read_reading_table([written(tmp_path / "t.csv", "what;u\na;1\nb;1.234\n")], label="what")


@pytest.mark.parametrize("names", ["u,v,w", "b0x_uT,b0y_uT,b0z_uT"])
def test_rows_of_a_silent_sensor_are_left_out_and_counted(tmp_path, names):
    rows = "".join(f"{'ab'[i % 2]},{i + 1},{-i - 1},{i + 0.5}\n" for i in range(6))
    text = f"what,{names}\n{rows}a,0,0,0\nb,0,0,0\n"
    table = read_reading_table([written(tmp_path / "t.csv", text)], label="what")
    assert len(table.reading) == 6
    assert any("2 rows in which a chip did not answer" in note for note in table.notes)
    with pytest.raises(DataError, match="answer"):
        read_reading_table([written(tmp_path / "t.csv", f"what,{names}\na,0,0,0\nb,0,0,0\n")], label="what")


def test_rows_of_zeros_are_readings_of_sensors_that_often_send_zeros(tmp_path):
    text = "what,u,v,w\na,0,0,0\nb,0,1,0\nb,1,0,0\nb,0,0,1\n"
    assert len(read_reading_table([written(tmp_path / "t.csv", text)], label="what").reading) == 4


@pytest.mark.skipif(not GRASPS.is_dir(), reason="needs the real grasps in I2T_DATA")
def test_the_real_grasps_are_read_whole():
    table = read_reading_table(sorted(GRASPS.glob("*.csv.gz")), label="object", ignore=["slipped"])
    assert table.reading.shape == (4682, 72)
    assert (len(table.labels), len(table.groups)) == (41, 3)
    assert min(map(len, rows_of_labels(table))) == 25


def clumps(samples: int, drift: float = 0.0) -> ReadingTable:
    """Four labels of 40 rows of six values, `samples` of each touch, whose touches drift from row to row."""
    rng = np.random.default_rng(1)
    label = np.repeat(np.arange(4), 40)
    own = rng.normal(size=(160, 6))[np.arange(160) // samples] if not drift else 0.0
    reading = 2 * rng.normal(size=(4, 6))[label] + own + 0.05 * rng.normal(size=(160, 6))
    reading = reading + drift * np.cumsum(rng.normal(size=(160, 6)), 0)
    return ReadingTable(reading, label, tuple("abcd"), 0 * label, ("g",), tuple("uvwxyz"))


@pytest.mark.parametrize("samples", [2, 4, 10])
def test_samples_of_one_touch_are_distinguished_from_touches_and_from_drift(samples):
    assert close_followers(clumps(samples)) == pytest.approx(1 - 1 / samples, abs=0.1)
    assert close_followers(clumps(1)) == 0
    assert close_followers(clumps(1, drift=0.3)) == 0


@pytest.mark.skipif(not GRASPS.is_dir(), reason="needs the real data set (I2T_DATA)")
def test_held_grasps_of_real_recordings_are_recognised_as_repeated_samples():
    for path in sorted(GRASPS.glob("*.csv.gz")):
        assert 0.1 < close_followers(read_reading_table([path], label="object", ignore=["slipped"])) < 0.6


def test_rows_of_one_touch_become_their_mean(tmp_path):
    rows = ["a,1,0", "a,1,2", "a,1,4", "a,2,5", "b,2,6", "b,3,7", "b,3,9", "a,1,10"]
    path = written(tmp_path / "t.csv", "what,grasp,u\n" + "\n".join(rows))
    table = read_reading_table([path], label="what", touch="grasp")
    np.testing.assert_array_equal(table.reading[:, 0], [2, 5, 6, 8, 10])  # a label's change and a return begin a touch
    assert [table.labels[i] for i in table.label] == ["a", "a", "b", "b", "a"]
    assert (table.samples, table.columns) == (8, ("u",))
    other = written(tmp_path / "s.csv", "what,grasp,u\na,1,20\na,1,22\n")  # a file begins anew
    both = read_reading_table([tmp_path / "t.csv", other], label="what", touch="grasp")
    np.testing.assert_array_equal(both.reading[-2:, 0], [10, 21])
    with pytest.raises(DataError, match="there is no column stroke"):
        read_reading_table([other], label="what", touch="stroke")


def test_a_counter_column_is_not_a_reading():
    table = clumps(1)
    refuse_counters(table, Path("t.csv"))
    for counter in (np.arange(160.0), np.arange(160) // 4, 1e9 + 0.01 * np.arange(160), np.arange(160) % 40):
        counted = table._replace(reading=np.column_stack([table.reading, counter]), columns=(*table.columns, "grasp"))
        with pytest.raises(DataError, match=r"t.csv: column grasp never falls .*--ignore grasp.*--touch grasp"):
            refuse_counters(counted, Path("t.csv"))
    refuse_counters(table._replace(reading=np.column_stack([table.reading, np.full(160, 7.0)])), Path("t.csv"))
