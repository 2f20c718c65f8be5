"""The benchmark compares like with like and says what it found; how fast anything was is not tested."""

import json
import sys
from pathlib import Path

import jax
import pytest

from experiments import benchmark
from experiments.benchmark import Benchmark, MissingPeerError, Row, Training
from i2t import training
from i2t.model import ModelConfig
from i2t.training import TrainConfig

TINY = Training(
    touches=20,
    epochs=2,
    seeds=2,
    model=ModelConfig(pixels=6),
    train=TrainConfig(schedule="constant", batch_size=8, learning_rate=1e-4),
)


def test_training_section_against_pytorch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The section itself checks that both trainings have the same losses, and fails where they have not."""
    pytest.importorskip("torch", reason="the extra bench is not installed")
    rows = benchmark.main(Benchmark(turns=2, out=tmp_path / "out", training=TINY))
    assert [row.peer_name.split(",")[0] for row in rows] == ["eager PyTorch", "the seeds one by one"]
    report = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [Row(**row) for row in report["rows"]] == rows
    assert report["config"]["training"]["touches"] == 20
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(rows)


def test_unequal_work_is_not_compared() -> None:
    torch = pytest.importorskip("torch", reason="the extra bench is not installed")
    batch = benchmark._random_touches(TINY)
    state = jax.jit(lambda: training.start(TINY.model, TINY.train, TINY.touches))()
    peer = benchmark.TorchTraining(TINY, state, batch, "foreach")
    before = peer.epochs()
    again = benchmark.TorchTraining(TINY, state, batch, "foreach")
    with torch.no_grad():
        again.decoder[0].bias += 1.0
    assert abs(again.epochs()[0] / before[0] - 1) > 1e-2  # ten times what the section lets pass


def test_a_missing_peer_is_named_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPeerError, match=r"PyTorch, which is not installed; run pip install 'i2t\[bench\]'"):
        benchmark.main(Benchmark(training=TINY))


def test_unknown_sections_are_refused() -> None:
    with pytest.raises(ValueError, match="--sections is 'speed'; choose from training"):
        benchmark.main(Benchmark(sections=("speed",)))


def test_rows_are_medians_over_turns() -> None:
    row = benchmark.compare("s", "w", [1.0, 2.0, 4.0], "p", [3.0, 2.0, 8.0])
    assert row == Row("s", "w", "s", 2.0, "p", 3.0, 2.0)


def test_every_contender_gets_every_turn_in_order() -> None:
    calls: list[str] = []
    seconds = benchmark.in_turns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b"] * 3
    assert {name: len(each) for name, each in seconds.items()} == {"a": 2, "b": 2}
