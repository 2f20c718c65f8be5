"""What is saved comes back, bit for bit and with its meaning; what is not a checkpoint is said to be none."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from i2t import training
from i2t.errors import CheckpointError
from i2t.prediction import checkpoint
from i2t.prediction.model import Inputs, ModelConfig, Normalisation, learner
from i2t.training import Batch, Standard, TrainConfig, TrainState

MODEL = ModelConfig(
    pixels=6, encoder_width=8, bottleneck=3, decoder_width=8, auxiliary_width=4, conditions=("force", "depth"),
    heteroscedastic=True, beta=0.25, members=2,
)  # fmt: skip
TRAIN = TrainConfig(epochs=4, batch_size=8)
N = 12


@pytest.fixture(scope="module")
def norm() -> Normalisation:
    rng = np.random.default_rng(0)
    reading, conditions = rng.uniform(1, 2, (2, 15)), rng.uniform(1, 2, (2, 2))
    standards = [Standard(*(jnp.asarray(row, jnp.float32) for row in rows)) for rows in (reading, conditions)]
    return Normalisation(*standards, jnp.asarray(rng.uniform(size=15), jnp.float32))


@pytest.fixture(scope="module")
def batch() -> Batch:
    rng = np.random.default_rng(1)
    image, conditions, target = (jnp.asarray(rng.random(shape), jnp.float32) for shape in ((N, 6, 6), (N, 2), (N, 15)))
    return Batch(Inputs(image, conditions), target)


@pytest.fixture(scope="module")
def saved(norm: Normalisation, batch: Batch, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[TrainState]]:
    """A training of four epochs that saved after each, and its states."""
    directory = tmp_path_factory.mktemp("run") / "checkpoint"
    states: list[TrainState] = []

    state, epoch = training.init(jax.random.key(7), learner(MODEL), TRAIN, N), training.compiled(learner(MODEL), TRAIN)
    for _ in range(TRAIN.epochs):
        state, _ = epoch(state, batch, None)
        states.append(state)
        extra = {"objects": ["hexagon", "star"], "pad": None}
        checkpoint.save(directory, state, MODEL, TRAIN, norm, touches=N, extra=extra)
    return directory, states


def assert_same(left: Any, right: Any) -> None:
    assert jax.tree.structure(left) == jax.tree.structure(right)
    for a, b in zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True):
        assert a.dtype == b.dtype
        if jax.dtypes.issubdtype(a.dtype, jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(a, b)


def test_everything_comes_back(saved: tuple[Path, list[TrainState]], norm: Normalisation) -> None:
    directory, states = saved
    state, back, about = checkpoint.restore(directory)
    assert_same(state, states[-1])
    assert_same(back, norm)
    assert (about.model, about.train, about.touches, about.epoch) == (MODEL, TRAIN, N, 4)
    assert about.extra == {"objects": ["hexagon", "star"], "pad": None}
    assert about.packages["jax"] == jax.__version__
    params, _, loaded = checkpoint.load(directory)
    assert loaded == about
    assert_same(params, states[-1].best_params)
    assert [entry.name for entry in directory.iterdir()] == ["4"]  # only the latest epoch stays


def test_checkpoints_from_before_are_read(saved: tuple[Path, list[TrainState]], tmp_path: Path) -> None:
    """They name one seed, and no number of readings, which was 15."""
    folder = edited(saved[0], tmp_path / "copy", {"train.seeds": 1, "model.readings": None})
    assert_same(checkpoint.restore(folder)[0], saved[1][-1])


def edited(saved: Path, folder: Path, change: dict[str, Any]) -> Path:
    """A copy whose description says something else; nothing where it says None."""
    shutil.copytree(saved, folder)
    path = folder / "4" / "_CHECKPOINT_METADATA"
    about = json.loads(path.read_text())
    for key, value in change.items():
        inner = about["custom_metadata"]
        *parents, last = key.split(".")
        for parent in parents:
            inner = inner[parent]
        inner[last] = value
        if value is None:
            del inner[last]
    path.write_text(json.dumps(about))
    return folder


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"train.seeds": 3, "model.readings": None}, "does not know .several seeds"),
        ({"format": "something else"}, "not written by i2t"),
        ({"version": 99}, "checkpoint version 99, but this i2t reads version 1; use the i2t that wrote it"),
        ({"model.attention": 8}, "does not know .unknown attention"),
        ({"model.bottleneck": 0}, "does not know .paper.bottleneck is 0"),
        ({"model.members": 3}, "damaged or do not fit their configuration"),
    ],
)
def test_foreign_newer_and_inconsistent_checkpoints(
    saved: tuple[Path, list[TrainState]], tmp_path: Path, change: dict, words: str
) -> None:
    with pytest.raises(CheckpointError, match=words):
        checkpoint.load(edited(saved[0], tmp_path / "copy", change))


def test_folders_that_are_no_checkpoint(saved: tuple[Path, list[TrainState]], tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no checkpoint folder .*nowhere"):
        checkpoint.load(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()
    (tmp_path / "12.orbax-checkpoint-tmp").mkdir()
    assert not checkpoint.exists(tmp_path)  # only a finished save exists
    with pytest.raises(CheckpointError, match="holds no finished checkpoint"):
        checkpoint.load(tmp_path)
    (tmp_path / "10").mkdir()
    assert checkpoint.exists(tmp_path)
    with pytest.raises(CheckpointError, match="not written by i2t, or is damaged"):
        checkpoint.restore(tmp_path)
    lacking = edited(saved[0], tmp_path / "copy", {})
    shutil.rmtree(lacking / "4" / "params")
    with pytest.raises(CheckpointError, match=r"copy/4 are damaged"):
        checkpoint.load(lacking)


def test_a_save_that_dies_leaves_the_one_before(
    saved: tuple[Path, list[TrainState]], norm: Normalisation, tmp_path: Path
) -> None:
    directory, states = saved
    folder = tmp_path / "copy"
    shutil.copytree(directory, folder)
    # What a killed process leaves: a temporary folder of the next epoch, half written.
    shutil.copytree(folder / "4" / "params", folder / "5.orbax-checkpoint-tmp-1" / "params")
    assert_same(checkpoint.restore(folder)[0], states[-1])
    later = states[-1]._replace(epoch=states[-1].epoch + 1)
    checkpoint.save(folder, later, MODEL, TRAIN, norm, touches=N)
    assert_same(checkpoint.restore(folder)[0], later)
    assert [entry.name for entry in folder.iterdir()] == ["5"]


def test_a_finished_training_is_kept_without_what_going_on_needs(saved, tmp_path):
    """The same predictions from less than half of the bytes."""
    kept = edited(saved[0], tmp_path / "kept", {})
    checkpoint.drop_state(kept)
    sizes = [sum(file.stat().st_size for file in one.rglob("*") if file.is_file()) for one in (kept, saved[0])]
    assert sizes[0] < 0.5 * sizes[1]
    before, after = checkpoint.load(saved[0]), checkpoint.load(kept)
    jax.tree.map(np.testing.assert_array_equal, before[:2], after[:2])
    assert before[2] == after[2]
    with pytest.raises(CheckpointError, match="damaged"):
        checkpoint.restore(kept)
