"""Data sets: touches as NumPy arrays, the names that their indices refer to, and what all touches have in common.

All arrays are NumPy's; arrays of other libraries, such as JAX, are converted on construction. Floats are float32 and
indices int32.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from i2t.errors import DataError
from i2t.patches.dimensions import PATCH_WINDOW, REACH, VIEW_PIXELS
from i2t.types import Board, Pad, ReturnCode, Touches, Truth

NOT_STATED = "not stated"  # source of recordings whose format does not state whether they are real
SOURCES = ("simulated", "mixed", "real", NOT_STATED)  # sources of the touches of a data set
# fields of touches that hold integers: indices of names, and the return code
INDEX_FIELDS = ("object", "pad", "session", "code")
# fields of touches without a default
REQUIRED_FIELDS = tuple(name for name in Touches._fields if name not in Touches._field_defaults)
AXIS_NAMES = ("x", "y", "z")  # axes of a vector, in their order


@dataclass(frozen=True, repr=False)
class Dataset:
    """A data set: touches, the names of their objects, pads and sessions, the sensor board, and provenance.
    `touches.object[i]` is an index into `objects`, and `pad` and `session` likewise. Rows are in order of time.

    Example:
        dataset = i2t.load_dataset("DATA")
        train = dataset.select(dataset.touches.session > 0)  # without the first session
        dataset.touches.reading, dataset.objects[dataset.touches.object[0]]
    """

    touches: Touches
    objects: tuple[str, ...]
    pads: tuple[str, ...]
    sessions: tuple[str, ...]  # names of sessions, each a recording with one placement of an object
    board: Board
    source: str  # "simulated", "real", "mixed" (partly simulated) or "not stated"
    window: float = PATCH_WINDOW  # m, edge of the square that a patch covers
    reach: float = REACH  # m, largest depth of a patch
    meta: Mapping[str, str] = field(default_factory=dict)  # provenance of the touches as names and texts

    def __repr__(self) -> str:
        return (
            f"Dataset({len(self)} touches, {self.source}, {len(self.objects)} objects, {len(self.pads)} pads, "
            f"{len(self.sessions)} sessions, {self.board.num_chips} chips)"
        )

    def __str__(self) -> str:
        """Count the touches by object, name the skins, and count missing values."""
        summary = self.summary()
        objects = [f"{name} {count}" for name, count in summary["objects"].items() if count]
        missing = [f"{name} {count}" for name, count in summary["missing"].items() if count]
        pads = [name for name, count in summary["pads"].items() if count]
        sessions = sum(count > 0 for count in summary["sessions"].values())
        return "\n  ".join(
            [
                f"Dataset of {len(self)} touches in {sessions} sessions ({source_phrase(self.source)})",
                f"objects: {_listed(objects)}",
                f"skins: {_listed(pads)}, with {self.board.num_chips} chips",
                *([f"missing: {_listed(missing)}"] if missing else []),
            ]
        )

    def __post_init__(self) -> None:
        def numpy(name: str, values: Any) -> np.ndarray:
            # Unix time in float32 would have steps of two minutes.
            return np.asarray(
                values, np.int32 if name in INDEX_FIELDS else np.float64 if name == "time" else np.float32
            )

        object.__setattr__(self, "touches", _map(numpy, self.touches))
        object.__setattr__(self, "board", Board(*(np.asarray(value, np.float32) for value in self.board)))

    @classmethod
    def simulated(
        cls,
        touches: Touches,
        objects: Sequence[str],
        pad: Pad,
        *,
        pad_name: str = "simulated pad",
        session: str = "session",
        meta: Mapping[str, str] | None = None,
    ) -> "Dataset":
        """Make a data set, marked as simulated, from the result of `i2t.simulate_touches`.

        Args:
            touches: Simulated touches of one pad.
            objects: Names of the objects, in the order of the simulated surfaces.
            pad: The simulated pad.
            pad_name: Name of the pad in the data set.
            session: Prefix of the names of sessions, which are numbered.
            meta: Provenance of the touches, as names and texts.

        Returns:
            The data set of the simulated touches.
        """
        sessions = tuple(f"{session} {i:03d}" for i in range(int(np.max(touches.session)) + 1))
        return cls(
            touches, tuple(objects), pads=(pad_name,), sessions=sessions, board=pad.board,
            source="simulated", meta=dict(meta or {}),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.touches.reading)

    def select(self, rows: Any) -> "Dataset":
        """Select some of the touches, and keep all names.

        Args:
            rows: A boolean mask (n,), an array of row numbers, or a slice.

        Returns:
            A data set of the selected touches.
        """
        rows = np.arange(len(self))[rows]
        touches = _map(lambda _, values: _rows(values, rows), self.touches)
        return replace(self, touches=touches)

    def summary(self) -> dict[str, Any]:
        """Count touches and missing values, and compute statistics of the readings (uT, by chip axis). All values can
        be written to JSON, and unknown ones are None.
        """
        touches = self.touches
        by_axis = touches.reading.reshape(-1, self.board.num_chips, 3).astype(np.float64)
        finite = {name: np.isfinite(getattr(touches, name)) for name in ("nearest", "force", "travel")}
        return {
            "touches": len(self),
            "source": self.source,
            "objects": _counts(touches.object, self.objects),
            "pads": _counts(touches.pad, self.pads),
            "sessions": _counts(touches.session, self.sessions),
            "codes": {code.name.lower(): int(np.sum(touches.code == code)) for code in ReturnCode},
            "reading_uT": {
                axis: _statistics(values[np.isfinite(values)])
                for axis, values in zip(AXIS_NAMES, by_axis.reshape(-1, 3).T, strict=True)
            },
            "reading_norm_uT": _statistics(np.sqrt(np.nansum(by_axis**2, axis=(1, 2)))),
            "force_N": _statistics(touches.force[finite["force"]].astype(np.float64)),
            "travel_m": _statistics(touches.travel[finite["travel"]].astype(np.float64)),
            "nearest_m": _statistics(touches.nearest[finite["nearest"]].astype(np.float64)),
            "missing": {
                **{name: int(np.sum(~mask)) for name, mask in finite.items()},
                "chips": int(np.isnan(touches.reading).any(1).sum()),
                "view": int(sum(np.isnan(view).any() for view in touches.view)),
                "T_w_t": int(np.isnan(touches.T_w_t).any((1, 2)).sum()),
                "T_w_o": int(np.isnan(touches.T_w_o).any((1, 2)).sum()),
                "time": len(self) if touches.time is None else int(np.isnan(touches.time).sum()),
            },
            "truth": touches.truth is not None,
            "window_m": float(self.window),
            "reach_m": float(self.reach),
            "patch_pixels": touches.patch.shape[-1],
            "meta": dict(self.meta),
        }


def holds_simulated(source: str) -> bool:
    """Test whether any touch of a data set is known to be simulated.

    Args:
        source: The source of the data set, one of `SOURCES`.

    Returns:
        True for "simulated" and "mixed"; False for "real" and "not stated".
    """
    return source in ("simulated", "mixed")


def source_phrase(source: str) -> str:
    """Convert the source of a data set to words for a sentence.

    Args:
        source: The source of the data set, one of `SOURCES`.

    Returns:
        "simulated", "real", "mixed" or "source not stated".
    """
    return f"source {source}" if source == NOT_STATED else source


def _common_source(sources: set[str]) -> str:
    """Find the source of a data set that joins parts with the given sources."""
    if len(sources) == 1:
        return next(iter(sources))
    return "mixed" if any(map(holds_simulated, sources)) else NOT_STATED


def missing_views(touches: int, pixels: int = VIEW_PIXELS) -> np.ndarray:
    """Make NaN views for touches whose surroundings were not recorded.

    Args:
        touches: Number of touches.
        pixels: Number of pixels along each edge of a view.

    Returns:
        Read-only NaN array of shape (touches, pixels, pixels), which shares one value and takes no memory.
    """
    return np.broadcast_to(np.float32(np.nan), (touches, pixels, pixels))


def concatenate(datasets: Sequence[Dataset]) -> Dataset:
    """Join data sets in the given order, and merge their names.

    Args:
        datasets: At least one data set. The error-free values (`truth`) are kept if every data set has them, and times
            if any has them. Entries of `meta` that differ are joined by "; ".

    Returns:
        The joined data set.

    Raises:
        DataError: The patches' windows or reaches, or the boards, differ.
    """
    if not datasets:
        raise DataError("no data set given; name at least one")
    first = datasets[0]
    for other in datasets[1:]:
        _require_joinable(first, other)
    names: dict[str, Any] = {
        kind: tuple(dict.fromkeys(name for d in datasets for name in getattr(d, kind)))
        for kind in ("objects", "pads", "sessions")
    }
    columns: dict[str, Any] = {}
    for column in REQUIRED_FIELDS:
        parts = [getattr(d.touches, column) for d in datasets]
        if (kind := column + "s") in names:
            parts = [_renumbered(part, getattr(d, kind), names[kind]) for d, part in zip(datasets, parts, strict=True)]
        columns[column] = _joined(parts)
    truths = [d.touches.truth for d in datasets]
    if all(truth is not None for truth in truths):
        columns["truth"] = Truth(*(_joined(list(parts)) for parts in zip(*truths, strict=True)))
    if any(d.touches.time is not None for d in datasets):
        columns["time"] = np.concatenate([times_of(d) for d in datasets])
    sources = {d.source for d in datasets}
    return replace(
        first,
        touches=Touches(**columns),
        **names,
        source=_common_source(sources),
        meta={key: _merged([d.meta[key] for d in datasets if key in d.meta]) for d in datasets for key in d.meta},
    )


def times_of(dataset: Dataset) -> np.ndarray:
    """Read the time of each touch.

    Args:
        dataset: Data set of n touches.

    Returns:
        `(n,)` times (s) on the clock of the recording, Unix time where it has that; NaN where unknown.
    """
    time = dataset.touches.time
    return np.full(len(dataset), np.nan) if time is None else np.asarray(time, np.float64)


def _require_joinable(first: Dataset, other: Dataset) -> None:
    """Refuse patches of different sizes and readings of different boards."""
    alike = np.isclose((other.window, other.reach), (first.window, first.reach), rtol=1e-6, atol=0).all()
    shapes = [(d.touches.patch.shape[1:], d.touches.view.shape[1:]) for d in (first, other)]
    if not alike or shapes[0] != shapes[1]:
        both = f"{_geometry(first)} and of {_geometry(other)}"
        raise DataError(f"patches of {both} cannot be joined; convert them with one window and one reach")
    if not all(
        a.shape == b.shape and np.allclose(a, b, rtol=0, atol=1e-6)
        for a, b in zip(first.board, other.board, strict=True)
    ):
        raise DataError("readings of different boards cannot be joined; keep them in separate data sets")


def _renumbered(numbers: np.ndarray, names: Sequence[str], all_names: Sequence[str]) -> np.ndarray:
    """Convert indices into the names of a part to indices into the names of the whole."""
    place = {name: i for i, name in enumerate(all_names)}
    return np.array([place[name] for name in names], np.int32)[numbers]


def validate(dataset: Dataset) -> None:
    """Check that a data set is valid: shapes, indices, finite patches, rigid poses and the like.

    Args:
        dataset: The data set. Readings must have three values for each chip of its board, which are NaN if the chip did
            not answer.

    Raises:
        DataError: One sentence that names the first invalid field and its first bad row.
    """
    _check_shapes(dataset)
    _check_values(dataset)
    for name in ("object", "pad", "session"):
        names, value = getattr(dataset, name + "s"), getattr(dataset.touches, name)
        _require(len(set(names)) == len(names), f"{name} names are not unique")
        _require_rows(name, (value >= 0) & (value < len(names)), f"is not an index into the {len(names)} {name} names")
    _require_rows("code", np.isin(dataset.touches.code, [int(code) for code in ReturnCode]), "is not a return code")


def _check_shapes(dataset: Dataset) -> None:
    touches, n = dataset.touches, len(dataset.touches.reading)
    pixels, view = touches.patch.shape[-1], touches.view.shape[-1]
    chips = len(dataset.board.rotations)
    shapes: dict[str, tuple[int, ...]] = {
        "patch": (n, pixels, pixels),
        "view": (n, view, view),
        "reading": (n, 3 * chips),
        "T_w_t": (n, 4, 4),
        "T_w_o": (n, 4, 4),
    }
    _require_shape("board/chips", dataset.board.chips, (chips, 3))
    _require_shape("board/rotations", dataset.board.rotations, (chips, 3, 3))
    for name in REQUIRED_FIELDS:
        _require_shape(name, getattr(touches, name), shapes.get(name, (n,)))
    if touches.truth is not None:
        for name, value in touches.truth._asdict().items():
            shape = (n, *value.shape[1:2] * 2) if name == "view" else shapes.get(name, (n,))
            _require_shape(f"truth/{name}", value, shape)
    _require_shape("time", times_of(dataset), (n,))


def _check_values(dataset: Dataset) -> None:
    touches, n = dataset.touches, len(dataset.touches.reading)
    _require(dataset.source in SOURCES, f"source is {dataset.source!r}, not one of {', '.join(SOURCES)}")
    _require(
        0 < dataset.window < np.inf and 0 < dataset.reach < np.inf,
        "window and reach must be positive lengths in metres",
    )
    _require_rows("patch", np.isfinite(touches.patch).all((1, 2)), "is not finite")
    slack = 1e-6 * dataset.reach  # float32 rounds the reach
    _require_rows(
        "patch",
        (touches.patch >= -slack).all((1, 2)) & (touches.patch <= dataset.reach + slack).all((1, 2)),
        "is outside the range from 0 to the reach",
    )
    fields = touches.reading.reshape(n, dataset.board.num_chips, 3)
    whole = np.isfinite(fields).all(2) | np.isnan(fields).all(2)  # a chip has all its axes or none
    _require_rows("reading", whole.all(1), "is infinite, or has only some of the axes of a chip")
    _require_rows("reading", np.isfinite(touches.reading).any(1) | (n == 0), "has no values")
    for name in ("force", "travel"):
        _require_rows(name, ~np.isinf(getattr(touches, name)), "is infinite; write NaN if it is unknown")
    _require_rows("time", ~np.isinf(times_of(dataset)), "is infinite; write NaN if it is unknown")
    _require_rows("nearest", touches.nearest != -np.inf, "is minus infinity; write NaN if it is unknown")
    for name in ("T_w_t", "T_w_o"):
        _require_rows(name, _rigid_or_unknown(getattr(touches, name)), "is not a rigid transform")
    _require_rows(
        "board/rotations",
        _orthonormal(dataset.board.rotations).astype(bool),
        "is neither a rotation nor a reflection",
        "chip",
    )


def _map(change: Callable[[str, Any], np.ndarray], touches: Touches) -> Touches:
    columns: dict[str, Any] = {
        name: change(name, values)
        for name, values in touches._asdict().items()
        if name != "truth" and values is not None
    }
    if touches.truth is not None:
        columns["truth"] = Truth(*(change(name, values) for name, values in touches.truth._asdict().items()))
    return Touches(**columns)


def _require(holds: bool, problem: str) -> None:
    if not holds:
        raise DataError(f"{problem}; correct the recording or convert it again")


def _require_shape(name: str, value: np.ndarray, shape: tuple[int, ...]) -> None:
    _require(value.shape == shape, f"field {name} has shape {value.shape}, not {shape}")


def _require_rows(name: str, good: np.ndarray, problem: str, row: str = "row") -> None:
    bad = np.flatnonzero(~good)
    if bad.size:
        _require(False, f"field {name} {problem} in {bad.size} of {good.size} {row}s, first in {row} {bad[0]}")


def _orthonormal(rotations: np.ndarray) -> np.ndarray:
    product = rotations.astype(np.float64) @ rotations.astype(np.float64).swapaxes(-1, -2)
    # Rounding to float32 causes errors of 1e-6, and quaternions printed with four decimals errors of 1e-4.
    return np.abs(product - np.eye(3)).max((-1, -2)) < 1e-4


def _rigid_or_unknown(transforms: np.ndarray) -> np.ndarray:
    unknown = np.isnan(transforms).all((1, 2))
    T = np.where(unknown[:, None, None], np.eye(4, dtype=np.float32), transforms)
    T = np.where(np.isfinite(T), T, 0)  # a partly unknown transform fails below
    proper = np.linalg.det(T[:, :3, :3].astype(np.float64)) > 0
    complete = np.isfinite(transforms).all((1, 2)) | unknown
    return unknown | (complete & _orthonormal(T[:, :3, :3]) & proper & (T[:, 3] == (0, 0, 0, 1)).all(1))


def _rows(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    if _takes_no_memory(values):
        return np.broadcast_to(values[:1, :1, :1].reshape(()), (len(rows), *values.shape[1:]))
    return values[rows]


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    if all(_takes_no_memory(part) for part in parts):
        return missing_views(sum(map(len, parts)), parts[0].shape[-1])
    return np.concatenate(parts)


def _takes_no_memory(values: np.ndarray) -> bool:
    """Test whether an array was made by `missing_views`."""
    return values.ndim == 3 and values.size > 0 and not any(values.strides)


def _geometry(dataset: Dataset) -> str:
    pixels = dataset.touches.patch.shape[-1]
    return f"{pixels} pixels over {1e3 * dataset.window:g} mm with reach {1e3 * dataset.reach:g} mm"


def _merged(values: list[str]) -> str:
    different = list(dict.fromkeys(values))
    more = [f"and {len(different) - 8} more"] if len(different) > 8 else []
    return "; ".join(different[:8] + more)


def _listed(texts: Sequence[str], shown: int = 8) -> str:
    """Join texts by commas; of many, only the first."""
    return ", ".join([*texts[:shown], *([f"and {len(texts) - shown} more"] if len(texts) > shown else [])])


def _counts(indices: np.ndarray, names: tuple[str, ...]) -> dict[str, int]:
    counts = np.bincount(indices, minlength=len(names))
    return {name: int(count) for name, count in zip(names, counts, strict=True)}


def _statistics(values: np.ndarray) -> dict[str, float | None]:
    if not values.size:
        return dict.fromkeys(("mean", "std", "min", "median", "max"))
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "min": float(values.min()),
        "median": float(np.median(values)),
        "max": float(values.max()),
    }
