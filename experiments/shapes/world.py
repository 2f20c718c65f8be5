"""Simulation of the paper's stamp experiment, in which stamps are pressed on a fixed skin.

Each press has a random position of the stamp's centre on the skin, a random rotation about the skin's normal and a
random force. The stamp moves along the normal until it reaches that force. Errors are those of
`i2t.simulation.touches`: limited repeatability of the arm, a slight tilt of the stamp, a slanted motion (so that
friction drags the skin), errors of measured force and travel, and a noisy board with faults.

The skin's tool frame T is the world frame, and the object O is the stamp, as in recordings of a probe on a fixed skin
(`i2t.convert.eflesh`): `T_w_t` is the identity and `T_w_o` the nominal pose of the stamp, so position and rotation are
measurements of the arm. The patch is computed from the stamp's drawing at that pose, without a camera.

A stamp has one flat face, parallel to its base. Its surface is therefore a plane inside an outline, with nothing within
reach outside, and `heights` computes it without a renderer.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t import geometry
from i2t.dataset import Dataset
from i2t.objects import catalogue, solids
from i2t.patches.dimensions import ARM_STIFFNESS_N_PER_M, PAD_WINDOW, REACH, VIEW_PIXELS, VIEW_WINDOW
from i2t.patches.views import view_of_heights
from i2t.runtime.batching import map_batches
from i2t.simulation import touches as simulation
from i2t.skin.contact import MAX_HEIGHT_M
from i2t.skin.elasticity import FINE_GRID, GRID, Grid
from i2t.skin.pad import friction_response, press_force
from i2t.types import Board, Pad, ReturnCode, Touches, Truth

PREFIX = "stamp-"  # of the stamps' names in the catalogue
SHAPES = tuple(name.removeprefix(PREFIX) for name in catalogue.STAMPS)
MAX_POSITION_M = 2.9e-3  # from the skin's centre along x and y, so that the whole face is on it at any rotation
ERRORS = simulation.SimulationErrors()


class Stamp(NamedTuple):
    """A stamp with a flat face in its own frame, whose z points out of the face."""

    face: Float[Array, "k 3 2"]  # m, triangles that tile the face
    top: Float[Array, ""]  # m, height of the face
    base: Float[Array, ""]  # m, height of the base around the face


@dataclass(frozen=True)
class StampPressConfig:
    """Settings of the presses of the stamps."""

    grid: Grid = FINE_GRID  # fine, because of the sharp edges
    friction: bool = True
    forces: tuple[float, float] = (1.0, 3.0)  # N, as in the paper
    touches_per_session: int = 64  # during which the sensor warms, wears and drifts


def stamps(names: Sequence[str] = SHAPES) -> Stamp:
    """Stack stamps of the catalogue (ValueError: it has no stamp of a name)."""
    unknown = [name for name in names if name not in SHAPES]
    if unknown:
        raise ValueError(f"no stamp is called {', '.join(unknown)}; the catalogue has {', '.join(SHAPES)}")
    drawn = [catalogue.make_object(PREFIX + name).mesh for name in names]
    tops = [mesh.vertices[:, 2].max() for mesh in drawn]
    faces = []
    for mesh, top in zip(drawn, tops, strict=True):
        corners = mesh.vertices[mesh.faces]
        faces.append(corners[(corners[..., 2] > top - 1e-9).all(1), :, :2])
    most = max(map(len, faces))
    padded = [np.concatenate([face, np.zeros((most - len(face), 3, 2))]) for face in faces]
    return Stamp(
        jnp.asarray(np.stack(padded), jnp.float32),
        jnp.asarray(tops, jnp.float32),
        jnp.asarray(tops, jnp.float32) - solids.STAMP_RELIEF_MM / solids.MM_PER_M,
    )


def pose(position: Float[Array, "2"], rotation: Float[Array, ""], stamp: Stamp) -> Float[Array, "4 4"]:
    """Compute T_t_o of a stamp whose face is centred at `position` (m) on the skin, at `rotation` (rad) about the
    normal. Its z points into the skin, and at rotation 0 its x is that of the skin.
    """
    c, s = jnp.cos(rotation), jnp.sin(rotation)
    matrix = jnp.stack([c, s, jnp.zeros(()), s, -c, jnp.zeros(()), jnp.zeros(()), jnp.zeros(()), -jnp.ones(())])
    return geometry.transform(matrix.reshape(3, 3), jnp.append(position, stamp.top))


@geometry.full_precision
def heights(
    stamp: Stamp, T_t_o: Float[Array, "4 4"], window: float, cells: int
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    """Compute the heights along tool z (m) of the stamp's face and of its base at the cells' centres; +inf outside."""
    at = ((np.arange(cells) + 0.5) / cells - 0.5) * window
    x, y = jnp.meshgrid(jnp.float32(at), jnp.float32(at))
    normal, origin = T_t_o[:3, 2], T_t_o[:3, 3]
    # The plane of the face satisfies normal . (p - origin) = top.
    plane = origin[2] + (stamp.top - normal[0] * (x - origin[0]) - normal[1] * (y - origin[1])) / normal[2]
    points = jnp.stack([x, y, plane], -1) - origin[None, None]
    u, v = points @ T_t_o[:3, 0], points @ T_t_o[:3, 1]

    def inside(triangle: Float[Array, "3 2"]) -> Array:
        a, b = triangle, jnp.roll(triangle, -1, axis=0)
        side = (b - a)[:, 0, None, None] * (v[None] - a[:, 1, None, None]) - (b - a)[:, 1, None, None] * (
            u[None] - a[:, 0, None, None]
        )
        flat = jnp.all(triangle == triangle[:1])
        return jnp.all(side >= 0, axis=0) & ~flat

    on_face = jnp.any(jax.vmap(inside)(stamp.face), axis=0)
    edge = solids.STAMP_BASE_MM[0] / solids.MM_PER_M / 2
    over = (jnp.abs(u) <= edge) & (jnp.abs(v) <= edge)
    return jnp.where(on_face, plane, jnp.inf), jnp.where(over, plane - (stamp.top - stamp.base) / normal[2], jnp.inf)


@geometry.full_precision
def press_stamp(
    key: Key[Array, ""], stamp: Stamp, pad: Pad, position: Float[Array, "2"], rotation: Float[Array, ""],
    force: Float[Array, ""], cfg: StampPressConfig,
) -> Touches:  # fmt: skip
    """Simulate one press with the reading of an ideal sensor and indices of 0 (see `read_session`)."""
    key_arm, key_tilt, key_scalars = jax.random.split(key, 3)
    force_error, travel_error, *slant = jax.random.normal(key_scalars, (4,))
    nominal = pose(position, rotation, stamp)
    level = jnp.eye(4).at[2, 3].set(stamp.top)  # the stamp tilts about the centre of its face
    missed = geometry.random_motion(key_arm, ERRORS.repeatability, 0.0)
    tilted = level @ geometry.random_motion(key_tilt, 0.0, ERRORS.approach_angle) @ geometry.inverse(level)
    T_t_o = nominal @ missed @ tilted

    surface = heights(stamp, T_t_o, PAD_WINDOW, cfg.grid.cells)[0]
    surface = jnp.minimum(surface - jnp.min(surface), MAX_HEIGHT_M)
    pressed = press_force(pad, surface, force, cfg.grid)
    reading = pressed.reading
    if cfg.friction:
        slide = ERRORS.slant * pressed.indentation * jnp.stack(slant)
        # Every other cell suffices for the small effect of friction, and takes a quarter of the time.
        step = max(cfg.grid.cells // GRID.cells, 1)
        coarse = GRID if step > 1 else cfg.grid
        reading = reading + friction_response(pad, surface[::step, ::step], pressed.indentation, slide, grid=coarse)

    travel = pressed.indentation + force / ARM_STIFFNESS_N_PER_M
    deep = jnp.eye(4).at[2, 3].set(-pressed.indentation)
    seen, z = (_view_heights(stamp, deep @ T) for T in (nominal, T_t_o))
    view = view_of_heights(seen)
    true_nearest = jnp.min(z)
    zero = jnp.int32(0)
    return Touches(
        patch=view.patch.depth,
        view=view.depth,
        nearest=view.patch.nearest,
        reading=reading,
        force=force + ERRORS.force * force_error,
        travel=travel + ERRORS.repeatability * travel_error,
        T_w_t=jnp.eye(4),
        T_w_o=deep @ nominal,
        object=zero,
        pad=zero,
        session=zero,
        code=jnp.int32(ReturnCode.WRENCH),
        truth=Truth(jnp.clip(z - true_nearest, 0, REACH), true_nearest, force, pressed.indentation, reading),
    )


def _view_heights(stamp: Stamp, T_t_o: Array) -> Array:
    """Compute tool z (m) of the stamp in a view."""
    return jnp.minimum(*heights(stamp, T_t_o, VIEW_WINDOW, VIEW_PIXELS))


@partial(jax.jit, static_argnames=("cfg",))
def press_session(
    key: Key[Array, ""],
    drawn: Stamp,
    which: Int[Array, " n"],
    pad: Pad,
    cfg: StampPressConfig,
    *,
    presses_before: Int[Array, ""] | int = 0,
) -> Touches:
    """Simulate a session of one press of each stamp in `which`, with the errors of a real sensor."""
    n = len(which)
    key_position, key_rotation, key_force, key_touch, key_skin = jax.random.split(key, 5)
    positions = jax.random.uniform(key_position, (n, 2), minval=-MAX_POSITION_M, maxval=MAX_POSITION_M)
    rotations = jax.random.uniform(key_rotation, (n,), maxval=2 * math.pi)
    forces = jax.random.uniform(key_force, (n,), minval=cfg.forces[0], maxval=cfg.forces[1])

    def press_once(args: tuple) -> Touches:
        key, stamp, position, rotation, force = args
        return press_stamp(key, jax.tree.map(lambda leaf: leaf[stamp], drawn), pad, position, rotation, force, cfg)

    touches = map_batches(
        press_once, (jax.random.split(key_touch, n), which, positions, rotations, forces), batch_size=16
    )
    read = simulation.read_session(key_skin, touches.reading, touches.T_w_t, pad, ERRORS, presses_before=presses_before)
    return touches._replace(reading=read, object=which)


def press_stamps(
    key: Key[Array, ""],
    pads: Sequence[Pad],
    n: int,
    cfg: StampPressConfig,
    progress: Callable[[int], None] = lambda n: None,
) -> Dataset:
    """Simulate n presses of all stamps on each pad, in sessions, as a data set that is marked as simulated."""
    drawn, rows = stamps(), cfg.touches_per_session
    parts, session = [], 0
    for number, pad in enumerate(pads):
        for start in range(0, n, rows):
            key_order, key_press = jax.random.split(jax.random.fold_in(jax.random.fold_in(key, number), start))
            shapes = jnp.arange(start, start + rows, dtype=jnp.int32) % len(SHAPES)
            which = jax.random.permutation(key_order, shapes)
            part = jax.device_get(press_session(key_press, drawn, which, pad, cfg, presses_before=jnp.int32(start)))
            kept = min(rows, n - start)
            part = jax.tree.map(lambda leaf, kept=kept: leaf[:kept], part)
            parts.append(part._replace(pad=part.pad + number, session=part.session + session))
            session += 1
            progress(kept)
    return Dataset(
        jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts),
        SHAPES,
        tuple(f"simulated pad {i}" for i in range(len(pads))),
        tuple(f"session {i:03d}" for i in range(session)),
        Board(*(np.asarray(leaf) for leaf in pads[0].board)),
        "simulated",
        meta={"made by": "experiments.shapes"},
    )
