"""The command that puts mistakes into simulated recordings and counts which are found."""

import json

import pytest

from experiments.unknowns.__main__ import main
from experiments.unknowns.run import Answer, summary


@pytest.mark.full
def test_mistakes_are_put_into_a_skin_and_found(tmp_path, capsys):
    words = ["--cases", "1", "--presses", "60", "--kinds", "lattice", "--questions", "lag", "swap"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["source"] == "simulated"
    assert set(metrics["questions"]) == {"lag", "swap"}
    lag = metrics["questions"]["lag"]["lattice"]
    assert (lag["cases"], lag["found"]["count"], lag["accused"]["count"]) == (1, 1, 0)
    assert "1 of 1" in capsys.readouterr().out


def test_shares_have_the_exact_intervals_of_rates():
    """Of 20 cases with 19 found, as tables of Clopper and Pearson have it."""
    answers = [Answer(found=i < 19, known=i < 15, accused=False, error=1e-3 * i) for i in range(20)]
    said = summary(answers)
    assert [said[name]["count"] for name in ("found", "known", "accused")] == [19, 15, 0]
    assert (said["found"]["low"], said["found"]["high"]) == pytest.approx((0.7513, 0.9987), abs=1e-4)
    assert (said["accused"]["low"], said["accused"]["high"]) == pytest.approx((0.0, 0.1684), abs=1e-4)
    assert len(said["errors_mm"]) == 15
