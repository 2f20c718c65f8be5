"""Logs of a skin, a row for every sample: their presses are found in bounded memory and become touches."""

import tracemalloc
from datetime import UTC, datetime

import numpy as np
import pytest
from helpers.recordings import READING_NAMES, converted, refused, run, write_table

from i2t.convert import log_rows
from i2t.convert.stream import table_of_presses
from i2t.errors import DataError
from i2t.recordings.segmentation import segment_presses
from i2t.skin.boards import reskin_board

RATE, NOISE = 400.0, 1.5
BOARD = reskin_board()
NAMES = ["time_s", "x_mm", "y_mm", "z_mm", "force_N", *READING_NAMES]


def log(presses: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a log in the order of NAMES, and of each press x, y and travel (mm), force (N) and reading (uT).

    The stage comes down from 2 mm above the skin at 10 mm/s, waits half a second in the skin, and goes up again.
    """
    rng = np.random.default_rng(seed)
    told = np.column_stack(
        [rng.uniform(-6, 6, (presses, 2)), rng.uniform(0.3, 0.9, presses), rng.uniform(0.5, 2, presses)]
    )
    levels = rng.normal(scale=60, size=(presses, 15))
    parts = []
    for (x, y, travel, force), level in zip(told, levels, strict=True):
        down = np.linspace(2, -travel, int(RATE * (2 + travel) / 10))
        z = np.concatenate([np.full(200, 2.0), down, np.full(200, -travel), down[::-1], np.full(120, 2.0)])
        share = np.maximum(-z, 0) / travel
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
    np.testing.assert_allclose(1e3 * touches.travel, told[:, 2], atol=0.1)
    output = capsys.readouterr().out
    assert "found: 12 presses" in output
    assert "travel counts from the height at which a press's reading left its value at rest" in output


def test_a_log_read_in_pieces_has_the_presses_of_the_whole(tmp_path, monkeypatch):
    rows, _ = log(6)
    path = write_table(tmp_path / "log.csv.gz", NAMES, rows)
    whole = table_of_presses(path, board=BOARD)
    segmented = segment_presses(rows[:, 0], rows[:, 5:])
    assert [line for line, _ in whole.rows] == (segmented.start + 2).tolist()  # the first line holds the names
    np.testing.assert_allclose(numbers(whole), segmented.reading, atol=1e-6)
    for at_once in (64, 1000):
        # Noise is found from the first rows, so a press may begin and end a block sooner or later.
        monkeypatch.setattr(log_rows, "ROWS_READ_AT_ONCE", at_once)
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
    with pytest.raises(DataError, match="line 51 has 19 fields instead of 20"):
        table_of_presses(path, board=BOARD)
    table = table_of_presses(path, board=BOARD, skip_bad=True)
    assert len(table.rows) == 4
    assert any("2 damaged rows; the first: " in note and "line 51" in note for note in table.notes)
    assert "left out: 1 rows in which a chip did not answer" in table.notes


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("time_s", "date", "column time_s is missing"),
        ("\n0.5,", "\n3600.5,", "its time at line 202, 3600.500000 s, contradicts the rows before and after it"),
        ("\n0.5,", "\nnoon,", "line 202 has 'noon' in column time_s"),
        ("", "", "no press was found in its"),
    ],
)
def test_other_tables_are_refused_in_one_sentence(tmp_path, old, new, sentence):
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
    assert "the positions of presses are unknown" in refused(capsys, "stream", path, data, *indenter)
    refused(capsys, "stream", path, table, *indenter)
    assert "--indenter is missing" in refused(capsys, "stream", path, data)
    assert run("stream", path, tmp_path / "presses.CSV") == 0
    assert run("stream", path, table) == 0
    places = ["x_mm,y_mm", *(f"{x},{y}" for x, y in told[:, :2])]
    lines = zip(places, table.read_text().splitlines(), strict=True)
    table.write_text("\n".join(f"{place},{line}" for place, line in lines))
    reading = converted("presses", table, data, *indenter, "--as-stated").touches.reading
    np.testing.assert_allclose(reading, told[:, 4:], atol=1.5)


LOG, TOLD = log(6)


def presses_of(path, time=LOG[:, 0], rows=LOG, name="time_s", **options):
    """The table of presses of a log with other stamps or readings."""
    stamps = [stamp if isinstance(stamp, str) else repr(float(stamp)) for stamp in time]
    cells = [[stamp, *row] for stamp, row in zip(stamps, rows[:, 1:], strict=True)]
    return table_of_presses(write_table(path / "log.csv", [name, *NAMES[1:]], cells), board=BOARD, **options)


def silent_log(share=0.06, gap=None, chips=slice(None)):
    """The log with rows of exact zeros: a share of all, or those of a gap."""
    rows = LOG.copy()
    gone = np.random.default_rng(0).uniform(size=len(rows)) < share
    if gap is not None:
        gone = np.isin(np.arange(len(rows)), np.arange(*gap))
    rows[np.ix_(gone, np.arange(5, 20)[chips])] = 0
    return rows, int(gone.sum())


MUTE = np.where(np.arange(20) < 5, 1.0, 0.0)
IN_A_PRESS = int(np.flatnonzero(LOG[:, 3] < 0)[300])  # in the second half of its rest in the skin


@pytest.mark.parametrize(
    "silence", [{}, {"chips": slice(6, 9)}, {"share": 0.6}, {"gap": (IN_A_PRESS, IN_A_PRESS + 40)}], ids=str
)
def test_rows_of_a_silent_board_neither_make_nor_end_a_press(tmp_path, silence):
    rows, silent = silent_log(**silence)
    table = presses_of(tmp_path, rows=rows)
    assert f"left out: {silent} rows in which a chip did not answer" in table.notes
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)


def test_a_board_that_never_answers_is_reported_by_name(tmp_path):
    for chips, sentence in ((slice(6, 9), "chip 2 does not answer"), (slice(None), "no chip answers")):
        rows, _ = silent_log(1.1, chips=chips)
        with pytest.raises(DataError, match=sentence):
            presses_of(tmp_path, rows=rows)


def changed(which, value):
    stamps = 1.76e9 + LOG[:, 0]
    stamps[which] = value(stamps[which])
    return stamps


REST = int(np.flatnonzero(np.diff(LOG[:, 3]) > 0)[-1]) + 50  # in the log's last rest
BAD_STAMPS = {
    "an hour late": (400, lambda t: t + 3600),
    "an hour early": (400, lambda t: t - 3600),
    "zero": (400, lambda t: 0 * t),
    "of several rows late": (slice(400, 430), lambda t: t + 3600),
    "of several rows zero": (slice(IN_A_PRESS, IN_A_PRESS + 30), lambda t: 0 * t),
    "of the first row": (0, lambda t: t + 3600),
    "of the last row": (-1, lambda t: t - 3600),
    "none": (400, lambda t: np.nan),
}


@pytest.mark.parametrize("bad", BAD_STAMPS)
def test_a_damaged_stamp_loses_only_its_row_and_is_named(tmp_path, bad):
    which, value = BAD_STAMPS[bad]
    stamps = changed(which, value)
    lines = np.arange(len(LOG))[which].ravel() + 2
    with pytest.raises(DataError, match=f"line {lines[0]}[ ,]"):
        presses_of(tmp_path, stamps)
    table = presses_of(tmp_path, stamps, skip_bad=True)
    assert any(f"left out: {len(lines)} damaged rows" in note for note in table.notes)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)


def full_after(unit, bits, signed=False):
    """Time stamps of a counter that overflows in the middle of the log."""
    counts = np.round(LOG[:, 0] / unit).astype(np.int64)
    counts += 2**bits // (1 + signed) - counts[len(counts) // 2]
    return (counts + signed * 2 ** (bits - 1)) % 2**bits - signed * 2 ** (bits - 1)


def texts(form, start=1.76e9):
    return [datetime.fromtimestamp(start + t, UTC).strftime(form) for t in LOG[:, 0]]


CLOCKS = {
    "Windows": ("time_s", np.floor(LOG[:, 0] / 0.015625) * 0.015625 + 1.76e9),
    "whole seconds": ("time_s", np.floor(LOG[:, 0] + 0.3)),
    "milliseconds since 1970": ("timestamp", np.round(1e3 * (1.76e9 + LOG[:, 0]))),
    "nanoseconds since 1970": ("%time", np.round(1e9 * (1.76e9 + LOG[:, 0]))),
    "micros()": ("time_us", full_after(1e-6, 32)),
    "signed micros()": ("time_us", full_after(1e-6, 32, signed=True)),
    "millis()": ("time_ms", full_after(1e-3, 32)),
    "16 bits of milliseconds": ("time_ms", full_after(1e-3, 16)),
    "minutes and seconds": ("time", [f"{59 + t // 60:02.0f}:{t % 60:04.1f}" for t in LOG[:, 0]]),
    "an hour that ends": ("time", texts("%M:%S.%f", 1.76e9 // 3600 * 3600 - 3)),
    "ISO 8601": ("timestamp", texts("%Y-%m-%d %H:%M:%S.%f")),
    "ISO 8601 with a zone": ("time_s", texts("%Y-%m-%dT%H:%M:%S.%fZ")),
    "a day that ends": ("Time", texts("%H:%M:%S.%f", 1.76e9 // 86400 * 86400 - 3)),
    "set back an hour in a press": ("time_s", changed(slice(IN_A_PRESS, None), lambda t: t - 3600)),
    "set forward an hour in a press": ("time_s", changed(slice(IN_A_PRESS, None), lambda t: t + 3600)),
    "set back a little": ("time_s", changed(slice(IN_A_PRESS, None), lambda t: t - 0.3)),
    "started anew": ("time_s", np.where(np.arange(len(LOG)) < REST, LOG[:, 0], LOG[:, 0] - LOG[REST, 0])),
    "unset at first": ("time_s", changed(slice(0, 100), lambda t: 0 * t)),
}


@pytest.mark.parametrize("clock", CLOCKS)
def test_presses_are_the_same_by_any_clock(tmp_path, clock):
    name, stamps = CLOCKS[clock]
    table = presses_of(tmp_path, stamps, name=name)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)
    assert not any("damaged" in note for note in table.notes)


def test_an_overflow_of_a_counter_is_continued(tmp_path):
    table = presses_of(tmp_path, full_after(1e-6, 32), name="time_us")
    time = [float(cells[0]) for _, cells in table.rows]
    even = [float(cells[0]) for _, cells in presses_of(tmp_path).rows]
    np.testing.assert_allclose(np.diff(time), np.diff(even), atol=0.05)
    assert any("a 32-bit counter of microseconds overflows" in note for note in table.notes)


def test_useless_stamps_are_noted_and_a_rate_can_be_stated(tmp_path):
    for stamps in (np.float32(1.76e9 + LOG[:, 0]), np.zeros(len(LOG))):
        table = presses_of(tmp_path, stamps)
        assert any("100 rows per second" in note and "--rate-hz" in note for note in table.notes)
        assert all(cells[0] == "" for _, cells in table.rows)
        stated = presses_of(tmp_path, stamps, rate=RATE)
        for either in (table, stated, presses_of(tmp_path, [""] * len(LOG), name="note", rate=RATE)):
            np.testing.assert_allclose(numbers(either), TOLD[:, 4:], atol=2.0)
        assert not any("assumed: 100" in note for note in stated.notes)


@pytest.mark.parametrize(
    ("name", "stamps", "sentence"),
    [
        ("time_s", 1e6 * LOG[:, 0], "rows are 2.5e.03 s apart, slower than a press; name its column by the unit"),
        ("time_ms", LOG[:, 0], "rows are 2.5e-06 s apart, faster than any board"),
        ("time_s", np.random.default_rng(0).permutation(LOG[:, 0]), "they are not in order of time; sort them"),
        ("time_s", LOG[::-1, 0], "they are not in order of time; sort them"),
        ("time", LOG[:, 0], "name the column of time by its unit"),
        ("time_s", texts("%d.%m.%Y %H:%M:%S"), "which is not a time in ISO 8601"),
        ("time_s", texts("%Y-%m-%d %H:%M.%f"), "which is not a time in ISO 8601"),
    ],
    ids=["unit", "other unit", "shuffled", "descending", "no unit", "other dates", "decimal minutes"],
)
def test_an_impossible_time_is_refused_with_its_remedy(tmp_path, name, stamps, sentence):
    with pytest.raises(DataError, match=sentence):
        presses_of(tmp_path, stamps, name=name)


def test_a_simulated_log_gives_a_simulated_set(tmp_path):
    rows = [[*row, "simulated"] for row in LOG]
    path = write_table(tmp_path / "log.csv", [*NAMES, "source"], rows)
    assert converted("stream", path, tmp_path / "dst", "--indenter", "sphere:4", "--as-stated").source == "simulated"


@pytest.mark.full
def test_memory_does_not_grow_with_the_log(tmp_path, monkeypatch):
    monkeypatch.setattr(log_rows, "ROWS_READ_AT_ONCE", 2048)
    peaks = []
    for presses in (10, 60):
        path = write_table(tmp_path / f"{presses}.csv", NAMES, log(presses)[0])
        tracemalloc.start()
        table = table_of_presses(path, board=BOARD)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(table.rows) == presses
    assert peaks[1] < 1.15 * peaks[0]


def cut(seconds, before):
    """The log without the rows of some seconds before a row of its fourth press."""
    moment = int(np.flatnonzero(np.diff(np.sign(LOG[:, 3])) < 0)[3]) + before
    kept = np.ones(len(LOG), bool)
    kept[moment - int(seconds * RATE) : moment] = False
    return LOG[kept]


def one_clock(rows):
    """The time of rows, and the rows."""
    return rows[:, 0], rows


FIRST_IN_SKIN = int(np.flatnonzero(LOG[:, 3] < 0)[0])
CUT_PRESSES = {
    "rows missing up to a press": (*one_clock(cut(1.2, 60)), {3}),
    "rows missing up to its beginning": (*one_clock(cut(1.2, 5)), {3}),
    "begins pressed": (*one_clock(LOG[FIRST_IN_SKIN + 60 :]), {0}),
    "silent up to a press": (
        LOG[:, 0],
        np.where(np.isin(LOG[:, 0], cut(1.3, 60)[:, 0])[:, None], LOG, LOG * MUTE),
        {3},
    ),
    "started anew in a press": (np.where(LOG[:, 0] < 4, LOG[:, 0], LOG[:, 0] - 4), LOG, set()),
}


@pytest.mark.parametrize("name", CUT_PRESSES)
def test_a_cut_press_does_not_affect_other_presses(tmp_path, name):
    time, rows, lost = CUT_PRESSES[name]
    table = presses_of(tmp_path, time, rows)
    distance = np.linalg.norm(numbers(table)[:, None] - TOLD[:, 4:], axis=2).min(0)
    assert {int(press) for press in np.flatnonzero(distance > 10)} <= lost
    assert len(table.rows) <= len(TOLD)
    assert len(table.rows) == len(TOLD) or any("that had begun before their part" in note for note in table.notes)


def test_a_session_that_changes_with_each_press_cuts_no_press(tmp_path):
    pressed = LOG[:, 3] < 0
    which = np.cumsum(np.diff(pressed, prepend=False) & pressed)
    sessions = [f"press {k}" if on else "" for k, on in zip(which, pressed, strict=True)]
    rows = [[session, *row] for session, row in zip(sessions, LOG, strict=True)]
    table = table_of_presses(write_table(tmp_path / "log.csv", ["session", *NAMES], rows), board=BOARD)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)
    assert [cells[0] for _, cells in table.rows] == [f"press {k}" for k in range(1, 7)]


def test_single_rows_that_stand_out_are_replaced_and_counted(tmp_path):
    rows = LOG.copy()
    rng = np.random.default_rng(0)
    spiked = rng.uniform(size=len(rows)) < 0.005
    rows[spiked, 5:] += rng.choice([-500, 500], (int(spiked.sum()), 15))
    table = presses_of(tmp_path, rows=rows)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)
    replaced = next(int(note.split()[3]) for note in table.notes if note.startswith("replaced: "))
    assert abs(replaced - spiked.sum()) <= 2
    assert not any("replaced" in note for note in presses_of(tmp_path).notes)


def test_a_sensor_that_is_read_too_often_makes_no_press(tmp_path):
    held = LOG[::8].repeat(8, axis=0)[: len(LOG)]
    table = presses_of(tmp_path, rows=held)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=4.0)
    assert any("read faster than it measures" in note for note in table.notes)


def test_rows_that_repeat_earlier_ones_are_left_out(tmp_path):
    again = LOG[np.r_[: REST - 100, REST - 500 : len(LOG)]]
    table = presses_of(tmp_path, *one_clock(again))
    assert any("left out: 400 rows that repeat earlier ones" in note for note in table.notes)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)


def test_a_depth_is_unknown_if_first_contact_was_not_recorded(tmp_path):
    met = int(np.flatnonzero(np.diff(np.sign(LOG[:, 3])) < 0)[2])
    table = presses_of(tmp_path, *one_clock(np.delete(LOG, slice(met - 20, met + 20), axis=0)))
    travels = [cells[table.header.index("travel_mm")] for _, cells in table.rows]
    assert [travel == "" for travel in travels] == [False, False, True, False, False, False]
    assert any("1 presses begin where rows are missing" in note for note in table.notes)


def test_two_presses_with_silence_between_are_two(tmp_path):
    begins = np.flatnonzero(np.diff(np.sign(LOG[:, 3])) < 0)
    rows = LOG.copy()
    rows[begins[1] + 100 : begins[2] + 100, 5:] = 0
    table = presses_of(tmp_path, rows=rows)
    distance = np.linalg.norm(numbers(table)[:, None] - TOLD[:, 4:], axis=2).min(0)
    assert set(np.flatnonzero(distance > 10)) <= {2}
    assert any("that had begun before their part" in note for note in table.notes)


def test_rows_in_batches_are_evenly_spaced(tmp_path):
    within = np.arange(len(LOG)) % 8
    arrived = LOG[:, 0] + (7 - within) / RATE + 150e-6 * within
    table = presses_of(tmp_path, arrived)
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)
    assert any(note.startswith("rows come in batches every 0.02 s") for note in table.notes)


def test_presses_of_a_clock_of_whole_seconds_have_times_between_them(tmp_path):
    time = [[float(row[0]) for _, row in presses_of(tmp_path, stamps).rows] for stamps in (LOG[:, 0], LOG[:, 0] // 1)]
    np.testing.assert_allclose(*time, atol=0.1)


def test_a_counter_that_overflows_often_is_refused_with_its_remedy(tmp_path):
    with pytest.raises(DataError, match="give --rate-hz"):
        presses_of(tmp_path, np.round(1e6 * LOG[:, 0]) % 2**14, name="time_us")


def test_a_press_that_is_not_steady_before_the_log_ends_is_left_out(tmp_path):
    ramp = np.linspace(0, 1, 200)[:, None] * TOLD[0, 4:]
    rows = np.concatenate([LOG, LOG[-200:]])
    rows[:, 0] = np.arange(len(rows)) / RATE
    rows[-200:, 5:] += ramp
    table = presses_of(tmp_path, *one_clock(rows))
    np.testing.assert_allclose(numbers(table), TOLD[:, 4:], atol=2.0)
    assert any("1 presses that were not steady" in note for note in table.notes)
