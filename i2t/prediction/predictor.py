"""A trained model for its user: a depth patch, or a mesh and a pose, becomes a reading in uT with its standard
deviation.

A predictor holds a model (`i2t.prediction.touch_model.TouchModel`) of any method (`i2t.prediction.methods`) and calls
its `predict_batch`. `Predictor.save` writes predictors and `load_predictor` reads them, including the conversion from a
patch to the model's input. For a board with n chips a reading has 3 n values.

    predictor = i2t.load_predictor("runs/train")
    seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)                    # or i2t.render_patch of a mesh
    reading, std = predictor.predict(seen, force=1.0)                           # (3n,) uT each
    reading, std = predictor.predict_touch("mug.stl", T_o_t, force=1.0, unit="m")
"""

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped
from orbax.checkpoint import v1 as ocp

from i2t.contact.pressure import PressureModelConfig
from i2t.dataset import Dataset, holds_simulated
from i2t.dataset.digests import touch_digests
from i2t.errors import CheckpointError, DataError
from i2t.files.archives import max_unpacked_size
from i2t.files.checkpoints import custom_metadata
from i2t.files.writing import as_path
from i2t.installation import training_command
from i2t.leave_one_out import STDS_WITHIN_90
from i2t.models import explain_no_predictor, ready_path
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.patches.views import PatchView
from i2t.prediction import user_input
from i2t.prediction.loads import rows_with_load
from i2t.prediction.metrics import PredictorScore, score_readings
from i2t.prediction.splitting import touches_with_contact
from i2t.prediction.touch_model import Reading, TouchBatch, TouchModel, from_disk, recorded_batch, to_disk
from i2t.recordings.sets import corrected_dataset
from i2t.rendering.render import prepare_surface, render_view
from i2t.runtime.batching import size_classes
from i2t.skin.boards import board_from_lists, same_board
from i2t.types import Board, Surface

PREDICTOR_FORMAT = "i2t predictor"  # name of the format in the description of a saved predictor
PREDICTOR_VERSION = 5  # version of the format of predictors that is written

Values: TypeAlias = int | float | Sequence[int | float] | np.ndarray | Array  # one for all touches, or one for each


@dataclass(frozen=True, repr=False)
class Predictor:
    """Trained model that predicts a skin's reading from a depth patch, or from a mesh and a pose (`load_predictor`).

    Attributes:
        model: The model that predicts.
        window: Edge (m) of the square that a patch shows.
        reach: Depth (m) of a patch behind its nearest point.
        default_force: Force (N) if a user gives none: the median of the training touches.
        default_travel: Travel (m) past first contact if a user gives none: the median of the training touches.
        std_scale: Factor on the model's standard deviations that gives the errors on validation touches unit variance.
        metadata: Provenance: method, data and seed of the training, and digests of the touches that were used.

    Example:
        predictor = i2t.load_predictor("runs/train")
        reading, std = predictor.predict(patch, force=1.0)  # (c,) uT each
    """

    model: TouchModel
    window: float
    reach: float
    default_force: float
    default_travel: float
    std_scale: float = 1.0
    metadata: dict[str, Any] | None = None

    def __repr__(self) -> str:
        """Describe the kind of model, the board's size and the patch in one line."""
        source = (self.metadata or {}).get("source", "unknown source")
        return (
            f"Predictor({type(self.model).__name__}, {self.model.channels // 3} chips, "
            f"patch {self.window * 1e3:g} mm, default {self.load} {self._usual_load}, {source})"
        )

    def __str__(self) -> str:
        """Describe the method, the touches of the fit, the input and the output."""
        about = self.metadata or {}
        lines = [
            f"Predictor: {about.get('method', type(self.model).__name__)} ({about.get('source', 'unknown source')})"
        ]
        if trained := about.get("trained_on"):
            lines += [f"fitted to {trained['training']} touches of {', '.join(trained['training_objects'])}"]
            if trained["validation"]:
                lines[-1] += f"; tuned on {trained['validation']} of {', '.join(trained['validation_objects'])}"
        lines += [f"takes patches of {1e3 * self.window:g} mm and a {self.load} ({self._usual_load} by default)"]
        lines += [f"predicts {self.model.channels} values (uT) of {self.model.channels // 3} chips, with their errors"]
        return "\n  ".join(lines)

    @property
    def load(self) -> Literal["force", "travel"]:
        """Load from which the model predicts."""
        if self.pressure is not None:
            return self.pressure.control
        return "travel" if self._uses("travel") and not self._uses("force") else "force"

    @property
    def _usual_load(self) -> str:
        """Default load with its unit."""
        return f"{self.default_force:.2g} N" if self.load == "force" else f"{1e3 * self.default_travel:.2g} mm"

    def _uses(self, load: str) -> bool:
        """Test whether the model predicts from a load, or from another measurement of the same name."""
        of_network = getattr(getattr(self.model, "cfg", None), "conditions", ())
        conditions: Sequence[str] = getattr(self.model, "conditions", of_network)
        return load in conditions or (self.pressure is not None and self.pressure.control == load)

    @property
    def largest_force(self) -> float | None:
        """Largest absolute force (N) of the training touches; None if it is unknown."""
        return max(map(abs, user_input.known_range(self.metadata, "force_range")), default=None)

    @property
    def board(self) -> Board | None:
        """The board whose readings the model was trained on; None if it was not saved."""
        board = board_from_lists((self.metadata or {}).get("board"))
        return board if board and board.num_readings == self.model.channels else None

    @property
    def simulated(self) -> bool:
        """Whether any touch of the training was simulated, or may have been because the source is not recorded."""
        return holds_simulated((self.metadata or {}).get("source", "simulated"))

    @property
    def pressure(self) -> PressureModelConfig | None:
        """Configuration of the predicted contact pressure; None for a model on patches."""
        return self.model.pressure

    def with_pressure(self, **changes: Any) -> "Predictor":
        """Change fields of the predictor's pressure model; a predictor without one stays the same.

        Args:
            changes: Fields of `PressureModelConfig` with their new values.

        Returns:
            Changed copy of the predictor.
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
        travel: Values | None = None,
        view: Float[Array, "*batch w w"] | np.ndarray | None = None,
        *,
        valid: Bool[Array, "*batch n n"] | np.ndarray | None = None,
    ) -> Reading:
        """Predict the reading of one touch, or of many on axis 0.

        Give the whole result of `i2t.patch_from_depth`, `i2t.render_patch` or a view of either. It contains the
        distance of the surface from the skin, so that a patch of a distant surface is refused, and the mask of seen
        pixels. An array of depths contains neither: it is taken for a fully seen surface in contact with the skin.

        Args:
            patch: A `Patch`, `DepthPatch`, `PatchView` or `DepthView`, of one touch or of n on axis 0, or a list of
                them; or depths (48, 48) or (n, 48, 48) in m behind the nearest point.
            force: Force (N) along tool z. The default is the median of the training touches. A predictor that was
                fitted to presses by travel takes none (`load`).
            nearest: Signed distance (m) of the nearest point from the tool origin, in place of the patch's own. Beyond
                10 mm the skin touches nothing, which is refused; beyond 1 mm in front there is a warning.
            travel: Travel (m) past first contact, for a predictor that was fitted to presses by travel. The default is
                the median of the training touches.
            view: The patch with its surroundings and pixels of the same size, as from `i2t.patches.views`: m
                behind the patch's nearest point, negative where something stands out in front of it. It improves the
                prediction at the rim of the skin and shows what the skin meets first. A model on patches ignores it.
            valid: Mask (48, 48) or (n, 48, 48) of seen pixels, in place of the patch's own. The others are predicted as
                if they were empty and as if the surface continued; the difference widens the standard deviation.

        Returns:
            Mean and standard deviation, (3 chips,) or (n, 3 chips) uT.

        Raises:
            ValueError: Shapes or values do not fit, or are not those of a touch: a patch that is not in metres, shows
                no surface, was hardly seen or lies far from the skin; a force that presses nothing, breaks the skin or
                is far beyond the training touches; a force or a travel that the model does not use.

        Example:
            seen = i2t.patch_from_depth(image, camera, T_w_c, T_w_t)
            reading, std = predictor.predict(seen, force=1.0)
        """
        if force is not None and not self._uses("force") and self._uses("travel"):
            raise ValueError("force: this predictor was fitted to presses by travel; give travel=, in metres")
        if travel is not None and force is None and not self._uses("travel") and self._uses("force"):
            raise ValueError("travel: this predictor was fitted to presses by force; give force=, in newtons")
        seen = user_input.seen_touches(patch, nearest=nearest, view=view, valid=valid)
        user_input.check_size_of_patches(seen, self.window, self.reach)
        mask = None if seen.valid is None else user_input.checked_valid(seen.valid, np.shape(seen.depth))
        patches = user_input.checked_patches(seen.depth, self.reach)
        n, pitch = len(patches), self.window / patches.shape[1]
        touches = TouchBatch(
            patches,
            patches if seen.view is None else user_input.checked_views(seen.view, patches, self.reach),
            pitch,
            force=user_input.checked_column("force", force, n, self.default_force),
            nearest=user_input.checked_column("nearest", seen.nearest, n, None, unknown=nearest is None),
            travel=user_input.checked_column("travel", travel, n, self.default_travel),
        )
        doubts = user_input.check_press(
            touches.force, touches.travel, usual_force=self.default_force, largest_force=self.largest_force,
            least_force=min(user_input.known_range(self.metadata, "force_range"), default=0.0),
        )  # fmt: skip
        if np.isfinite(touches.nearest).any():
            views = None if seen.view is None else touches.view
            rendered = isinstance(patch, TouchBatch)  # `render_touches` has warned already
            remedy = (
                "move the tool onto it (i2t.pose_at_pixel), or correct the unit of the depth image: give metres, by "
                "its camera's scale, such as 1e-4 where it stores tenths of a millimetre"
            )
            user_input.check_met(touches.nearest, views, pitch, remedy=remedy, warn=not rendered)
        seen_whole = mask is None or mask.all()
        reading = self._predict_classes(touches) if seen_whole else self._predict_unseen(touches, mask)
        doubts += user_input.unlike_training(self.metadata, patches, self.reach, touches.travel, reading.mean)
        if doubts:
            warnings.warn(f"{'; '.join(doubts)}: its prediction is only a guess", stacklevel=2)
        return _first(reading) if np.ndim(seen.depth) == 2 else reading

    def predict_touch(
        self,
        mesh: Any,
        T_o_t: Float[Array, "*batch 4 4"] | np.ndarray,
        force: Values | None = None,
        unit: str | None = None,
        *,
        travel: Values | None = None,
    ) -> Reading:
        """Predict the reading of the skin pressed on a mesh, at one pose or at many.

        The skin is 20 mm wide and first meets whatever stands out under it, even outside the 17 mm of the patch. The
        prediction is the reading of a press on what it meets first.

        Args:
            mesh: The object in W: a file, which is read as by `i2t.load_mesh` with its `unit`, with its box
                centred in x and y and its lowest point on z = 0; an `i2t.objects.Object`; any mesh with `vertices` and
                `faces` (m), such as one of trimesh, or with `vertices` and `triangles`, such as one of Open3D; or a
                prepared `Surface`.
            T_o_t: (4, 4) pose of the tool frame at the contact, or (n, 4, 4).
            force: Force (N) along tool z, one for all touches or one for each. The default is the median of the
                training touches. A predictor that was fitted to presses by travel takes none (`load`).
            unit: Unit of a file's coordinates, such as "mm".
            travel: Travel (m) past first contact, one for all touches or one for each, for a predictor that was fitted
                to presses by travel. The default is the median of the training touches.

        Returns:
            Mean and standard deviation, (3 chips,) or (n, 3 chips) uT.

        Raises:
            ValueError: A pose is not a rigid transform, the skin does not lie on the surface there, or the model does
                not use this load.

        Example:
            T_o_t = i2t.contact_pose(mesh, mesh.vertices[0])
            reading, std = predictor.predict_touch(mesh, T_o_t, force=1.0)
        """
        seen = self.render_touches(mesh, T_o_t, unit)
        reading = self.predict(seen, force=force, travel=travel)
        return _first(reading) if np.ndim(T_o_t) == 2 else reading

    def render_touches(
        self, mesh: Any, T_o_t: Float[Array, "*batch 4 4"] | np.ndarray, unit: str | None = None
    ) -> TouchBatch:
        """Render the views in front of the skin at poses on a mesh, as `predict_touch` does.

        Args:
            mesh: The object, as for `predict_touch`.
            T_o_t: (4, 4) pose of the tool frame at the contact, or (n, 4, 4).
            unit: Unit of a file's coordinates, such as "mm".

        Returns:
            Patches, views and signed distances, n on axis 0, with unknown force and travel.

        Raises:
            ValueError: A pose is not a rigid transform, or the skin does not lie on the surface there.
        """
        surface, poses = _surface_of(mesh, unit), user_input.checked_poses(T_o_t)
        seen = [jax.device_get(_render(surface, jnp.asarray(pose), self.window, self.reach)) for pose in poses]
        for pose, view in zip(poses, seen, strict=True):
            user_input.check_in_front(surface, pose, view, self.window)
        views = jax.tree.map(lambda *leaves: np.stack(leaves), *seen)
        unknown = np.full(len(poses), np.nan, np.float32)
        return TouchBatch(
            views.patch.depth, views.depth, self.window / PATCH_PIXELS,
            force=unknown, nearest=views.patch.nearest, travel=unknown,
        )  # fmt: skip

    def _predict_classes(self, touches: TouchBatch) -> Reading:
        """Predict touches in batches of few sizes, so that a new number of touches compiles nothing."""
        n = len(touches.patch)
        parts = [self.predict_batch(touches.rows(rows)) for rows in size_classes(n)]
        return Reading(*(np.concatenate(column)[:n] for column in zip(*parts, strict=True)))

    def _predict_unseen(self, touches: TouchBatch, valid: Any) -> Reading:
        """Predict touches with unseen pixels: halfway between the readings for emptiness and for a continued surface,
        with their difference in the uncertainty.
        """
        empty, continued = (
            self._predict_classes(touches._replace(patch=filled, view=user_input.in_middle(touches.view, filled)))
            for filled in user_input.fill_unseen(touches.patch, valid, self.reach)
        )
        half = (empty.mean - continued.mean) / 2
        variance = np.maximum(empty.std, continued.std) ** 2 + half**2
        return Reading(continued.mean + half, np.sqrt(variance))

    def predict_batch(self, touches: TouchBatch) -> Reading:
        """Predict the readings of n touches with scaled standard deviations.

        Args:
            touches: The touches; a contact pressure that they hold is not predicted again.

        Returns:
            Mean and standard deviation, (n, 3 chips) uT.

        Raises:
            ValueError: Patches or conditions do not fit the model.
        """
        mean, std = self.model.predict_batch(touches)
        return Reading(mean, std * self.std_scale)

    def score(
        self,
        dataset: Dataset,
        rows: Bool[np.ndarray, " n"] | Int[np.ndarray, " m"] | None = None,
        *,
        groups: Shaped[np.ndarray, " n"] | None = None,
    ) -> PredictorScore:
        """Compare predictions with the readings of a data set's touches that were not used in the fit.

        Touches count as used if the predictor was fitted to them, or chose or scaled something on them, also when they
        are in another file now. They are identified by their readings.

        Args:
            dataset: Data set of n touches of the predictor's skin. Its forces and travels are corrected as for a fit.
            rows: Mask or indices of the touches to score. By default, all touches with contact and a known load that
                were not used in the fit; with the split of the fit, these are its test touches.
            groups: Labels of groups of touches that are not independent; sessions by default.

        Returns:
            R2, root mean square error, cosine and coverage, with 95 % intervals over the groups. It prints itself, with
            the number of touches that were used in the fit.

        Raises:
            DataError: All touches were used in the fit, no touch is selected, or board or patch differ from those of
                the predictor.
            TypeError: `dataset` is not a data set.

        Example:
            predictor = i2t.fit_predictor(dataset)
            print(predictor.score(dataset))
        """
        if not isinstance(dataset, Dataset):
            raise TypeError(f"dataset: is a {type(dataset).__name__}; give a data set, as i2t.load_dataset reads it")
        self._check_dataset(dataset)
        corrected, _ = corrected_dataset(dataset)
        digests = (self.metadata or {}).get("used_touches")
        used = np.isin(touch_digests(dataset), digests or [])
        if rows is None:
            with_load, _ = rows_with_load(corrected)
            scored = np.flatnonzero(touches_with_contact(corrected.touches) & with_load & ~used)
            if not len(scored) and used.any():
                raise DataError(
                    "dataset: all its usable touches were used in the fit; give other touches, or name the rows to "
                    "score (rows=)"
                )
        else:
            scored = np.arange(len(dataset))[rows]
        if not len(scored):
            raise DataError("rows: no touch is selected; select touches with contact")
        touches = corrected.select(scored).touches
        batch = recorded_batch(corrected.select(scored))
        reading = self._predict_classes(
            batch._replace(
                force=np.where(np.isfinite(batch.force), batch.force, np.float32(self.default_force)),
                travel=np.where(np.isfinite(batch.travel), batch.travel, np.float32(self.default_travel)),
            )
        )
        labels = np.asarray(dataset.touches.session if groups is None else groups)[scored]
        return PredictorScore(
            *score_readings(touches.reading, reading, labels),
            touches=len(scored),
            objects=tuple(dataset.objects[i] for i in np.unique(touches.object)),
            groups=len(np.unique(labels)),
            grouped_by="sessions" if groups is None else "groups",
            used=None if digests is None else int(used[scored].sum()),
            source=dataset.source,
            measured=touches.reading,
            predicted=reading,
        )

    def _check_dataset(self, dataset: Dataset) -> None:
        """Refuse a data set of another board or with other patches (DataError)."""
        trained_on = self.board
        if self.model.channels != dataset.board.num_readings or (
            trained_on is not None and not same_board(trained_on, dataset.board)
        ):
            raise DataError(
                f"dataset: its board has {dataset.board.num_chips} chips, and the predictor was fitted to another "
                f"board with {self.model.channels // 3}; give touches of the same skin"
            )
        if not np.allclose((dataset.window, dataset.reach), (self.window, self.reach), rtol=1e-6, atol=0):
            raise DataError(
                f"dataset: its patches cover {1e3 * dataset.window:g} mm with a reach of {1e3 * dataset.reach:g} mm, "
                f"and those of the fit {1e3 * self.window:g} mm with {1e3 * self.reach:g} mm; convert the recording "
                "with the same patches"
            )

    def save(self, directory: Path | str) -> None:
        """Write the predictor into a folder, which appears completely or not at all (`load_predictor`).

        Args:
            directory: Folder to create or to replace.

        Raises:
            TypeError: The directory is neither text nor a path.

        Example:
            predictor.save("runs/mine")
            predictor = i2t.load_predictor("runs/mine")
        """
        arrays, model = to_disk(self.model)
        about = {
            "format": PREDICTOR_FORMAT,
            "version": PREDICTOR_VERSION,
            "model": model,
            **{name: getattr(self, name) for name in _PREDICTOR_FIELDS},
            "shapes": jax.tree.map(lambda leaf: [str(leaf.dtype), *leaf.shape], arrays),
        }
        ocp.save_checkpointables(
            as_path("directory", directory).absolute(), _with_values(arrays),
            custom_metadata=json.loads(json.dumps(about)), overwrite=True,
        )  # fmt: skip


def load_predictor(directory: Path | str) -> Predictor:
    """Load a predictor from a run's folder, or the ready one that comes with i2t.

    Args:
        directory: A folder that `python -m experiments.train` wrote, or the `checkpoint/predictor` in it; or the name
            of a ready model, "nominal" (`i2t.models`), trained on one simulated pad.

    Returns:
        Predictor on the default device.

    Raises:
        CheckpointError: The folder holds no predictor, or it cannot be read.
        TypeError: The directory is neither text nor a path.

    Example:
        predictor = i2t.load_predictor("nominal")
        reading, std = predictor.predict(patch, force=1.0)
    """
    name, directory = directory, ready_path(directory, "predictor").absolute()
    nested = directory / "checkpoint" / "predictor"
    directory = nested if nested.is_dir() else directory
    about = _description(directory, name)
    try:
        if about["version"] == 4:
            about["model"]["settings"] = _with_travel(about["model"]["settings"])
        _drop_conventions(directory, about)
        arrays = _load_arrays(directory, about)
        return Predictor(from_disk(arrays, about["model"]), **{name: about[name] for name in _PREDICTOR_FIELDS})
    except CheckpointError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        reason = " ".join(str(error).split())[:100]
        raise CheckpointError(
            f"the predictor in {directory} is damaged ({reason}); train again, or restore a copy"
        ) from error


def std_scale(readings: Float[np.ndarray, "n c"], prediction: Reading) -> float:
    """Compute the factor on predicted standard deviations that makes them match the errors.

    Args:
        readings: Readings (uT) of touches outside the training set.
        prediction: Predictions of the same touches.

    Returns:
        Root mean square of the errors, each divided by its predicted standard deviation; 1 is calibrated, and more
        is overconfident.
    """
    return float(np.sqrt(np.mean(((readings - prediction.mean) / prediction.std) ** 2)))


def coverage(readings: Float[np.ndarray, "n c"], prediction: Reading) -> float:
    """Compute the fraction of measured values that lie in their predicted central 90 % interval.

    Args:
        readings: Readings (uT) of touches outside the training set.
        prediction: Predictions of the same touches.

    Returns:
        Fraction between 0 and 1; 0.9 is calibrated.
    """
    return float(np.mean(np.abs(readings - prediction.mean) < STDS_WITHIN_90 * prediction.std))


# Fields of a predictor that its file stores as numbers or texts.
_PREDICTOR_FIELDS = ("window", "reach", "default_force", "default_travel", "std_scale", "metadata")


def _description(directory: Path, name: Path | str) -> dict[str, Any]:
    """Read the description of a predictor on disk, which the user called `name`."""
    try:
        about = custom_metadata(directory)
        if about["format"] != PREDICTOR_FORMAT:
            raise KeyError(about["format"])
        version = about["version"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise CheckpointError(f"{name}: {explain_no_predictor(name)}") from error
    if version not in (4, PREDICTOR_VERSION):  # version 4 called travel depth
        raise CheckpointError(
            f"{directory} holds a predictor of version {version}, but this i2t reads version {PREDICTOR_VERSION}; use "
            f"the i2t that wrote it, or train again: {training_command()}"
        )
    if version == 4 and "default_depth" in about:
        about["default_travel"] = about.pop("default_depth")
    missing = [name for name in ("model", "shapes", *_PREDICTOR_FIELDS) if name not in about]
    if missing:
        raise CheckpointError(f"the predictor in {directory} lacks {', '.join(missing)}; train again")
    return about


def _with_travel(settings: dict[str, Any]) -> dict[str, Any]:
    """Rename the travel of a press in the settings of a model, which version 4 called depth."""
    renamed = {}
    for name, value in settings.items():
        if isinstance(value, dict):
            value = _with_travel(value)
        elif name == "conditions":
            value = ["travel" if condition == "depth" else condition for condition in value]
        elif name == "control" and value == "depth":
            value = "travel"
        renamed[name] = value
    return renamed


def _drop_conventions(directory: Path, about: dict[str, Any]) -> None:
    """Drop the conventions of a recording with which predictors were once saved. Refuse any but the usual ones: forces
    press, and travel counts from first contact.
    """
    odd = about["default_force"] < 0
    for setting in about["model"]["settings"].values():
        if isinstance(setting, dict) and "force_sign" in setting.get("values", {}):
            odd |= setting["values"].pop("force_sign") != 1 or setting["values"].pop("depth_offset", 0.0) != 0
    if odd:
        raise CheckpointError(
            f"the predictor in {directory} was trained on forces or travels as its recording counted them (a pressing "
            "force negative, or a travel from another height than first contact), which this i2t corrects before "
            f"training; train again: {training_command()}"
        )


def _load_arrays(directory: Path, about: dict[str, Any]) -> dict[str, Any]:
    """Load the arrays of a predictor from disk to the default device, by field."""
    here = jax.sharding.SingleDeviceSharding(jax.devices()[0])

    def leaf(description: list[Any]) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(tuple(description[1:]), description[0], sharding=here)

    described = jax.tree.map(leaf, about["shapes"], is_leaf=lambda node: isinstance(node, list))
    abstract = _with_values(described)
    _check_size(directory, abstract)
    try:
        loaded = ocp.load_checkpointables(directory, abstract)
    except Exception as error:  # orbax raises many kinds of errors, also those of its storage library
        raise CheckpointError(f"the arrays in {directory} are damaged; train again, or restore a copy") from error
    return {
        name: jax.tree.map(
            lambda leaf, value: value if leaf.size else jnp.zeros(leaf.shape, leaf.dtype),
            tree,
            loaded.get(name, jax.tree.map(lambda _: None, tree)),
        )
        for name, tree in described.items()
    }


def _check_size(folder: Path, shapes: PyTree) -> None:
    """Refuse arrays whose described size exceeds what the folder can hold, because missing parts are read as zeros."""
    described = 4 * sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    held = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
    if described > max_unpacked_size(held):
        raise CheckpointError(
            f"{folder} describes {described} bytes of numbers, more than its {held} bytes can hold; train again, or "
            "restore a copy."
        )


def _with_values(arrays: dict[str, Any]) -> dict[str, Any]:
    """Leave out arrays without values, which orbax refuses."""
    kept = {name: jax.tree.map(lambda leaf: leaf if leaf.size else None, tree) for name, tree in arrays.items()}
    return {name: tree for name, tree in kept.items() if jax.tree.leaves(tree)}


def _first(reading: Reading) -> Reading:
    return Reading(reading.mean[0], reading.std[0])


@partial(jax.jit, static_argnums=(2, 3))
def _render(surface: Surface, T_o_t: Array, window: float, reach: float) -> PatchView:
    return render_view(surface, T_o_t, window=window, reach=reach)


def _surface_of(mesh: Any, unit: str | None) -> Surface:
    """Prepare a surface for rendering from any form of a mesh."""
    if isinstance(mesh, Surface):
        return mesh
    if isinstance(mesh, str | Path):
        from i2t.objects import load_mesh

        mesh = load_mesh(mesh, unit)
    elif unit is not None:
        raise ValueError("unit is that of a file; vertices of a mesh are in metres: scale them, and omit unit")
    mesh = getattr(mesh, "mesh", mesh)
    user_input.check_size(mesh)
    return prepare_surface(mesh)
