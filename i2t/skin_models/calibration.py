"""A calibrated skin: presses in, readings out, on disk in one file.

    import i2t

    calibration = i2t.calibrate(positions, depths, readings, load_kind="depth")  # (n, 2) m, (n,) m, (n, c) uT
    mean, std = calibration.predict(other_positions, other_depths)  # (m, c) uT each
    calibration.save("skin.npz")
    calibration = i2t.load_calibration("skin.npz")

A press's load is its depth (m), its normal force (N), both, or not known at all, the same throughout a calibration. The
model is the Gaussian process of `i2t.skin_models.tip_gp.population`, whose hyperparameters are marginalised over a
population of skins; with `hyperparameters` given it is the one kernel of `i2t.skin_models.tip_gp.structured`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Key
from numpy.typing import ArrayLike

from i2t import validation
from i2t.errors import did_you_mean
from i2t.files import serialization
from i2t.skin.boards import AXES_OF_CHIP
from i2t.skin_models.base import load_fitted
from i2t.skin_models.tip_gp import population
from i2t.skin_models.tip_gp.candidates import board_candidates
from i2t.skin_models.tip_gp.left_out import Conditioned, one_thread_for_few
from i2t.skin_models.tip_gp.population import PopulationGP, PressTable
from i2t.skin_models.tip_gp.structured import StructuredGPHyperparameters, fit_structured
from i2t.types import Array, Board

FILE_KIND = "i2t calibrated skin"
MAX_POSITION_M = 1.0
MAX_LOAD = {"depth": 0.1, "force": 1e3}  # m, N
LOAD_UNITS = {"depth": "m", "force": "N"}
NO_BOARD_NAME, GIVEN_BOARD = "none", "the given board"
LINEAR_TERMS = "linear_terms"  # in the metadata of files of an earlier version, which are refused

LoadKind: TypeAlias = Literal["depth", "force", "both", "none"]
LOAD_COLUMNS: dict[str, tuple[str, ...]] = {
    "depth": ("depth",), "force": ("force",), "both": ("depth", "force"), "none": (),
}  # fmt: skip


class CalibrationRecord(NamedTuple):
    """A calibration on disk."""

    gp: PopulationGP  # fitted to the presses
    interval_scaling: Array  # (c,)
    previous: PopulationGP | None = None  # of an earlier session


@dataclass(frozen=True, repr=False)
class Calibration:
    """Predicts the readings of presses of one tip on one skin; make one with `calibrate` or `load_calibration`.

    Attributes:
        gp: The Gaussian process, conditioned on the presses.
        interval_scaling: (c,) factors on its standard deviations, so that nine in ten readings lie in the 90 % range.
        load_kind: Whether loads are depths (m), forces (N), both or unknown.
        metadata: Whatever the caller wants to remember, as JSON can hold it.
        previous: An earlier session of the same skin, whose predictions are the mean of some of the mixture.
        boards: Name of the board that takes part, or nothing.
    """

    gp: PopulationGP
    interval_scaling: Array
    load_kind: LoadKind
    metadata: dict[str, Any] = field(default_factory=dict)
    previous: "Calibration | None" = None
    boards: tuple[str, ...] = ()

    def __repr__(self) -> str:
        chips, earlier = len(self.interval_scaling) // 3, "" if self.previous is None else ", on an earlier session"
        return (
            f"Calibration({type(self.gp).__name__}, {chips} chips, loads are {self.load_kind}{earlier}, "
            f"{self.about_board})"
        )

    @property
    def board_shares(self) -> dict[str, float]:
        """Weight of the board that takes part, and of none, by presses left out; they sum to 1."""
        return dict(zip((NO_BOARD_NAME, *self.boards), map(float, population.board_shares(self.gp)), strict=True))

    @property
    def about_board(self) -> str:
        """The board that weighs most, or none, in words."""
        shares = self.board_shares
        best = max(shares, key=lambda name: shares[name])
        said = "no board" if best == NO_BOARD_NAME else best if best == GIVEN_BOARD else f"board {best}"
        if len(shares) == 1:
            return said
        rest = ", ".join(f"{name} {share:.2f}" for name, share in shares.items() if name != best)
        return f"{said} by evidence ({shares[best]:.2f}; {rest})"

    @property
    def left_out(self) -> Float[np.ndarray, "n c"]:
        """Errors (uT) on the presses of the fit, each predicted from all others."""
        with one_thread_for_few(len(self.gp.readings)):
            return population.left_out_errors(self.gp)

    def predict(
        self,
        positions: ArrayLike | None,
        loads: ArrayLike | float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict readings, with uncertainty.

        Args:
            positions: (n, 2) or (2,) positions of the tip in the tool frame (m); None where the calibration has none.
            loads: (n,) or () depths (m) or forces (N), (n, 2) or (2,) of both, None of neither.

        Returns:
            Mean and standard deviation (uT), noise included, (n, c) or (c,) each.

        Raises:
            ValueError: Shapes do not belong together, or a value cannot be.
        """
        positions, loads, single = _as_rows(positions, loads, self.load_kind)
        _check_rows(positions, loads, self.load_kind)
        mean, std = self._predict_table(PressTable(positions, loads))
        std = std * np.asarray(self.interval_scaling)
        return (mean[0], std[0]) if single else (mean, std)

    def _predict_table(self, table: PressTable) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation (uT) of the mixture; the mean of an earlier session is that of this one."""
        if self.previous is not None:
            table = table._replace(previous_mean=self.previous._predict_table(table)[0])
        with one_thread_for_few(len(self.gp.readings)):
            return population.predict_population(self.gp, table, self._conditioned)

    def save(self, path: Path | str) -> None:
        """Write one file, which appears whole or not at all.

        Args:
            path: File to write; `.npz` by custom.

        Raises:
            SerializationError: It cannot be written.
        """
        about = {"load": self.load_kind, "about": self.metadata, "boards": list(self.boards)}
        if self.previous is not None:
            about["previous_boards"] = list(self.previous.boards)
        previous = None if self.previous is None else self.previous.gp
        serialization.save(path, FILE_KIND, CalibrationRecord(self.gp, self.interval_scaling, previous), about)

    @cached_property
    def _conditioned(self) -> list[Conditioned]:
        return population.condition(self.gp)


class TipPresses(NamedTuple):
    """Presses of one skin with one tip; what each holds is in the arguments of `calibrate`."""

    positions: ArrayLike | None
    loads: ArrayLike | None
    readings: ArrayLike
    board: Board | None = None
    previous_session: Calibration | None = None


@dataclass(frozen=True)
class TipModel:
    """The Gaussian process of one tip.

    Attributes:
        load_kind: Whether loads are depths (m), forces (N), both (first column the depth), or not known.
        hyperparameters: Of one kernel, in place of a population's.
    """

    load_kind: LoadKind
    hyperparameters: StructuredGPHyperparameters | None = None

    def fit(self, key: Key[Any, ""] | None, data: TipPresses) -> Calibration:
        """Calibrate one skin from n presses, as `calibrate` does.

        Args:
            key: Not used, as the fit draws nothing.
            data: The presses.

        Returns:
            The calibrated skin.

        Raises:
            ValueError: Shapes do not belong together, or a value cannot be.
        """
        table, readings = _checked(data, self.load_kind)
        with one_thread_for_few(len(readings)):
            fit = self._of_population if self.hyperparameters is None else self._of_one
            return fit(data, table, readings)

    def _of_one(self, data: TipPresses, table: PressTable, readings: np.ndarray) -> Calibration:
        """The mixture of one kernel."""
        if self.load_kind not in MAX_LOAD or data.previous_session is not None:
            raise ValueError("with hyperparameters given, loads are depths or forces, and no earlier session is known")
        assert self.hyperparameters is not None
        chips, boards = (None, ()) if data.board is None else (_chips(data.board), (GIVEN_BOARD,))
        gp = fit_structured(self.hyperparameters, table, readings, chips)
        return Calibration(gp, population.interval_scaling(gp), self.load_kind, boards=boards)

    def _of_population(self, data: TipPresses, table: PressTable, readings: np.ndarray) -> Calibration:
        """The mixture over a population of skins."""
        known, previous = data.board, data.previous_session
        boards = board_candidates(table.position, readings) if known is None else {GIVEN_BOARD: _chips(known)}
        if previous is not None:
            if previous.previous is not None:
                raise ValueError("an earlier session must itself be calibrated without one")
            if previous.gp.readings.shape[1] != readings.shape[1] or previous.load_kind != self.load_kind:
                raise ValueError(
                    "the earlier session has other channels or another kind of load; calibrate it as this one"
                )
            table = table._replace(previous_mean=previous._predict_table(table)[0])
        chips = np.stack(list(boards.values())) if boards else None
        gp = population.fit_population(table, readings, load_kinds=LOAD_COLUMNS[self.load_kind], chip_positions=chips)
        kept = () if gp.chip_positions is None else gp.chip_positions
        named = tuple(name for at in kept for name, chips in boards.items() if np.array_equal(at, chips))
        return Calibration(gp, population.interval_scaling(gp), self.load_kind, previous=previous, boards=named)


def calibrate(
    positions: ArrayLike | None,
    loads: ArrayLike | None,
    readings: ArrayLike,
    *,
    load_kind: LoadKind,
    board: Board | None = None,
    previous_session: Calibration | None = None,
    hyperparameters: StructuredGPHyperparameters | None = None,
    metadata: dict[str, Any] | None = None,
) -> Calibration:
    """Calibrate one skin from n presses with one tip.

    What the skin's board tells is weighed by presses left out (`Calibration.board_shares`): the board that is given, or
    else the likeliest of the named boards of as many chips that fit best to where each chip reads most.

    Args:
        positions: (n, 2) positions of the tip in the tool frame (m); None where they are not known.
        loads: (n,) depths past first contact (m) or normal forces (N), (n, 2) of both, or None.
        readings: (n, c) readings (uT), ambient subtracted.
        load_kind: Whether `loads` are depths, forces, both (first column the depth), or not known.
        board: The sensor board, c / 3 chips: each channel's amplitude may then fall with the distance from its chip, as
            far as the presses bear it out. By default boards of a name are tried.
        previous_session: An earlier session of the same skin, aligned with this one: the presses decide how much of its
            predictions is kept as the mean.
        hyperparameters: Of one kernel, in place of a population's.
        metadata: Whatever shall be saved with it, as JSON can hold it.

    Returns:
        The calibrated skin.

    Raises:
        ValueError: Shapes do not belong together, or a value cannot be.

    Example:
        calibration = i2t.calibrate(positions, forces, readings, load_kind="force", board=i2t.reskin_board())
    """
    presses = TipPresses(positions, loads, readings, board, previous_session)
    return replace(TipModel(load_kind, hyperparameters).fit(None, presses), metadata=metadata or {})


def load_calibration(path: Path | str) -> Calibration:
    """Load a calibration from its file.

    Args:
        path: A file that `Calibration.save` wrote; or the name of a ready model, "eflesh"
            (`i2t.models`), of one real skin.

    Returns:
        The calibrated skin.

    Raises:
        SerializationError: The file is missing, damaged or something else.

    Example:
        mean, std = i2t.load_calibration("skin.npz").predict(positions, depths)
    """
    return load_fitted(path, FILE_KIND, CalibrationRecord, _calibration, ready="calibration.npz")


def _calibration(path: Path | str, record: CalibrationRecord, about: dict[str, Any]) -> Calibration:
    """A calibration from its record on disk, if its parts fit."""
    load_kind, gp, boards = about.get("load", ""), record.gp, tuple(about.get("boards") or ())
    fits = load_kind in LOAD_COLUMNS and all(
        len(part.readings) == len(part.presses.position) == len(part.extra_noise)
        and part.weights.shape == (len(part.components.log_share), part.readings.shape[1])
        and (part.far_weights is None or part.far_weights.shape == part.weights.shape)
        for part in (gp, record.previous)
        if part is not None
    )
    if not fits or len(boards) != (0 if gp.chip_positions is None else len(gp.chip_positions)):
        raise serialization.SerializationError(f"{path}: its parts do not fit each other; calibrate again")
    if about["about"].get(LINEAR_TERMS):
        raise serialization.SerializationError(
            f"{path}: its predictions need the reading before or the temperature; calibrate again, with neither"
        )
    previous = None
    if record.previous is not None:
        previous = Calibration(record.previous, np.ones(1), load_kind, boards=tuple(about.get("previous_boards") or ()))
    return Calibration(gp, record.interval_scaling, load_kind, about["about"], previous, boards=boards)


def _chips(board: Board) -> np.ndarray:
    return np.asarray(board.chips[:, :2], np.float64)


def _checked(data: TipPresses, load_kind: str) -> tuple[PressTable, np.ndarray]:
    """Valid presses and their readings (n, c), or ValueError."""
    positions, loads, readings, board, _ = data
    if load_kind not in LOAD_COLUMNS:
        raise ValueError(f"{load_kind!r} is no load; {did_you_mean(load_kind, LOAD_COLUMNS)}")
    if positions is None and load_kind == "none":
        raise ValueError(
            "readings alone can be segmented into presses and checked, but say nothing about another press; give "
            "positions, depths or forces"
        )
    readings = validation.numbers("readings", readings, "(n, channels) uT").astype(np.float64)
    n = len(readings) if readings.ndim == 2 else 0
    where, amount = np.zeros((n, 2)), np.zeros((n, 0))
    if positions is not None:
        where = validation.numbers("positions", positions, "(n, 2) metres").astype(np.float64)
    if loads is not None:
        amount = validation.numbers("loads", loads, "(n,) metres or newtons").astype(np.float64)
    shape = (n,) if load_kind in MAX_LOAD else (n, len(LOAD_COLUMNS[load_kind]))
    if n == 0 or where.shape != (n, 2) or amount.shape != shape:
        raise ValueError(
            f"positions {where.shape}, loads {amount.shape} and readings {readings.shape} do not belong together; "
            f"give (n, 2), {str(shape).replace(str(n), 'n') if n else '(n,)'} and (n, channels)"
        )
    if not np.isfinite(readings).all():
        raise ValueError(
            f"{np.sum(~np.isfinite(readings).all(1))} presses have readings that are not finite; drop them"
        )
    if board is not None and readings.shape[1] != AXES_OF_CHIP * len(board.chips):
        raise ValueError(
            f"readings of {readings.shape[1]} values are not those of a board with {len(board.chips)} chips; "
            "give the board that was pressed"
        )
    amount = amount.reshape(n, -1) if amount.size else np.zeros((n, 0))
    _check_rows(where, amount, load_kind)
    return PressTable(where, amount), readings


def _as_rows(
    positions: ArrayLike | None, loads: ArrayLike | float | None, load_kind: str
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Positions (n, 2) and loads (n, kinds) to be predicted, and whether a single press was asked for."""
    kinds = len(LOAD_COLUMNS[load_kind])
    amount = None if loads is None else validation.numbers("loads", loads, "metres or newtons").astype(np.float64)
    if (amount is None) != (kinds == 0):
        raise ValueError(f"loads are missing or not known to this calibration, whose loads are: {load_kind}")
    if positions is None:
        assert amount is not None
        rows = amount.shape[: amount.ndim - (kinds > 1)]
        where = np.zeros((*rows, 2))
    else:
        where = validation.numbers("positions", positions, "(n, 2) metres").astype(np.float64)
    rows = where.shape[:-1]
    expected = None if amount is None else (*rows, kinds) if kinds > 1 else rows
    if where.shape[-1:] != (2,) or len(rows) > 1 or (amount is not None and amount.shape != expected):
        shape = None if amount is None else amount.shape
        raise ValueError(f"positions {where.shape} do not go with loads {shape}; give (n, 2) and (n,)")
    n = rows[0] if rows else 1
    return where.reshape(n, 2), np.zeros((n, 0)) if amount is None else amount.reshape(n, kinds), not rows


def _check_rows(positions: np.ndarray, loads: np.ndarray, load_kind: str) -> None:
    """Refuse impossible positions and loads (ValueError)."""
    if not (np.abs(positions) < MAX_POSITION_M).all():
        raise ValueError(f"positions must be finite and within {MAX_POSITION_M:g} m of the skin's centre; give metres")
    for kind, amount in zip(LOAD_COLUMNS[load_kind], loads.T, strict=True):
        largest = MAX_LOAD[kind]
        if not ((amount >= 0) & (amount < largest)).all():
            raise ValueError(
                f"a {kind} must lie between 0 and {largest:g} {LOAD_UNITS[kind]}; correct it or leave the press out"
            )
