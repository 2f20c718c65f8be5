"""The benchmark compares equal work and reports its results; speeds are not tested."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import pytest
import trimesh

from experiments.benchmark import accelerator, contests, rendering, skin, startup
from experiments.benchmark import run as benchmark
from experiments.benchmark import training as benchmark_training
from experiments.benchmark.arguments import BenchmarkArgs
from experiments.benchmark.contests import BenchmarkRow, Contest
from i2t import training
from i2t.errors import MissingExtraError
from i2t.paper import loss, network
from i2t.training import Learner

ROOT = Path(__file__).parents[2]


def run(section: str, turns: int = 1, out: Path | None = None) -> list[BenchmarkRow]:
    """Rows of a section in its smallest size, which are all positive and within their ranges."""
    rows = benchmark.run(BenchmarkArgs(sections=(section,), turns=turns, preset="debug", out=out))  # type: ignore[arg-type]
    assert all(0 < row.least <= row.ours <= row.most and (row.peer is None or row.peer > 0) for row in rows)
    return rows


def test_training_section_against_pytorch(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The section itself checks that both trainings have the same losses, and fails otherwise."""
    pytest.importorskip("torch", reason="the extra bench is not installed")
    rows = run("training", 2, tmp_path / "out")
    assert [row.peer_name.split(",")[0] for row in rows] == ["eager PyTorch"] * 2
    report = json.loads((tmp_path / "out" / "benchmark.json").read_text())
    assert [BenchmarkRow(**row) for row in report["rows"]] == rows
    assert report["config"]["turns"] == 2
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(rows)


def test_unequal_work_is_not_compared() -> None:
    torch = pytest.importorskip("torch", reason="the extra bench is not installed")
    setup = benchmark_training.SMALL
    batch = benchmark_training.random_touches(setup)
    learner = Learner(setup.model, network.init, loss.losses)
    state = training.init(jax.random.key(0), learner, setup.train, setup.touches)
    peer = benchmark_training.TorchTraining(setup, state, batch, "foreach")
    before = peer.epochs()
    again = benchmark_training.TorchTraining(setup, state, batch, "foreach")
    with torch.no_grad():
        again.decoder[0].bias += 1.0
    assert abs(again.epochs()[0] / before[0] - 1) > 1e-2  # ten times what the section lets pass


def test_a_missing_peer_is_named_with_its_remedy_before_any_section_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingExtraError, match=r'section training needs torch, .* pip install -e "\.\[bench\]"'):
        BenchmarkArgs(sections=("latency", "training")).check()


def test_contenders_take_turns_and_a_row_has_the_median_of_the_ratios_of_turns() -> None:
    calls: list[str] = []
    seconds = contests.interleave({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b"] * 3
    assert {name: len(each) for name, each in seconds.items()} == {"a": 2, "b": 2}
    ours, peer = iter([1.0, 2.0, 4.0]), iter([6.0, 6.0, 6.0])
    contest = Contest("work", lambda: next(ours), "them", lambda: next(peer), 0.5, 2.0, unit="MiB", measured=True)
    row = contests.measure("rendering", contest, 3)
    assert row == BenchmarkRow("rendering", "work", "MiB", 1.0, 0.5, 2.0, "them", 12.0, 12.0, None)


def test_rendering_section_against_ray_casters() -> None:
    """The section itself checks that all see the same, and fails otherwise."""
    pytest.importorskip("open3d", reason="the extra bench is not installed", exc_type=ImportError)
    rows = run("rendering")
    assert [row.peer_name for row in rows] == [*["Open3D", "embreex", "Open3D, rays given"] * 3, "rays and distances"]


@pytest.mark.full
def test_skin_section_against_contact_mechanics() -> None:
    """The section itself checks that both find the same pressures, and fails otherwise."""
    assert [row.peer_name for row in run("skin")] == ["ContactMechanics"] * 3 + ["the contact alone"]


def test_pressures_that_are_not_the_peer_s_are_refused() -> None:
    heights, indentations = skin.touches(skin.GRID, ["punch"], 1)
    pad = skin.nominal_pad()
    found = jax.jit(jax.vmap(skin.solve, (None, 0, 0)))(pad, heights, indentations)
    with pytest.raises(ValueError, match="pressures differ by "):
        skin.check("punch", found, [1.5 * found.pressure[0]], skin.GRID)


@pytest.mark.full
def test_patches_of_another_mesh_are_not_compared() -> None:
    """The peer is a ray caster that needs no system package, with a sphere a centimetre smaller."""
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
@pytest.mark.parametrize(
    ("section", "works", "unit"), [("latency", 5, "ms"), ("simulation", 1, "1/s"), ("accelerator", 6, "1/s")]
)
def test_sections_with_goals_run_in_their_smallest_size(
    section: str, works: int, unit: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(accelerator, "find_spec", lambda name: None)  # a peer that no extra installs
    rows = run(section)
    assert [(row.section, row.unit, row.peer) for row in rows] == [(section, unit, None)] * works


@pytest.mark.full
def test_the_start_of_a_command_is_timed_with_nothing_compiled_and_once_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    args = BenchmarkArgs(sections=("startup",), turns=1, preset="debug", out=tmp_path / "out")
    assert benchmark.run(args) == []
    (row,) = json.loads((tmp_path / "out" / "benchmark.json").read_text())["startup"]
    assert row["command"] == "-m i2t.imagine"
    assert 0 < row["second"] < row["first"]
    assert row["first_range"] == [row["first"]] * 2
    assert "python -m i2t.imagine" in capsys.readouterr().out


def test_a_failing_command_raises_instead_of_being_timed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"-m i2t.imagine nothing ended with exit code 2: .*nothing"):
        startup._run(startup.TimedCommand("-m i2t.imagine nothing", 1, 1), tmp_path, tmp_path / "compiled")


def test_every_compiled_program_is_listed_with_its_size_and_the_calling_line(tmp_path: Path) -> None:
    script, out = tmp_path / "small.py", tmp_path / "programs.json"
    script.write_text(
        "import jax\nfrom i2t.geometry import inverse\n@jax.jit\ndef twice(x):\n    return inverse(x) @ x\n"
        "twice(jax.numpy.eye(4))\n"
    )
    words = [sys.executable, "-m", "experiments.benchmark.programs", str(script)]
    environment = {**os.environ, "PROGRAMS_JSON": str(out), "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "compiled")}
    done = subprocess.run(words, env=environment, cwd=ROOT, capture_output=True, text=True, check=True)
    found = {each["name"]: each for each in json.loads(out.read_text())}
    assert found["twice"]["instructions"] > 5
    assert min(found["twice"][stage] for stage in ("traced", "lowered", "compiled")) > 0
    assert "all " in done.stdout.splitlines()[-1]
