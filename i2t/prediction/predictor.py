"""A trained model in the hands of a user: depth patches, or a mesh and a pose, become readings in uT with their spread.

A predictor is one of two things that `python -m experiments.train` makes: the network of `i2t.prediction.model` on a
depth patch or on imagined pressure, or the Gaussian process of `i2t.prediction.gp` on imagined pressure. Both are saved
by `save` and read by `load_predictor`; what is done to a patch on the way is part of what is saved.

    predictor = i2t.load_predictor("runs/train")
    reading, spread = predictor.predict(patch, force=1.0)                       # (15,) uT each
    reading, spread = predictor.predict_touch("mug.stl", T_w_t, force=1.0, unit="m")
"""

import json
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from orbax.checkpoint import v1 as ocp

from i2t.errors import CheckpointError
from i2t.prediction import checkpoint, gp, model
from i2t.prediction.gp import GP, ContactPressure
from i2t.prediction.model import ModelConfig, Normalisation, Params
from i2t.prediction.pressure import PressureModelConfig, predict_pressure
from i2t.rendering.render import prepare_surface, render_patch
from i2t.skin.pad import nominal_pad
from i2t.types import PATCH_PIXELS, WIDE_PIXELS, Pad, Surface

FORMAT = "i2t predictor"
FORMAT_VERSION = 1
BATCH = 64  # touches imagined at a time


class Reading(NamedTuple):
    """A predicted touch, in the board's order and axes; unpacks as (reading, spread)."""

    mean: np.ndarray  # (15,) or (n, 15) uT
    std: np.ndarray  # as mean: standard deviation of what the sensor will say, its noise included


class TrainedNetwork(NamedTuple):
    """A trained network with what it needs."""

    params: Params  # members as axis 0
    cfg: ModelConfig
    normalisation: Normalisation


@dataclass(frozen=True)
class Predictor:
    """Predicts readings; make one with `load_predictor`.

    `process` or `network` does the work. `imagination` is None for a network that sees patches themselves. `window` and
    `reach` (m) say what a patch is, `load` (N) and `depth` (m) are the middle of the training touches, and `spread`
    scales the standard deviations to what was seen on validation touches.
    """

    process: GP | None
    network: TrainedNetwork | None
    imagination: PressureModelConfig | None
    window: float
    reach: float
    default_force: float
    default_depth: float
    std_scale: float = 1.0
    metadata: dict[str, Any] | None = None

    def predict(
        self,
        patch: Float[Array, "*batch n n"] | np.ndarray,
        force: Any = None,
        nearest: Any = None,
        depth: Any = None,
        wide: Float[Array, "*batch w w"] | np.ndarray | None = None,
    ) -> Reading:
        """The reading of one touch, or of many on axis 0.

        `patch` is in metres behind the nearest point (as in `i2t.types.Patch`), `force` in newtons along tool z; left
        out, the middle of the training touches is taken. `nearest` and `depth` (m) are needed only by a model that was
        trained with them. `wide` is the same view with its surroundings and makes the prediction better at the rim of
        the skin. Raises ValueError for shapes and values that do not fit.
        """
        patch = np.asarray(patch, np.float32)
        single = patch.ndim == 2
        patches = patch[None] if single else patch
        n = len(patches)
        if patches.ndim != 3 or patches.shape[1] != patches.shape[2]:
            raise ValueError(f"patch has shape {patch.shape}; give (n, n) or (touches, n, n)")
        if not np.isfinite(patches).all():
            raise ValueError("patch holds NaN or infinity; pixels without a surface are `reach`")
        measured = {
            "force": _column("force", force, n, self.default_force),
            "nearest": _column("nearest", nearest, n, None),
            "depth": _column("depth", depth, n, self.default_depth),
        }
        if self.imagination is None:
            reading = self.from_image(patches, measured)
        else:
            views = patches if wide is None else np.asarray(wide, np.float32).reshape(n, *np.shape(wide)[-2:])
            cfg = replace(self.imagination, pitch=self.window / patches.shape[1])
            reading = self.from_imagined(predict_pressures(cfg, views, measured["force"], measured["depth"]), measured)
        return Reading(reading.mean[0], reading.std[0]) if single else reading

    def predict_touch(
        self,
        mesh: Any,
        T_w_t: Float[Array, "4 4"] | np.ndarray,
        force: float | None = None,
        unit: str | None = None,
    ) -> Reading:
        """The reading of the skin pressed on a mesh with its tool frame at T_w_t (the mesh is in W).

        `mesh` is a file (then `unit` is required), an `i2t.objects.catalogue.Object` or anything with `vertices` and
        `faces`, or a prepared `Surface`. Raises ValueError where nothing lies in front of the skin.
        """
        if isinstance(mesh, str | Path):
            from i2t.objects import catalogue

            if unit is None:
                raise ValueError(f"{mesh}: say in which unit the file is, for instance unit='mm'")
            mesh = catalogue.load_mesh(mesh, unit, table=False)[0]
        surface = mesh if isinstance(mesh, Surface) else prepare_surface(getattr(mesh, "mesh", mesh))
        T = jnp.asarray(T_w_t, jnp.float32)
        if T.shape != (4, 4) or not bool(jnp.all(jnp.isfinite(T))):
            raise ValueError(f"T_w_t must be a finite (4, 4) transform, got shape {T.shape}")
        pitch = self.window / PATCH_PIXELS
        patch = _render(surface, T, self.window, PATCH_PIXELS, self.reach)
        if not bool(jnp.isfinite(patch.nearest)):
            raise ValueError("nothing lies in front of the skin at this pose; move T_w_t towards the surface")
        wide = _render(surface, T, pitch * WIDE_PIXELS, WIDE_PIXELS, self.reach)
        # Both views count from the patch's nearest point, as the camera's do.
        around = np.clip(np.asarray(wide.depth) + float(wide.nearest - patch.nearest), 0, self.reach)
        return self.predict(np.asarray(patch.depth), force=force, nearest=float(patch.nearest), wide=around)

    def from_imagined(self, imagined: ContactPressure, measured: dict[str, np.ndarray]) -> Reading:
        """The readings of touches (axis 0) that `imagine_all` made from their views with this predictor's imagination.

        `measured` holds the force, `nearest` and depth of each touch, NaN where unknown.
        """
        if self.process is None:
            return self.from_image(np.asarray(imagined.pressure), measured)
        mean, std = _process(self.process, imagined)
        return Reading(np.asarray(mean), np.asarray(std) * self.std_scale)

    def from_image(self, images: np.ndarray, measured: dict[str, np.ndarray]) -> Reading:
        """The readings that a network sees in images (n, p, p): patches, or imagined pressures. Raises ValueError where
        they do not fit it.
        """
        assert self.network is not None
        params, network, norm = self.network
        if images.shape[1] != network.pixels:
            raise ValueError(f"patch has {images.shape[1]} pixels an edge; this model sees {network.pixels}")
        missing = [name for name in network.conditions if not np.isfinite(measured[name]).all()]
        if missing:
            raise ValueError(f"this model needs {', '.join(missing)} of every touch; pass it to predict")
        values = [measured[name] for name in network.conditions]
        conditions = np.stack(values, -1) if values else np.zeros((len(images), 0))
        mean, std = _network(network, params, norm, model.Inputs(jnp.float32(images), jnp.float32(conditions)))
        return Reading(np.asarray(mean), np.asarray(std) * self.std_scale)


def predict_pressures(
    cfg: PressureModelConfig,
    views: np.ndarray,
    force: np.ndarray,
    depth: np.ndarray,
    pad: Pad | None = None,
) -> ContactPressure:
    """Imagine many touches (axis 0) on a layer of nominal stiffness, a batch at a time."""
    values = (jnp.float32(views), jnp.float32(force), jnp.float32(depth))
    return _imagine(cfg, nominal_pad() if pad is None else pad, values)


@partial(jax.jit, static_argnums=0)
def _imagine(cfg: PressureModelConfig, pad: Pad, values: tuple[Array, Array, Array]) -> ContactPressure:
    return jax.lax.map(lambda touch: predict_pressure(cfg, pad, *touch), values, batch_size=BATCH)


@jax.jit
def _process(process: GP, imagined: ContactPressure) -> tuple[Array, Array]:
    return gp.predict(process, imagined)


@partial(jax.jit, static_argnums=0)
def _network(cfg: ModelConfig, params: Params, norm: Normalisation, inputs: model.Inputs) -> tuple[Array, Array]:
    return jax.vmap(partial(model.predict, params, cfg, norm))(inputs)


@partial(jax.jit, static_argnums=(2, 3, 4))
def _render(surface: Surface, T_w_t: Array, window: float, pixels: int, reach: float):
    return render_patch(surface, T_w_t, window=window, pixels=pixels, reach=reach)


def _column(name: str, values: Any, n: int, default: float | None) -> np.ndarray:
    if values is None:
        return np.full(n, np.nan if default is None else default, np.float32)
    given = np.asarray(values, np.float32)
    column = np.full(n, given) if given.ndim == 0 else given
    if column.shape != (n,) or not np.isfinite(column).all():
        raise ValueError(f"{name} must be finite, one for all touches or one for each of {n}")
    return column


def save(directory: Path | str, predictor: Predictor) -> None:
    """Write a predictor into a folder, which appears complete or not at all."""
    directory = Path(directory).absolute()
    arrays: dict[str, Any] = {"process": predictor.process}
    about = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "imagination": None if predictor.imagination is None else asdict(predictor.imagination),
        "network": None if predictor.network is None else asdict(predictor.network.cfg),
        **{name: getattr(predictor, name) for name in ("window", "reach", "load", "depth", "spread", "about")},
    }
    if predictor.network is not None:
        arrays = {"params": predictor.network.params, "normalisation": predictor.network.normalisation}
    arrays = _plain(arrays)
    about["shapes"] = jax.tree.map(lambda leaf: list(leaf.shape), arrays)
    ocp.save_checkpointables(directory, arrays, custom_metadata=json.loads(json.dumps(about)), overwrite=True)


def load_predictor(directory: Path | str) -> Predictor:
    """The predictor in a run's folder (or in its `checkpoint/predictor`).

    Raises CheckpointError, one sentence, where there is none or it cannot be read.
    """
    directory = Path(directory).absolute()
    nested = directory / "checkpoint" / "predictor"
    directory = nested if nested.is_dir() else directory
    try:
        about = json.loads((directory / "_CHECKPOINT_METADATA").read_text())["custom_metadata"]
        if about["format"] != FORMAT or about["version"] != FORMAT_VERSION:
            raise KeyError(about["format"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{directory} holds no predictor of this i2t; name the folder that `python -m experiments.train` wrote"
        ) from error
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    abstract = jax.tree.map(
        lambda shape: jax.ShapeDtypeStruct(tuple(shape), jnp.float32, sharding=here),
        about["shapes"],
        is_leaf=lambda node: isinstance(node, list),
    )
    try:
        arrays = ocp.load_checkpointables(directory, abstract)
    except Exception as error:  # orbax raises many kinds, down to bare ones of its storage library
        raise CheckpointError(f"the arrays in {directory} are damaged; train again, or restore a copy") from error
    process = network = None
    if about["network"] is None:
        process = _as(GP, arrays["process"], hyper=gp.GPHyperparameters, touches=ContactPressure)
    else:
        cfg = checkpoint.config_from(ModelConfig, about["network"])
        norm = _as(Normalisation, arrays["normalisation"], reading=model.Standard, conditions=model.Standard)
        network = TrainedNetwork(arrays["params"], cfg, norm)
    imagination = None if about["imagination"] is None else PressureModelConfig(**about["imagination"])
    return Predictor(
        process,
        network,
        imagination,
        **{name: about[name] for name in ("window", "reach", "load", "depth", "spread", "about")},
    )


def _plain(node: Any) -> Any:
    """Named tuples as dicts, all the way down, so that what is on disk names its fields; orbax refuses empty arrays."""
    if isinstance(node, tuple) and hasattr(node, "_asdict"):
        node = node._asdict()
    if isinstance(node, dict):
        return {name: _plain(value) for name, value in node.items()}
    return jnp.asarray(node, jnp.float32) if np.size(node) else None


def _as(kind: Any, values: dict[str, Any], **nested: Any) -> Any:
    """A named tuple from its dict, in which empty arrays are missing."""
    fields: dict[str, Any] = {name: jnp.zeros(0) if value is None else value for name, value in values.items()}
    return kind(**{name: _as(nested[name], value) if name in nested else value for name, value in fields.items()})


def middle(values: np.ndarray, default: float) -> float:
    """Median of what was measured, or a default where nothing was."""
    known = np.asarray(values)[np.isfinite(values)]
    return float(np.median(known)) if len(known) else default


def std_scale(readings: np.ndarray, prediction: Reading) -> float:
    """The factor by which standard deviations must grow for the errors on these touches to have unit variance."""
    return float(np.sqrt(np.mean(((readings - prediction.mean) / prediction.std) ** 2)))
