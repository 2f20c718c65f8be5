"""Simulated touches in bulk: (key, objects, pad, errors, n) -> Touches.

A session is what a lab does at one time: the object is placed and registered once (a constant placement error), the
camera is calibrated once (a constant hand-eye error), and the arm makes a number of touches, each with its own
repeatability and tilt of approach. Nothing the model may later use is error free:

  patch    what the *camera* saw: rendered from where the object really is, through the wrong hand-eye transform, with
           lateral bleeding, depth noise and quantisation;
  reading  what the skin *really* met: rendered over the whole pad from the pose the arm really reached, pressed until
           the skin change or the force first crosses its limit, then felt by a skin that remembers, creeps and warms
           and read through the board with ambient and noise.

`i2t.contact.press` says where a press ends; its rule sees the reading without friction. Until there the arm travels
the indentation and F / stiffness past first contact (series compliance of arm and mount).

Depth camera after Handa et al. (ICRA 2014): pixels are displaced sideways near edges, then noise, then quantisation.
Default sizes: a short-range stereo camera at 0.1 m and a calibrated UR arm; each is a field of `SimulationErrors`, and
zero switches it off. Everything here is simulated, and says so where it is stored.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t import geometry, validation
from i2t.contact.approach import FirstContact, facing_surface, meet
from i2t.contact.press import PadResponse, PressLaw, PressLimits, pad_response, press_finally, press_to_stop
from i2t.patches.dimensions import REACH, WIDE_PIXELS, WIDE_WINDOW
from i2t.patches.views import WideView, camera_view, centre, pixels_on_skin
from i2t.rendering.render import render_heights, stack_surfaces
from i2t.runtime.batching import select_rows, spread
from i2t.runtime.compiling import jit_by_amount, jit_quickly, traced_floats
from i2t.simulation import sites as touch_sites
from i2t.skin import faults
from i2t.skin.contact import CELL_GRID, GRID, Grid
from i2t.skin.dipoles import rest_field
from i2t.skin.faults import Faults
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import friction_response
from i2t.skin.pad import press as press_pad
from i2t.types import Array as AnyArray
from i2t.types import Pad, Patch, ReturnCode, Surface, Touches, Truth

POSE_ERRORS = 7  # the first of `SimulationErrors`
FEW_SESSIONS = 400  # of no more, compiling them quickly pays
CAMERA_DISTANCE_M = 104e-3  # m from the camera to the surface while looking (the paper's 40 mm + 64 mm)


@traced_floats
@dataclass(frozen=True)
class SimulationErrors:
    """Standard deviations of the lab's errors about the true world (metres, radians, newtons).

    Example:
        errors = i2t.SimulationErrors(placement=2e-3, force=0.2)  # the others as in a usual lab
        touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, 1000)
    """

    placement: float = 1e-3  # of the object, per axis and session
    placement_angle: float = math.radians(1.0)
    hand_eye: float = 1e-3  # of the camera in the tool frame, per axis and session
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
    def none(cls) -> "SimulationErrors":
        """No errors of the lab; the sensor's own noise and faults are off too."""
        sensor: dict[str, Any] = {"noise": Noise.none(), "faults": Faults()}
        return cls(**{each.name: sensor.get(each.name, 0.0) for each in fields(cls)})

    def scaled(self, factor: float) -> "SimulationErrors":
        """All pose errors times a factor; camera and sensor stay.

        Args:
            factor: 0 for none.

        Returns:
            The new errors.
        """
        return replace(self, **{each.name: factor * getattr(self, each.name) for each in fields(self)[:POSE_ERRORS]})


class SessionErrors(NamedTuple):
    """Constant errors of one session."""

    T_o_placed: Float[Array, "4 4"]  # where the object is, seen from where the lab believes it
    T_t_camera: Float[Array, "4 4"]  # where the camera really looks from, seen from where the lab believes


def sample_session_errors(key: Key[Array, ""], errors: SimulationErrors) -> SessionErrors:
    """Draw the placement and hand-eye errors of one session.

    Args:
        key: Random key.
        errors: Their sizes.

    Returns:
        The errors.
    """
    key_placement, key_camera = jax.random.split(key)
    return SessionErrors(
        geometry.random_motion(key_placement, errors.placement, errors.placement_angle),
        geometry.random_motion(key_camera, errors.hand_eye, errors.hand_eye_angle),
    )


def apply_camera_model(key: Key[Array, ""], z: Float[Array, "wide wide"], errors: SimulationErrors) -> WideView:
    """View of heights by the depth camera.

    Args:
        key: Random key.
        z: m along tool z.
        errors: Sizes of the camera's errors.

    Returns:
        The patch and its surroundings, as of `camera_view`.
    """
    row, column = jnp.meshgrid(jnp.arange(WIDE_PIXELS), jnp.arange(WIDE_PIXELS), indexing="ij")
    drawn = jax.random.normal(key, (3, *z.shape))  # one draw: each takes XLA a second to compile
    shift = jnp.round(errors.depth_bleed * drawn[:2]).astype(jnp.int32)
    z = z[jnp.clip(row + shift[0], 0, WIDE_PIXELS - 1), jnp.clip(column + shift[1], 0, WIDE_PIXELS - 1)]
    z = z + errors.depth_noise * drawn[2]
    step = jnp.where(errors.depth_quantum > 0, errors.depth_quantum, 1.0)
    # A product, because a compiler makes one of a quotient or not: a pixel between two quanta would be here or there.
    rounded = jnp.round((z + CAMERA_DISTANCE_M) * jax.lax.optimization_barrier(1 / step)) * step - CAMERA_DISTANCE_M
    return camera_view(jnp.where(errors.depth_quantum > 0, rounded, z))


class _Press(NamedTuple):
    """The end of a press, zero where nothing was hit."""

    sinking: Float[Array, ""]  # m, of the tool into the skin past the pose of first contact
    travel: Float[Array, ""]  # m, past first contact: the indentation and what arm and mount yield
    indentation: Float[Array, ""]  # m
    force: Float[Array, ""]  # N
    reading: Float[Array, " c"]  # uT, of an ideal sensor
    code: Int[Array, ""]


@geometry.full_precision
def simulate_touch(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_site: Float[Array, "4 4"],
    *,
    session: SessionErrors,
    pad: Pad,
    errors: SimulationErrors,
    limits: PressLimits,
    law: PressLaw | None = press_pad,
    response: PadResponse | None = None,
) -> Touches:
    """One touch at a site chosen on the believed object: approach along the site's z, press, look.

    Args:
        key: random key.
        surface: of the object, in its frame.
        T_w_o: pose of the object as the lab believes it.
        T_w_site: contact pose of the tool, on the object as it is believed to stand.
        session: what stays wrong during the session.
        pad: the skin.
        errors: sizes of the errors that each touch draws anew.
        limits: when the press ends.
        law: what a press of the pad gives; another one makes a world whose physics is another. With None, the contact
            is solved on cells of 1 mm, the reading is linear in the pressure, and nothing rubs.
        response: the pad's `i2t.contact.press.pad_response`, or with a law of None its linear response on cells of
            1 mm; it is worked out anew where it is not given.

    Returns:
        One touch. Its reading is still that of an ideal sensor (see `read_session`), and its indices are left 0
        for the caller.
    """
    key_arm, key_tilt, key_camera, key_scalars = jax.random.split(key, 4)
    overrun, force_error, travel_error, *slant = jax.random.normal(key_scalars, (5,))
    T_o_w = geometry.inverse(T_w_o @ session.T_o_placed)  # from here on the object is where it really is

    T_w_arm = T_w_site @ geometry.random_motion(key_arm, errors.repeatability, 0.0)
    T_w_press = T_w_arm @ geometry.random_motion(key_tilt, 0.0, errors.approach_angle)
    contact, facing = meet(
        surface, T_o_w @ T_w_press, before=limits.approach_distance, beyond=limits.overtravel, grid=_grid(law)
    )
    overshoot = limits.overshoot * jnp.abs(overrun)
    press = _press(
        surface, pad, contact, facing,
        overshoot=overshoot, slant=jnp.stack(slant), errors=errors, limits=limits, law=law, response=response,
    )  # fmt: skip

    end = _along_z(contact.distance + press.travel)
    # What the camera sees and what the skin meets, side by side: one compiled renderer for both.
    poses = jnp.stack([T_o_w @ T_w_arm @ end @ session.T_t_camera, contact.T_w_t @ _along_z(press.sinking)])
    seen, z = jax.vmap(lambda T: render_heights(surface, geometry.inverse(T), WIDE_WINDOW, WIDE_PIXELS))(poses)
    camera = apply_camera_model(key_camera, seen, errors)
    nearest = jnp.min(centre(z, pixels_on_skin(WIDE_WINDOW / WIDE_PIXELS)))
    met = jnp.clip(z - jnp.where(jnp.isfinite(nearest), nearest, 0), 0, REACH)
    return Touches(
        patch=camera.patch.depth,
        wide=camera.wide,
        nearest=camera.patch.nearest,
        reading=press.reading,
        force=press.force + errors.force * force_error,
        depth=jnp.where(contact.hit, press.travel + errors.repeatability * travel_error, jnp.nan),
        T_w_t=T_w_site @ end,
        T_w_o=T_w_o,
        object=jnp.int32(0),
        pad=jnp.int32(0),
        session=jnp.int32(0),
        code=press.code.astype(jnp.int32),
        truth=Truth(met, nearest, press.force, press.indentation, press.reading),
    )


def _grid(law: PressLaw | None) -> Grid:
    """Cells on which a contact is solved."""
    return CELL_GRID if law is None else GRID


def _press(
    surface: Surface,
    pad: Pad,
    contact: FirstContact,
    facing: Patch,
    *,
    overshoot: Float[Array, ""],
    slant: Float[Array, "2"],
    errors: SimulationErrors,
    limits: PressLimits,
    law: PressLaw | None,
    response: PadResponse | None,
) -> _Press:
    """Press past first contact to the limits, once more on the final grid where that is another, and with friction.

    `overshoot` is the part by which the press runs past its limits, `slant` the slope of its motion along x and y in
    standard deviations.
    """
    stop = press_to_stop(pad, facing.depth, limits, overshoot, law=law, response=response, grid=_grid(law))
    friction = jnp.zeros_like(stop.reading)
    if law is not None:
        pressed = stop.press if law is press_pad else None
        slide = errors.slant * stop.indentation * slant
        friction = friction_response(pad, facing.depth, stop.indentation, slide, pressed=pressed)
    if law is not None and limits.final != GRID:
        finer = facing_surface(surface, contact.T_w_t, limits.final)
        deeper = stop.indentation + facing.nearest - finer.nearest  # the finer grid may see a nearer point
        stop = press_finally(pad, finer.depth, deeper, stop, final=limits.final, law=law, response=response)
    # The grid of the pad meets a point between its cells a little late; that distance is counted, so that nearest and
    # depth agree.
    hit = contact.hit
    sinking = jnp.where(hit, facing.nearest + stop.indentation, 0.0)
    return _Press(
        sinking=sinking,
        travel=jnp.where(hit, sinking + stop.force / limits.stiffness, 0.0),
        indentation=jnp.where(hit, stop.indentation, 0.0),
        force=jnp.where(hit, stop.force, 0.0),
        reading=jnp.where(hit, stop.reading + friction, 0.0),
        code=jnp.where(hit, stop.code, ReturnCode.AIR),
    )


@geometry.full_precision
def read_session(
    key: Key[Array, ""],
    reading: Float[Array, "n c"],
    T_w_t: Float[Array, "n 4 4"],
    pad: Pad,
    errors: SimulationErrors,
    *,
    presses_before: Int[Array, ""] | int = 0,
) -> Float[Array, "n c"]:
    """The readings of one session by a real sensor, which errs and remembers.

    Args:
        key: random key of the session; faults of the board itself are the same in all its sessions.
        reading: uT, of an ideal sensor, in the order of the touches.
        T_w_t: poses of the tool.
        pad: the skin.
        errors: whose noise and faults are applied.
        presses_before: that the pad had in the sessions before, and that softened it.

    Returns:
        Readings (uT).
    """
    key_faults, key_noise, _ = jax.random.split(key, 3)  # one more than is used: the draws of a seed stay
    rest = pad.board.to_board(rest_field(pad))
    felt = faults.apply(
        key_faults, reading, T_w_t, pad.board, errors.faults,
        key_board=faults.board_key(pad.gains), rest=rest, presses_before=presses_before,
    )  # fmt: skip
    keys = jax.random.split(key_noise, len(felt))
    return jax.vmap(lambda key, reading: add_sensor_noise(key, reading, pad.board, errors.noise))(keys, felt)


def touch_simulator(
    key: Key[Array, ""],
    surface: Surface,
    pad: Pad,
    *,
    errors: SimulationErrors,
    limits: PressLimits | None = None,
    T_w_o: Float[Array | np.ndarray, "4 4"] | None = None,
) -> Callable[[Float[Array | np.ndarray, "4 4"]], Touches]:
    """A simulated robot before one object, which is put down once and touched at any sites.

    Args:
        key: random key of the session and of all its touches.
        surface: of the object, in its frame.
        pad: the skin; its readings are those of an ideal sensor (see `read_session`).
        errors: of the lab.
        limits: when a press ends.
        T_w_o: pose of the object as the lab believes it; the world's origin by default.

    Returns:
        A function that takes a contact pose T_w_t, makes the next touch there and gives it, on the host.
    """
    key_session, key_touches = jax.random.split(key)
    session = _draw_session(key_session, errors=errors)
    limits = limits or PressLimits()
    response = pad_response(pad, limits.final)
    stated = {"session": session, "pad": pad, "errors": errors, "limits": limits, "response": response}
    believed = np.eye(4, dtype=np.float32) if T_w_o is None else np.asarray(T_w_o, np.float32)
    numbers = itertools.count()

    def touch(T_w_t: Float[Array | np.ndarray, "4 4"]) -> Touches:
        key_touch = jax.random.fold_in(key_touches, next(numbers))
        return jax.device_get(_touch_once(key_touch, surface, believed, jnp.asarray(T_w_t, jnp.float32), **stated))

    return touch


_draw_session = jax.jit(sample_session_errors)
_touch_once = jit_quickly(simulate_touch)


def _along_z(distance: Float[Array, ""]) -> Float[Array, "4 4"]:
    return jnp.eye(4).at[2, 3].set(distance)


@geometry.full_precision
def _simulate_session(
    key: Key[Array, ""],
    surface: Surface,
    presses_before: Int[Array, ""],
    T_w_o: Float[Array, "4 4"],
    pad: Pad,
    errors: SimulationErrors,
    limits: PressLimits,
    sites: touch_sites.SiteLimits,
    response: PadResponse,
    T_t_camera: Float[Array, "4 4"] | None,
    *,
    n: int,
    law: PressLaw = press_pad,
) -> Touches:
    """One session of n touches on random safe sites of one object.

    Args:
        key: random key.
        surface: of the object, in its frame.
        presses_before: that the pad had in the sessions before.
        T_w_o: pose of the object as the lab believes it.
        pad: the skin.
        errors: of the lab.
        limits: when a press ends.
        sites: which sites are safe.
        response: the pad's `pad_response`.
        T_t_camera: where the camera looks from, seen from where the lab believes it; drawn where it is none.
        n: touches.
        law: what a press of the pad gives.

    Returns:
        n touches; rows whose site is unsafe, because too few safe ones were found, carry the code FAILED.
    """
    key_session, key_sites, key_touches, key_skin = jax.random.split(key, 4)
    chosen = touch_sites.sample_sites(key_sites, surface, n, sites)
    session = sample_session_errors(key_session, errors)
    if T_t_camera is not None:
        session = session._replace(T_t_camera=T_t_camera)

    def touch(key: Key[Array, ""], T_o_site: Float[Array, "4 4"]) -> Touches:
        T_w_site = T_w_o @ T_o_site
        return simulate_touch(
            key, surface, T_w_o, T_w_site,
            session=session, pad=pad, errors=errors, limits=limits, law=law, response=response,
        )  # fmt: skip

    touches = jax.vmap(touch)(jax.random.split(key_touches, n), chosen.T_w_t)
    touches = touches._replace(code=jnp.where(chosen.safe, touches.code, ReturnCode.FAILED))
    read = read_session(key_skin, touches.reading, touches.T_w_t, pad, errors, presses_before=presses_before)
    return touches._replace(reading=read)


OF_SESSION = ("n", "law")  # static
_simulate = jit_by_amount(_simulate_session, FEW_SESSIONS, static_argnames=OF_SESSION)


def simulate_touches(
    key: Key[Array, ""],
    objects: Sequence[Surface],
    pad: Pad,
    errors: SimulationErrors,
    n: int | Sequence[int],
    *,
    limits: PressLimits | None = None,
    sites: touch_sites.SiteLimits | None = None,
    touches_per_session: int = 36,
    T_t_camera: Float[AnyArray, "4 4"] | None = None,
    law: PressLaw = press_pad,
    progress: Callable[[int], None] = lambda touches: None,
) -> Touches:
    """Simulated touches on objects, in sessions, with the errors of a real lab.

    More than `FEW_SESSIONS` sessions are compiled with all optimisations; last bits may differ from those of fewer.

    Args:
        key: random key.
        objects: surfaces, each at the world's origin.
        pad: the skin; its board says how many values a reading has. It softens from session to session.
        errors: of the lab; `SimulationErrors.none()` is a lab that knows everything.
        n: touches on each object, or on the i-th.
        limits: when a press ends.
        sites: which sites are safe.
        touches_per_session: touches after which the object is placed anew.
        T_t_camera: where the camera looks from in all sessions, seen from where the lab believes it; left out, each
            session has a camera that was calibrated anew.
        law: what a press of the pad gives; another one makes a world whose physics is another.
        progress: called with the number of touches just made.

    Returns:
        Touches. `object` and `session` are indices in the order made; `pad` is 0.

    Raises:
        ValueError: an object has too few safe sites, or numbers make no sense.
        TypeError: the key is none, or a number of touches is no whole number.

    Example:
        from i2t import load_mesh, prepare_surface, sample_pad, simulate_touches
        from i2t.simulation.touches import SimulationErrors

        surface = prepare_surface(load_mesh("cup.stl", "mm"))
        touches = simulate_touches(jax.random.key(0), [surface], sample_pad(jax.random.key(1)), SimulationErrors(), 36)
    """
    validation.random_key("key", key)
    camera = None if T_t_camera is None else np.asarray(validation.pose("T_t_camera", T_t_camera), np.float32)
    limits, sites = limits or PressLimits(), sites or touch_sites.SiteLimits()
    touches_per_session = validation.count("touches_per_session", touches_per_session)
    counts = _counts(objects, n)
    surfaces = stack_surfaces(objects)  # one size class for all, and so one compilation
    sessions = [
        (i, min(touches_per_session, count - start))
        for i, count in enumerate(counts)
        for start in range(0, count, touches_per_session)
    ]

    def calls() -> Iterator[tuple[Array, Surface, Array]]:
        presses = 0
        for session, (i, kept) in enumerate(sessions):
            surface = jax.tree.map(lambda field, i=i: field[i], surfaces)
            yield jax.random.fold_in(key, session), surface, jnp.int32(presses)
            presses += kept

    made = spread(
        _simulate(len(sessions)),
        calls(),
        shared=(np.eye(4, dtype=np.float32), pad, errors, limits, sites, pad_response(pad, limits.final), camera),
        n=touches_per_session, law=law,
    )  # fmt: skip
    parts = []
    for session, ((i, kept), part) in enumerate(zip(sessions, made, strict=True)):
        if (part.code == ReturnCode.FAILED).any():
            raise ValueError(
                f"object {i} has too few safe touch sites; relax the limits of i2t.simulation.sites.SiteLimits"
            )
        part = part._replace(object=part.object + i, session=part.session + session)
        parts.append(select_rows(part, slice(kept)))
        progress(kept)
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def _counts(objects: Sequence[Surface], n: int | Sequence[int]) -> list[int]:
    """Touches on each object."""
    if not objects:
        raise ValueError("objects: there is none; give one surface or more")
    if isinstance(n, Sequence | np.ndarray) and not isinstance(n, str):
        counts = [validation.count(f"n[{i}]", each, least=0) for i, each in enumerate(n)]
        if len(counts) != len(objects):
            raise ValueError(f"n: has {len(counts)} numbers for {len(objects)} objects; give one for each")
        validation.count("n, of all objects,", sum(counts))
        return counts
    return [validation.count("n", n)] * len(objects)
