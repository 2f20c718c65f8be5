"""The central types: arrays are as annotated, and a board has any number of chips."""

import jax
import jax.numpy as jnp
import numpy as np
from helpers.field_types import wrong_fields
from helpers.random_touches import make

from i2t.objects import catalogue
from i2t.rendering.render import prepare_surface
from i2t.simulation.sites import Sites
from i2t.skin.boards import make_board
from i2t.skin.pad import nominal_pad
from i2t.types import Patch


def test_fields_are_as_annotated():
    board = make_board("grid-4x4")
    pad = nominal_pad(board=board)
    touches = make(3, truth=True, view=True, board="grid-4x4").touches
    surface = prepare_surface(catalogue.make_object("star").mesh)
    for value in (board, pad, touches, surface, Patch(np.zeros((48, 48), np.float32), np.float32(0))):
        assert wrong_fields(value) == []
        assert len(repr(value).splitlines()) == 1
        assert len(repr(value)) < 1500
    assert repr(Sites(jnp.zeros((9, 4, 4)), jnp.ones(9, bool))) == "Sites(T_w_t=9x4x4 float32, safe=9 bool)"
    pads = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), pad)
    assert wrong_fields(pads) == []  # a batch has a leading axis


def test_a_wrong_field_is_found():
    touches = make(3, truth=True).touches
    assert wrong_fields(touches._replace(force=np.zeros(2, np.float32))) == ["force"]
    assert wrong_fields(touches._replace(truth=touches.truth._replace(view=np.zeros((3, 72, 71))))) == ["truth.view"]
    assert wrong_fields(nominal_pad()._replace(young=3)) == ["young"]
