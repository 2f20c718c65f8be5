"""Logs of a skin, a row for every sample: their presses are found in bounded memory and become touches."""

import tracemalloc

import numpy as np
import pytest
from helpers.recordings import READING_NAMES, converted, refused, run, write_table

from i2t.convert import stream
from i2t.convert.stream import table_of_presses
from i2t.errors import DataError
from i2t.skin.boards import reskin_board
from i2t.unknowns.segmentation import segment_presses

RATE, NOISE = 400.0, 1.5
BOARD = reskin_board()
NAMES = ["time_s", "x_mm", "y_mm", "z_mm", "force_N", *READING_NAMES]


def log(presses: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a log in the order of NAMES, and of each press x, y and depth (mm), force (N) and reading (uT).

    The stage comes down from 2 mm above the skin at 10 mm/s, waits half a second in the skin, and goes up again.
    """
    rng = np.random.default_rng(seed)
    told = np.column_stack(
        [rng.uniform(-6, 6, (presses, 2)), rng.uniform(0.3, 0.9, presses), rng.uniform(0.5, 2, presses)]
    )
    levels = rng.normal(scale=60, size=(presses, 15))
    parts = []
    for (x, y, depth, force), level in zip(told, levels, strict=True):
        down = np.linspace(2, -depth, int(RATE * (2 + depth) / 10))
        z = np.concatenate([np.full(200, 2.0), down, np.full(200, -depth), down[::-1], np.full(120, 2.0)])
        share = np.maximum(-z, 0) / depth
        place = np.column_stack([np.full(len(z), x), np.full(len(z), y), z, force * share])
        parts.append(np.column_stack([place, share[:, None] * level]))
    rows = np.concatenate(parts)
    rows[:, 4:] += 300 * rng.normal(size=15) + NOISE * rng.normal(size=(len(rows), 15))
    return np.round(np.column_stack([np.arange(len(rows)) / RATE, rows]), 5), np.column_stack([told, levels])


def numbers(table):
    at = [table.header.index(name) for name in READING_NAMES]
    return np.array([[float(cells[i]) for i in at] for _, cells in table.rows])


def test_each_press_of_a_log_becomes_a_touch(tmp_path, capsys):
    rows, told = log(12)
    path = write_table(tmp_path / "log.csv", NAMES, rows)
    touches = converted("stream", path, tmp_path / "data", "--indenter", "sphere:4", "--as-stated").touches
    assert len(touches.reading) == 12
    np.testing.assert_allclose(1e3 * touches.T_w_o[:, :2, 3], told[:, :2], atol=1e-4)
    np.testing.assert_allclose(touches.force, told[:, 3], atol=1e-3)
    np.testing.assert_allclose(touches.reading, told[:, 4:], atol=1.5)  # the drift of a median of 20 ms and more
    # The reading leaves its noise within a few rows, in which the stage moves 25 um each.
    np.testing.assert_allclose(1e3 * touches.depth, told[:, 2], atol=0.1)
    said = capsys.readouterr().out
    assert "found: 12 presses" in said
    assert "depth counts from the height at which a press's reading left its rest" in said


def test_a_log_read_piece_by_piece_has_the_presses_of_the_whole(tmp_path, monkeypatch):
    rows, _ = log(6)
    path = write_table(tmp_path / "log.csv.gz", NAMES, rows)
    whole = table_of_presses(path, board=BOARD)
    found = segment_presses(rows[:, 0], rows[:, 5:])
    assert [line for line, _ in whole.rows] == (found.start + 2).tolist()  # the first line holds the names
    np.testing.assert_allclose(numbers(whole), found.reading, atol=1e-6)
    for at_once in (64, 1000):
        # Noise is found from the first rows, so a press may begin and end a block sooner or later.
        monkeypatch.setattr(stream, "ROWS_READ_AT_ONCE", at_once)
        pieces = table_of_presses(path, board=BOARD)
        np.testing.assert_allclose([line for line, _ in pieces.rows], [line for line, _ in whole.rows], atol=8)
        np.testing.assert_allclose(numbers(pieces), numbers(whole), atol=1.0)


def test_a_pause_and_another_session_begin_anew(tmp_path):
    rows, _ = log(4)
    warmed = rows + 500 * (np.arange(20) >= 5)  # which is no press
    later = np.arange(len(rows)) >= len(rows) // 2
    paused = np.where(later[:, None], warmed, rows)
    paused[later, 0] += 60
    assert len(table_of_presses(write_table(tmp_path / "paused.csv", NAMES, paused), board=BOARD).rows) == 4
    sessions = [[name, *row] for name, part in (("one", rows), ("two", warmed)) for row in part]
    table = table_of_presses(write_table(tmp_path / "two.csv", ["session", *NAMES], sessions), board=BOARD)
    assert [cells[0] for _, cells in table.rows] == ["one"] * 4 + ["two"] * 4


def test_damaged_rows_are_refused_or_counted(tmp_path):
    path = write_table(tmp_path / "log.csv", NAMES, log(4)[0])
    lines = path.read_text().splitlines()
    lines[50] = lines[50].rpartition(",")[0]
    lines[60] = lines[60].replace(".", "?", 1)
    lines[70] = ",".join([*lines[70].split(",")[:5], "", "", "", *lines[70].split(",")[8:]])
    path.write_text("\n".join(lines))
    with pytest.raises(DataError, match="line 51 has not 20 fields"):
        table_of_presses(path, board=BOARD)
    table = table_of_presses(path, board=BOARD, skip_bad=True)
    assert len(table.rows) == 4
    assert any("2 damaged rows; the first: " in note and "line 51" in note for note in table.notes)
    assert "left out: 1 rows in which a chip did not answer" in table.notes


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("time_s", "date", "column time_s is missing"),
        ("\n0.5,", "\n0.4975,", "at line 202 time does not increase"),
        ("\n0.5,", "\nnoon,", "line 202 has 'noon' in column time_s"),
        ("", "", "nothing presses in its"),
    ],
)
def test_what_is_no_log_of_presses_is_refused_in_a_sentence(tmp_path, old, new, sentence):
    rows = log(2)[0]
    if not old:
        rows[:, 5:] = NOISE * np.random.default_rng(1).normal(size=(len(rows), 15))
    path = write_table(tmp_path / "log.csv", NAMES, rows, lambda text: text.replace(old, new, bool(old)))
    with pytest.raises(DataError, match=sentence):
        table_of_presses(path, board=BOARD)


def test_a_log_without_places_becomes_a_table_to_complete(tmp_path, capsys):
    rows, told = log(3)
    path = write_table(tmp_path / "log.csv", np.delete(NAMES, [1, 2]), np.delete(rows, [1, 2], axis=1))
    data, table = tmp_path / "data", tmp_path / "presses.csv"
    indenter = ("--indenter", "sphere:4")
    assert "where it was pressed is not known" in refused(capsys, "stream", path, data, *indenter)
    refused(capsys, "stream", path, table, *indenter)
    assert "--indenter is missing" in refused(capsys, "stream", path, data)
    assert run("stream", path, table) == 0
    places = ["x_mm,y_mm", *(f"{x},{y}" for x, y in told[:, :2])]
    lines = zip(places, table.read_text().splitlines(), strict=True)
    table.write_text("\n".join(f"{place},{line}" for place, line in lines))
    reading = converted("presses", table, data, *indenter, "--as-stated").touches.reading
    np.testing.assert_allclose(reading, told[:, 4:], atol=1.5)


@pytest.mark.full
def test_memory_does_not_grow_with_the_log(tmp_path, monkeypatch):
    monkeypatch.setattr(stream, "ROWS_READ_AT_ONCE", 2048)
    peaks = []
    for presses in (10, 60):
        path = write_table(tmp_path / f"{presses}.csv", NAMES, log(presses)[0])
        tracemalloc.start()
        found = table_of_presses(path, board=BOARD)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(found.rows) == presses
    assert peaks[1] < 1.15 * peaks[0]
