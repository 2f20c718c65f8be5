"""A small environment whose table is drawn at random: everything but the physics, without compiling any."""

import jax.numpy as jnp
import numpy as np

from i2t.contact.press import PadResponse
from i2t.recognition.environment import (
    EnvironmentConfig,
    EnvironmentParams,
    OutcomeTable,
    TabulatedTouches,
    TouchEnvironment,
)
from i2t.skin.boards import reskin_board
from i2t.types import Pad, Surface

OBJECTS, SITES, PADS, PLACEMENTS, CHANNELS = 3, 5, 2, 4, 15


def random_environment(config: EnvironmentConfig | None = None) -> tuple[TouchEnvironment, EnvironmentParams]:
    """Rules and parameters of `OBJECTS` objects, `SITES` sites, `PADS` pads; site 4 is unsafe."""
    rng = np.random.default_rng(0)
    shape = (PADS, OBJECTS, PLACEMENTS, SITES)
    touches = TabulatedTouches(
        reading=jnp.float32(rng.normal(scale=20, size=(*shape, CHANNELS))),
        force=jnp.float32(rng.uniform(0.5, 2, shape)),
        advance=jnp.float32(rng.normal(scale=1e-3, size=shape)),
        contact=jnp.asarray(rng.random(shape) < 0.8),
    )
    board = reskin_board()
    stacked = type(board)(*(jnp.float32(np.stack([part] * PADS)) for part in (board.chips, board.rotations)))
    one = jnp.ones(PADS)
    pads = Pad(
        2e-3 * one, 1e5 * one, 0.48 * one, jnp.ones((PADS, 2, 2, 3)), jnp.ones((PADS, CHANNELS)), stacked, one, one
    )
    poses = np.tile(np.diag([1.0, -1, -1, 1]), (SITES, 1, 1))
    poses[:, :2, 3] = rng.uniform(-0.02, 0.02, (SITES, 2))
    params = EnvironmentParams(
        surfaces=Surface(jnp.zeros((OBJECTS, 1, 3, 3))),
        pads=pads,
        response=PadResponse(jnp.zeros((PADS, CHANNELS, 2, 2)), None),
        T_w_site=jnp.float32(poses),
        owner=jnp.arange(SITES) % OBJECTS,
        allowed=jnp.arange(SITES) < SITES - 1,
        table=OutcomeTable(touches, jnp.tile(jnp.eye(4), (PLACEMENTS, 1, 1))),
    )
    return TouchEnvironment(config=config or EnvironmentConfig(touches=4)), params
