"""Simulated touches in bulk: (key, objects, pad, errors, n) -> Touches.

A run is what a lab does in one sitting: the object is placed and registered once (a constant placement error), the
camera is calibrated once (a constant hand-eye error), and the arm makes a number of touches, each with its own
repeatability and tilt of approach. Nothing the model may later use is error free:

  patch    what the *camera* saw: rendered from where the object really is, through the wrong hand-eye transform, with
           lateral bleeding, depth noise and quantisation;
  reading  what the skin *really* met: rendered over the whole pad from the pose the arm really reached, pressed until
           the skin change or the force first crosses its limit, then felt by a skin that remembers, creeps and warms
           and read through the board with ambient and noise.

`i2t.simulation.press` says where a press ends; its rule sees the reading without friction. Until there the arm travels
the indentation and F / stiffness past first contact (series compliance of arm and mount).

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
from jaxtyping import Array, Float, Key

from i2t import geometry
from i2t.rendering.render import render_heights, render_patch, stack_surfaces
from i2t.simulation import sites as touch_sites
from i2t.simulation.press import PressLimits, press_until
from i2t.skin import faults
from i2t.skin.contact import GRID
from i2t.skin.dipoles import rest_field
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise, observe
from i2t.skin.pad import dragged
from i2t.skin.pad import press as press_pad
from i2t.types import (
    PAD_WINDOW,
    PATCH_PIXELS,
    PATCH_WINDOW,
    REACH,
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
SAME = 1.5e-3  # m, five times the default depth noise: pixels closer in depth than this are taken for one surface


@dataclass(frozen=True)
class Errors:
    """Standard deviations of all that separates what the lab believes from what is (metres, radians, newtons)."""

    placement: float = 1e-3  # of the object, per axis and run
    placement_angle: float = math.radians(1.0)
    hand_eye: float = 1e-3  # of the camera in the tool frame, per axis and run
    hand_eye_angle: float = math.radians(0.5)
    repeatability: float = 0.05e-3  # of the arm, per axis and touch
    approach_angle: float = math.radians(0.3)  # between looking and pressing, per touch
    slant: float = math.radians(1.0)  # of the press's motion against the tool's axis, per touch and along x and y
    depth_noise: float = 0.3e-3  # of a depth pixel
    depth_bleed: float = 1.0  # pixels by which depth is displaced sideways
    depth_quantum: float = 0.1e-3
    force: float = 0.1  # N, of the wrench sensor after zeroing
    noise: Noise = field(default_factory=Noise)
    faults: Faults = field(default_factory=Faults.typical)

    @classmethod
    def none(cls) -> "Errors":
        """A world in which the lab knows everything; the sensor's own noise and faults are off too."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, Noise.none(), Faults())

    def scaled(self, factor: float) -> "Errors":
        """All pose errors times a factor; camera and sensor stay."""
        names = (
            "placement",
            "placement_angle",
            "hand_eye",
            "hand_eye_angle",
            "repeatability",
            "approach_angle",
            "slant",
        )
        return replace(self, **{name: factor * getattr(self, name) for name in names})


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


def sense(key: Key[Array, ""], z: Float[Array, "wide wide"], errors: Errors) -> tuple[Float[Array, "wide wide"], Patch]:
    """What the depth camera makes of heights `z` (m along tool z): the wide view and its patch (see `cut`)."""
    row, column = jnp.meshgrid(jnp.arange(WIDE_PIXELS), jnp.arange(WIDE_PIXELS), indexing="ij")
    drawn = jax.random.normal(key, (3, *z.shape))  # one draw: each takes XLA a second to compile
    shift = jnp.round(errors.depth_bleed * drawn[:2]).astype(jnp.int32)
    z = z[jnp.clip(row + shift[0], 0, WIDE_PIXELS - 1), jnp.clip(column + shift[1], 0, WIDE_PIXELS - 1)]
    z = z + errors.depth_noise * drawn[2]
    if errors.depth_quantum > 0:
        z = jnp.round((z + CAMERA_DISTANCE) / errors.depth_quantum) * errors.depth_quantum - CAMERA_DISTANCE
    return cut(z)


def cut(z: Float[Array, "wide wide"]) -> tuple[Float[Array, "wide wide"], Patch]:
    """A wide view (m along tool z from the tool origin, +inf where nothing is seen) as the model sees it.

    Depths (m) are measured from the patch's nearest point and clipped to 0 and the reach; what lies outside the patch
    and is nearer reads 0. Nearest is the least mean of 5 x 5 pixels, of which those on the window's nearest surface
    count (a sigma filter; Lee, CVGIP 24, 1983) and must be at least ten, or as many as there are anywhere: few pixels
    would be the noisiest rather than the nearest.
    """
    central = _centre(z, PATCH_WINDOW)
    inner = PATCH_PIXELS - 4
    windows = jnp.stack([central[i : i + inner, j : j + inner] for i in range(5) for j in range(5)])
    same = jnp.isfinite(windows) & (windows <= jnp.min(windows, axis=0, keepdims=True) + SAME)
    count = jnp.sum(same, axis=0)
    mean = jnp.sum(jnp.where(same, windows, 0), axis=0) / jnp.maximum(count, 1)
    nearest = jnp.min(jnp.where(count >= jnp.clip(jnp.max(count), 1, 10), mean, jnp.inf))
    depth = _behind(z, nearest)
    return depth, Patch(_centre(depth, PATCH_WINDOW), nearest)


def _centre(wide: Array, window: float) -> Array:
    """The pixels of a wide view whose centres lie in a window (m) about its middle."""
    margin = math.ceil((1 - window / WIDE_WINDOW) * WIDE_PIXELS / 2 - 0.5)
    return wide[margin : WIDE_PIXELS - margin, margin : WIDE_PIXELS - margin]


def _behind(z: Array, nearest: Array) -> Array:
    """Depth behind the nearest point, clipped to 0 and the reach; the reach where nothing is seen."""
    return jnp.clip(z - jnp.where(jnp.isfinite(nearest), nearest, 0), 0, REACH)


@geometry.full_precision
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
    """One touch at a site chosen on the believed object: approach along the site's z, press, look.

    The reading is still that of an ideal sensor (see `feel`), and indices are left 0 for the caller.
    """
    key_arm, key_tilt, key_camera, key_scalars = jax.random.split(key, 4)
    slip, force_error, travel_error, *slant = jax.random.normal(key_scalars, (5,))
    T_o_w = geometry.inverse(T_w_o @ run.T_o_placed)  # from here on the object is where it really is

    T_w_arm = T_w_site @ geometry.random_motion(key_arm, errors.repeatability, 0.0)
    T_w_press = T_w_arm @ geometry.random_motion(key_tilt, 0.0, errors.approach_angle)
    start = T_o_w @ T_w_press @ _along_z(jnp.asarray(-limits.prepare))
    T_o_t, hit = touch_sites.press_along(surface, start, start[:3, 2], travel=limits.prepare + limits.past_goal)

    met = render_patch(surface, T_o_t, window=PAD_WINDOW, pixels=GRID.cells)
    hit = hit & jnp.isfinite(met.nearest)
    overshoot = limits.overshoot * jnp.abs(slip)
    stop = press_until(pad, met.depth, limits, overshoot)
    if limits.final != GRID:
        heights = render_heights(surface, geometry.inverse(T_o_t), PAD_WINDOW, limits.final.cells)
        nearest = jnp.min(heights)
        deeper = stop.indentation + met.nearest - nearest  # the finer grid may see a nearer point
        press = press_pad(pad, heights - nearest, deeper, limits.final)
        stop = stop._replace(force=press.force, reading=press.reading)
    slide = errors.slant * stop.indentation * jnp.stack(slant)
    force = jnp.where(hit, stop.force, 0.0)
    reading = jnp.where(hit, stop.reading + dragged(pad, met.depth, stop.indentation, slide), 0.0)
    indentation = jnp.where(hit, stop.indentation, 0.0)
    code = jnp.where(hit, stop.code, ReturnCode.AIR)

    # The grid of the pad meets a point between its cells a little late; that travel is counted, so that nearest and
    # depth agree.
    sunk = jnp.where(hit, met.nearest + stop.indentation, 0.0)
    past_contact = jnp.where(hit, sunk + stop.force / limits.stiffness, 0.0)
    advanced = jnp.linalg.norm(T_o_t[:3, 3] - start[:3, 3]) - limits.prepare
    end = _along_z(advanced + past_contact)
    T_w_t = T_w_site @ end
    # What the camera sees and what the skin meets, side by side: one compiled renderer for both.
    poses = jnp.stack([T_o_w @ T_w_arm @ end @ run.T_t_camera, T_o_t @ _along_z(sunk)])
    seen, z = jax.vmap(lambda T: render_heights(surface, geometry.inverse(T), WIDE_WINDOW, WIDE_PIXELS))(poses)
    wide, patch = sense(key_camera, seen, errors)
    nearest = jnp.min(_centre(z, PAD_WINDOW))
    return Touches(
        patch=patch.depth,
        wide=wide,
        nearest=patch.nearest,
        reading=reading,
        force=force + errors.force * force_error,
        depth=jnp.where(hit, past_contact + errors.repeatability * travel_error, jnp.nan),
        T_w_t=T_w_t,
        T_w_o=T_w_o,
        object=jnp.int32(0),
        pad=jnp.int32(0),
        run=jnp.int32(0),
        code=code.astype(jnp.int32),
        truth=Truth(_behind(z, nearest), nearest, force, indentation, reading),
    )


@geometry.full_precision
def feel(key: Key[Array, ""], touches: Touches, pad: Pad, errors: Errors) -> Touches:
    """The touches of one run, in the order made, with readings of a real sensor instead of those of an ideal one."""
    key_faults, key_noise, key_record = jax.random.split(key, 3)
    rest = pad.board.to_board(rest_field(pad))
    felt = faults.apply(key_faults, touches.reading, touches.T_w_t, pad.board, errors.faults, rest)
    keys = jax.random.split(key_noise, len(felt))
    read = jax.vmap(lambda key, reading: observe(key, reading, pad.board, errors.noise))(keys, felt)
    return touches._replace(reading=faults.record(key_record, read, errors.faults))


def _along_z(distance: Float[Array, ""]) -> Float[Array, "4 4"]:
    return jnp.eye(4).at[2, 3].set(distance)


@geometry.full_precision
def simulate_run(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    pad: Pad,
    errors: Errors,
    limits: PressLimits,
    sites: touch_sites.Limits,
    n: int,
) -> Touches:
    """One run of n touches on random safe sites of one object.

    Rows whose site is unsafe, because too few safe ones were found, carry the code FAILED.
    """
    key_run, key_sites, key_touches, key_skin = jax.random.split(key, 4)
    chosen = touch_sites.sample_sites(key_sites, surface, n, sites)
    run = sample_run(key_run, errors)
    touches = jax.vmap(
        lambda key, T_o_site: touch_once(key, surface, T_w_o, T_w_o @ T_o_site, run, pad, errors, limits)
    )(jax.random.split(key_touches, n), chosen.T_w_t)
    touches = touches._replace(code=jnp.where(chosen.safe, touches.code, ReturnCode.FAILED))
    return feel(key_skin, touches, pad, errors)


def simulate(
    key: Key[Array, ""],
    objects: Sequence[Surface],
    pad: Pad,
    errors: Errors,
    n: int | Sequence[int],
    *,
    limits: PressLimits | None = None,
    sites: touch_sites.Limits | None = None,
    touches_per_run: int = 36,
    progress: Callable[[int], None] = lambda touches: None,
) -> Touches:
    """n touches on each object (or n[i] on the i-th), in runs of `touches_per_run`, each object at the world's origin.

    `object` and `run` are indices in the order made; `pad` is 0. `progress` is told the number of touches just made.
    Raises ValueError where an object has too few safe sites.
    """
    limits, sites = limits or PressLimits(), sites or touch_sites.Limits()
    counts = [n] * len(objects) if isinstance(n, int) else list(n)
    run_once = jax.jit(simulate_run, static_argnames=("errors", "limits", "sites", "n"))
    surfaces = stack_surfaces(objects)  # one size class for all, and so one compilation
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
                raise ValueError(
                    f"object {i} has too few safe touch sites; relax the limits of i2t.simulation.sites.Limits"
                )
            part = part._replace(object=part.object + i, run=part.run + run)
            kept = min(touches_per_run, count - start)
            parts.append(jax.tree.map(lambda array, kept=kept: array[:kept], part))
            run += 1
            progress(kept)
    return jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *parts)
