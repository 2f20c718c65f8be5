"""Simulate touches in bulk: (key, objects, pad, errors, n) -> Touches.

In a session, the object is placed and registered once (a constant placement error), the
camera is calibrated once (a constant hand-eye error), and the arm makes a number of touches, each with its own errors
of repeatability and tilt. Everything that a model may use later has errors:

  patch    the *camera*'s view: a rendering of the object at its true pose, through the wrong hand-eye transform,
           with lateral bleeding, depth noise and quantisation;
  reading  the *skin*'s measurement: a rendering over the whole pad from the pose that the arm truly reaches, pressed
           until the skin change or the force first crosses its limit, measured by a skin with hysteresis, creep and
           warming, and read through the board with ambient and noise.

`i2t.contact.press` determines where a press ends, by the reading without friction. Until then the arm travels the
indentation plus F / stiffness past first contact (series compliance of arm and mount).

The depth camera follows Handa et al. (ICRA 2014): pixels are displaced sideways near edges, then noise is added, then
depths are quantised. Default errors are those of a short-range stereo camera at 0.1 m and a calibrated UR arm. Each is
a field of `SimulationErrors`, and zero disables it. Stored results are marked as simulated.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t import geometry, validation
from i2t.contact.approach import FirstContact, facing_surface, meet
from i2t.contact.press import PadResponse, PressLaw, PressLimits, pad_response, press_at_stop, press_to_stop
from i2t.patches.dimensions import REACH, VIEW_PIXELS, VIEW_WINDOW
from i2t.patches.views import PatchView, centre, pixels_on_skin, view_of_noisy_heights
from i2t.rendering.render import render_heights, stack_surfaces
from i2t.runtime.batching import map_on_devices, select_rows
from i2t.runtime.compiling import compiles_slowly, jit_by_amount, jit_quickly, traced_floats
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

CAMERA_DISTANCE_M = 104e-3  # m, distance from the camera to the surface while it looks (the paper's 40 mm + 64 mm)


@traced_floats
@dataclass(frozen=True)
class SimulationErrors:
    """Sizes of the errors of a simulated lab's placement, camera, arm and sensor (standard deviations; m, rad, N).

    Example:
        errors = i2t.SimulationErrors(placement=2e-3, force=0.2)  # the others as in a usual lab
        touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, 1000)
    """

    placement: float = 1e-3  # m, standard deviation of the object's position, per axis and session
    placement_angle: float = math.radians(1.0)
    hand_eye: float = 1e-3  # m, standard deviation of the camera's position in the tool frame, per axis and session
    hand_eye_angle: float = math.radians(0.5)
    repeatability: float = 0.05e-3  # m, standard deviation of the arm's position, per axis and touch
    # rad, standard deviation of the angle between looking and pressing, per touch
    approach_angle: float = math.radians(0.3)
    # rad, standard deviation of the angle between press motion and tool axis, per touch and along x and y
    slant: float = math.radians(1.0)
    depth_noise: float = 0.3e-3  # m, standard deviation of a pixel's depth
    depth_bleed: float = 1.0  # pixels, standard deviation of the lateral displacement of depths
    depth_quantum: float = 0.1e-3  # m, step of the depths
    force: float = 0.1  # N, standard deviation of the wrench sensor's force after zeroing
    noise: Noise = field(default_factory=Noise)
    faults: Faults = field(default_factory=Faults.typical)
    num_pose_errors: ClassVar[int] = 7  # number of fields, the first ones, that are errors of poses

    @classmethod
    def error_free(cls) -> "SimulationErrors":
        """Describe a lab without errors, whose sensor has no noise and no faults."""
        sensor: dict[str, Any] = {"noise": Noise.none(), "faults": Faults()}
        return cls(**{error.name: sensor.get(error.name, 0.0) for error in fields(cls)})

    def scaled(self, factor: float) -> "SimulationErrors":
        """Multiply the errors of placement, camera pose, arm, tilt and slant by a factor; all others stay.

        Args:
            factor: The factor; 0 removes the errors.

        Returns:
            The scaled errors.
        """
        pose_errors = [error.name for error in fields(self)[: self.num_pose_errors]]
        return replace(self, **{name: factor * getattr(self, name) for name in pose_errors})


class SessionErrors(NamedTuple):
    """Constant errors of one session: true poses of the object and of the camera relative to the believed ones."""

    T_o_placed: Float[Array, "4 4"]  # true pose of the object relative to the believed one
    T_t_camera: Float[Array, "4 4"]  # true pose of the camera relative to the believed one


def sample_session_errors(key: Key[Array, ""], errors: SimulationErrors) -> SessionErrors:
    """Draw the placement and hand-eye errors of one session.

    Args:
        key: Random key.
        errors: Sizes of the errors.

    Returns:
        The constant errors of a session.
    """
    key_placement, key_camera = jax.random.split(key)
    return SessionErrors(
        geometry.random_motion(key_placement, errors.placement, errors.placement_angle),
        geometry.random_motion(key_camera, errors.hand_eye, errors.hand_eye_angle),
    )


def apply_camera_model(key: Key[Array, ""], z: Float[Array, "w w"], errors: SimulationErrors) -> PatchView:
    """Simulate the depth camera's view of a surface, with its errors, from exact heights.

    Args:
        key: Random key.
        z: `(w, w)` heights (m) along tool z from the tool origin, growing away from the skin.
        errors: Sizes of the camera's errors.

    Returns:
        The patch and its surroundings, as from `view_of_noisy_heights`.
    """
    row, column = jnp.meshgrid(jnp.arange(VIEW_PIXELS), jnp.arange(VIEW_PIXELS), indexing="ij")
    drawn = jax.random.normal(key, (3, *z.shape))  # a single draw, because XLA takes a second to compile each
    shift = jnp.round(errors.depth_bleed * drawn[:2]).astype(jnp.int32)
    z = z[jnp.clip(row + shift[0], 0, VIEW_PIXELS - 1), jnp.clip(column + shift[1], 0, VIEW_PIXELS - 1)]
    z = z + errors.depth_noise * drawn[2]
    step = jnp.where(errors.depth_quantum > 0, errors.depth_quantum, 1.0)
    # A product, because compilers may replace a quotient by one, and pixels between two quanta would then differ.
    rounded = jnp.round((z + CAMERA_DISTANCE_M) * jax.lax.optimization_barrier(1 / step)) * step - CAMERA_DISTANCE_M
    return view_of_noisy_heights(jnp.where(errors.depth_quantum > 0, rounded, z))


class _Press(NamedTuple):
    """The end of a press; zero if nothing was hit."""

    sinking: Float[Array, ""]  # m, motion of the surface into the skin past first contact
    travel: Float[
        Array, ""
    ]  # m, motion of the arm past first contact: the indentation and the deflection of arm and mount
    indentation: Float[Array, ""]  # m, largest indentation of the skin
    force: Float[Array, ""]  # N, force of the press
    reading: Float[Array, " c"]  # uT, from an ideal sensor
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
    """Simulate a touch with its camera view: approach a site on the believed object along its z axis, and press.

    Args:
        key: Random key.
        surface: Surface of the object, in its frame.
        T_w_o: Believed pose of the object.
        T_w_site: Contact pose of the tool on the object at its believed pose.
        session: Constant errors of the session.
        pad: The skin.
        errors: Sizes of the errors that are drawn for each touch.
        limits: Limits at which the press ends.
        law: Function that computes a press of the pad; another function makes a world with different physics. With
            None, the contact is solved on cells of 1 mm, the reading is linear in the pressure, and there is no
            friction.
        response: The pad's `i2t.contact.press.pad_response`, or its linear response on cells of 1 mm if `law` is None.
            It is computed if it is not given.

    Returns:
        A touch with the reading of an ideal sensor (see `read_session`) and with indices 0.
    """
    key_arm, key_tilt, key_camera, key_scalars = jax.random.split(key, 4)
    overrun, force_error, travel_error, *slant = jax.random.normal(key_scalars, (5,))
    T_o_w = geometry.inverse(T_w_o @ session.T_o_placed)  # from here on at the true pose of the object

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
    # The camera's view and the skin's are rendered together, so that the renderer is compiled once.
    poses = jnp.stack([T_o_w @ T_w_arm @ end @ session.T_t_camera, contact.T_w_t @ _along_z(press.sinking)])
    seen, z = jax.vmap(lambda T: render_heights(surface, geometry.inverse(T), VIEW_WINDOW, VIEW_PIXELS))(poses)
    camera = apply_camera_model(key_camera, seen, errors)
    nearest = jnp.min(centre(z, pixels_on_skin(VIEW_WINDOW / VIEW_PIXELS)))
    met = jnp.clip(z - jnp.where(jnp.isfinite(nearest), nearest, 0), 0, REACH)
    return Touches(
        patch=camera.patch.depth,
        view=camera.depth,
        nearest=camera.patch.nearest,
        reading=press.reading,
        force=press.force + errors.force * force_error,
        travel=jnp.where(contact.hit, press.travel + errors.repeatability * travel_error, jnp.nan),
        T_w_t=T_w_site @ end,
        T_w_o=T_w_o,
        object=jnp.int32(0),
        pad=jnp.int32(0),
        session=jnp.int32(0),
        code=press.code.astype(jnp.int32),
        truth=Truth(met, nearest, press.force, press.indentation, press.reading),
    )


def _grid(law: PressLaw | None) -> Grid:
    """Choose the cells on which a contact is solved."""
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
    """Press past first contact to the limits, with friction, and again on the final grid if that differs.

    The press exceeds its limits by the fraction `overshoot`. `slant` is the slope of its motion along x and y in
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
        stop = press_at_stop(pad, finer.depth, deeper, stop, final=limits.final, law=law, response=response)
    # The grid of the pad meets a point between its cells late. This distance is included, so that nearest and travel
    # agree.
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
    """Compute the readings of a session by a real sensor, which has errors and hysteresis.

    Args:
        key: Random key of the session. Faults of the board are the same in all its sessions.
        reading: `(n, c)` readings (uT) of an ideal sensor, in the order of the touches.
        T_w_t: `(n, 4, 4)` poses of the tool.
        pad: The skin.
        errors: Errors of the lab, for noise and faults of the sensor.
        presses_before: Number of presses in earlier sessions, which softened the pad.

    Returns:
        `(n, c)` readings (uT) of the real sensor.
    """
    key_faults, key_noise, _ = jax.random.split(key, 3)  # the third key is unused, so that the draws of a seed stay
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
    """Make a function that simulates touches of an object, which is placed once, by a robot at any sites.

    Args:
        key: Random key of the session and of all its touches.
        surface: Surface of the object, in its frame.
        pad: The skin; its readings are those of an ideal sensor (see `read_session`).
        errors: Errors of the lab.
        limits: Limits at which a press ends.
        T_w_o: Believed pose of the object, by default the world's origin.

    Returns:
        A function that takes a contact pose T_w_t, makes the next touch there and returns it, on the host.
    """
    key_session, key_touches = jax.random.split(key)
    session = _draw_session(key_session, errors=errors)
    limits = limits or PressLimits()
    response = pad_response(pad, limits.final)
    settings = {"session": session, "pad": pad, "errors": errors, "limits": limits, "response": response}
    believed = np.eye(4, dtype=np.float32) if T_w_o is None else np.asarray(T_w_o, np.float32)
    numbers = itertools.count()

    def touch(T_w_t: Float[Array | np.ndarray, "4 4"]) -> Touches:
        key_touch = jax.random.fold_in(key_touches, next(numbers))
        return jax.device_get(_touch_once(key_touch, surface, believed, jnp.asarray(T_w_t, jnp.float32), **settings))

    return touch


_draw_session = jax.jit(sample_session_errors)
_touch_once = jit_quickly(simulate_touch)


def _along_z(distance: Float[Array, ""]) -> Float[Array, "4 4"]:
    return jnp.eye(4).at[2, 3].set(distance)


@compiles_slowly("the simulation of touches", seconds=8)
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
    """Simulate a session of n touches on random safe sites of an object.

    Args:
        key: Random key.
        surface: Surface of the object, in its frame.
        presses_before: Number of presses in earlier sessions.
        T_w_o: Believed pose of the object.
        pad: The skin.
        errors: Errors of the lab.
        limits: Limits at which a press ends.
        sites: Limits of safe sites.
        response: The pad's `pad_response`.
        T_t_camera: True pose of the camera relative to the believed one; it is drawn if it is None.
        n: Number of touches.
        law: Function that computes a press of the pad.

    Returns:
        n touches. Rows without a safe site, because too few were found, have the code FAILED.
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


_simulate = jit_by_amount(_simulate_session, 400, static_argnames=("n", "law"))


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
    """Simulate touches on objects, in sessions, with the errors of a real lab.

    More than 400 sessions are compiled with all optimisations; the last bits may differ from those of fewer sessions.

    Args:
        key: Random key.
        objects: Surfaces, each at the world's origin.
        pad: The skin, whose board determines the number of values in a reading. It softens from session to session.
        errors: Errors of the lab; `SimulationErrors.error_free()` is a lab without errors.
        n: Number of touches on each object, or a list with the number for each.
        limits: Limits at which a press ends.
        sites: Limits of safe sites.
        touches_per_session: Number of touches after which the object is placed again.
        T_t_camera: True pose of the camera relative to the believed one in all sessions. By default, it is drawn for
            each session.
        law: Function that computes a press of the pad; another function makes a world with different physics.
        progress: Function that is called with the number of touches just made.

    Returns:
        The touches. `object` and `session` are indices in order of simulation; `pad` is 0.

    Raises:
        ValueError: An object has too few safe sites, or a number is out of range.
        TypeError: `key` is not a JAX key, or a number of touches is not an integer.

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
    surfaces = stack_surfaces(objects)  # a single size class, so that the program is compiled once
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

    results = map_on_devices(
        _simulate(len(sessions)),
        calls(),
        shared=(np.eye(4, dtype=np.float32), pad, errors, limits, sites, pad_response(pad, limits.final), camera),
        n=touches_per_session, law=law,
    )  # fmt: skip
    parts = []
    for session, ((i, kept), part) in enumerate(zip(sessions, results, strict=True)):
        if (part.code == ReturnCode.FAILED).any():
            raise ValueError(
                f"object {i} has too few safe touch sites; relax the limits of i2t.simulation.sites.SiteLimits"
            )
        part = part._replace(object=part.object + i, session=part.session + session)
        parts.append(select_rows(part, slice(kept)))
        progress(kept)
    return jax.tree.map(lambda *arrays: np.concatenate(arrays), *parts)


def _counts(objects: Sequence[Surface], n: int | Sequence[int]) -> list[int]:
    """Check the numbers of touches on the objects."""
    if not objects:
        raise ValueError("objects: the list is empty; give at least one surface")
    if isinstance(n, Sequence | np.ndarray) and not isinstance(n, str):
        counts = [validation.count(f"n[{i}]", count, minimum=0) for i, count in enumerate(n)]
        if len(counts) != len(objects):
            raise ValueError(f"n: has {len(counts)} numbers for {len(objects)} objects; give one for each")
        validation.count("n, of all objects,", sum(counts))
        return counts
    return [validation.count("n", n)] * len(objects)
