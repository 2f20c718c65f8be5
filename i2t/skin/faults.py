"""Faults of a real skin besides noise: each a small function whose size, at zero, switches it off.

`apply` takes the readings of one session in the order in which they were made, and composes the faults as physics does:

  the layer     softens with use, creeps while it is held, and keeps a part of the press before;
  its field     is joined by the earth's and the room's, which turn as the arm does;
  the chip      warms and saturates; `i2t.skin.noise` comes next.

Additive fields that change slowly reach a reading only by their change since the ambient was last measured, see
`subtract_ambient`. How often that is, is `Faults.ambient_every`: by default at every touch, as in the paper's procedure
and in `i2t.collect`; data of that procedure also hold one ambient for every ten touches, and other recordings one for a
session. An ambient of the same touch takes the uniform fields of earth and room away, as the tool does not turn after
it, but not the drift in the seconds until the reading (`Faults.ambient_lag`).

What belongs to a board and not to a session is drawn from `board_key`: the chip that remembers, the chips' own drifts
and the place where the board is used. Softening goes on over the sessions of a pad.

Default sizes are of real boards where a recording exists, and else of the literature; each docstring says which, and
says so where a size is an assumption. Readings are microtesla in the board's order and the chips' own axes; W is the
world, z up. Functions of one reading are lifted by `vmap`.
"""

from dataclasses import dataclass
from typing import TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t import geometry
from i2t.runtime.compiling import traced_floats
from i2t.types import Board

EARTH_DIP_RAD = np.deg2rad(64.0)  # of the earth's field below the horizon in central Europe (IGRF-13, 2020)
PRONY_TIMES_S = (0.3, 3.0, 30.0)  # s: an equal share for each decade, relaxation linear in log time as elastomers show
WEAR_PRESSES = (
    40.0  # presses: a contact of 10 mm2 covers the pad once, and all softening comes with a place's first presses
)
RANGE_XY_UT, RANGE_Z_UT = 4915.0, 7930.0  # uT, full scale: 2^15 steps at gain 7 and resolution 0 (MLX90393 data sheet)
HOLD_TIME_S = 1.0  # s, mean time from contact to the reading
LAYER_SHARE = 0.2  # part of a press that the layer takes up and not the arm; see `creep`
WARMING_SPREAD = 0.12  # of the warming: chips warmed by 10 K lie up to 2.4 K apart, as recorded

Size: TypeAlias = float | Float[Array, ""]  # of a fault; traced where `Faults` is


@traced_floats
@dataclass(frozen=True)
class Faults:
    """Sizes of the faults of one board and session; zero switches one off, and all are off by default."""

    softening: float = 0.0  # final part by which readings grow with use (Mullins softening); see `mullins_softening`
    relaxation: float = 0.0  # final part of the layer's stress that relaxes; see `creep`
    hysteresis: float = 0.0  # part of the press before that one chip keeps (hysteresis); see `apply_hysteresis`
    earth: float = 0.0  # uT; see `ambient_field`
    room: float = 0.0  # uT, standard deviation of each component
    warming: float = 0.0  # K over the session; see `temperature_drift` and `apply_warming`
    range_xy: float = 0.0  # uT, full scale of x and y; see `saturate`
    range_z: float = 0.0  # and of z
    # How the session was made, without effect while the sizes above are zero:
    ambient_every: int = 1  # touches from one measurement of the ambient to the next; 0: once, before the session
    ambient_lag: float = 0.2  # of the time from touch to touch, from an ambient to its reading; see `temperature_drift`

    @classmethod
    def typical(cls) -> "Faults":
        """Sizes as on real boards in order, the ambient measured at every touch."""
        return cls(
            softening=0.1,
            relaxation=0.05,
            hysteresis=0.3,
            earth=48.0,
            room=10.0,
            warming=10.0,
            range_xy=RANGE_XY_UT,
            range_z=RANGE_Z_UT,
        )


def board_key(gains: Float[Array, " c"]) -> Key[Array, ""]:
    """The random key of the faults that stay with a board over its sessions.

    The gains of its chips tell one board from another, and boards of equal gains are one board.

    Args:
        gains: of the board's axes (`Pad.gains`).

    Returns:
        The key; the same gains give the same key.
    """
    bits = jax.lax.bitcast_convert_type(gains.astype(jnp.float32), jnp.uint32)
    places = jnp.arange(1, 2 * gains.shape[-1], 2, dtype=jnp.uint32)  # odd factors: no bit is lost, and order counts
    return jax.random.fold_in(jax.random.key(0), jnp.sum(bits * places))


def apply(
    key: Key[Array, ""],
    readings: Float[Array, "n c"],
    T_w_t: Float[Array, "n 4 4"],
    board: Board,
    faults: Faults,
    *,
    key_board: Key[Array, ""],
    rest: Float[Array, " c"],
    presses_before: Int[Array, ""] | int = 0,
) -> Float[Array, "n c"]:
    """The readings of one session by a faulty sensor (see the module's head).

    Args:
        key: random key of the session.
        readings: uT, in the order made.
        T_w_t: poses of the tool.
        board: whose chips lie below the skin.
        faults: sizes of the faults.
        key_board: random key of the board, the same in all its sessions; see `board_key`.
        rest: uT, what the chips measure of the pad itself when nothing touches it (`dipoles.rest_field` through
            `board.to_board`): saturation starts from there, and warming weakens it.
        presses_before: that the pad had in the sessions before.

    Returns:
        Readings in uT.
    """
    n, channels = readings.shape
    key_hold, _, key_warm = jax.random.split(key, 3)  # one more than is used, and below: the draws of a seed stay
    key_memory, key_place, key_offset, _ = jax.random.split(jax.random.fold_in(key_board, 0), 4)

    presses = presses_before + jnp.arange(n)
    seconds = 2 * HOLD_TIME_S * jax.random.uniform(key_hold, (n,))
    x = jax.vmap(lambda reading, i: mullins_softening(reading, i, faults.softening))(readings, presses)
    x = jax.vmap(lambda reading, held: creep(reading, held, faults.relaxation))(x, seconds)
    x = apply_hysteresis(key_memory, x, faults.hysteresis)

    place = ambient_field(key_place, faults.earth, faults.room)
    seen = jax.vmap(lambda T: ambient(T, place, board))(T_w_t)
    offset = jax.random.normal(key_offset, (channels,))
    x, drifted, drifted_before = _warmed(key_warm, x, rest=rest, offset=offset, chips=board.num_chips, faults=faults)
    x = x + subtract_ambient(seen + drifted, seen + drifted_before, faults.ambient_every)
    return jax.vmap(lambda reading: saturate(reading, rest, faults.range_xy, faults.range_z))(x)


def _warmed(
    key: Key[Array, ""],
    readings: Float[Array, "n c"],
    *,
    rest: Float[Array, " c"],
    offset: Float[Array, " c"],
    chips: int,
    faults: Faults,
) -> tuple[Float[Array, "n c"], Float[Array, "n c"], Float[Array, "n c"]]:
    """Readings in a warming skin, and the drifts of its zero at the readings and at their touches' ambients."""
    early, late = (
        temperature_drift(jax.random.clone(key), len(readings), chips, faults.warming, lag)
        for lag in (0.0, faults.ambient_lag)
    )
    warm = jax.vmap(lambda reading, kelvin: apply_warming(reading, rest, kelvin, offset))
    _, drifted_before = warm(readings, early)
    return (*warm(readings, late), drifted_before)


def mullins_softening(
    reading: Float[Array, " c"], presses: Int[Array, ""] | int, size: Size = 0.1
) -> Float[Array, " c"]:
    """At a given force a used layer yields more: readings grow towards 1 + `size` times as presses wear the pad.

    The Mullins effect: silicones soften in their first load cycles only (Case, White and Kramer, Soft Robotics 2, 2015;
    Liao et al., Int. J. Mech. Sci. 206, 2021), which here come place by place. A tenth is an assumption: for strains
    of some 10 % no figure was found.

    Args:
        reading: uT, of a new layer.
        presses: That the pad has had.
        size: Growth in the end, as a share.

    Returns:
        The reading (uT) of the used layer.
    """
    return reading * (1 + size * (1 - jnp.exp(-presses / WEAR_PRESSES)))


def stress_left(seconds: Size, size: Size = 0.05) -> Float[Array, ""]:
    """Part of the layer's stress that is left after a hold: a Prony series of shares size / 3 at PRONY_TIMES.

    Args:
        seconds: For which the touch was held.
        size: Part that relaxes in the end.

    Returns:
        Between 1 - `size` and 1.
    """
    return 1 - size * jnp.mean(1 - jnp.exp(-seconds / jnp.asarray(PRONY_TIMES_S)))


def creep(
    reading: Float[Array, " c"],
    seconds: Size,
    size: Size = 0.05,
    yielding: float = LAYER_SHARE,
) -> Float[Array, " c"]:
    """Growth of a reading while the touch is held and the stress in the layer relaxes.

    A held depth keeps the layer's shape, and so its field. But the arm yields: with s = layer / (layer + arm), the part
    of the press that the arm takes up, the indentation grows by 1 / (1 - s (1 - g)) where g of the stress is left, and
    the reading is taken to follow it. s = 0.2 is a tip of 2.5 N/mm on an arm of 10 N/mm; 0 is a held depth, 1 a held
    force. 5 % of relaxation is an assumption: silicone relaxes considerably when new and hardly when it was strained
    before (Liao et al., Polymer Testing 86, 2020), and skins are in use.

    Args:
        reading: uT, at the start of the hold.
        seconds: For which the touch is held.
        size: Part of the stress that relaxes in the end.
        yielding: s above.

    Returns:
        The reading (uT) at the end of the hold.
    """
    return reading / (1 - yielding * (1 - stress_left(seconds, size)))


def apply_hysteresis(key: Key[Array, ""], readings: Float[Array, "n c"], size: Size = 0.3) -> Float[Array, "n c"]:
    """Hysteresis: one chip, drawn for the board, adds a part of the press before to each reading.

    On a real ReSkin board one chip was up to 35 uT off after a press, where a strong press is 107 uT (p95);
    hysteresis and slip look alike there. Negative if the ambient was measured on the memory and the press wipes
    it out.

    Args:
        key: Random key, of the board.
        readings: uT, of the session's touches in order.
        size: That part.

    Returns:
        The readings (uT) with it.
    """
    chips = readings.shape[-1] // 3
    chip = jnp.repeat(jnp.arange(chips) == jax.random.randint(key, (), 0, chips), 3)
    before = jnp.concatenate([jnp.zeros_like(readings[:1]), readings[:-1]])
    return readings + size * jnp.where(chip[None], before, 0.0)


def ambient_field(key: Key[Array, ""], earth: Size = 48.0, room: Size = 10.0) -> Float[Array, "3"]:
    """The uniform field of a place: the earth's, at its dip and an unknown compass bearing, and the room's.

    48 uT is central Europe's (IGRF-13, 2020). Iron in walls, table and robot adds tens of microtesla; 10 uT for each
    component is an assumption, as is that the robot's own iron is far.

    Args:
        key: Random key.
        earth: uT, the earth's.
        room: uT, standard deviation of each component of the room's.

    Returns:
        The field (uT, world axes).
    """
    key_bearing, key_room = jax.random.split(key)
    bearing = jax.random.uniform(key_bearing, maxval=2 * np.pi)
    level = jnp.stack([jnp.cos(bearing), jnp.sin(bearing)]) * np.cos(EARTH_DIP_RAD)
    return earth * jnp.append(level, -np.sin(EARTH_DIP_RAD)) + room * jax.random.normal(key_room, (3,))


@geometry.full_precision
def ambient(T_w_t: Float[Array, "4 4"], field: Float[Array, "3"], board: Board) -> Float[Array, " c"]:
    """Reading of a uniform field: one vector for all chips, each in its axes.

    Args:
        T_w_t: Pose of the tool.
        field: uT, world axes.
        board: That reads it.

    Returns:
        The reading (uT).
    """
    return board.to_board(jnp.broadcast_to(T_w_t[:3, :3].T @ field, (board.num_chips, 3)))


def subtract_ambient(values: Float[Array, "n c"], before: Float[Array, "n c"], every: int) -> Float[Array, "n c"]:
    """Slow additive terms minus their values when the ambient was last measured.

    Measured at each touch, in the pose of the touch, it takes all away that did not change until the reading.

    Args:
        values: uT, the terms at each touch of a session, when it is read.
        before: uT, the terms at each touch, when its ambient is measured or would be.
        every: touches from one measurement of the ambient to the next; 0 if only the first touch has one.

    Returns:
        What is left of them (uT).
    """
    touch = np.arange(values.shape[0])
    return values - before[touch // every * every if every else 0 * touch]


def temperature_drift(
    key: Key[Array, ""], touches: int, chips: int, size: Size = 10.0, lag: Size = 0.0
) -> Float[Array, "n chips"]:
    """Warming of each chip at each touch of a session that begins cold: all but a twentieth of `size` by its end.

    Real boards were recorded at 22-32 C, their chips 1-2.5 K apart. Exponential in the number of the touch. From an
    ambient to its reading a press of 5 mm at 2 mm/s takes up to 3 s, of some 15 s from touch to touch: the lag of
    `Faults` is 0.2.

    Args:
        key: Random key.
        touches: Of the session.
        chips: Of the board.
        size: K.
        lag: Part of the time from touch to touch by which the touches are later.

    Returns:
        Warming (K).
    """
    uneven = WARMING_SPREAD * jax.random.uniform(key, (chips,), minval=-1.0)
    course = 1 - jnp.exp(-3 * (jnp.arange(touches) + lag) / max(touches - 1, 1))
    return size * course[:, None] * (1 + uneven)[None]


def apply_warming(
    reading: Float[Array, " c"],
    rest: Float[Array, " c"],
    kelvin: Float[Array, " chips"],
    offset: Float[Array, " c"],
    *,
    gain: float = -1.2e-3,
    drift: float = 0.2,
) -> tuple[Float[Array, " c"], Float[Array, " c"]]:
    """A reading in a warmer skin, and the drift of its zero.

    The magnets weaken by 0.12 % per kelvin (remanence of neodymium magnets, makers' tables): the reading by that
    factor, and the zero by that part of the pad's own field at rest (6 uT/K at 5 mT, enough for the drifts of up to
    64 uT that real boards show). The chips' own drift is what drifts of 1-15 uT over 10 K leave for boards with a weak
    pad.

    Args:
        reading: uT, of the cold skin.
        rest: uT, the pad's own field at rest.
        kelvin: Warming of each chip.
        offset: Standard normal, of the chips' own drifts.
        gain: Change of the magnets per kelvin, as a share.
        drift: uT/K, size of the chips' own drifts.

    Returns:
        The reading and the drift of its zero (uT).
    """
    warmer = jnp.repeat(kelvin, 3)
    return reading * (1 + gain * warmer), warmer * (gain * rest + drift * offset)


def saturate(
    reading: Float[Array, " c"], rest: Float[Array, " c"], range_xy: Size = RANGE_XY_UT, range_z: Size = RANGE_Z_UT
) -> Float[Array, " c"]:
    """A change of field where each axis ends at its full scale.

    16 bits: 2^15 steps of 0.150 uT (x, y) and 0.242 uT (z) at gain 7 and resolution 0 (MLX90393 data sheet, sensitivity
    table; its features name 5 mT as the smallest range).

    Args:
        reading: uT, the change.
        rest: uT, from which it begins.
        range_xy: uT, full scale of x and y; 0 has no end.
        range_z: uT, of z.

    Returns:
        The change (uT) that is read.
    """
    limit = jnp.tile(jnp.array([range_xy, range_xy, range_z]), reading.shape[-1] // 3)
    limit = jnp.where(limit > 0, limit, jnp.inf)
    # Written as a correction, so that a reading in range is left as it is and not rounded to the field at rest.
    total = rest + reading
    over = total - jnp.clip(total, -limit, limit)
    return reading - over + (rest - jnp.clip(rest, -limit, limit))
