"""The benchmark compares like with like and says what it found; how fast anything was is not tested."""

import json
import sys
from pathlib import Path

import jax
import pytest
import trimesh

from experiments.benchmark import rendering, skin, timing
from experiments.benchmark import run as benchmark
from experiments.benchmark import training as benchmark_training
from experiments.benchmark.logs import Logs
from experiments.benchmark.rendering import Rendering
from experiments.benchmark.run import Benchmark
from experiments.benchmark.skin import SkinBenchmark
from experiments.benchmark.timing import BenchmarkRow
from experiments.benchmark.training import Training
from i2t import training
from i2t.errors import MissingExtraError
from i2t.paper import loss, network
from i2t.paper.config import PaperConfig
from i2t.training import Learner, TrainConfig

TINY = Training(
    touches=20,
    epochs=2,
    model=PaperConfig(pixels=6),
    train=TrainConfig(schedule="constant", batch_size=8, learning_rate=1e-4),
)


def test_training_section_against_pytorch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The section itself checks that both trainings have the same losses, and fails where they have not."""
    pytest.importorskip("torch", reason="the extra bench is not installed")
    rows = benchmark.run(Benchmark(sections=("training",), turns=2, out=tmp_path / "out", training=TINY))
    assert [row.peer_name.split(",")[0] for row in rows] == ["eager PyTorch"]
    report = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [BenchmarkRow(**row) for row in report["rows"]] == rows
    assert report["config"]["training"]["touches"] == 20
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(rows)


def test_unequal_work_is_not_compared() -> None:
    torch = pytest.importorskip("torch", reason="the extra bench is not installed")
    batch = benchmark_training._random_touches(TINY)
    learner = Learner(TINY.model, network.init, loss.losses)
    state = training.init(jax.random.key(0), learner, TINY.train, TINY.touches)
    peer = benchmark_training.TorchTraining(TINY, state, batch, "foreach")
    before = peer.epochs()
    again = benchmark_training.TorchTraining(TINY, state, batch, "foreach")
    with torch.no_grad():
        again.decoder[0].bias += 1.0
    assert abs(again.epochs()[0] / before[0] - 1) > 1e-2  # ten times what the section lets pass


def test_a_missing_peer_is_named_with_its_remedy_before_any_section_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    monkeypatch.setitem(benchmark.SECTIONS, "policy", lambda cfg: pytest.fail("it ran"))
    with pytest.raises(MissingExtraError, match=r"section training needs torch, .* 'imagine2touch\[bench\]'"):
        benchmark.run(Benchmark(sections=("policy", "training"), training=TINY))


def test_every_contender_gets_every_turn_in_order() -> None:
    calls: list[str] = []
    seconds = timing.interleave({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b"] * 3
    assert {name: len(each) for name, each in seconds.items()} == {"a": 2, "b": 2}


def test_rendering_section_against_ray_casters(capsys: pytest.CaptureFixture[str]) -> None:
    """The section itself checks that all see the same, and fails where they do not."""
    pytest.importorskip("open3d", reason="the extra bench is not installed", exc_type=ImportError)
    tiny = Rendering(spheres=(1,), shapes=("star",), batch=4, batches=(1,), largest=8)
    rows = benchmark.run(Benchmark(sections=("rendering",), turns=1, rendering=tiny))
    assert [row.peer_name for row in rows] == [*["Open3D", "embreex", "Open3D, rays given"] * 3, "rays and distances"]
    assert all(row.ours > 0 and row.peer > 0 for row in rows)
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(rows)


@pytest.mark.full
def test_skin_section_against_contact_mechanics() -> None:
    """The section itself checks that both find the same pressures, and fails where they do not."""
    tiny = SkinBenchmark(batch=2, cells=(20,), dipoles=(10,), shapes=("tilted punch",), steady=0)
    rows = benchmark.run(Benchmark(sections=("skin",), turns=1, skin=tiny))
    assert [row.peer_name for row in rows] == ["ContactMechanics"] * 3 + ["the contact alone"]
    assert all(row.ours > 0 and row.peer > 0 for row in rows)


def test_pressures_that_are_not_the_peer_s_are_refused() -> None:
    heights, depths = skin._touches(skin.GRID, ["punch"], 1)
    pad = skin.nominal_pad()
    found = jax.jit(jax.vmap(skin.solve, (None, 0, 0)))(pad, heights, depths)
    with pytest.raises(ValueError, match="pressures differ by "):
        skin.check("punch", found, [1.5 * found.pressure[0]], skin.GRID)


@pytest.mark.full
def test_patches_of_another_mesh_are_not_compared() -> None:
    """A ray caster that needs no system package, and a sphere a centimetre smaller."""
    ball = trimesh.creation.icosphere(3, 0.03)
    surface = rendering.prepare_surface(ball)
    poses = rendering.random_poses(surface, 4)
    patch = jax.jit(jax.vmap(rendering.render_patch, (None, 0)))(surface, poses)
    rays = rendering.rays_of(poses)
    seen = [
        rendering.embreex_caster(mesh)(rays).reshape(4, 48, 48) for mesh in (ball, trimesh.creation.icosphere(3, 0.02))
    ]
    rendering.check("ball", "embreex", patch.depth, patch.nearest, seen[0])
    with pytest.raises(ValueError, match="of the pixels differ from embreex's"):
        rendering.check("ball", "embreex", patch.depth, patch.nearest, seen[1])


@pytest.mark.full
def test_logs_section_measures_memory_and_time_of_an_import() -> None:
    rows = benchmark.run(Benchmark(sections=("logs",), logs=Logs(long=6000, short=3000)))
    assert [row.unit for row in rows] == ["MiB", "s"]
    assert 20 < rows[0].ours < 2000
    assert rows[0].ratio == pytest.approx(1, abs=0.2)
