"""Recognition from tables of readings: folds in time, beliefs with shared errors, unknown labels, the command."""

import json

import numpy as np
import pytest

from experiments.recognize.__main__ import main
from experiments.recognize.reading_methods import (
    BOTH,
    KNN,
    LOGISTIC,
    TREES,
    ClassifierConfig,
    Fold,
    Labelled,
    all_log_probabilities,
    choose,
    draw_series,
    folds_in_time,
    log_probabilities,
    novelty,
    product,
)
from i2t.recognition.calibrated import calibrated_beliefs, fit_temperature_to_sets
from i2t.recognition.metrics import log_loss

RNG = np.random.default_rng(0)


def touches(labels: int, rows: int, seed: int, session: float = 0.0) -> Labelled:
    """Unit normal readings about the labels' corners, 2 apart, with a shift that all rows of a label share."""
    rng = np.random.default_rng(seed)
    label = np.repeat(np.arange(labels), rows)
    shift = session * rng.normal(size=(labels, labels))
    return Labelled(2 * np.eye(labels)[label] + shift[label] + rng.normal(size=(len(label), labels)), label)


def test_test_rows_of_a_fold_come_before_or_after_all_training_rows():
    label = np.tile([0, 1], 10)  # rows of the labels take turns
    for (taught, judged), after in zip(folds_in_time(label, 0.6), (1, -1), strict=True):
        for c in (0, 1):
            first, last = (rows[label[rows] == c] for rows in (taught, judged))
            assert (len(first), len(last)) == (6, 4)
            assert (last.min() > first.max()) if after == 1 else (last.max() < first.min())
    assert [len(rows) for fold in folds_in_time(np.zeros(3, int), 0.9) for rows in fold] == [2, 1, 2, 1]


def test_episodes_are_drawn_without_replacement_from_one_label():
    label = np.array([0, 0, 0, 0, 1, 1, 1])
    series = draw_series(label, each=4, most=10, seed=0)
    assert series.rows.shape == (8, 3)  # as many touches as the least label has rows
    assert (label[series.rows] == series.truth[:, None]).all()
    assert all(len(set(rows)) == 3 for rows in series.rows)
    assert draw_series(label, each=4, most=2, seed=0).rows.shape == (8, 2)


def test_no_touch_rules_a_label_out_and_both_classifiers_make_their_geometric_mean():
    found = all_log_probabilities(touches(3, 10, 0), touches(3, 4, 1).reading, seed=0)
    for name, log_p in found.items():
        np.testing.assert_allclose(np.exp(log_p).sum(1), 1, err_msg=name)
        assert np.exp(log_p).min() > 0.01 / 3 * (0.9 if name != BOTH else 0.5)
    mean = np.sqrt(np.exp(found[TREES] + found[LOGISTIC]))
    np.testing.assert_allclose(np.exp(found[BOTH]), mean / mean.sum(1, keepdims=True))


def test_a_known_reading_has_its_neighbours_and_no_novelty():
    train = touches(3, 10, 0)
    np.testing.assert_allclose(novelty(train, train.reading), 0, atol=1e-6)
    far = train.reading + np.array([0.0, 0.0, 100.0])
    assert (novelty(train, far) > 50).all()
    p = np.exp(log_probabilities(KNN, train, train.reading, 0))  # the reading itself outweighs all others
    np.testing.assert_allclose(p[np.arange(30), train.label], 0.99 + 0.01 / 3)


def test_the_product_is_that_of_the_touches():
    p = RNG.dirichlet(np.ones(4), (5, 3))
    wanted = np.cumprod(p, 1)
    np.testing.assert_allclose(product(np.log(p)), wanted / wanted.sum(-1, keepdims=True))


def shared_errors(seed: int, labels: int = 6, episodes: int = 300, count: int = 8) -> Fold:
    """Log likelihoods of touches with unit noise whose episodes share an error of the same size."""
    rng = np.random.default_rng(seed)
    truth = rng.integers(labels, size=episodes)
    shared = rng.normal(size=(episodes, 1, labels))
    y = 2 * np.eye(labels)[truth][:, None] + shared + rng.normal(size=(episodes, count, labels))
    log_p = 2 * y  # of unit normal readings about 2 at the label's place
    return Fold({KNN: log_p - np.log(np.exp(log_p).sum(-1, keepdims=True))}, truth)


def test_a_temperature_that_grows_takes_account_of_errors_that_touches_share():
    """y = truth + shared + own error, both of variance 1: n touches have the variance 1 + 1/n, and the product, which
    takes it for 1/n, needs the temperature n + 1 = 2 (1 + (n - 1) / 2).
    """
    folds = [shared_errors(0), shared_errors(1, labels=5, count=5)]
    found = fit_temperature_to_sets([(product(fold.log_p[KNN]), fold.truth) for fold in folds])
    assert found.initial == pytest.approx(2, rel=0.15)
    assert found.growth == pytest.approx(0.5, rel=0.2)
    choice, test = choose(folds, [KNN]), shared_errors(2)
    p = product(test.log_p[KNN])
    ours, independent = (log_loss(x, test.truth)[:, -1].mean() for x in (calibrated_beliefs(p, choice.temperature), p))
    assert ours < independent - 0.3


def test_perfect_folds_do_not_give_a_zero_width_interval():
    sure = Fold({KNN: np.log(np.tile([0.99, 0.01], (4, 3, 1)))}, np.zeros(4, int))
    p = calibrated_beliefs(product(sure.log_p[KNN]), choose([sure], [KNN]).temperature)
    assert p[0, -1, 0] < 0.95  # of one label that was always right, one more may be anything


def test_removing_a_label_from_a_fold_keeps_the_others():
    fold = Fold({KNN: RNG.normal(size=(4, 2, 3))}, np.array([0, 1, 2, 2]))
    less = fold.without(np.array([1]))
    np.testing.assert_array_equal(less.truth, [0, 1, 1])
    np.testing.assert_array_equal(less.log_p[KNN], fold.log_p[KNN][[0, 2, 3]][..., [0, 2]])


# --- the command ---


def write_table(path, labels: str, rows: int = 8) -> None:
    found = touches(len(labels), rows, 0, session=1.0)
    lines = [
        f"{labels[c]},{','.join(f'{x:.3f}' for x in y)},7" for c, y in zip(found.label, found.reading, strict=True)
    ]
    names = ",".join(f"Kanal{i}" for i in range(len(labels)))
    path.write_text("\n".join([f"Stück,{names},fest", *lines]) + "\n")


def test_the_command_reports_both_splits_and_unknown_labels_with_intervals(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("experiments.recognize.reading_methods.CONFIG", ClassifierConfig(trees=10))
    for name, labels in (("a", "xyz"), ("b", "wxy")):  # groups of other labels
        write_table(tmp_path / f"{name}.csv", labels)
    words = ["recorded", "--readings", str(tmp_path / "a.csv"), str(tmp_path / "b.csv"), "--label", "Stück"]
    out = tmp_path / "out"
    assert main([*words, "--episodes", "2", "--draws", "1", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "split in file order" in said
    assert "episodes with labels held out" in said
    found = json.loads((out / "metrics.json").read_text())
    assert (found["labels"], found["groups"]) == (["w", "x", "y", "z"], ["a", "b"])
    for entry in found["splits"].values():
        assert (entry["episodes"], entry["touches"]) == (12, 3)  # of 8 rows, 3 are not for training
        assert set(entry["methods"]) == {"nearest neighbours", "votes", "average", "product", "calibrated belief"}
        for scores in entry["methods"].values():
            assert set(scores["by_group"]) == {"a", "b"}
            assert all(
                low <= mean <= high for mean, low, high in zip(*scores["accuracy"].values(), strict=True)
            )  # over the four labels
            assert [stop["requested_error"] for stop in scores["stopping"]] == [0.01, 0.05, 0.1]
    assert found["unknown"]["episodes"] > found["unknown"]["unknown"] > 0
    assert all(0 <= x <= 1 for x in found["unknown"]["calibrated belief"]["mean"])


def test_two_labels_are_classified_none_is_held_out_and_a_run_resumes(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.recognize.reading_methods.CONFIG", ClassifierConfig(trees=10))
    write_table(tmp_path / "t.csv", "xy", rows=5)
    out = tmp_path / "out"
    words = ["recorded", "--readings", str(tmp_path / "t.csv"), "--label", "Stück", "--episodes", "1"]
    assert main([*words, "--out", str(out)]) == 0
    found = (out / "metrics.json").read_bytes()
    assert json.loads(found)["unknown"] is None
    for made in (out / "metrics.json", out / "at_random-0.npz"):
        made.unlink()
    assert main([*words, "--out", str(out), "--resume"]) == 0
    assert (out / "metrics.json").read_bytes() == found


def test_a_label_of_few_rows_is_refused_before_anything_is_written(tmp_path, capsys):
    write_table(tmp_path / "t.csv", "xy", rows=4)
    words = ["recorded", "--readings", str(tmp_path / "t.csv"), "--label", "Stück", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "label x has 4 of the 5 rows that are needed in group t" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_fewer_touches_than_requested_and_repeated_samples_are_reported_and_kept(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("experiments.recognize.reading_methods.CONFIG", ClassifierConfig(trees=10))
    rng = np.random.default_rng(0)
    lines = [
        f"{'xy'[c]},{grasp},{','.join(f'{v:.4f}' for v in 3 * c + own + 0.02 * rng.normal(size=4))}"
        for c in (0, 1)
        for grasp, own in enumerate(rng.normal(size=(10, 4)))
        for _ in range(5)
    ]
    (tmp_path / "t.csv").write_text("\n".join(["what,grasp,a,b,c,d", *lines]) + "\n")
    words = ["recorded", "--readings", str(tmp_path / "t.csv"), "--label", "what", "--episodes", "1"]
    assert main([*words, "--ignore", "grasp", "--out", str(tmp_path / "rows")]) == 0
    out = capsys.readouterr().out
    assert "warning: 8" in out  # four in five rows follow a sample of the same grasp
    assert "--touch COLUMN" in out
    assert main([*words, "--touch", "grasp", "--out", str(tmp_path / "touches")]) == 0
    out = capsys.readouterr().out
    assert "100 rows are samples of 20 touches by column grasp" in out
    assert "episodes have 4 touches, and 10 were asked for (--max-touches): label x in group t has 10 touches" in out
    metrics = json.loads((tmp_path / "touches" / "metrics.json").read_text())
    assert (metrics["samples"], metrics["rows"], metrics["touches_asked"]) == (100, 20, 10)
    assert metrics["splits"]["in file order"]["touches"] == 4
    assert main([*words, "--touch", "grasp", "--max-touches", "4", "--out", str(tmp_path / "as-asked")]) == 0
    assert "asked for" not in capsys.readouterr().out
