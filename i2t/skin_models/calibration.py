"""Calibration of a skin for one tip: fitted to presses, predicts readings, kept in one file.

    import i2t

    calibration = i2t.calibrate(positions, travels, readings, load_kind="travel")  # (n, 2) m, (n,) m, (n, c) uT
    mean, std = calibration.predict(other_positions, other_travels)  # (m, c) uT each
    calibration.save("skin.npz")
    calibration = i2t.load_calibration("skin.npz")

The load of a press is its travel (m), its normal force (N), both, or unknown, the same throughout a calibration. The
model is the Gaussian process of `i2t.skin_models.tip_gp.population`, whose hyperparameters are marginalised over a
population of skins. With `hyperparameters` given, it is a single kernel (`i2t.skin_models.tip_gp.structured`).
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
from i2t.skin_models.tip_gp.leave_one_out import Conditioned, limit_blas_threads
from i2t.skin_models.tip_gp.population import PopulationGP, PressTable
from i2t.skin_models.tip_gp.structured import StructuredGPHyperparameters, fit_structured
from i2t.types import Array, Board

FILE_KIND = "i2t calibrated skin"  # kind of file in the header of a saved calibration
GIVEN_BOARD_NAME = "the given board"  # name, among candidate boards, of the board that the user gave
LOADS = {"travel": ("m", 0.1), "force": ("N", 1e3)}  # kinds of load of a press: unit, and largest accepted load

LoadKind: TypeAlias = Literal["travel", "force", "both", "none"]
# Loads that a calibration uses, by the name of the choice.
LOAD_COLUMNS: dict[str, tuple[str, ...]] = {
    "travel": ("travel",), "force": ("force",), "both": ("travel", "force"), "none": (),
}  # fmt: skip


class CalibrationRecord(NamedTuple):
    """Arrays of a `Calibration` in its file: mixture, factors on standard deviations, mixture of an earlier session."""

    gp: PopulationGP
    interval_scaling: Array  # (c,) factor on each channel's standard deviation
    previous: PopulationGP | None = None  # mixture of an earlier session, or None


class PressEstimate(NamedTuple):
    """Position (m) of a press with its standard deviation, its load (m or N), and the misfit of its reading.

    The misfit is the root mean square difference of the reading from that of the best press, in standard deviations.
    """

    position: Float[np.ndarray, "2"]  # m, in the tool frame
    position_std: Float[np.ndarray, "2"]  # m
    load: Float[np.ndarray, " kinds"]  # m of travel, N of force, both, or nothing, as in the calibration
    misfit: float  # standard deviations; about 1 for a press of the calibration's tip, and larger for another contact


@dataclass(frozen=True, repr=False)
class Calibration:
    """Model that predicts the readings of one skin pressed by one tip; from `calibrate` or `load_calibration`.

    Attributes:
        gp: The Gaussian process, conditioned on the presses.
        interval_scaling: (c,) factors on the process's standard deviations, so that nine in ten readings lie in the
            90 % range.
        load_kind: Whether loads are travels (m), forces (N), both or unknown.
        metadata: The caller's own data, in types that JSON can hold.
        previous: Calibration of an earlier session of the same skin; part of the mixture uses its predictions as mean.
        boards: Name of the board whose chip positions the model uses, if any.

    Example:
        calibration = i2t.load_calibration("eflesh")
        mean, std = calibration.predict([[0.0, 2e-3]], 0.3e-3)  # uT, of a press 0.3 mm deep at x = 0, y = 2 mm
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

    def __str__(self) -> str:
        """Describe the presses of the fit, the input and the output."""
        load = {"travel": "a travel (m)", "force": "a force (N)"}.get(self.load_kind, f"loads ({self.load_kind})")
        earlier = "" if self.previous is None else ", on a calibration of an earlier session"
        return (
            f"Calibration of a skin with {len(self.interval_scaling) // 3} chips, {self.about_board}\n"
            f"  fitted to {len(self.gp.readings)} presses of one tip{earlier}\n"
            f"  takes positions (m) and {load}, predicts {len(self.interval_scaling)} values (uT) with their errors"
        )

    @property
    def board_shares(self) -> dict[str, float]:
        """Weights of kernels with the board's chip positions, by its name, and without ("none"); they sum to 1."""
        return dict(zip(("none", *self.boards), map(float, population.board_shares(self.gp)), strict=True))

    @property
    def about_board(self) -> str:
        """Phrase that names the board with the largest weight (or no board), and the weights."""
        shares = self.board_shares
        best = max(shares, key=lambda name: shares[name])
        board = "no board" if best == "none" else best if best == GIVEN_BOARD_NAME else f"board {best}"
        if len(shares) == 1:
            return board
        rest = ", ".join(f"{name} {share:.2f}" for name, share in shares.items() if name != best)
        return f"{board} by evidence ({shares[best]:.2f}; {rest})"

    @property
    def leave_one_out(self) -> Float[np.ndarray, "n c"]:
        """Measured minus predicted readings (uT) of each press of the fit, predicted from all other presses."""
        with limit_blas_threads(len(self.gp.readings)):
            return population.leave_one_out_errors(self.gp)

    def predict(
        self,
        positions: ArrayLike | None,
        loads: ArrayLike | float | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predict the readings of n presses and their uncertainty.

        Args:
            positions: `(n, 2)` or `(2,)` positions of the tip in the tool frame (m); None if the calibration has none.
            loads: `(n,)` or `()` travels (m) or forces (N), `(n, 2)` or `(2,)` of both, None if loads are unknown.

        Returns:
            Means and standard deviations (uT), noise included, `(n, c)` or `(c,)` each.

        Raises:
            ValueError: The shapes do not fit each other, or a value is impossible.
        """
        positions, loads, single = _as_rows(positions, loads, self.load_kind)
        _check_rows(positions, loads, self.load_kind)
        mean, std = self._predict_table(PressTable(positions, loads))
        std = std * np.asarray(self.interval_scaling)
        return (mean[0], std[0]) if single else (mean, std)

    def locate(self, reading: ArrayLike) -> "PressEstimate":
        """Estimate the position of a press from its reading, by Bayes' rule on a grid.

        Before the press, all positions and loads between the smallest and the largest of the fit are equally probable.

        Args:
            reading: `(c,)` reading (uT), ambient subtracted.

        Returns:
            Mean and standard deviation of the position, the mean of the loads, and how unlikely the reading is.

        Raises:
            ValueError: The reading has another number of values, or the calibration was fitted without positions.
        """
        positions, loads, mean, std = self._press_grid
        values = validation.numbers("reading", reading, f"{mean.shape[1]} values (uT)").astype(np.float64)
        if values.shape != mean.shape[1:]:
            raise ValueError(f"reading: has the shape {values.shape}; give the {mean.shape[1]} values of the skin")
        squares = (((values - mean) / std) ** 2).sum(1)
        log_density = -squares / 2 - np.log(std).sum(1)
        weights = np.exp(log_density - log_density.max())
        weights /= weights.sum()
        centre = weights @ positions
        spread = np.sqrt(weights @ (positions - centre) ** 2)
        return PressEstimate(centre, spread, weights @ loads, float(np.sqrt(squares.min() / len(values))))

    @cached_property
    def _press_grid(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Positions (m) and loads of the presses that `locate` compares, with their readings and deviations (uT).

        The deviations include how much the reading changes within a cell of the grid.
        """
        presses, kinds = self.gp.presses, len(LOAD_COLUMNS[self.load_kind])
        if not np.ptp(presses.position, axis=0).any():
            raise ValueError("this calibration was fitted without positions, so that it cannot locate a press")
        axes = np.linspace(presses.position.min(0), presses.position.max(0), 41).T
        grids = [np.linspace(column.min(), column.max(), 16 if kinds == 1 else 6) for column in presses.loads.T[:kinds]]
        levels = np.stack(np.meshgrid(*grids, indexing="ij"), -1).reshape(-1, kinds) if kinds else np.zeros((1, 0))
        at = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
        shape = (*at.shape[:2], *map(len, grids))
        positions, loads = np.repeat(at.reshape(-1, 2), len(levels), axis=0), np.tile(levels, (at[..., 0].size, 1))
        mean, std = self.predict(positions, None if not kinds else loads[:, 0] if kinds == 1 else loads)
        steps = np.gradient(mean.reshape(*shape, -1), axis=tuple(range(2 + kinds)))
        within = sum(step**2 for step in steps).reshape(mean.shape) / 12  # of a uniform distribution in the cell
        return positions, loads, mean, np.sqrt(std**2 + within)

    def _predict_table(self, table: PressTable) -> tuple[np.ndarray, np.ndarray]:
        """Predict means and standard deviations (uT), without `interval_scaling`."""
        if self.previous is not None:
            table = table._replace(previous_mean=self.previous._predict_table(table)[0])
        with limit_blas_threads(len(self.gp.readings)):
            return population.predict_population(self.gp, table, self._conditioned)

    def save(self, path: Path | str) -> None:
        """Write the calibration to one file, which appears whole or not at all.

        Args:
            path: Path of the file; `.npz` by convention.

        Raises:
            SerializationError: The file cannot be written.
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
    """Presses of one skin with one tip: positions (m), loads (m or N), readings (uT), board and an earlier session.

    The fields are arguments of `calibrate`; unknown ones are None.
    """

    positions: ArrayLike | None
    loads: ArrayLike | None
    readings: ArrayLike
    board: Board | None = None
    previous_session: Calibration | None = None


@dataclass(frozen=True)
class TipModel:
    """Options of a calibration, the Gaussian process that predicts the readings of presses with one tip.

    Attributes:
        load_kind: Whether loads are travels (m), forces (N), both (first column the travel), or unknown.
        hyperparameters: Hyperparameters of a single kernel, in place of a population's.
    """

    load_kind: LoadKind
    hyperparameters: StructuredGPHyperparameters | None = None

    def fit(self, key: Key[Any, ""] | None, data: TipPresses) -> Calibration:
        """Calibrate one skin from n presses, as `calibrate` does.

        Args:
            key: Ignored, because the fit draws nothing.
            data: n presses.

        Returns:
            The calibrated skin.

        Raises:
            ValueError: The shapes do not fit each other, or a value is impossible.
        """
        table, readings = _checked(data, self.load_kind)
        with limit_blas_threads(len(readings)):
            fit = self._fit_population if self.hyperparameters is None else self._fit_kernel
            return fit(data, table, readings)

    def _fit_kernel(self, data: TipPresses, table: PressTable, readings: np.ndarray) -> Calibration:
        """Condition the single kernel."""
        if self.load_kind not in LOADS or data.previous_session is not None:
            raise ValueError("with given hyperparameters, loads must be travels or forces, without an earlier session")
        assert self.hyperparameters is not None
        chips, boards = (None, ()) if data.board is None else (_chips(data.board), (GIVEN_BOARD_NAME,))
        gp = fit_structured(self.hyperparameters, table, readings, chips)
        return Calibration(gp, population.interval_scaling(gp), self.load_kind, boards=boards)

    def _fit_population(self, data: TipPresses, table: PressTable, readings: np.ndarray) -> Calibration:
        """Condition the mixture over a population of skins."""
        board, previous = data.board, data.previous_session
        boards = board_candidates(table.position, readings) if board is None else {GIVEN_BOARD_NAME: _chips(board)}
        if previous is not None:
            if previous.previous is not None:
                raise ValueError("the earlier session must itself be calibrated without an earlier session")
            if previous.gp.readings.shape[1] != readings.shape[1] or previous.load_kind != self.load_kind:
                raise ValueError(
                    "the earlier session has other channels or another kind of load; calibrate it in the same way as "
                    "this session"
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

    The chip positions of a board are used as far as leave-one-out errors support them (`Calibration.board_shares`). The
    board is the given one, or the most probable of the named boards that have as many chips and whose chips lie where
    the channels read most.

    Args:
        positions: `(n, 2)` positions of the tip in the tool frame (m); None if they are unknown.
        loads: `(n,)` travels past first contact (m) or normal forces (N), `(n, 2)` of both, or None.
        readings: `(n, c)` readings (uT), ambient subtracted.
        load_kind: Whether `loads` are travels, forces, both (first column the travel), or unknown.
        board: The sensor board with c / 3 chips. Each channel's amplitude may then fall with the distance from its
            chip, as far as the presses support it. By default named boards are tried.
        previous_session: An earlier session of the same skin in the same frame. The presses determine how much of its
            predictions is used as the mean.
        hyperparameters: Hyperparameters of a single kernel, in place of a population's.
        metadata: Data to be saved with the calibration, in types that JSON can hold.

    Returns:
        The calibrated skin.

    Raises:
        ValueError: The shapes do not fit each other, or a value is impossible.

    Example:
        calibration = i2t.calibrate(positions, forces, readings, load_kind="force", board=i2t.reskin_board())
    """
    presses = TipPresses(positions, loads, readings, board, previous_session)
    return replace(TipModel(load_kind, hyperparameters).fit(None, presses), metadata=metadata or {})


def load_calibration(path: Path | str) -> Calibration:
    """Load a calibration from its file.

    Args:
        path: Path of a file that `Calibration.save` wrote, or the name of a ready model: "eflesh" (`i2t.models`), of
            one real skin.

    Returns:
        The calibrated skin.

    Raises:
        SerializationError: The file is missing, damaged or not a calibration.

    Example:
        mean, std = i2t.load_calibration("skin.npz").predict(positions, travels)
    """
    return load_fitted(path, FILE_KIND, CalibrationRecord, _calibration, ready="calibration.npz")


def _calibration(path: Path | str, record: CalibrationRecord, about: dict[str, Any]) -> Calibration:
    """Build a calibration from its record on disk."""
    load_kind, gp, boards = about.get("load", ""), record.gp, tuple(about.get("boards") or ())
    if load_kind == "depth":  # as earlier files call it
        load_kind = "travel"
    fits = load_kind in LOAD_COLUMNS and all(
        len(part.readings) == len(part.presses.position) == len(part.extra_noise)
        and part.weights.shape == (len(part.components.log_share), part.readings.shape[1])
        and (part.far_weights is None or part.far_weights.shape == part.weights.shape)
        for part in (gp, record.previous)
        if part is not None
    )
    if not fits or len(boards) != (0 if gp.chip_positions is None else len(gp.chip_positions)):
        raise serialization.SerializationError(f"{path}: its parts do not fit each other; calibrate again")
    if about["about"].get("linear_terms"):  # written by an earlier version
        raise serialization.SerializationError(
            f"{path}: its predictions need the previous reading or the temperature; calibrate again without them"
        )
    previous = None
    if record.previous is not None:
        previous = Calibration(record.previous, np.ones(1), load_kind, boards=tuple(about.get("previous_boards") or ()))
    return Calibration(gp, record.interval_scaling, load_kind, about["about"], previous, boards=boards)


def _chips(board: Board) -> np.ndarray:
    return np.asarray(board.chips[:, :2], np.float64)


def _checked(data: TipPresses, load_kind: str) -> tuple[PressTable, np.ndarray]:
    """Check presses, and return them with their readings (n, c); raise ValueError if they are invalid."""
    positions, loads, readings, board, _ = data
    if load_kind not in LOAD_COLUMNS:
        raise ValueError(f"{load_kind!r} is not a kind of load; {did_you_mean(load_kind, LOAD_COLUMNS)}")
    if positions is None and load_kind == "none":
        raise ValueError(
            "readings alone can be segmented into presses and checked, but cannot predict another press; give "
            "positions, travels or forces"
        )
    readings = validation.numbers("readings", readings, "(n, channels) uT").astype(np.float64)
    n = len(readings) if readings.ndim == 2 else 0
    where, amount = np.zeros((n, 2)), np.zeros((n, 0))
    if positions is not None:
        where = validation.numbers("positions", positions, "(n, 2) metres").astype(np.float64)
    if loads is not None:
        amount = validation.numbers("loads", loads, "(n,) metres or newtons").astype(np.float64)
    shape = (n,) if load_kind in LOADS else (n, len(LOAD_COLUMNS[load_kind]))
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
    """Shape the inputs of a prediction as positions (n, 2) and loads (n, kinds); also return whether it is single."""
    kinds = len(LOAD_COLUMNS[load_kind])
    amount = None if loads is None else validation.numbers("loads", loads, "metres or newtons").astype(np.float64)
    if (amount is None) != (kinds == 0):
        raise ValueError(f"loads do not match this calibration, whose loads are: {load_kind}")
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
    if not (np.abs(positions) < 1.0).all():
        raise ValueError("positions must be finite and within 1 m of the skin's centre; give metres")
    for kind, amount in zip(LOAD_COLUMNS[load_kind], loads.T, strict=True):
        unit, limit = LOADS[kind]
        if not ((amount >= 0) & (amount < limit)).all():
            raise ValueError(f"a {kind} must lie between 0 and {limit:g} {unit}; correct it or leave the press out")
