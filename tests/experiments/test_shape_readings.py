"""Labels of strokes and of single readings: features of a stroke, choices of settings, and the command."""

import json
import sys

import numpy as np
import pytest
from sklearn.ensemble import ExtraTreesClassifier

from experiments.common.reading_tables import IN_ORDER, read_reading_table, training_rows
from experiments.shapes import __main__ as command
from experiments.shapes import readings, strokes
from experiments.shapes.arguments import ShapesArgs
from i2t.errors import MissingExtraError

SAMPLES, VALUES = 12, 4


def warped(a: np.ndarray, b: np.ndarray) -> float:
    """The textbook's recursion, cell by cell."""
    reached = np.full((len(a) + 1, len(b) + 1), np.inf)
    reached[0, 0] = 0
    for i, j in np.ndindex(len(a), len(b)):
        cost = ((a[i] - b[j]) ** 2).sum()
        reached[i + 1, j + 1] = cost + min(reached[i, j + 1], reached[i + 1, j], reached[i, j])
    return float(reached[-1, -1])


def test_distances_are_those_of_the_best_alignment_and_blind_to_pace():
    a, b = np.random.default_rng(0).normal(size=(2, 3, 7, 2))
    found = strokes.warped_distances(a, b)
    np.testing.assert_allclose(found, [[warped(x, y) for y in b] for x in a])
    slow = np.repeat(a, 2, axis=1)
    np.testing.assert_allclose(np.diag(strokes.warped_distances(slow, np.concatenate([a, a[:, -1:]], 1))), 0, atol=1e-9)


def test_a_stroke_is_blind_to_the_ambient_field_and_hardly_feels_its_force():
    rng = np.random.default_rng(0)
    change = np.zeros((2, 9, 3))
    change[:, 3:7] = rng.normal(size=(1, 4, 3)) * np.array([1.0, 30.0])[:, None, None]
    field = rng.normal(size=(2, 1, 3)) * 100
    np.testing.assert_allclose(strokes.less_ambient(change + field), change, atol=1e-12)
    weak, strong = strokes.saturated(change[None], np.array([0]), 0.5)[0]
    assert np.linalg.norm(strong, axis=-1).max() < 1
    touched = slice(3, 7)
    cosine = (weak * strong)[touched].sum(-1) / (np.linalg.norm(weak, axis=-1) * np.linalg.norm(strong, axis=-1))[
        touched
    ]
    np.testing.assert_allclose(cosine, 1)


def test_the_quietest_samples_are_those_at_rest():
    rng = np.random.default_rng(0)
    stroke = 100 + rng.normal(size=(3, 20, 4))
    stroke[:, 5:12] += 30
    rest = np.delete(np.arange(20), np.s_[5:12])
    quiet = strokes.quietest(stroke)
    assert quiet.shape == (3, 4, 4)
    for own, of in zip(quiet, stroke, strict=True):
        rows = [int(np.flatnonzero((of == sample).all(1))[0]) for sample in own]
        assert set(rows) <= set(rest)
        assert rows == sorted(rows)


def test_a_moved_stroke_loses_only_what_leaves_its_window():
    change = np.arange(1.0, 11)[None, :, None]
    late, early = strokes.varied(change)[-2:, 0, :, 0]
    assert late.tolist() == [0, 0, *range(1, 9)]
    assert early.tolist() == [*range(3, 11), 0, 0]


def test_a_mean_path_has_equal_steps_at_any_pace():
    paced = np.array([0, 0.1, 0.2, 0.9, 1.0])
    paths = np.stack([np.stack([x, 0 * x], -1) for x in (paced, paced**2)])
    found = strokes.mean_paths(paths, np.array([0, 0]), 1)[0]
    np.testing.assert_allclose(np.diff(found[:, 0]), 1 / 23)


def test_a_perfect_score_has_the_certainty_that_its_number_of_rows_allows():
    """The certainty is as if half a row more had been of any label (Jeffreys), for any claim of the classifier."""
    label = np.tile([0, 1], 20)
    train, test = np.arange(30), np.arange(30, 40)
    told = readings.predict_calibrated(lambda _, rows: np.eye(2)[label[rows]], label, train, test)
    judged = sum(len(block) for _, block in readings.rolling_blocks(label, train))
    np.testing.assert_allclose(told.p.max(1), 1 - 0.25 / (0.5 + judged), rtol=1e-3)


def test_training_rows_of_a_label_precede_its_test_block():
    label = np.random.default_rng(0).integers(0, 3, 60)
    train = np.flatnonzero(np.arange(60) % 3 > 0)
    judged = []
    for before, block in readings.rolling_blocks(label, train):
        assert set(label[before]) == {0, 1, 2}
        for each in range(3):
            assert before[label[before] == each].max() < block[label[block] == each].min()
        judged += block.tolist()
    assert len(judged) == len(set(judged))
    assert set(judged) <= set(train)


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """Strokes along one line in either direction, or to and fro, in the ambient field of the hour."""
    rng = np.random.default_rng(0)
    time = np.linspace(0, 1, SAMPLES)
    columns = ",".join(f"t{i:02d}_{c}" for i in range(SAMPLES) for c in range(VALUES))
    lines = [f"number,kind,{columns}"]
    for i, kind in enumerate(rng.permutation(np.repeat(["back", "forth", "there and back"], 12))):
        part = np.clip((time - rng.uniform(0.1, 0.3)) / rng.uniform(0.4, 0.6), 0, 1)
        place = {"back": 1 - part, "forth": part, "there and back": 1 - np.abs(2 * part - 1)}[kind]
        on = ((part > 0) & (part < 1)) * rng.uniform(20, 60)
        change = np.stack([np.cos(3 * place) * on, np.sin(3 * place) * on, on, 0 * on], -1)
        reading = change + 100 * rng.normal(size=VALUES) + rng.normal(size=(SAMPLES, VALUES))
        lines.append(f"{i},{kind}," + ",".join(f"{value:.2f}" for value in reading.ravel()))
    path = tmp_path_factory.mktemp("table") / "strokes.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def said(table, out, *more: str) -> dict:
    words = ["--preset", "debug", "--readings", str(table), "--label", "kind", "--ignore", "number"]
    assert command.main([*words, "--out", str(out), *more]) == 0
    return json.loads((out / "metrics.json").read_text())


def test_strokes_are_classified_by_their_path_and_not_by_the_ambient_field(table, tmp_path, monkeypatch):
    monkeypatch.setattr(readings, "SATURATIONS", (0.5,))
    monkeypatch.setattr(readings, "PENALTIES", (300.0,))
    monkeypatch.setattr(readings, "TREES", 20)
    found = said(table, tmp_path / "run", "--samples", str(SAMPLES))
    assert found["train"] == {"in file order": 21, "at random": 21}
    for part in found["splits"].values():
        rate = {name: each["accuracy"][0] for name, each in part["methods"].items()}
        assert min(rate[readings.WARPED], rate[readings.PATH]) > 0.9
        assert rate[readings.AMBIENT] < 0.7
        assert rate[readings.REST_PAIRS] < 0.7
        assert len(part["methods"][readings.AT_REST][readings.LEAD]) == 3
        assert np.shape(part["mean_paths"]) == (3, 24, 2)
        assert np.sum(part["methods"][readings.WARPED]["confusion"]) == 15
    assert {path.name for path in (tmp_path / "run").glob("*.png")} == {"rates.png", "confusion.png", "paths.png"}


@pytest.mark.full
def test_single_readings_are_given_to_classifiers_alone(table, tmp_path):
    found = said(table, tmp_path / "run")
    assert (found["samples"], found["values"]) == (1, SAMPLES * VALUES)
    assert all(name.endswith(readings.RECORDED) for name in found["splits"]["in file order"]["methods"])


def test_a_table_that_does_not_fit_is_refused_in_a_sentence(table, tmp_path, monkeypatch, capsys):
    for more, answer in (
        (["--samples", "7"], "not a multiple of --samples 7"),
        (["--label", "sort"], "there is no column sort"),
        (["--dataset", str(tmp_path)], "pass one of them"),
        (["--samples", "0"], "at least one sample"),
    ):
        words = ["--readings", str(table), "--ignore", "number", "--out", str(tmp_path / "run")]
        words += [] if "--label" in more else ["--label", "kind"]
        (tmp_path / "file").write_text("")
        assert command.main([*words, *more]) == 2
        printed = capsys.readouterr().err
        assert answer in printed
        assert printed.count("\n") == 1
        assert not (tmp_path / "run").exists()
    monkeypatch.setitem(sys.modules, "sklearn", None)
    with pytest.raises(MissingExtraError, match="needs scikit-learn, which is missing: python -m pip install"):
        ShapesArgs(readings=table, label="kind").check()


@pytest.mark.full
def test_warped_paths_classify_later_digits_better_than_trees(shared_data):
    path = shared_data / "magnetic_digits" / "strokes.csv.gz"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    table = read_reading_table([path], label="digit", ignore=("first_row", "last_row", "stroke"))
    data = readings.as_strokes(table, 19, path)
    taught = training_rows(table, 0.6, seed=0)[IN_ORDER]
    train, test = np.flatnonzero(taught), np.flatnonzero(~taught)
    kernel = readings.WarpedStrokes(data, train).kernel(1.0, paths=False)
    ours = strokes.classify(kernel, data.label, train, test, penalty=300.0).argmax(1) == data.label[test]
    flat = strokes.less_ambient(data.reading).reshape(len(data.label), -1)
    trees = ExtraTreesClassifier(200, random_state=0).fit(flat[train], data.label[train])
    assert ours.mean() > (trees.predict(flat[test]) == data.label[test]).mean() + 0.03
