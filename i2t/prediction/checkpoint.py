"""Trained models on disk: a folder that orbax writes, with everything that is needed to use the model or to go on
training.

Each save is a folder of its own named by the epoch, which appears complete or not at all; only then is the one before
it removed. Next to the arrays (the best parameters, the normalisation, and the rest of the training's state) it holds,
as JSON, both configurations, the versions of the packages that wrote it, and whatever the caller wants to remember
(object names, seeds, provenance).
"""

import math
import shutil
from dataclasses import asdict
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree
from orbax.checkpoint import v1 as ocp

from i2t import training
from i2t._version import __version__
from i2t.errors import CheckpointError
from i2t.files import may_grow_to, read_json
from i2t.paper.config import PaperConfig
from i2t.paper.network import Params
from i2t.prediction.model import ModelConfig, Normalisation, as_paper, conditions_of, learner
from i2t.prediction.touch_model import config_from
from i2t.training import Standard, TrainConfig, TrainState

CHECKPOINT_FORMAT = "i2t checkpoint"
CHECKPOINT_VERSION = 1
MAX_DESCRIPTION_BYTES = 2**26
PACKAGES = ("jax", "flax", "optax", "orbax-checkpoint", "numpy")


class Description(NamedTuple):
    """Description of a checkpoint."""

    model: PaperConfig  # or a `ModelConfig`
    train: TrainConfig
    touches: int  # in the training set, which sets the length of an epoch
    epoch: int
    packages: dict[str, str]
    extra: dict[str, Any]


def save(
    directory: Path | str,
    state: TrainState,
    model: PaperConfig,
    train: TrainConfig,
    norm: Normalisation,
    *,
    touches: int,
    extra: dict[str, Any] | None = None,
) -> None:
    """Write the state of a training, in place of an earlier epoch's.

    Args:
        directory: Folder of the checkpoint.
        state: Of the training.
        model: Which network.
        train: How it is trained.
        norm: Of the training set.
        touches: In the training set.
        extra: Anything that JSON can hold, to be remembered.
    """
    epoch = int(state.epoch.max())
    about = {
        "format": CHECKPOINT_FORMAT,
        "version": CHECKPOINT_VERSION,
        "model": asdict(model),
        "train": asdict(train),
        "touches": touches,
        "packages": {"i2t": __version__} | {name: version(name) for name in PACKAGES},
        "extra": extra or {},
    }
    arrays = {"params": state.best_params, "normalisation": norm, "state": state._replace(best_params=None)}
    arrays = jax.tree.map(lambda leaf: leaf if jnp.size(leaf) else None, arrays)  # orbax refuses arrays without values
    latest = ocp.training.preservation_policies.LatestN(1)
    with ocp.training.Checkpointer(
        Path(directory).absolute(), preservation_policy=latest, cleanup_tmp_directories=True
    ) as checkpointer:
        checkpointer.save_checkpointables(epoch, arrays, custom_metadata=about, force=True, overwrite=True)


def exists(directory: Path | str) -> bool:
    """Test for a finished save; a first one that was interrupted leaves only its beginnings.

    Args:
        directory: Folder of the checkpoint.

    Returns:
        True where `load` and `restore` have something to read.
    """
    directory = Path(directory)
    return directory.is_dir() and any(entry.name.isdecimal() for entry in directory.iterdir())


def load(directory: Path | str) -> tuple[Params, Normalisation, Description]:
    """The best parameters, to predict with.

    Args:
        directory: Folder of the checkpoint.

    Returns:
        Parameters (members as axis 0), normalisation, and what the checkpoint says of itself.

    Raises:
        CheckpointError: They cannot be had.
    """
    about, step = _describe(directory)
    params, norm, _ = _abstract(about)
    arrays = _arrays(step, {"params": params, "normalisation": norm})
    return arrays["params"], arrays["normalisation"], about


def restore(directory: Path | str) -> tuple[TrainState, Normalisation, Description]:
    """The whole state, to go on training exactly where it stopped.

    Args:
        directory: Folder of the checkpoint.

    Returns:
        State, normalisation, and what the checkpoint says of itself.

    Raises:
        CheckpointError: It cannot be had.
    """
    about, step = _describe(directory)
    params, norm, state = _abstract(about)
    arrays = _arrays(step, {"params": params, "normalisation": norm, "state": state})
    return arrays["state"]._replace(best_params=arrays["params"]), arrays["normalisation"], about


def drop_state(directory: Path | str) -> None:
    """Remove the part that only a resumed training needs, three quarters of its size; `load` reads the rest.

    Args:
        directory: Folder of the checkpoint.

    Raises:
        CheckpointError: There is none.
        OSError: It cannot be removed.
    """
    _, step = _describe(directory)
    if (step / "state").is_dir():
        shutil.rmtree(step / "state")


def _describe(directory: Path | str) -> tuple[Description, Path]:
    """Read and check the description of the latest epoch, and find its folder."""
    directory = Path(directory).absolute()
    if not directory.is_dir():
        raise CheckpointError(
            f"There is no checkpoint folder {directory}; train first, or name the folder that training wrote."
        )
    steps = sorted((int(entry.name), entry) for entry in directory.iterdir() if entry.name.isdecimal())
    if not steps:
        raise CheckpointError(
            f"{directory} holds no finished checkpoint; name the folder 'checkpoint' that training wrote."
        )
    epoch, step = steps[-1]
    try:
        about = read_description(step)
        if about["format"] != CHECKPOINT_FORMAT:
            raise KeyError(about["format"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{step} was not written by i2t, or is damaged; name a folder that i2t's training wrote."
        ) from error
    if about["version"] != CHECKPOINT_VERSION:
        raise CheckpointError(
            f"{step} has checkpoint version {about['version']}, but this i2t reads version {CHECKPOINT_VERSION}; use "
            "the i2t that wrote it or train again."
        )
    try:
        model, train = _configs(dict(about["model"]), dict(about["train"]))
        touches = int(about["touches"])
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        written_by = about.get("packages", {}) if isinstance(about.get("packages"), dict) else {}
        raise CheckpointError(
            f"{step} has a configuration that this i2t does not know ({error}); use the i2t that wrote it "
            f"({written_by.get('i2t', 'unknown')}) or train again."
        ) from error
    return Description(
        model=model,
        train=train,
        touches=touches,
        epoch=epoch,
        packages=dict(about["packages"]),
        extra=dict(about.get("extra") or {}),
    ), step


def _configs(model: dict[str, Any], train: dict[str, Any]) -> tuple[PaperConfig, TrainConfig]:
    """Network and training options. Earlier versions could train several seeds together, of which one is trained now,
    and kept the weights of the loss with the training; `members` are of networks that may be more than the paper's.
    """
    if train.pop("seeds", 1) != 1:
        raise ValueError("several seeds trained together")
    train.pop("seed", None)
    weights = train.pop("loss", {})
    model |= {new: weights[old] for old, new in (("auxiliary", "auxiliary_weight"), ("beta", "beta")) if old in weights}
    return network_config(model), config_from(TrainConfig, train)


def network_config(values: dict[str, Any]) -> PaperConfig:
    """Network, from its JSON form.

    Args:
        values: Fields by name.

    Returns:
        The paper's configuration where nothing more is configured.

    Raises:
        ValueError: A field is unknown, or a value is refused.
    """
    input_now = {"image": "pressure"}.get(values.get("input", ""), values.get("input"))  # a name of earlier versions
    values = values | ({"input": input_now} if input_now else {})
    return as_paper(config_from(ModelConfig if "members" in values else PaperConfig, values))


def read_description(folder: Path) -> dict[str, Any]:
    """Read the description of a checkpoint.

    Args:
        folder: Of one checkpoint.

    Returns:
        The description.

    Raises:
        ValueError: It is damaged.
        KeyError: It says nothing.
        OSError: It is missing.
    """
    about = read_json(folder / "_CHECKPOINT_METADATA", MAX_DESCRIPTION_BYTES)["custom_metadata"]
    if not isinstance(about, dict):
        raise TypeError("no table")
    return about


def check_size(folder: Path, shapes: PyTree) -> None:
    """Refuse arrays that are said to be larger than a folder can hold: unwritten parts are read as zeros.

    Args:
        folder: Of one checkpoint.
        shapes: Arrays of 4 bytes a value, or what tells their shapes.

    Raises:
        CheckpointError: They are.
    """
    said = 4 * sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    held = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    if said > may_grow_to(held):
        raise CheckpointError(
            f"{folder} says that it holds {said} bytes of numbers, more than its {held} bytes can; train again, or "
            "restore a copy."
        )


def _arrays(step: Path, abstract: dict[str, Any]) -> dict[str, Any]:
    """Load the arrays of `abstract` to the default device."""
    check_size(step, abstract)

    def shapes(tree: Any) -> Any:
        return jax.tree.map(lambda leaf: tuple(leaf.shape), tree)

    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=here), abstract)
    try:
        stored: Any = ocp.checkpointables_metadata(step).metadata
        # Compared here because orbax, in refusing, leaves half of its reading behind and says so at length.
        if shapes(stored["params"]) == shapes(abstract["params"]):
            arrays = ocp.load_checkpointables(step, jax.tree.map(lambda leaf: leaf if leaf.size else None, abstract))
            # What has no values was not stored.
            return jax.tree.map(
                lambda leaf, value: value if leaf.size else jnp.zeros(leaf.shape, leaf.dtype), abstract, arrays
            )
        problem: Exception = ValueError("shapes differ")
    except Exception as error:  # orbax raises many kinds, down to bare ones of its storage library
        problem = error
    raise CheckpointError(
        f"The arrays in {step} are damaged or do not fit their configuration; train again, or restore a copy."
    ) from problem


def _abstract(about: Description) -> tuple[PyTree, Normalisation, TrainState]:
    """Shapes and types in a checkpoint: best parameters, normalisation, and the rest of the state."""
    try:
        begin = partial(training.init, learner=learner(about.model), cfg=about.train, touches=about.touches)
        state = jax.eval_shape(begin, jax.random.key(0))
    except (TypeError, ValueError, ArithmeticError, LookupError) as error:
        raise CheckpointError(
            f"no network is as the checkpoint says ({error}); train again, or restore a copy."
        ) from error

    def normalisation() -> Normalisation:
        reading, conditions = jnp.zeros(about.model.readings), jnp.zeros(len(conditions_of(about.model)))
        return Normalisation(Standard(reading, reading), Standard(conditions, conditions), reading)

    return state.best_params, jax.eval_shape(normalisation), state._replace(best_params=None)
