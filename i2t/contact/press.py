"""End of a press: the indentation at which the skin change or the force first crosses its limit.

The stop is the root of the excess f(delta) = log max(|dB|/limit, F/limit) over the indentation delta. In the logarithms
of both a contact is nearly a straight line (Hertz: F ~ delta^1.5). What costs time is the field of a press, so the
search knows two readings of a pressure: its own and a linear one, the derivative of the field at rest times the
pressure. First the linear excess is scanned on a geometric grid for its first crossing, which regula falsi closes in on
(Anderson and Bjorck, BIT 13, 1973), with contacts solved roughly. Then secant steps alternate with readings by the
press's own law, whose difference from the linear reading is carried along: it grows as the square of the indentation,
being what the linear reading leaves out. Two to four readings by the law are enough.

`press_to_stop` is that search. Where the readings of a press are known at a few loads, as of imagined touches, of which
there are thousands, `stop_load` interpolates between them: within 1 % of the load of the search on smooth shapes.

Metres, newtons, microtesla.
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
from i2t.skin.dipoles import CELL_NODES, linear_response
from i2t.skin.dipoles import response as skin_response
from i2t.skin.lanes import by_lanes
from i2t.skin.pad import Press
from i2t.skin.pad import press as press_pad
from i2t.types import Pad, ReturnCode

PressLaw = Callable[..., Press]  # (pad, height, indentation, *, grid, start) to a press, as `i2t.skin.pad.press`
SCAN_START_FRACTION = 0.005  # of the deepest indentation, where the search begins
BRACKET_EXCESS = 0.05  # of the linear excess, within which regula falsi ends
ROUGH_TOLERANCE = 1e-2  # of contacts in the bracket
CLOSE_TOLERANCE = 1e-4  # of contacts in secant steps
EXCESS_TOLERANCE = 5e-4  # of the press's own excess, at which the search ends
FLAT_EXCESS_TOLERANCE = 1e-4  # where the excess hardly grows, so that the indentation is met as well
FLAT_SLOPE = 0.3
SLOPES = (0.1, 50.0)  # of the excess by the logarithm of the indentation: a second tip that arrives makes it steep
MAX_BRACKETING_TRIALS = 16
FINE_SHEETS = 2  # of dipoles that are as fine as the cells of a final grid finer than GRID: readings within 0.04 uT
FIELDS_AT_A_TIME = 6  # on such a grid
MAX_READINGS = 8  # by the law; a search that is still further off ends there


@traced_floats
@dataclass(frozen=True)
class PressLimits:
    """Limits of a press (the paper's values).

    Example:
        limits = i2t.PressLimits(force=5.0, stiffness=20e3)  # a stiffer arm, which presses less
        touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, 1000, limits=limits)
    """

    skin_change: float = 25.0  # uT, norm of the reading
    force: float = 8.0  # N
    indentation: float = 0.6  # of the layer's thickness: beyond it small-strain elasticity means nothing
    overshoot: float = 0.1  # relative standard deviation by which a press runs past its limit (latency; one-sided)
    scan: int = 6  # strides, each as much deeper as the one before, in which the first crossing is sought
    stiffness: float = ARM_STIFFNESS_N_PER_M  # N/m, arm and mount in series
    final: Grid = GRID  # of the last press, whose reading counts; sharp edges want `i2t.skin.contact.FINE_GRID`
    approach_distance: float = STANDOFF  # m before the site where the approach starts
    overtravel: float = 6e-3  # m beyond the site before a press counts as air (three extra steps of 2 mm)


class PressResult(NamedTuple):
    """The end of a press."""

    indentation: Float[Array, ""]  # m
    force: Float[Array, ""]  # N
    reading: Float[Array, " c"]  # uT, noise free
    code: Int[Array, ""]
    pressure: Float[Array, "g g"]  # Pa, of the pad's own physics, whatever the law

    @property
    def press(self) -> Press:
        """The last press."""
        return Press(self.reading, self.force, self.indentation, self.pressure, jnp.asarray(True))


class PadResponse(NamedTuple):
    """Derivatives of a pad's reading, by which its presses are simulated quickly."""

    linear: Float[Array, "c g g"]  # uT/Pa at rest, by the pressure on the cells of the search
    # uT/Pa, by the pressure on the cells of a finer final grid: what deep sheets of fewer dipoles leave out
    deep: Float[Array, "c f f"] | None


@partial(jax.jit, static_argnames="final")
def pad_response(pad: Pad, final: Grid = GRID) -> PadResponse:
    """Work out the derivatives of a pad's reading, once for all of its presses.

    Args:
        pad: the skin.
        final: grid of the last press, `PressLimits.final`.

    Returns:
        The derivatives.
    """
    dipoles = _final_dipoles(final)
    if dipoles is None:
        return PadResponse(linear_response(pad), None)
    deep = partial(linear_response, pad, final, first_sheet=FINE_SHEETS)
    missing = deep() - deep(dipoles=GRID)
    return PadResponse(linear_response(pad), missing)


def _final_dipoles(final: Grid) -> tuple[Grid, ...] | None:
    """Grids of the dipoles under a finer grid, deep sheets of which feel no sharp edges; None where there is no finer
    grid of the same period.
    """
    finer = final.cells > GRID.cells and final.modes * final.spacing == GRID.modes * GRID.spacing
    return (final,) * FINE_SHEETS + (GRID,) * (CELL_NODES - FINE_SHEETS) if finer else None


def press_finally(
    pad: Pad,
    height: Float[Array, "f f"],
    indentation: Float[Array, ""],
    stop: PressResult,
    *,
    final: Grid,
    law: PressLaw = press_pad,
    response: PadResponse | None = None,
) -> PressResult:
    """The end of a press once more, on a finer grid.

    The upper sheets of the skin have a dipole under each cell of that grid. Those of `GRID` are enough for the deep
    ones, and their error is taken to be linear in the pressure.

    Args:
        pad: the skin.
        height: m, the surface behind its nearest point over the cells of `final`.
        indentation: m past first touch, of that nearest point.
        stop: the end of the press on `GRID`.
        final: the finer grid.
        law: what a press of the pad gives.
        response: the pad's `pad_response` for this grid.

    Returns:
        `stop` with other force and reading.
    """
    dipoles = _final_dipoles(final)
    if law is not press_pad or dipoles is None:
        pressed = law(pad, height, indentation, grid=final)
        return stop._replace(force=pressed.force, reading=pressed.reading)
    deep = (pad_response(pad, final) if response is None else response).deep
    start = jax.image.resize(stop.pressure, height.shape, "linear")
    contact = solve(pad, height, indentation, final, start=start, tolerance=CLOSE_TOLERANCE)
    reading = _reading_in_turn(final, dipoles)(pad, contact.pressure[None])[0]
    return stop._replace(force=contact.force, reading=reading + jnp.einsum("cij,ij->c", deep, contact.pressure))


@lru_cache
def _reading_in_turn(grid: Grid, dipoles: tuple[Grid, ...]) -> Callable[..., Array]:
    """The reading of pressures, a few at a time: fields of all presses of a session outgrow the caches."""

    def reading(pad: Pad, pressures: Float[Array, "lanes f f"]) -> Float[Array, "lanes c"]:
        def field(pressure: Array) -> Array:
            return skin_response(pad, pressure, grid, dipoles=dipoles)

        return map_batches(field, pressures, FIELDS_AT_A_TIME)

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
    """Press until the skin change or the force first crosses its limit, which is met within 0.05 %.

    A crossing within the first 0.2 % of the deepest indentation is not resolved; the press ends there.

    Args:
        pad: the skin.
        height: m, the surface behind its nearest point over the pad's cells.
        limits: of skin change, force and indentation.
        overshoot: fraction by which both limits are raised.
        law: what a press of the pad gives; with None, its reading is the linear one.
        response: the pad's `pad_response`, which is worked out anew where it is not given.
        grid: cells of the contact, of `height` and of `response`.

    Returns:
        The end of the press. Its code SKIN or WRENCH says which limit came first; UNDEFINED means that the deepest
        allowed indentation crossed neither.
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
    """The load at which a press would end, from its readings at a few loads: no contact is solved.

    A reading grows about as a power of its load, so that the logarithm of its size is interpolated in that of the load.

    Args:
        readings: uT, at `loads`.
        loads: Ascending (N).
        skin_change: Change of the reading (uT) at which the press ends.
        force: Force (N) at which it ends at the latest.

    Returns:
        The load (N), from a tenth of the least load to `force`.
    """
    size = jnp.log(jnp.maximum(jnp.linalg.norm(readings, axis=1), 1e-3))
    knots, goal = jnp.log(loads), jnp.log(skin_change)
    i = jnp.clip(jnp.sum(size < goal) - 1, 0, len(loads) - 2)
    slope = jnp.maximum((size[i + 1] - size[i]) / (knots[i + 1] - knots[i]), 0.2)
    return jnp.clip(jnp.exp(knots[i] + (goal - size[i]) / slope), loads[0] / 10, force)


class _World(NamedTuple):
    """What a search is about."""

    pad: Pad
    height: Array
    limits: PressLimits
    overshoot: Array
    law: PressLaw | None
    linear: Array
    grid: Grid

    @property
    def deepest(self) -> Array:
        """Logarithm of the deepest indentation."""
        return jnp.log(self.limits.indentation * self.pad.thickness)

    def press_linearly(self, x: Array, start: Array, tolerance: float) -> tuple[Array, Array]:
        """Pressure at the log indentation x, and its force and linear reading: (c + 1,)."""
        contact = solve(self.pad, self.height, jnp.exp(x), self.grid, start=start, tolerance=tolerance)
        reading = jnp.einsum("cij,ij->c", self.linear, contact.pressure)
        return contact.pressure, jnp.append(reading, contact.force)

    def read(self, x: Array, pressure: Array, felt: Array) -> Array:
        """Reading and force by the law (c + 1,), at the log indentation x whose linear ones and pressure are known."""
        if self.law is None:
            return felt
        if self.law is press_pad:
            return jnp.append(skin_response(self.pad, pressure, self.grid), felt[-1])
        pressed = self.law(self.pad, self.height, jnp.exp(x), grid=self.grid, start=pressure)
        return jnp.append(pressed.reading, pressed.force)

    def excess(self, felt: Array) -> tuple[Array, Array]:
        """Excess of a reading and force (c + 1,) over the limits, and the code of the limit that it is about."""
        skin = jnp.linalg.norm(felt[:-1]) / self.limits.skin_change
        wrench = felt[-1] / self.limits.force
        over = jnp.log(jnp.maximum(jnp.maximum(skin, wrench) / (1 + self.overshoot), 1e-6))
        return over, jnp.where(skin >= wrench, ReturnCode.SKIN, ReturnCode.WRENCH)


class _Bracket(NamedTuple):
    """Bracket of the crossing: two trials around it, of which the upper one is a guess until it is found."""

    low: Array  # log indentation below the crossing
    f_low: Array
    high: Array  # and above it, once found
    f_high: Array
    above: Array  # whether the last trial was
    found: Array
    x: Array  # the last trial
    f: Array
    pressure: Array
    trials: Array


def _bracket(world: _World) -> _Bracket:
    """A trial near the first crossing of the linear excess, or at the deepest indentation, and its bracket."""
    deepest = world.deepest
    stride = -math.log(SCAN_START_FRACTION) / (world.limits.scan - 1)

    def unfinished(now: _Bracket) -> Array:
        near = jnp.where(now.found, jnp.abs(now.f) < BRACKET_EXCESS, now.x >= deepest)
        return ~near & (now.trials < MAX_BRACKETING_TRIALS)

    def try_next(now: _Bracket) -> _Bracket:
        secant = now.low - now.f_low * (now.high - now.low) / (now.f_high - now.f_low)
        x = jnp.where(now.found, secant, jnp.minimum(now.low + stride, deepest))
        pressure, felt = world.press_linearly(x, now.pressure * jnp.exp(x - now.x), ROUGH_TOLERANCE)
        f, _ = world.excess(felt)
        return _narrowed(now, x, f)._replace(pressure=pressure)

    no = jnp.asarray(False)
    low = deepest - world.limits.scan * stride
    # A crossing in the first stride is sought as if the excess grew in proportion to the indentation below it.
    start = _Bracket(
        low=low, f_low=jnp.asarray(-stride), high=deepest, f_high=jnp.ones(()), above=no, found=no,
        x=low, f=jnp.asarray(-stride), pressure=jnp.zeros_like(world.height), trials=jnp.asarray(0),
    )  # fmt: skip
    return jax.lax.while_loop(unfinished, try_next, start)


def _narrowed(now: _Bracket, x: Array, f: Array) -> _Bracket:
    """The bracket after a trial at x whose excess is f.

    Anderson and Bjorck: the value at an end that stays twice in a row is shrunk, so that it cannot stay for ever.
    """
    above = f >= 0
    shrunk = 1 - f / jnp.where(above, now.f_high, now.f_low)
    kept = jnp.where(now.found & (above == now.above), jnp.where(shrunk > 0, shrunk, 0.5), 1.0)
    return now._replace(
        low=jnp.where(above, now.low, x),
        f_low=jnp.where(above, kept * now.f_low, f),
        high=jnp.where(above, x, now.high),
        f_high=jnp.where(above, f, kept * now.f_high),
        above=above,
        found=now.found | above,
        x=x,
        f=f,
        trials=now.trials + 1,
    )


class _Trial(NamedTuple):
    """A trial of the search by secants."""

    x: Array  # log indentation
    f: Array  # excess
    slope: Array  # of the excess there
    pressure: Array


class _Approach(NamedTuple):
    """A search by secants, with readings by the law."""

    trial: _Trial
    measured_at: Array  # log indentation of the last reading by the law
    remainder: Array  # (c + 1,) of that reading and its force, less the linear ones
    low: Array  # deepest log indentation whose reading by the law is below the limits
    high: Array  # shallowest one whose reading is above them, or the deepest allowed
    nearest: Array  # smallest size of an excess by the law
    stop: PressResult
    done: Array
    readings: Array


def _approach_stop(world: _World, bracket: _Bracket) -> PressResult:
    """From a trial near it to the stop."""
    deepest = world.deepest

    def step(now: _Approach, last: tuple[_Trial, Array]) -> tuple[_Trial, Array]:
        """One secant step, and what is felt there by the linear reading alone."""
        trial, _ = last
        x = jnp.clip(trial.x - jnp.clip(trial.f / trial.slope, -1.0, 1.0), now.low, now.high)
        pressure, felt = world.press_linearly(x, trial.pressure * jnp.exp(x - trial.x), CLOSE_TOLERANCE)
        f, _ = world.excess(felt + now.remainder * jnp.exp(2 * (x - now.measured_at)))
        run = x - trial.x
        slope = (f - trial.f) / jnp.where(run == 0, 1, run)
        slope = jnp.where(jnp.abs(run) > 1e-4, jnp.clip(slope, *SLOPES), trial.slope)
        return _Trial(x, f, slope, pressure), felt

    def read(now: _Approach) -> _Approach:
        """Two secant steps, one where nothing is known of the law yet, and the law's reading where they end."""
        steps = jnp.where(now.readings == 0, 1, 2)
        first = now.trial, jnp.zeros_like(now.remainder)
        trial, felt = jax.lax.fori_loop(0, steps, lambda _, last: step(now, last), first)
        true = world.read(trial.x, trial.pressure, felt)
        f, code = world.excess(true)
        tolerance = jnp.where(trial.slope < FLAT_SLOPE, FLAT_EXCESS_TOLERANCE, EXCESS_TOLERANCE)
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

    slope = jnp.clip((bracket.f_high - bracket.f_low) / (bracket.high - bracket.low), *SLOPES)
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
    return jax.lax.while_loop(lambda now: ~now.done & (now.readings < MAX_READINGS), read, start).stop
