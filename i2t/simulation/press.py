"""End of a press: the indentation at which the skin change or the force first crosses its limit.

The stop is found by root-finding on the indentation delta: f(delta) = log max(|dB|/limit, F/limit) is scanned on a
geometric grid for its first crossing and refined by regula falsi (Anderson and Bjorck, BIT 13, 1973) in log-log
coordinates, where a contact is nearly a straight line (Hertz: F ~ delta^1.5). Every press gets the same number
of trials, so that many of them can run side by side.

Metres, newtons, microtesla.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from i2t.compiling import traced_floats
from i2t.skin.contact import GRID, Grid
from i2t.skin.pad import Press
from i2t.skin.pad import press as press_pad
from i2t.types import Pad, ReturnCode
from i2t.windows import STANDOFF

PressLaw = Callable[..., Press]  # (pad, height, indentation, *, grid) to a press, as `i2t.skin.pad.press`
SCAN_START_FRACTION = 0.005  # of the deepest indentation, where the search begins


@traced_floats
@dataclass(frozen=True)
class PressLimits:
    """Limits of a press (the paper's values)."""

    skin_change: float = 25.0  # uT, norm of the reading
    force: float = 8.0  # N
    indentation: float = 0.6  # of the layer's thickness: beyond it small-strain elasticity means nothing
    overshoot: float = 0.1  # relative standard deviation by which a press runs past its limit (latency; one-sided)
    scan: int = 6  # presses at growing strides, up to the deepest indentation, that bracket the crossing
    refine: int = 4  # at least so many more close in on it: the limit is met within 0.1 %, mostly within 0.001 %
    stiffness: float = 10e3  # N/m, arm and mount in series
    final: Grid = GRID  # of the last press, whose reading counts; sharp edges want `i2t.skin.contact.FINE_GRID`
    approach_distance: float = STANDOFF  # m before the site where the approach starts
    overtravel: float = 6e-3  # m beyond the site before a press counts as air (three extra steps of 2 mm)


class PressResult(NamedTuple):
    """The end of a press."""

    indentation: Float[Array, ""]  # m
    force: Float[Array, ""]  # N
    reading: Float[Array, " c"]  # uT, noise free
    code: Int[Array, ""]


def press_to_stop(
    pad: Pad,
    height: Float[Array, "g g"],
    limits: PressLimits,
    overshoot: Float[Array, ""] | float = 0.0,
    *,
    law: PressLaw = press_pad,
) -> PressResult:
    """Press until the skin change or the force first crosses its limit.

    A crossing within the first 0.2 % of the deepest indentation is not resolved; the press ends there.

    Args:
        pad: the skin.
        height: m, the surface behind its nearest point over the pad's cells.
        limits: of skin change, force and indentation.
        overshoot: fraction by which both limits are raised.
        law: what a press of the pad gives.

    Returns:
        The end of the press. Its code SKIN or WRENCH says which limit came first; UNDEFINED means that the deepest
        allowed indentation crossed neither.
    """
    deepest = jnp.log(limits.indentation * pad.thickness)
    stride = -math.log(SCAN_START_FRACTION) / (limits.scan - 1)

    def try_next(_: Int[Array, ""], state: _Bracket) -> _Bracket:
        """One press at the next trial."""
        x = _next_trial(state, stride, deepest)
        excess, stop = _try(pad, height, x, limits, overshoot=overshoot, law=law)
        return _narrowed(state, x, excess, stop)

    start = _unbracketed(deepest, stride, limits.scan, pad.board.num_readings)
    end = jax.lax.fori_loop(0, limits.scan + limits.refine, try_next, start)
    return end.stop._replace(code=jnp.where(end.found, end.stop.code, ReturnCode.UNDEFINED))


class _Bracket(NamedTuple):
    """Bracket of the crossing: two trials around it, of which the upper one is a guess until it is found."""

    low: Array  # log indentation below the crossing
    f_low: Array
    high: Array  # and above it, once found
    f_high: Array
    above: Array  # whether the last trial was
    found: Array
    stop: PressResult  # at the last trial


def _unbracketed(deepest: Array, stride: float, scan: int, channels: int) -> _Bracket:
    """Bracket before the first trial: a crossing in the first stride is sought as if the excess grew in proportion to
    the indentation below it.
    """
    no = jnp.asarray(False)
    nothing = PressResult(jnp.zeros(()), jnp.zeros(()), jnp.zeros(channels), jnp.asarray(ReturnCode.UNDEFINED))
    return _Bracket(
        low=deepest - scan * stride,
        f_low=jnp.asarray(-stride),
        high=deepest,
        f_high=jnp.ones(()),
        above=no,
        found=no,
        stop=nothing,
    )


def _next_trial(state: _Bracket, stride: float, deepest: Array) -> Array:
    """The log indentation to try: a stride further until the crossing is bracketed, then where the secant is zero."""
    secant = state.low - state.f_low * (state.high - state.low) / (state.f_high - state.f_low)
    return jnp.where(state.found, secant, jnp.minimum(state.low + stride, deepest))


def _try(
    pad: Pad,
    height: Float[Array, "g g"],
    x: Array,
    limits: PressLimits,
    *,
    overshoot: Float[Array, ""] | float,
    law: PressLaw,
) -> tuple[Array, PressResult]:
    """A press at the log indentation x: its excess over the limits (a logarithm, positive beyond them), and its end."""
    press = law(pad, height, jnp.exp(x), grid=GRID)
    skin = jnp.linalg.norm(press.reading) / limits.skin_change
    wrench = press.force / limits.force
    excess = jnp.log(jnp.maximum(jnp.maximum(skin, wrench) / (1 + overshoot), 1e-6))
    code = jnp.where(skin >= wrench, ReturnCode.SKIN, ReturnCode.WRENCH)
    return excess, PressResult(jnp.exp(x), press.force, press.reading, code)


def _narrowed(state: _Bracket, x: Array, f: Array, stop: PressResult) -> _Bracket:
    """The bracket after a trial at x whose excess is f.

    Anderson and Bjorck: the value at an end that stays twice in a row is shrunk, so that it cannot stay for ever.
    """
    above = f >= 0
    shrunk = 1 - f / jnp.where(above, state.f_high, state.f_low)
    kept = jnp.where(state.found & (above == state.above), jnp.where(shrunk > 0, shrunk, 0.5), 1.0)
    return _Bracket(
        low=jnp.where(above, state.low, x),
        f_low=jnp.where(above, kept * state.f_low, f),
        high=jnp.where(above, x, state.high),
        f_high=jnp.where(above, f, kept * state.f_high),
        above=above,
        found=state.found | above,
        stop=stop,
    )
