"""Stamps pressed on a skin that is held still: the paper's stamp experiment, simulated.

A press draws a place of the stamp's centre on the skin, a turn about the skin's normal and a force; the stamp comes
down along the normal until it bears that force. What goes wrong is what goes wrong in `i2t.world`: the arm misses the
place by its repeatability, the stamp's face is not quite level, the motion slants (so that friction drags the skin),
force and travel are measured with errors, and the skin is read by a noisy board with faults.

The skin's tool frame T is the world's, and the object O is the stamp, as in recordings of a probe on a fixed skin
(`i2t.converters.eflesh`): `T_w_t` is the identity and `T_w_o` the stamp's believed pose, so that place and turn are the
arm's own measurements. The patch is the stamp as its drawing says it lies there; no camera looks.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from i2t import geometry, objects, world
from i2t.dataset import Dataset
from i2t.render import prepare, render_heights, stack
from i2t.skin.layer import FINE, GRID, Grid
from i2t.skin.pad import dragged, press_force
from i2t.types import PAD_WINDOW, WIDE_PIXELS, WIDE_WINDOW, Board, Pad, ReturnCode, Surface, Touches, Truth

TOP = 8.5e-3  # m, height of a stamp's face over its base (`i2t.objects.stamp`)


@dataclass(frozen=True)
class Pressing:
    """How the stamps are pressed."""

    place: float = 2.9e-3  # m, furthest from the skin's middle along x and y: at any turn the whole relief meets the skin
    force: tuple[float, float] = (1.0, 3.0)  # N, the paper's "depths"
    errors: world.Errors = field(default_factory=world.Errors)
    stiffness: float = 10e3  # N/m, of arm and mount in series
    grid: Grid = FINE  # sharp edges
    touches_per_run: int = 64  # a sitting, over which the sensor warms, wears and drifts


def stamp_pose(x: Array | float, y: Array | float, turn: Array | float, height: Array | float = 0.0) -> Array:
    """T_t_o of a stamp whose face, `height` over the skin, looks down on (x, y) (m), turned by `turn` (rad)."""
    c, s = jnp.cos(turn), jnp.sin(turn)
    zero, one = jnp.zeros_like(c), jnp.ones_like(c)
    # The stamp's z points into the skin, so its drawing is seen from behind: x as drawn, y turned over.
    return jnp.stack(
        [
            jnp.stack([c, s, zero, x * one]),
            jnp.stack([s, -c, zero, y * one]),
            jnp.stack([zero, zero, -one, (height + TOP) * one]),
            jnp.stack([zero, zero, zero, one]),
        ]
    )


@geometry.full_precision
def press_stamp(
    key: Key[Array, ""], surface: Surface, pad: Pad, place: Float[Array, "2"], turn: Float[Array, ""],
    force: Float[Array, ""], how: Pressing,
) -> Touches:  # fmt: skip
    """One press; the reading is still that of an ideal sensor, and indices are left 0 (see `world.feel`)."""
    errors = how.errors
    key_arm, key_tilt, key_scalars = jax.random.split(key, 3)
    force_error, travel_error, *slant = jax.random.normal(key_scalars, (4,))
    missed = geometry.random_motion(key_arm, errors.repeatability, 0.0)
    tilted = geometry.random_motion(key_tilt, 0.0, errors.approach_angle)
    believed = stamp_pose(place[0], place[1], turn)
    level = jnp.eye(4).at[2, 3].set(TOP)  # the face, about whose middle it tilts
    T_t_o = believed @ missed @ level @ tilted @ geometry.invert(level)

    heights = render_heights(surface, geometry.invert(T_t_o), PAD_WINDOW, how.grid.cells)
    first = jnp.min(heights)
    pressed = press_force(pad, heights - first, force, how.grid)
    slide = errors.slant * pressed.indentation * jnp.stack(slant)
    reading = pressed.reading + dragged(pad, heights - first, pressed.indentation, slide, how.grid)

    travel = pressed.indentation + force / how.stiffness
    deep = jnp.eye(4).at[2, 3].set(-pressed.indentation)
    views = jnp.stack([geometry.invert(deep @ believed), geometry.invert(deep @ T_t_o)])
    seen, met = jax.vmap(lambda T: render_heights(surface, T, WIDE_WINDOW, WIDE_PIXELS))(views)
    wide, patch = world.cut(seen)
    zero = jnp.int32(0)
    return Touches(
        patch=patch.depth,
        wide=wide,
        nearest=patch.nearest,
        reading=reading,
        force=force + errors.force * force_error,
        depth=travel + errors.repeatability * travel_error,
        T_w_t=jnp.eye(4),
        T_w_o=deep @ believed,
        object=zero,
        pad=zero,
        run=zero,
        code=jnp.int32(ReturnCode.WRENCH),
        truth=Truth(world.cut(met)[0], jnp.min(met), force, pressed.indentation, reading),
    )


def surfaces(names: Sequence[str] = objects.STAMPS) -> Surface:
    """The stamps, stacked."""
    return stack([prepare(objects.make(name).mesh) for name in names])


@partial(jax.jit, static_argnames=("how",))
def _run(key: Array, stamps: Surface, which: Array, pad: Pad, how: Pressing) -> Touches:
    n = len(which)
    key_place, key_turn, key_force, key_touch, key_skin = jax.random.split(key, 5)
    places = jax.random.uniform(key_place, (n, 2), minval=-how.place, maxval=how.place)
    turns = jax.random.uniform(key_turn, (n,), maxval=2 * math.pi)
    forces = jax.random.uniform(key_force, (n,), minval=how.force[0], maxval=how.force[1])

    def one(args: tuple) -> Touches:
        key, stamp, place, turn, force = args
        return press_stamp(key, jax.tree.map(lambda leaf: leaf[stamp], stamps), pad, place, turn, force, how)

    touches = jax.lax.map(one, (jax.random.split(key_touch, n), which, places, turns, forces), batch_size=16)
    return world.feel(key_skin, touches._replace(object=which), pad, how.errors)


def press_stamps(
    key: Array, pads: Sequence[Pad], n: int, how: Pressing | None = None,
    progress: Callable[[int], None] = lambda touches: None,
) -> Dataset:  # fmt: skip
    """n presses of all stamps in turn on each pad, in runs, as a data set that says it is simulated."""
    how = how or Pressing()
    stamps = surfaces()
    rows = how.touches_per_run
    parts, run = [], 0
    for number, pad in enumerate(pads):
        for start in range(0, n, rows):
            key_run = jax.random.fold_in(jax.random.fold_in(key, number), start)
            key_order, key_press = jax.random.split(key_run)
            which = jax.random.permutation(key_order, jnp.arange(rows, dtype=jnp.int32) % len(objects.STAMPS))
            part = jax.device_get(_run(key_press, stamps, which, pad, how))
            kept = min(rows, n - start)
            part = jax.tree.map(lambda leaf, kept=kept: leaf[:kept], part)
            parts.append(part._replace(pad=part.pad + number, run=part.run + run))
            run += 1
            progress(kept)
    return Dataset(
        jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts),
        tuple(name.removeprefix("stamp-") for name in objects.STAMPS),
        tuple(f"simulated pad {i}" for i in range(len(pads))),
        tuple(f"run {i:03d}" for i in range(run)),
        Board(*(np.asarray(leaf) for leaf in pads[0].board)),
        "simulated",
        meta={"made by": "experiments.shapes"},
    )
