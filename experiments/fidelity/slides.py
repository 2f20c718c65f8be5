"""Simulated skins that are pressed, dragged and let slip: the truth of force, shear, contact and slip that no recording
at hand has.

A stroke begins in air, presses a ball into the skin, and drags it along in small steps; its friction differs from
stroke to stroke, as surfaces do, so that no ratio of forces tells slip. The state of friction follows the path
(`i2t.skin.friction`). Slip is when every cell in contact bears all the friction it can. Readings are means of a few
samples less the ambient, with the noise of real boards (`i2t.skin.noise`).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from i2t.batching import map_batches
from i2t.calibration.heads import SkinRecording
from i2t.calibration.physics import RoundTip
from i2t.skin.contact import solve
from i2t.skin.dipoles import pressed_field, rest_field
from i2t.skin.elasticity import GRID
from i2t.skin.friction import rest, shear
from i2t.skin.noise import Noise, add_sensor_noise
from i2t.skin.pad import numbered_pad
from i2t.types import Pad

SLIDING_TIP = RoundTip("sphere", 4e-3)
AIR_ROWS, PRESS_ROWS, DRAG_ROWS = 2, 3, 9
STROKE_ROWS = AIR_ROWS + PRESS_ROWS + DRAG_ROWS
START_M = 5e-3  # of the first touch along x and y
DEPTHS_M = (0.3e-3, 0.9e-3)
FRICTIONS = (0.2, 1.0)
STEPS_M = (0.02e-3, 0.16e-3)  # of the drag from row to row
ROW_S = 0.05
STROKES_AT_ONCE = 8


class SlideRow(NamedTuple):
    """One row of a stroke, as the simulator knows it."""

    reading: Array  # (c,) uT
    position: Array  # (2,) m
    depth: Array  # m
    force: Array  # N
    shear: Array  # (2,) N, of the object on the skin
    slip: Array  # 0 or 1


def simulated_slides(number: int, strokes: int) -> SkinRecording:
    """Strokes over the numbered pad as a recording."""
    simulated = _slide(jax.random.key(number), numbered_pad(number), strokes)
    rows = {
        name: np.asarray(part, np.float64).reshape(strokes * STROKE_ROWS, *part.shape[2:])
        for name, part in simulated._asdict().items()
    }
    touched = rows["force"] > 0
    return SkinRecording(
        name=f"simulated skin {number}, pressed and dragged",
        readings=rows["reading"],
        targets={
            "position": np.where(touched[:, None], rows["position"], np.nan),
            "depth": np.where(touched, rows["depth"], np.nan)[:, None],
            "force": rows["force"][:, None],
            "shear": rows["shear"],
            "contact": touched.astype(float)[:, None],
            "slip": np.where(touched, rows["slip"], 0.0)[:, None],
        },
        session=np.repeat(np.arange(strokes), STROKE_ROWS),
        time=ROW_S * np.arange(strokes * STROKE_ROWS),
        board=jax.tree.map(np.asarray, numbered_pad(number).board),
        source="simulated",
        notes=("simulated: a ball of 4 mm, friction drawn for each stroke between 0.2 and 1, noise of real boards",),
    )


@partial(jax.jit, static_argnums=2)
def _slide(key: Key[Array, ""], pad: Pad, strokes: int) -> SlideRow:
    keys = jax.random.split(key, strokes)
    return map_batches(lambda one: _stroke(one, pad), keys, batch_size=min(STROKES_AT_ONCE, strokes))


def _stroke(key: Key[Array, ""], pad: Pad) -> SlideRow:
    names = ("start", "depth", "friction", "step", "turn", "noise")
    keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
    start = jax.random.uniform(keys["start"], (2,), minval=-START_M, maxval=START_M)
    deepest = jax.random.uniform(keys["depth"], minval=DEPTHS_M[0], maxval=DEPTHS_M[1])
    pad = pad._replace(friction=jax.random.uniform(keys["friction"], minval=FRICTIONS[0], maxval=FRICTIONS[1]))
    turn = jax.random.uniform(keys["turn"], maxval=2 * np.pi)
    step = jax.random.uniform(keys["step"], minval=STEPS_M[0], maxval=STEPS_M[1])
    step = step * jnp.stack([jnp.cos(turn), jnp.sin(turn)])
    depths = deepest * jnp.concatenate([jnp.arange(1, PRESS_ROWS + 1) / PRESS_ROWS, jnp.ones(DRAG_ROWS)])
    moves = jnp.concatenate([jnp.zeros(PRESS_ROWS), jnp.ones(DRAG_ROWS)])
    nothing = jnp.zeros((GRID.cells, GRID.cells))

    def follow(state: tuple, row: tuple[Array, Array]) -> tuple[tuple, SlideRow]:
        position, pressure, friction = state
        depth, moved = row
        position = position + moved * step
        pressure = solve(pad, SLIDING_TIP.height(position), depth, GRID, start=pressure).pressure
        friction = shear(pad, pressure, moved * step, GRID, before=friction)
        field = pressed_field(pad, pressure, GRID, traction=friction.traction) - rest_field(pad)
        touching = pressure > 0
        slipping = jnp.sum(friction.slipping & touching) >= jnp.sum(touching)
        area = GRID.spacing**2
        pressed = SlideRow(
            pad.gains * pad.board.to_board(field),
            position,
            depth,
            area * jnp.sum(pressure),
            area * jnp.sum(friction.traction, axis=(1, 2)),
            slipping.astype(jnp.float32),
        )
        return (position, pressure, friction), pressed

    _, rows = jax.lax.scan(follow, (start, nothing, rest(pad, nothing)), (depths, moves))
    rows = jax.tree.map(lambda part: jnp.concatenate([jnp.zeros((AIR_ROWS, *part.shape[1:])), part]), rows)
    noisy = jax.vmap(lambda one, reading: add_sensor_noise(one, reading, pad.board, Noise()))(
        jax.random.split(keys["noise"], STROKE_ROWS), rows.reading
    )
    return rows._replace(reading=noisy)
