"""Simulated touches in bulk: (key, objects, pad, errors, n) -> Touches.

A run is what a lab does in one sitting: the object is placed and registered once (a constant placement error), the
camera is calibrated once (a constant hand-eye error), and the arm makes a number of touches, each with its own
repeatability and tilt of approach. Nothing the model may later use is error free:

  patch    what the *camera* saw: rendered from where the object really is, through the wrong hand-eye transform, with
           lateral bleeding, depth noise and quantisation;
  reading  what the skin *really* met: rendered over the whole pad from the pose the arm really reached, pressed until
           the skin change or the force first crosses its limit, then read through the board with ambient, noise and
           drift.

The stop is found by root-finding on the indentation delta: f(delta) = log max(|dB|/limit, F/limit) is scanned on a
geometric grid for its first crossing and refined by regula falsi (Illinois) in log-log coordinates, where a contact is
nearly a straight line (Hertz: F ~ delta^1.5). The arm travels delta + F / stiffness past first contact (series
compliance of arm and mount).

Depth camera after Handa et al. (ICRA 2014): pixels are displaced sideways near edges, then noise, then quantisation.
Default sizes: a short-range stereo camera at 0.1 m and a calibrated UR arm; each is a field of `Errors`, and zero
switches it off. Everything here is simulated, and says so where it is stored.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from i2t import geometry, touch
from i2t.render import render_patch, stack
from i2t.skin.contact import GRID
from i2t.skin.noise import Noise, observe
from i2t.skin.pad import press as press_pad
from i2t.types import (
    PAD_WINDOW,
    PATCH_PIXELS,
    REACH,
    STANDOFF,
    WIDE_PIXELS,
    WIDE_WINDOW,
    Pad,
    Patch,
    ReturnCode,
    Surface,
    Touches,
    Truth,
)

CAMERA_DISTANCE = 104e-3  # m from the camera to the surface while looking (the paper's 40 mm + 64 mm)
MARGIN = (WIDE_PIXELS - PATCH_PIXELS) // 2


@dataclass(frozen=True)
class Errors:
    """Standard deviations of all that separates what the lab believes from what is (metres, radians, newtons)."""

    placement: float = 1e-3  # of the object, per axis and run
    placement_angle: float = math.radians(1.0)
    hand_eye: float = 1e-3  # of the camera in the tool frame, per axis and run
    hand_eye_angle: float = math.radians(0.5)
    repeatability: float = 0.05e-3  # of the arm, per axis and touch
    approach_angle: float = math.radians(0.3)  # between looking and pressing, per touch
    depth_noise: float = 0.3e-3  # of a depth pixel
    depth_bleed: float = 1.0  # pixels by which depth is displaced sideways
    depth_quantum: float = 0.1e-3
    force: float = 0.1  # N, of the wrench sensor after zeroing
    noise: Noise = field(default_factory=Noise)

    @classmethod
    def none(cls) -> "Errors":
        """A world in which the lab knows everything; the sensor's own noise is off too."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, Noise.none())

    def scaled(self, factor: float) -> "Errors":
        """All pose errors times a factor; camera and sensor stay."""
        names = ("placement", "placement_angle", "hand_eye", "hand_eye_angle", "repeatability", "approach_angle")
        return replace(self, **{name: factor * getattr(self, name) for name in names})


@dataclass(frozen=True)
class PressLimits:
    """When a press ends (the paper's values)."""

    skin_change: float = 25.0  # uT, norm of the 15-vector
    force: float = 8.0  # N
    indentation: float = 0.6  # of the layer's thickness: beyond it small-strain elasticity means nothing
    overshoot: float = 0.1  # relative standard deviation by which a press runs past its limit (latency; one-sided)
    stiffness: float = 10e3  # N/m, arm and mount in series
    scan: int = 6  # strides from 1.5 % of the deepest indentation to all of it
    refine: int = 4  # presses that close in on the crossing: the limit is met within 0.5 %
    prepare: float = STANDOFF  # m before the site where the approach starts
    past_goal: float = 6e-3  # m beyond the site before a press counts as air (three extra steps of 2 mm)


class RunErrors(NamedTuple):
    """What stays wrong during one run."""

    T_o_placed: Float[Array, "4 4"]  # where the object is, seen from where the lab believes it
    T_t_camera: Float[Array, "4 4"]  # where the camera really looks from, seen from where the lab believes


def sample_run(key: Key[Array, ""], errors: Errors) -> RunErrors:
    """Draw the placement and hand-eye errors of one run."""
    key_placement, key_camera = jax.random.split(key)
    return RunErrors(
        geometry.random_motion(key_placement, errors.placement, errors.placement_angle),
        geometry.random_motion(key_camera, errors.hand_eye, errors.hand_eye_angle),
    )


def look(
    key: Key[Array, ""], surface: Surface, T_o_t: Float[Array, "4 4"], errors: Errors
) -> tuple[Float[Array, "wide wide"], Patch]:
    """The depth camera's view of the surface from pose T_o_t: the wide view, and the patch cut from its centre.

    The nearest point is taken after a 5 x 5 mean, else it would be the noisiest pixel rather than the nearest. Returns
    metres as in `Patch`; pixels of the wide view are measured from the same nearest point.
    """
    key_bleed, key_noise = jax.random.split(key)
    view = render_patch(surface, T_o_t, window=WIDE_WINDOW, pixels=WIDE_PIXELS, reach=2 * REACH)
    nearest = jnp.where(jnp.isfinite(view.nearest), view.nearest, REACH)
    z = view.depth + nearest
    row, column = jnp.meshgrid(jnp.arange(WIDE_PIXELS), jnp.arange(WIDE_PIXELS), indexing="ij")
    shift = jnp.round(errors.depth_bleed * jax.random.normal(key_bleed, (2, *z.shape))).astype(jnp.int32)
    z = z[jnp.clip(row + shift[0], 0, WIDE_PIXELS - 1), jnp.clip(column + shift[1], 0, WIDE_PIXELS - 1)]
    z = z + errors.depth_noise * jax.random.normal(key_noise, z.shape)
    if errors.depth_quantum > 0:
        z = jnp.round((z + CAMERA_DISTANCE) / errors.depth_quantum) * errors.depth_quantum - CAMERA_DISTANCE
    return cut(z)


def cut(z: Float[Array, "wide wide"]) -> tuple[Float[Array, "wide wide"], Patch]:
    """A wide depth view (m along tool z from the tool origin) as the wide view and the patch that the model sees."""
    central = z[MARGIN : MARGIN + PATCH_PIXELS, MARGIN : MARGIN + PATCH_PIXELS]
    mean = jax.lax.reduce_window(central, 0.0, jax.lax.add, (5, 5), (1, 1), "valid") / 25
    nearest = jnp.min(mean)
    depth = jnp.clip(z - nearest, 0.0, REACH)
    return depth, Patch(depth[MARGIN : MARGIN + PATCH_PIXELS, MARGIN : MARGIN + PATCH_PIXELS], nearest)


class Stop(NamedTuple):
    """The end of a press."""

    indentation: Float[Array, ""]  # m
    force: Float[Array, ""]  # N
    reading: Float[Array, "15"]  # uT, noise free
    code: Int[Array, ""]


def press_until(
    pad: Pad, height: Float[Array, "g g"], limits: PressLimits, overshoot: Float[Array, ""] | float = 0.0
) -> Stop:
    """Press until the skin change or the force first crosses its limit.

    `height` is the surface over the pad's cells, m behind its nearest point. `overshoot` raises both limits by that fraction. Code SKIN or WRENCH says which came first; UNDEFINED means that the
    deepest allowed indentation crossed neither.
    """
    deepest = jnp.log(limits.indentation * pad.thickness)
    stride = -jnp.log(0.015) / (limits.scan - 1)

    def try_next(_: int, state: _Bracket) -> _Bracket:
        """Stride towards the deepest until the excess turns positive, then close in on the root; one press for each."""
        secant = state.low - state.f_low * (state.high - state.low) / (state.f_high - state.f_low)
        x = jnp.where(state.found, secant, jnp.minimum(state.low + stride, deepest))
        press = press_pad(pad, height, jnp.exp(x))
        skin = jnp.linalg.norm(press.reading) / limits.skin_change
        wrench = press.force / limits.force
        f = jnp.log(jnp.maximum(jnp.maximum(skin, wrench) / (1 + overshoot), 1e-6))
        above = f >= 0
        # Illinois: halve the value at the end that stays, so that it cannot stay for ever.
        return _Bracket(
            low=jnp.where(above, state.low, x),
            f_low=jnp.where(above, jnp.where(state.found, state.f_low / 2, state.f_low), f),
            high=jnp.where(above, x, state.high),
            f_high=jnp.where(above, f, jnp.where(state.found, state.f_high / 2, state.f_high)),
            found=state.found | above,
            stop=Stop(
                jnp.exp(x), press.force, press.reading, jnp.where(skin >= wrench, ReturnCode.SKIN, ReturnCode.WRENCH)
            ),
        )

    nothing = Stop(jnp.zeros(()), jnp.zeros(()), jnp.zeros(15), jnp.asarray(ReturnCode.UNDEFINED))
    start = _Bracket(deepest - limits.scan * stride, jnp.log(1e-6), deepest, jnp.ones(()), jnp.asarray(False), nothing)
    end = jax.lax.fori_loop(0, limits.scan + limits.refine, try_next, start)
    return end.stop._replace(code=jnp.where(end.found, end.stop.code, ReturnCode.UNDEFINED))


class _Bracket(NamedTuple):
    low: Array  # log indentation below the crossing
    f_low: Array
    high: Array  # and above it, once found
    f_high: Array
    found: Array
    stop: Stop  # at the last trial


def touch_once(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_site: Float[Array, "4 4"],
    run: RunErrors,
    pad: Pad,
    errors: Errors,
    limits: PressLimits,
) -> Touches:
    """One touch at a site chosen on the believed object: approach along the site's z, press, look, read.

    Indices are left 0 for the caller.
    """
    key_arm, key_tilt, key_overshoot, key_camera, key_skin, key_force, key_travel = jax.random.split(key, 7)
    T_o_w = geometry.invert(T_w_o @ run.T_o_placed)  # from here on the object is where it really is

    back = geometry.transform(jnp.eye(3), jnp.array([0.0, 0.0, -limits.prepare]))
    T_w_arm = T_w_site @ geometry.random_motion(key_arm, errors.repeatability, 0.0)
    T_w_press = T_w_arm @ geometry.random_motion(key_tilt, 0.0, errors.approach_angle)
    start = T_o_w @ T_w_press @ back
    T_o_t, hit = touch.press_along(surface, start, start[:3, 2], travel=limits.prepare + limits.past_goal)

    met = render_patch(surface, T_o_t, window=PAD_WINDOW, pixels=GRID.cells)
    hit = hit & jnp.isfinite(met.nearest)
    overshoot = limits.overshoot * jnp.abs(jax.random.normal(key_overshoot))
    stop = press_until(pad, met.depth, limits, overshoot)
    force = jnp.where(hit, stop.force, 0.0)
    reading = jnp.where(hit, stop.reading, 0.0)
    indentation = jnp.where(hit, stop.indentation, 0.0)
    code = jnp.where(hit, stop.code, ReturnCode.AIR)

    # The grid of the pad meets a point between its cells a little late; that travel is counted, so that nearest and
    # depth agree.
    past_contact = jnp.where(hit, met.nearest + stop.indentation + stop.force / limits.stiffness, 0.0)
    advanced = jnp.linalg.norm(T_o_t[:3, 3] - start[:3, 3]) - limits.prepare
    end = geometry.transform(jnp.eye(3), jnp.stack([jnp.zeros(()), jnp.zeros(()), advanced + past_contact]))
    T_w_t = T_w_site @ end
    wide, patch = look(key_camera, surface, T_o_w @ T_w_arm @ end @ run.T_t_camera, errors)

    sunk = geometry.transform(jnp.eye(3), jnp.stack([jnp.zeros(()), jnp.zeros(()), met.nearest * hit + indentation]))
    seen = render_patch(surface, T_o_t @ sunk, window=WIDE_WINDOW, pixels=WIDE_PIXELS)
    return Touches(
        patch=patch.depth,
        wide=wide,
        nearest=patch.nearest,
        reading=observe(key_skin, reading, pad.board, errors.noise),
        force=force + errors.force * jax.random.normal(key_force),
        depth=jnp.where(hit, past_contact + errors.repeatability * jax.random.normal(key_travel), jnp.nan),
        T_w_t=T_w_t,
        T_w_o=T_w_o,
        object=jnp.int32(0),
        pad=jnp.int32(0),
        run=jnp.int32(0),
        code=code.astype(jnp.int32),
        truth=Truth(seen.depth, seen.nearest, force, indentation, reading),
    )


def simulate_run(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    pad: Pad,
    errors: Errors,
    limits: PressLimits,
    sites: touch.Limits,
    n: int,
) -> Touches:
    """One run of n touches on random safe sites of one object.

    Rows whose site is unsafe, because too few safe ones were found, carry the code FAILED.
    """
    key_run, key_sites, key_touches = jax.random.split(key, 3)
    chosen = touch.sample_sites(key_sites, surface, n, sites)
    run = sample_run(key_run, errors)
    touches = jax.vmap(
        lambda key, T_o_site: touch_once(key, surface, T_w_o, T_w_o @ T_o_site, run, pad, errors, limits)
    )(jax.random.split(key_touches, n), chosen.T_w_t)
    return touches._replace(code=jnp.where(chosen.safe, touches.code, ReturnCode.FAILED))


def simulate(
    key: Key[Array, ""],
    objects: Sequence[Surface],
    pad: Pad,
    errors: Errors,
    n: int | Sequence[int],
    *,
    limits: PressLimits | None = None,
    sites: touch.Limits | None = None,
    touches_per_run: int = 36,
    progress: Callable[[int], None] = lambda touches: None,
) -> Touches:
    """n touches on each object (or n[i] on the i-th), in runs of `touches_per_run`, each object at the world's origin.

    `object` and `run` are indices in the order made; `pad` is 0. `progress` is told the number of touches just made.
    Raises ValueError where an object has too few safe sites.
    """
    limits, sites = limits or PressLimits(), sites or touch.Limits()
    counts = [n] * len(objects) if isinstance(n, int) else list(n)
    run_once = jax.jit(simulate_run, static_argnames=("errors", "limits", "sites", "n"))
    surfaces = stack(objects)  # one size class for all, and so one compilation
    parts, run = [], 0
    for i, count in enumerate(counts):
        surface = jax.tree.map(lambda field, i=i: field[i], surfaces)
        for start in range(0, count, touches_per_run):
            part = jax.device_get(
                run_once(
                    jax.random.fold_in(key, run),
                    surface,
                    jnp.eye(4),
                    pad,
                    errors=errors,
                    limits=limits,
                    sites=sites,
                    n=touches_per_run,
                )
            )
            if (part.code == ReturnCode.FAILED).any():
                raise ValueError(f"object {i} has too few safe touch sites; relax the limits of i2t.touch.Limits")
            part = part._replace(object=part.object + i, run=part.run + run)
            kept = min(touches_per_run, count - start)
            parts.append(jax.tree.map(lambda array, kept=kept: array[:kept], part))
            run += 1
            progress(kept)
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)
