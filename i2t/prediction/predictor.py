"""A trained model in the hands of a user: a depth patch, or a mesh and a pose, becomes a reading in uT with its
standard deviation.

A predictor holds a model (`i2t.prediction.touch_model.TouchModel`), whichever method made it
(`i2t.prediction.methods`), and asks it by `predict_batch`. Predictors are written by `save` and read by
`load_predictor`; how a patch is turned into what the model sees is part of what is saved. A board has n chips and a
reading 3 n values, whichever board the model was trained on.

    predictor = i2t.load_predictor("runs/train")
    seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)                    # or i2t.render_patch of a mesh
    reading, std = predictor.predict(seen, force=1.0)                           # (3n,) uT each
    reading, std = predictor.predict_touch("mug.stl", T_o_t, force=1.0, unit="m")
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree
from orbax.checkpoint import v1 as ocp

from i2t.contact.pressure import PressureModelConfig
from i2t.errors import CheckpointError
from i2t.files.archives import may_grow_to
from i2t.files.reading import read_json
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.models import ready_hint, ready_path
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.patches.views import WideView
from i2t.prediction import user_input
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel, from_disk, to_disk
from i2t.rendering.render import prepare_surface, render_view
from i2t.runtime.batching import size_classes
from i2t.skin.boards import board_from_lists
from i2t.types import Board, Surface

PREDICTOR_FORMAT = "i2t predictor"
PREDICTOR_VERSION = 4
MAX_DESCRIPTION_BYTES = 2**26

Values: TypeAlias = int | float | Sequence[int | float] | np.ndarray | Array  # one for all touches, or one for each


@dataclass(frozen=True, repr=False)
class Predictor:
    """Predicts readings; get one from `load_predictor`.

    Attributes:
        model: What predicts.
        window: m, edge of the square that a patch shows.
        reach: m, depth of a patch behind its nearest point.
        default_force: N, taken where a user gives no force: the median of the training touches.
        default_depth: m, likewise.
        std_scale: Factor on the model's standard deviations that gives the errors on validation touches unit variance.
        metadata: Provenance: how, from what and with which seed it was made.

    Example:
        predictor = i2t.load_predictor("runs/train")
        reading, std = predictor.predict(patch, force=1.0)  # (c,) uT each
    """

    model: TouchModel
    window: float
    reach: float
    default_force: float
    default_depth: float
    std_scale: float = 1.0
    metadata: dict[str, Any] | None = None

    def __repr__(self) -> str:
        """One line: the kind of model, the sensor's size and the patch."""
        source = (self.metadata or {}).get("source", "unknown source")
        return (
            f"Predictor({type(self.model).__name__}, {self.model.channels // 3} chips, "
            f"patch {self.window * 1e3:g} mm, default force {self.default_force:.2g} N, {source})"
        )

    @property
    def largest_force(self) -> float | None:
        """Largest force (N) of the training touches, without its sign; None where it is not known."""
        given = (self.metadata or {}).get("force_range")
        forces = [abs(force) for force in given if isinstance(force, int | float)] if isinstance(given, list) else []
        return max(forces, default=None)

    @property
    def board(self) -> Board | None:
        """The board whose readings it was trained on; None where that was not kept."""
        board = board_from_lists((self.metadata or {}).get("board"))
        return board if board and board.num_readings == self.model.channels else None

    @property
    def pressure(self) -> PressureModelConfig | None:
        """Model of contact pressure; None for a model that sees patches themselves."""
        return self.model.pressure

    def with_pressure(self, **changes: Any) -> "Predictor":
        """The same predictor with fields of its pressure model changed; a model on patches has none and stays.

        Args:
            changes: Fields of `PressureModelConfig` with their new values.

        Returns:
            The changed predictor.
        """
        if self.pressure is None:
            return self
        model: Any = self.model
        return replace(self, model=replace(model, pressure=replace(self.pressure, **changes)))

    def predict(
        self,
        patch: Any,
        force: Values | None = None,
        nearest: Values | None = None,
        depth: Values | None = None,
        wide: Float[Array, "*batch w w"] | np.ndarray | None = None,
        *,
        valid: Bool[Array, "*batch n n"] | np.ndarray | None = None,
    ) -> Reading:
        """The reading of one touch, or of many on axis 0.

        Give all that was seen: what `i2t.patch_from_depth`, `i2t.render_patch` or a wide view of either made. It says
        how far the surface is from the skin, so that a patch of a surface elsewhere is refused, and which pixels were
        seen. An array of depths says neither: it is taken for what the skin meets, seen as a whole.

        Args:
            patch: A `Patch`, `DepthPatch`, `WideView` or `DepthView`, of one touch or of n on axis 0, or a list of
                them; or (48, 48) or (n, 48, 48) m behind the nearest point.
            force: N along tool z; left out, the median of the training touches is taken.
            nearest: m, signed distance of the nearest point from the tool origin, in place of the patch's own. Beyond
                10 mm nothing is touched, which is refused; beyond 1 mm in front there is a warning.
            depth: m, travel past first contact; left out, the median of the training touches is taken.
            wide: The same view with its surroundings, pixels of the same size, as `i2t.patches.views` makes it: m
                behind the patch's nearest point, negative where something stands out before it. It makes the
                prediction better at the rim of the skin, and what stands out on the skin is met first. A model on
                patches alone does not look at it.
            valid: (48, 48) or (n, 48, 48), pixels that were seen, in place of the patch's own. The others are
                predicted as if nothing were there and as if the surface went on; the difference widens the standard
                deviation.

        Returns:
            Mean and standard deviation, (3 chips,) or (n, 3 chips) uT.

        Raises:
            ValueError: Shapes or values do not fit, or are none of a touch: a patch that is not in metres, shows no
                surface, was hardly seen or lies far from the skin; a force that presses nothing, breaks the skin or is
                far beyond the training touches.

        Example:
            seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)
            reading, std = predictor.predict(seen, force=1.0)
        """
        seen = user_input.seen_touches(patch, nearest=nearest, wide=wide, valid=valid)
        user_input.check_size_of_patches(seen, self.window, self.reach)
        mask = None if seen.valid is None else user_input.checked_valid(seen.valid, np.shape(seen.depth))
        patches = user_input.checked_patches(seen.depth, self.reach)
        n, pitch = len(patches), self.window / patches.shape[1]
        touches = TouchBatch(
            patches,
            patches if seen.wide is None else user_input.checked_wide(seen.wide, patches, self.reach),
            pitch,
            force=user_input.checked_column("force", force, n, self.default_force),
            nearest=user_input.checked_column("nearest", seen.nearest, n, None, unknown=nearest is None),
            depth=user_input.checked_column("depth", depth, n, self.default_depth),
        )
        user_input.check_press(
            touches.force, touches.depth, usual_force=self.default_force, largest_force=self.largest_force
        )
        if np.isfinite(touches.nearest).any():
            wide = None if seen.wide is None else touches.view
            rendered = isinstance(patch, TouchBatch)  # `render_touches` has warned already
            user_input.check_met(touches.nearest, wide, pitch, remedy=user_input.VIEW_REMEDY, warn=not rendered)
        seen_whole = mask is None or mask.all()
        reading = self._predict_classes(touches) if seen_whole else self._predict_unseen(touches, mask)
        return _first(reading) if np.ndim(seen.depth) == 2 else reading

    def predict_touch(
        self,
        mesh: Any,
        T_o_t: Float[Array, "*batch 4 4"] | np.ndarray,
        force: Values | None = None,
        unit: str | None = None,
    ) -> Reading:
        """The reading of the skin pressed on a mesh, at one pose or at many.

        The skin is 20 mm wide and meets first what stands out under it, though it lie beyond the 17 mm of the patch:
        the reading predicted is that of a press on what is met first.

        Args:
            mesh: In W: a file (then `unit` is required), which is read as `i2t.load_mesh` does, box centred in x and y
                and lowest point on z = 0; an `i2t.objects.Object`; anything with `vertices` and `faces` (m), such as a
                mesh of trimesh, or with `vertices` and `triangles`, such as one of Open3D; or a prepared `Surface`.
            T_o_t: (4, 4) pose of the tool frame at the contact, or (n, 4, 4).
            force: N along tool z, one for all or one for each; left out, the median of the training touches is taken.
            unit: Of a file's coordinates, such as "mm".

        Returns:
            Mean and standard deviation, (3 chips,) or (n, 3 chips) uT.

        Raises:
            ValueError: The pose is no rigid transform, or the skin does not lie on the surface there.

        Example:
            T_o_t = i2t.contact_pose(mesh, mesh.vertices[0])
            reading, std = predictor.predict_touch(mesh, T_o_t, force=1.0)
        """
        seen = self.render_touches(mesh, T_o_t, unit)
        reading = self.predict(seen, force=force)
        return _first(reading) if np.ndim(T_o_t) == 2 else reading

    def render_touches(
        self, mesh: Any, T_o_t: Float[Array, "*batch 4 4"] | np.ndarray, unit: str | None = None
    ) -> TouchBatch:
        """Render the views in front of the skin at poses on a mesh, as `predict_touch` does.

        Args:
            mesh: As for `predict_touch`.
            T_o_t: (4, 4) pose of the tool frame at the contact, or (n, 4, 4).
            unit: Of a file's coordinates, such as "mm".

        Returns:
            Patches, views with their surroundings, and signed distances, n on axis 0; force and depth are unknown.

        Raises:
            ValueError: The pose is no rigid transform, or the skin does not lie on the surface there.
        """
        surface, poses = _surface_of(mesh, unit), user_input.checked_poses(T_o_t)
        seen = [jax.device_get(_render(surface, jnp.asarray(pose), self.window, self.reach)) for pose in poses]
        for pose, view in zip(poses, seen, strict=True):
            user_input.check_in_front(surface, pose, view, self.window)
        views = jax.tree.map(lambda *each: np.stack(each), *seen)
        unknown = np.full(len(poses), np.nan, np.float32)
        return TouchBatch(
            views.patch.depth, views.wide, self.window / PATCH_PIXELS,
            force=unknown, nearest=views.patch.nearest, depth=unknown,
        )  # fmt: skip

    def _predict_classes(self, touches: TouchBatch) -> Reading:
        """Readings of touches in batches of few sizes, so that a new number of touches compiles nothing."""
        n = len(touches.patch)
        parts = [self.predict_batch(touches.rows(rows)) for rows in size_classes(n)]
        return Reading(*(np.concatenate(column)[:n] for column in zip(*parts, strict=True)))

    def _predict_unseen(self, touches: TouchBatch, valid: Any) -> Reading:
        """Readings of touches with unseen pixels: between those of nothing there and of the surface continued, and as
        uncertain as these differ.
        """
        empty, continued = (
            self._predict_classes(touches._replace(patch=filled, view=user_input.in_middle(touches.view, filled)))
            for filled in user_input.fill_unseen(touches.patch, valid, self.reach)
        )
        half = (empty.mean - continued.mean) / 2
        variance = np.maximum(empty.std, continued.std) ** 2 + half**2
        return Reading(continued.mean + half, np.sqrt(variance))

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """The model's readings of n touches, their standard deviations scaled.

        Args:
            touches: What is known of them; a contact pressure that it holds is not predicted again.

        Returns:
            Mean and standard deviation, (n, 3 chips) uT.

        Raises:
            ValueError: Patches or conditions do not fit the model.
        """
        mean, std = self.model.predict_batch(touches)
        return Reading(mean, std * self.std_scale)


def save(directory: Path | str, predictor: Predictor) -> None:
    """Write a predictor into a folder, which appears complete or not at all.

    Args:
        directory: Folder to make or to replace.
        predictor: What to write.
    """
    arrays, model = to_disk(predictor.model)
    about = {
        "format": PREDICTOR_FORMAT,
        "version": PREDICTOR_VERSION,
        "model": model,
        **{name: getattr(predictor, name) for name in _FIELDS},
        "shapes": jax.tree.map(lambda leaf: [str(leaf.dtype), *leaf.shape], arrays),
    }
    kept = _with_values(arrays)
    ocp.save_checkpointables(
        Path(directory).absolute(), kept, custom_metadata=json.loads(json.dumps(about)), overwrite=True
    )


def load_predictor(directory: Path | str) -> Predictor:
    """The predictor in a run's folder, or the ready one that comes with i2t.

    Args:
        directory: A folder that `python -m experiments.train` wrote, or the `checkpoint/predictor` in it; or the name
            of a ready model, "nominal" (`i2t.models`), of one simulated pad.

    Returns:
        The predictor.

    Raises:
        CheckpointError: There is none, or it cannot be read.
        TypeError: The directory is neither text nor a path.

    Example:
        predictor = i2t.load_predictor("nominal")
        reading, std = predictor.predict(patch, force=1.0)
    """
    hint = ready_hint(directory, "predictor")
    directory = ready_path(directory, "predictor").absolute()
    nested = directory / "checkpoint" / "predictor"
    directory = nested if nested.is_dir() else directory
    about = _description(directory, hint)
    try:
        _drop_conventions(directory, about)
        arrays = _load_arrays(directory, about)
        return Predictor(from_disk(arrays, about["model"]), **{name: about[name] for name in _FIELDS})
    except CheckpointError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:100]
        raise CheckpointError(
            f"the predictor in {directory} is damaged ({reason}); train again, or restore a copy"
        ) from error


def std_scale(readings: Float[np.ndarray, "n c"], prediction: Reading) -> float:
    """The factor by which standard deviations must grow for errors to have unit variance.

    Args:
        readings: uT, of touches that the model was not trained on.
        prediction: Of the same touches.

    Returns:
        Root mean square of the errors in predicted standard deviations.
    """
    return float(np.sqrt(np.mean(((readings - prediction.mean) / prediction.std) ** 2)))


def coverage(readings: Float[np.ndarray, "n c"], prediction: Reading) -> float:
    """The share of values in the predicted 90 % range.

    Args:
        readings: uT, of touches that the model was not trained on.
        prediction: Of the same touches.

    Returns:
        Between 0 and 1.
    """
    return float(np.mean(np.abs(readings - prediction.mean) < STDS_WITHIN_90 * prediction.std))


_FIELDS = ("window", "reach", "default_force", "default_depth", "std_scale", "metadata")  # numbers and text of a file


def _description(directory: Path, hint: str) -> dict[str, Any]:
    """Description of a predictor on disk, and a hint where there is none."""
    try:
        about = read_json(directory / "_CHECKPOINT_METADATA", MAX_DESCRIPTION_BYTES)["custom_metadata"]
        if about["format"] != PREDICTOR_FORMAT:
            raise KeyError(about["format"])
        version = about["version"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(
            f"{directory} holds no predictor of this i2t; name the folder that `python -m experiments.train` wrote"
            + hint
        ) from error
    if version != PREDICTOR_VERSION:
        raise CheckpointError(
            f"{directory} holds a predictor of version {version}, but this i2t reads version {PREDICTOR_VERSION}; use "
            "the i2t that wrote it, or train again: python -m experiments.train"
        )
    missing = [name for name in ("model", "shapes", *_FIELDS) if name not in about]
    if missing:
        raise CheckpointError(f"the predictor in {directory} lacks {', '.join(missing)}; train again")
    return about


def _drop_conventions(directory: Path, about: dict[str, Any]) -> None:
    """Drop the conventions of a recording that predictors were once saved with; refuse those that were not the usual
    ones, as forces press and depths count from first contact.
    """
    odd = about["default_force"] < 0
    for setting in about["model"]["settings"].values():
        if isinstance(setting, dict) and "force_sign" in setting.get("values", {}):
            odd |= setting["values"].pop("force_sign") != 1 or setting["values"].pop("depth_offset", 0.0) != 0
    if odd:
        raise CheckpointError(
            f"the predictor in {directory} was trained on forces or depths as its recording counted them (a pressing "
            "force negative, or a depth from another height than first contact), which this i2t corrects before it "
            "trains; train again: python -m experiments.train --dataset DATA"
        )


def _load_arrays(directory: Path, about: dict[str, Any]) -> dict[str, Any]:
    """The arrays of a predictor on disk, to the default device, under this version's names."""
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])

    def leaf(said: list[Any]) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(tuple(said[1:]), said[0], sharding=here)

    described = jax.tree.map(leaf, about["shapes"], is_leaf=lambda node: isinstance(node, list))
    abstract = _with_values(described)
    _check_size(directory, abstract)
    try:
        loaded = ocp.load_checkpointables(directory, abstract)
    except Exception as error:  # orbax raises many kinds, down to bare ones of its storage library
        raise CheckpointError(f"the arrays in {directory} are damaged; train again, or restore a copy") from error
    return {
        name: jax.tree.map(
            lambda each, value: value if each.size else jnp.zeros(each.shape, each.dtype),
            tree,
            loaded.get(name, jax.tree.map(lambda _: None, tree)),
        )
        for name, tree in described.items()
    }


def _check_size(folder: Path, shapes: PyTree) -> None:
    """Refuse arrays that are said to be larger than a folder can hold: unwritten parts are read as zeros."""
    said = 4 * sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    held = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    if said > may_grow_to(held):
        raise CheckpointError(
            f"{folder} says that it holds {said} bytes of numbers, more than its {held} bytes can; train again, or "
            "restore a copy."
        )


def _with_values(arrays: dict[str, Any]) -> dict[str, Any]:
    """Leave out arrays that hold no value, which orbax refuses."""
    kept = {name: jax.tree.map(lambda leaf: leaf if leaf.size else None, tree) for name, tree in arrays.items()}
    return {name: tree for name, tree in kept.items() if jax.tree.leaves(tree)}


def _first(reading: Reading) -> Reading:
    return Reading(reading.mean[0], reading.std[0])


@partial(jax.jit, static_argnums=(2, 3))
def _render(surface: Surface, T_o_t: Array, window: float, reach: float) -> WideView:
    return render_view(surface, T_o_t, window=window, reach=reach)


def _surface_of(mesh: Any, unit: str | None) -> Surface:
    """A surface to render, from any form of a mesh."""
    if isinstance(mesh, Surface):
        return mesh
    if isinstance(mesh, str | Path):
        from i2t.objects import load_mesh

        if unit is None:
            raise ValueError(f"{mesh}: say in which unit the file is, for instance unit='mm'")
        mesh = load_mesh(mesh, unit)
    elif unit is not None:
        raise ValueError("unit is of a file's coordinates; vertices of a mesh are metres: scale them, and leave it out")
    mesh = getattr(mesh, "mesh", mesh)
    user_input.check_size(mesh)
    return prepare_surface(mesh)
