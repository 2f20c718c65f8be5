"""End of a press: the indentation at which the change of the reading or the force first reaches its limit.

The stop is the root of the excess f(delta) = log max(|dB|/limit, F/limit) over the indentation delta. A contact is
nearly a straight line in the logarithms of both (Hertz: F ~ delta^1.5). The field of a press is expensive, so the
search uses two readings of a pressure: the exact one, and a linear one, the derivative of the field at rest times the
pressure. It first scans the linear excess on a geometric grid for a crossing and narrows the bracket by regula falsi
(Anderson and Bjorck, BIT 13, 1973), with roughly solved contacts. Secant steps then alternate with exact readings. The
difference between the exact and the linear reading, which grows as the square of the indentation, is carried from one
to the next. Two to four exact readings suffice.

`press_to_stop` is this search. For the thousands of predicted touches, whose readings are known at a few loads,
`stop_load` interpolates between these readings; on smooth shapes it is within 1 % of the load that the search finds.

Units are metres, newtons and microtesla.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M, STANDOFF
from i2t.runtime.batching import map_batches
from i2t.runtime.compiling import traced_floats
from i2t.skin.contact import GRID, Grid, solve
from i2t.skin.dipoles import DIPOLE_SHEETS, linear_response
from i2t.skin.dipoles import response as skin_response
from i2t.skin.lanes import by_lanes
from i2t.skin.pad import Press
from i2t.skin.pad import press as press_pad
from i2t.types import Pad, ReturnCode

# Function (pad, height, indentation, *, grid, start) -> press, such as `i2t.skin.pad.press`.
PressLaw = Callable[..., Press]
# number of dipole sheets, from the surface down, that are as fine as a fine final grid; readings stay within 0.04 uT
FINE_SHEETS = 2


@dataclass(frozen=True)
class StopSearch:
    """Steps and tolerances of the search for the indentation at which a simulated press reaches its limit."""

    start_fraction: float = 0.005  # indentation at which the scan begins, as a fraction of the largest allowed one
    bracket_excess: float = 0.05  # excess by the linear model at which regula falsi ends
    max_bracket_steps: int = 16
    bracket_tolerance: float = 1e-2  # relative tolerance of the contact solver while the stop is bracketed
    secant_tolerance: float = 1e-4  # relative tolerance of the contact solver in secant steps
    excess_tolerance: float = 5e-4  # excess of the exact reading or force over its limit at which the search ends
    # A smaller slope needs a smaller excess, so that the indentation is accurate as well.
    flat_slope: float = 0.3
    flat_excess_tolerance: float = 1e-4
    # Bounds on the slope of the excess over the logarithm of the indentation. A second tip that arrives makes it steep.
    min_slope: float = 0.1
    max_slope: float = 50.0
    max_exact_readings: int = 8


_STOP_SEARCH = StopSearch()  # steps and tolerances of the search for the indentation at which a press ends


@traced_floats
@dataclass(frozen=True)
class PressLimits:
    """Limits of reading (uT), force (N) and indentation at which a simulated press ends; the defaults are the paper's.

    It also holds the overshoot past these limits, the arm's stiffness (N/m), and how far a press goes without contact.

    Example:
        limits = i2t.PressLimits(force=5.0, stiffness=20e3)  # a stiffer arm, which presses less
        touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, 1000, limits=limits)
    """

    skin_change: float = 25.0  # uT, Euclidean norm of the change of the reading at which a press ends
    force: float = 8.0  # N, force at which a press ends
    # largest indentation as a fraction of the layer's thickness; small-strain elasticity fails beyond it
    indentation: float = 0.6
    overshoot: float = 0.1  # relative standard deviation of the overshoot past a limit by latency (one-sided)
    scan: int = 6  # steps of the geometric grid that is scanned for the first crossing
    stiffness: float = ARM_STIFFNESS_N_PER_M  # N/m, series stiffness of arm and mount
    final: Grid = GRID  # cells of the final press, which gives the reading; sharp edges need `FINE_GRID`
    approach_distance: float = STANDOFF  # m before the site at which the approach starts
    overtravel: float = 6e-3  # m beyond the site at which a press ends without contact (three steps of 2 mm)


class PressResult(NamedTuple):
    """End of a simulated press: indentation (m), force (N), noise-free reading (uT), return code and pressure (Pa)."""

    indentation: Float[Array, ""]  # m
    force: Float[Array, ""]  # N
    reading: Float[Array, " c"]  # uT, without noise
    code: Int[Array, ""]  # a `ReturnCode`
    pressure: Float[Array, "g g"]  # Pa, by the pad's own physics, whatever the press law

    @property
    def press(self) -> Press:
        """Reading, force, indentation and pressure at the end of the press, as a `Press`."""
        return Press(self.reading, self.force, self.indentation, self.pressure, jnp.asarray(True))


class PadResponse(NamedTuple):
    """Derivatives at rest (uT/Pa) of a pad's reading by the pressure on each cell, and the part that `GRID` misses."""

    linear: Float[Array, "c g g"]  # uT/Pa at rest, by the pressure on the cells of the search
    # uT/Pa, by the pressure on the cells of a finer final grid: the error of deep sheets with fewer dipoles
    deep: Float[Array, "c f f"] | None


@partial(jax.jit, static_argnames="final")
def pad_response(pad: Pad, final: Grid = GRID) -> PadResponse:
    """Compute the derivatives of a pad's reading by the pressure on it, once for all presses of the pad.

    Args:
        pad: The skin.
        final: Grid of the final press, `PressLimits.final`.

    Returns:
        Derivatives (uT/Pa) of the reading by the pressure on each cell of `GRID`; for a finer final grid also the part
        that deep sheets with the dipoles of `GRID` miss.
    """
    dipoles = _final_dipoles(final)
    if dipoles is None:
        return PadResponse(linear_response(pad), None)
    deep = partial(linear_response, pad, final, first_sheet=FINE_SHEETS)
    missing = deep() - deep(dipoles=GRID)
    return PadResponse(linear_response(pad), missing)


def _final_dipoles(final: Grid) -> tuple[Grid, ...] | None:
    """List the grid of each sheet of dipoles under a fine grid; deep sheets, which do not feel sharp edges, use `GRID`.
    Return None if the grid is not a finer one of the same period.
    """
    finer = final.cells > GRID.cells and final.modes * final.spacing == GRID.modes * GRID.spacing
    return (final,) * FINE_SHEETS + (GRID,) * (DIPOLE_SHEETS - FINE_SHEETS) if finer else None


def press_at_stop(
    pad: Pad,
    height: Float[Array, "f f"],
    indentation: Float[Array, ""],
    stop: PressResult,
    *,
    final: Grid,
    law: PressLaw = press_pad,
    response: PadResponse | None = None,
) -> PressResult:
    """Solve the end of a simulated press again on a finer contact grid, at the same indentation.

    The upper sheets of the skin have a dipole under each cell of the finer grid. The deep sheets have those of `GRID`,
    whose error is taken to be linear in the pressure.

    Args:
        pad: The skin.
        height: Depth (m) of the surface behind its nearest point over the cells of `final`.
        indentation: Distance (m) by which the nearest point is pressed into the skin.
        stop: The end of the press on `GRID`.
        final: The finer grid.
        law: Function that computes a press of the pad.
        response: The pad's `pad_response` for this grid; computed if it is not given.

    Returns:
        `stop` with the force and reading of the finer grid.
    """
    dipoles = _final_dipoles(final)
    if law is not press_pad or dipoles is None:
        pressed = law(pad, height, indentation, grid=final)
        return stop._replace(force=pressed.force, reading=pressed.reading)
    deep = (pad_response(pad, final) if response is None else response).deep
    start = jax.image.resize(stop.pressure, height.shape, "linear")
    contact = solve(pad, height, indentation, final, start=start, tolerance=_STOP_SEARCH.secant_tolerance)
    reading = _reading_in_batches(final, dipoles)(pad, contact.pressure[None])[0]
    return stop._replace(force=contact.force, reading=reading + jnp.einsum("cij,ij->c", deep, contact.pressure))


@lru_cache
def _reading_in_batches(grid: Grid, dipoles: tuple[Grid, ...]) -> Callable[..., Array]:
    """Make a function that computes readings in batches, because the fields of a whole session exceed the caches."""

    def reading(pad: Pad, pressures: Float[Array, "lanes f f"]) -> Float[Array, "lanes c"]:
        def field(pressure: Array) -> Array:
            return skin_response(pad, pressure, grid, dipoles=dipoles)

        return map_batches(field, pressures, 6)

    return by_lanes(reading)


def press_to_stop(
    pad: Pad,
    height: Float[Array, "g g"],
    limits: PressLimits,
    overshoot: Float[Array, ""] | float = 0.0,
    *,
    law: PressLaw | None = press_pad,
    response: PadResponse | None = None,
    grid: Grid = GRID,
) -> PressResult:
    """Simulate a press until the norm of the reading or the force first reaches its limit, within 0.05 %.

    A crossing within the first 0.2 % of the largest allowed indentation is not resolved; the press ends there.

    Args:
        pad: The skin.
        height: Depth (m) of the surface behind its nearest point, over the g x g cells of `grid`.
        limits: Limits of the skin change, the force and the indentation.
        overshoot: Fraction by which both limits are raised.
        law: Function that computes a press of the pad; None for a reading that is linear in the pressure.
        response: The pad's `pad_response`; computed if it is not given.
        grid: Cells of the contact, of `height` and of `response`.

    Returns:
        The end of the press. Its code is SKIN or WRENCH for the limit that came first, and UNDEFINED if neither limit
        was reached at the largest allowed indentation.
    """
    linear = linear_response(pad, grid) if response is None else response.linear
    world = _World(pad, height, limits, jnp.asarray(overshoot), law, linear, grid)
    return _approach_stop(world, _bracket(world))


def stop_load(
    readings: Float[Array, "l c"],
    loads: Float[Array, " l"],
    *,
    skin_change: float | Float[Array, ""],
    force: float | Float[Array, ""],
) -> Float[Array, ""]:
    """Estimate the load at which a press ends by interpolating its readings at a few loads; no contact is solved.

    The norm of a reading grows nearly as a power of the load, so its logarithm is interpolated over that of the load.

    Args:
        readings: `(l, c)` readings (uT, c values) at the l loads.
        loads: `(l,)` ascending loads (N).
        skin_change: Change of the reading (uT) at which the press ends.
        force: Force (N) at which the press ends in any case.

    Returns:
        The load (N), between a tenth of the smallest given load and `force`.
    """
    size = jnp.log(jnp.maximum(jnp.linalg.norm(readings, axis=1), 1e-3))
    knots, goal = jnp.log(loads), jnp.log(skin_change)
    i = jnp.clip(jnp.sum(size < goal) - 1, 0, len(loads) - 2)
    slope = jnp.maximum((size[i + 1] - size[i]) / (knots[i + 1] - knots[i]), 0.2)
    return jnp.clip(jnp.exp(knots[i] + (goal - size[i]) / slope), loads[0] / 10, force)


class _World(NamedTuple):
    """The press whose end is sought."""

    pad: Pad
    height: Array
    limits: PressLimits
    overshoot: Array
    law: PressLaw | None
    linear: Array
    grid: Grid

    @property
    def deepest(self) -> Array:
        """Logarithm of the largest allowed indentation."""
        return jnp.log(self.limits.indentation * self.pad.thickness)

    def press_linearly(self, x: Array, start: Array, tolerance: float) -> tuple[Array, Array]:
        """Compute the pressure at the log indentation x, and its linear reading and force as one vector (c + 1,)."""
        contact = solve(self.pad, self.height, jnp.exp(x), self.grid, start=start, tolerance=tolerance)
        reading = jnp.einsum("cij,ij->c", self.linear, contact.pressure)
        return contact.pressure, jnp.append(reading, contact.force)

    def read(self, x: Array, pressure: Array, felt: Array) -> Array:
        """Compute the exact reading and force (c + 1,) at the log indentation x from its linear ones and pressure."""
        if self.law is None:
            return felt
        if self.law is press_pad:
            return jnp.append(skin_response(self.pad, pressure, self.grid), felt[-1])
        pressed = self.law(self.pad, self.height, jnp.exp(x), grid=self.grid, start=pressure)
        return jnp.append(pressed.reading, pressed.force)

    def excess(self, felt: Array) -> tuple[Array, Array]:
        """Compute the excess of a reading and force (c + 1,) over the limits, and the code of the limit that counts."""
        skin = jnp.linalg.norm(felt[:-1]) / self.limits.skin_change
        wrench = felt[-1] / self.limits.force
        over = jnp.log(jnp.maximum(jnp.maximum(skin, wrench) / (1 + self.overshoot), 1e-6))
        return over, jnp.where(skin >= wrench, ReturnCode.SKIN, ReturnCode.WRENCH)


class _Bracket(NamedTuple):
    """Bracket of the crossing. Its upper end is a guess until a trial above the crossing is found."""

    low: Array  # log indentation below the crossing
    f_low: Array
    high: Array  # log indentation above the crossing, if `found`
    f_high: Array
    above: Array  # whether the last trial was above the crossing
    found: Array  # whether any trial was
    x: Array  # log indentation of the last trial
    f: Array
    pressure: Array
    trials: Array


def _bracket(world: _World) -> _Bracket:
    """Bracket the first crossing of the linear excess, with the last trial near it or at the largest indentation."""
    deepest = world.deepest
    stride = -math.log(_STOP_SEARCH.start_fraction) / (world.limits.scan - 1)

    def unfinished(now: _Bracket) -> Array:
        near = jnp.where(now.found, jnp.abs(now.f) < _STOP_SEARCH.bracket_excess, now.x >= deepest)
        return ~near & (now.trials < _STOP_SEARCH.max_bracket_steps)

    def try_next(now: _Bracket) -> _Bracket:
        secant = now.low - now.f_low * (now.high - now.low) / (now.f_high - now.f_low)
        x = jnp.where(now.found, secant, jnp.minimum(now.low + stride, deepest))
        pressure, felt = world.press_linearly(x, now.pressure * jnp.exp(x - now.x), _STOP_SEARCH.bracket_tolerance)
        f, _ = world.excess(felt)
        return _narrowed(now, x, f)._replace(pressure=pressure)

    no = jnp.asarray(False)
    low = deepest - world.limits.scan * stride
    # Below the first step of the scan, the excess is assumed to grow in proportion to the indentation.
    start = _Bracket(
        low=low, f_low=jnp.asarray(-stride), high=deepest, f_high=jnp.ones(()), above=no, found=no,
        x=low, f=jnp.asarray(-stride), pressure=jnp.zeros_like(world.height), trials=jnp.asarray(0),
    )  # fmt: skip
    return jax.lax.while_loop(unfinished, try_next, start)


def _narrowed(now: _Bracket, x: Array, f: Array) -> _Bracket:
    """Narrow the bracket after a trial at x with excess f.

    As Anderson and Bjorck do, the value at an end that is kept twice in a row is shrunk, so that it is replaced soon.
    """
    above = f >= 0
    shrunk = 1 - f / jnp.where(above, now.f_high, now.f_low)
    factor = jnp.where(now.found & (above == now.above), jnp.where(shrunk > 0, shrunk, 0.5), 1.0)
    return now._replace(
        low=jnp.where(above, now.low, x),
        f_low=jnp.where(above, factor * now.f_low, f),
        high=jnp.where(above, x, now.high),
        f_high=jnp.where(above, f, factor * now.f_high),
        above=above,
        found=now.found | above,
        x=x,
        f=f,
        trials=now.trials + 1,
    )


class _Trial(NamedTuple):
    """One trial of the secant search."""

    x: Array  # log indentation
    f: Array  # excess over the limit at this indentation
    slope: Array  # derivative of the excess by the log indentation
    pressure: Array


class _Approach(NamedTuple):
    """State of the secant search, with exact readings."""

    trial: _Trial
    measured_at: Array  # log indentation at which the exact reading was last computed
    remainder: Array  # (c + 1,) exact minus linear reading and force at that indentation
    low: Array  # largest log indentation whose exact reading is below the limits
    high: Array  # smallest log indentation whose exact reading is above the limits, or the largest allowed
    nearest: Array  # smallest absolute exact excess
    stop: PressResult
    done: Array
    readings: Array


def _approach_stop(world: _World, bracket: _Bracket) -> PressResult:
    """Search the stop from a trial near it."""
    deepest = world.deepest

    def step(now: _Approach, last: tuple[_Trial, Array]) -> tuple[_Trial, Array]:
        """Take one secant step, and compute the linear reading and force there."""
        trial, _ = last
        x = jnp.clip(trial.x - jnp.clip(trial.f / trial.slope, -1.0, 1.0), now.low, now.high)
        pressure, felt = world.press_linearly(x, trial.pressure * jnp.exp(x - trial.x), _STOP_SEARCH.secant_tolerance)
        f, _ = world.excess(felt + now.remainder * jnp.exp(2 * (x - now.measured_at)))
        run = x - trial.x
        slope = (f - trial.f) / jnp.where(run == 0, 1, run)
        slope = jnp.where(jnp.abs(run) > 1e-4, _clipped(slope), trial.slope)
        return _Trial(x, f, slope, pressure), felt

    def read(now: _Approach) -> _Approach:
        """Take two secant steps, or one before the first exact reading, and compute the exact reading at their end."""
        steps = jnp.where(now.readings == 0, 1, 2)
        first = now.trial, jnp.zeros_like(now.remainder)
        trial, felt = jax.lax.fori_loop(0, steps, lambda _, last: step(now, last), first)
        true = world.read(trial.x, trial.pressure, felt)
        f, code = world.excess(true)
        tolerance = jnp.where(
            trial.slope < _STOP_SEARCH.flat_slope, _STOP_SEARCH.flat_excess_tolerance, _STOP_SEARCH.excess_tolerance
        )
        beyond = (trial.x >= deepest) & (f < 0)
        code = jnp.where(beyond, ReturnCode.UNDEFINED, code)
        stop = PressResult(jnp.exp(trial.x), true[-1], true[:-1], code, trial.pressure)
        nearer = beyond | (jnp.abs(f) <= now.nearest)
        return _Approach(
            trial=trial._replace(f=f),
            measured_at=trial.x,
            remainder=true - felt,
            low=jnp.where(f < 0, jnp.maximum(now.low, trial.x), now.low),
            high=jnp.where(f < 0, now.high, jnp.minimum(now.high, trial.x)),
            nearest=jnp.minimum(now.nearest, jnp.abs(f)),
            stop=jax.tree.map(lambda new, old: jnp.where(nearer, new, old), stop, now.stop),
            done=beyond | (jnp.abs(f) < tolerance),
            readings=now.readings + 1,
        )

    slope = _clipped((bracket.f_high - bracket.f_low) / (bracket.high - bracket.low))
    slope = jnp.where(jnp.isfinite(slope), slope, 1.0)
    channels = world.pad.board.num_readings
    nothing = PressResult(
        jnp.zeros(()), jnp.zeros(()), jnp.zeros(channels), jnp.asarray(ReturnCode.UNDEFINED), bracket.pressure
    )
    start = _Approach(
        _Trial(bracket.x, bracket.f, slope, bracket.pressure), bracket.x, jnp.zeros(channels + 1),
        low=jnp.asarray(-jnp.inf), high=deepest, nearest=jnp.asarray(jnp.inf), stop=nothing, done=jnp.asarray(False),
        readings=jnp.asarray(0),
    )  # fmt: skip
    return jax.lax.while_loop(
        lambda now: ~now.done & (now.readings < _STOP_SEARCH.max_exact_readings), read, start
    ).stop


def _clipped(slope: Array) -> Array:
    return jnp.clip(slope, _STOP_SEARCH.min_slope, _STOP_SEARCH.max_slope)
