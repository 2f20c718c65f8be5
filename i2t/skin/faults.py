"""Faults of a real skin besides noise; each is a small function, and size zero turns it off.

`apply` takes the readings of one session in order, and composes the faults in their physical order:

  the layer     softens with use, creeps while it is held, and keeps a part of the previous press;
  the field     also contains those of the earth and the room, which rotate with the arm;
  the chip      warms and saturates; `i2t.skin.noise` comes next.

Additive fields that change slowly reach a reading only by their change since the last measurement of the ambient (see
`subtract_ambient`). `Faults.ambient_every` is its interval: by default every touch, as in the paper's procedure and in
`i2t.collect`. Data of that procedure also contain one ambient for every ten touches, and other recordings one for a
session. An ambient of the same touch removes the uniform fields of earth and room, because the tool does not rotate
after it, but not the drift in the seconds until the reading (`Faults.ambient_lag`).

Properties of a board, in contrast to those of a session, are drawn from `board_key`: the chip with hysteresis, the
chips' own drifts and the place where the board is used. Softening continues over the sessions of a pad.

Default sizes are those of real boards if a recording exists, and otherwise from the literature. Each docstring names
the source, and states if a size is an assumption. Readings are microtesla in the board's order and the chips' own axes;
W is the world, z up. Functions of one reading are lifted by `vmap`.
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

# uT, full scale of x and y, and of z, at which simulated fields are clipped: 2^15 steps at gain 7 and resolution 0
# (MLX90393 data sheet)
RANGE_XY_UT, RANGE_Z_UT = 4915.0, 7930.0


@dataclass(frozen=True)
class FaultModel:
    """Assumptions of all simulated faults: dip of the earth's field (rad), relaxation and hold times (s), shares."""

    # rad, dip of the earth's field below the horizon in central Europe (IGRF-13, 2020)
    earth_dip: float = np.deg2rad(64.0)
    # Relaxation times (s). One share for each decade makes relaxation linear in log time, as elastomers show.
    prony_times: tuple[float, ...] = (0.3, 3.0, 30.0)
    # A contact of 10 mm2 covers the pad once in 40 presses, and a place softens with its first presses.
    wear_presses: float = 40.0
    hold_time: float = 1.0  # s, mean time from contact to the reading
    layer_share: float = 0.2  # share of a press's travel that the layer takes up and not the arm; see `creep`
    # relative spread of the chips' warming; chips warmed by 10 K differ by up to 2.4 K, as recorded
    warming_spread: float = 0.12


FAULT_MODEL = FaultModel()  # assumptions about simulated faults, the same for all boards and sessions

Size: TypeAlias = float | Float[Array, ""]  # size of a fault; traced if `Faults` is


@traced_floats
@dataclass(frozen=True)
class Faults:
    """Sizes of the simulated faults of a skin on one board in one session; 0 turns a fault off, all off by default.

    Example:
        errors = i2t.SimulationErrors(faults=i2t.Faults(hysteresis=0.3))  # and no other fault
    """

    softening: float = 0.0  # final relative growth of readings with use (Mullins softening); see `mullins_softening`
    relaxation: float = 0.0  # final share of the layer's stress that relaxes; see `creep`
    hysteresis: float = 0.0  # share of the previous press that one chip keeps; see `apply_hysteresis`
    earth: float = 0.0  # uT, strength of the earth's field; see `ambient_field`
    room: float = 0.0  # uT, standard deviation of each component of the room's field
    warming: float = 0.0  # K, warming over the session; see `temperature_drift` and `apply_warming`
    range_xy: float = 0.0  # uT, full scale of x and y; see `saturate`
    range_z: float = 0.0  # uT, full scale of z
    # Procedure of the session, without effect while the sizes above are zero:
    # number of touches between measurements of the ambient; 0 for a single one before the session
    ambient_every: int = 1
    ambient_lag: float = 0.2  # time from an ambient to its reading, in times from touch to touch; `temperature_drift`

    @classmethod
    def typical(cls) -> "Faults":
        """Return the sizes of faults of real boards in good order, with the ambient measured at every touch."""
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
    """Derive the random key of the faults that stay with a board over its sessions.

    Boards are distinguished by the gains of their chips; boards with equal gains count as one board.

    Args:
        gains: `(c,)` gains of the board's axes (`Pad.gains`).

    Returns:
        The key; equal gains give equal keys.
    """
    bits = jax.lax.bitcast_convert_type(gains.astype(jnp.float32), jnp.uint32)
    places = jnp.arange(1, 2 * gains.shape[-1], 2, dtype=jnp.uint32)  # odd factors lose no bit, and the order matters
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
    """Apply the faults of a sensor, such as softening, hysteresis, drift and saturation, to readings of one session.

    Args:
        key: Random key of the session.
        readings: `(n, c)` readings (uT) in the order in which they were made.
        T_w_t: `(n, 4, 4)` poses of the tool.
        board: The board below the skin.
        faults: Sizes of the faults.
        key_board: Random key of the board, the same in all its sessions; see `board_key`.
        rest: `(c,)` field (uT) of the pad itself at the chips when nothing touches it (`dipoles.rest_field` through
            `board.to_board`). Saturation starts from it, and warming weakens it.
        presses_before: Number of presses on the pad in earlier sessions.

    Returns:
        `(n, c)` readings (uT) with the faults.
    """
    n, channels = readings.shape
    # Here and below, one more key is split off than is used, so that the draws of a seed stay the same.
    key_hold, _, key_warm = jax.random.split(key, 3)
    key_memory, key_place, key_offset, _ = jax.random.split(jax.random.fold_in(key_board, 0), 4)

    presses = presses_before + jnp.arange(n)
    seconds = 2 * FAULT_MODEL.hold_time * jax.random.uniform(key_hold, (n,))
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
    """Warm the skin; return the readings, and the drifts of zero at the readings and at their touches' ambients."""
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
    """Apply softening by use: at a given force, readings grow towards 1 + `size` times as presses wear the pad.

    This is the Mullins effect: silicones soften only in their first load cycles (Case, White and Kramer, Soft Robotics
    2, 2015; Liao et al., Int. J. Mech. Sci. 206, 2021), which here happen place by place. The default of a tenth is an
    assumption, because no value for strains of some 10 % was found.

    Args:
        reading: `(c,)` reading (uT) of a new layer.
        presses: Number of presses that the pad has had.
        size: Final relative growth.

    Returns:
        `(c,)` reading (uT) of the used layer.
    """
    return reading * (1 + size * (1 - jnp.exp(-presses / FAULT_MODEL.wear_presses)))


def remaining_stress(seconds: Size, size: Size = 0.05) -> Float[Array, ""]:
    """Compute the share of the layer's stress that is left after a hold: a Prony series with shares of size / 3.

    Args:
        seconds: Duration (s) of the hold.
        size: Share of the stress that relaxes finally.

    Returns:
        A share between 1 - `size` and 1.
    """
    return 1 - size * jnp.mean(1 - jnp.exp(-seconds / jnp.asarray(FAULT_MODEL.prony_times)))


def creep(
    reading: Float[Array, " c"],
    seconds: Size,
    size: Size = 0.05,
    yielding: float = FAULT_MODEL.layer_share,
) -> Float[Array, " c"]:
    """Compute the growth of a reading while the touch is held and the stress in the layer relaxes.

    A held indentation keeps the layer's shape, and so its field. The arm yields, however: with s = layer / (layer +
    arm), the share of the press that the arm takes up, the indentation grows by 1 / (1 - s (1 - g)) when the share g of
    the stress is left, and the reading is assumed to grow with it. s = 0.2 is a tip of 2.5 N/mm on an arm of 10 N/mm; 0
    is a held indentation, 1 a held force. The relaxation of 5 % is an assumption: silicone relaxes considerably when
    new and hardly after earlier strain (Liao et al., Polymer Testing 86, 2020), and skins are in use.

    Args:
        reading: `(c,)` reading (uT) at the start of the hold.
        seconds: Duration (s) of the hold.
        size: Share of the stress that relaxes finally.
        yielding: The share s, from 0 for a held indentation to 1 for a held force.

    Returns:
        `(c,)` reading (uT) at the end of the hold.
    """
    return reading / (1 - yielding * (1 - remaining_stress(seconds, size)))


def apply_hysteresis(key: Key[Array, ""], readings: Float[Array, "n c"], size: Size = 0.3) -> Float[Array, "n c"]:
    """Add hysteresis: one chip, drawn for the board, adds a share of the previous press to each reading.

    On a real ReSkin board one chip was off by up to 35 uT after a press, while a strong press is 107 uT (p95);
    hysteresis and slip cannot be distinguished there. The share is negative if the ambient was measured while the
    memory was present and the press erases it.

    Args:
        key: Random key of the board.
        readings: `(n, c)` readings (uT) of the session's touches in order.
        size: Share of the previous press's reading that the chip adds to the next one; may be negative.

    Returns:
        `(n, c)` readings (uT) with hysteresis.
    """
    chips = readings.shape[-1] // 3
    chip = jnp.repeat(jnp.arange(chips) == jax.random.randint(key, (), 0, chips), 3)
    before = jnp.concatenate([jnp.zeros_like(readings[:1]), readings[:-1]])
    return readings + size * jnp.where(chip[None], before, 0.0)


def ambient_field(key: Key[Array, ""], earth: Size = 48.0, room: Size = 10.0) -> Float[Array, "3"]:
    """Draw the uniform ambient field of a place: the earth's, with its dip and a random bearing, and the room's.

    48 uT is the value in central Europe (IGRF-13, 2020). Iron in walls, table and robot adds tens of microtesla; 10 uT
    for each component is an assumption, and so is a large distance to the robot's own iron.

    Args:
        key: Random key.
        earth: Strength of the earth's field (uT).
        room: Standard deviation (uT) of each component of the room's field.

    Returns:
        `(3,)` field (uT) in world axes.
    """
    key_bearing, key_room = jax.random.split(key)
    bearing = jax.random.uniform(key_bearing, maxval=2 * np.pi)
    level = jnp.stack([jnp.cos(bearing), jnp.sin(bearing)]) * np.cos(FAULT_MODEL.earth_dip)
    return earth * jnp.append(level, -np.sin(FAULT_MODEL.earth_dip)) + room * jax.random.normal(key_room, (3,))


@geometry.full_precision
def ambient(T_w_t: Float[Array, "4 4"], field: Float[Array, "3"], board: Board) -> Float[Array, " c"]:
    """Compute the reading of a uniform ambient field: one vector for all chips, each in its own axes.

    Args:
        T_w_t: Pose of the tool.
        field: `(3,)` field (uT) in world axes.
        board: The board that reads it.

    Returns:
        `(c,)` reading (uT).
    """
    return board.to_board(jnp.broadcast_to(T_w_t[:3, :3].T @ field, (board.num_chips, 3)))


def subtract_ambient(values: Float[Array, "n c"], before: Float[Array, "n c"], every: int) -> Float[Array, "n c"]:
    """Subtract from slow additive terms their values at the last measurement of the ambient.

    If the ambient is measured at each touch, in the pose of the touch, this removes all that did not change until the
    reading.

    Args:
        values: `(n, c)` terms (uT) at the reading of each touch of a session.
        before: `(n, c)` terms (uT) at the time of each touch's ambient, whether it is measured or not.
        every: Number of touches between measurements of the ambient; 0 if only the first touch has one.

    Returns:
        `(n, c)` differences (uT).
    """
    touch = np.arange(values.shape[0])
    return values - before[touch // every * every if every else 0 * touch]


def temperature_drift(
    key: Key[Array, ""], touches: int, chips: int, size: Size = 10.0, lag: Size = 0.0
) -> Float[Array, "n chips"]:
    """Compute the warming of each chip at each touch of a session that begins cold.

    All but a twentieth of `size` is reached by the end of the session, exponentially in the number of the touch. Real
    boards were recorded at 22-32 C, with chips 1-2.5 K apart. From an ambient to its reading a press of 5 mm at 2 mm/s
    takes up to 3 s, of some 15 s from touch to touch: the lag of `Faults` is 0.2.

    Args:
        key: Random key.
        touches: Number of touches in the session.
        chips: Number of chips of the board.
        size: Final warming (K).
        lag: Delay of the touches, in times from touch to touch.

    Returns:
        `(n, chips)` warming (K).
    """
    uneven = FAULT_MODEL.warming_spread * jax.random.uniform(key, (chips,), minval=-1.0)
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
    """Compute a reading in a warmer skin, and the drift of its zero.

    The magnets weaken by 0.12 % per kelvin (remanence of neodymium magnets, makers' tables). The reading falls by that
    factor, and the zero by that share of the pad's own field at rest (6 uT/K at 5 mT, enough for the drifts of up to 64
    uT that real boards show). The chips' own drift is the remainder, drifts of 1-15 uT over 10 K on boards with a weak
    pad.

    Args:
        reading: `(c,)` reading (uT) of the cold skin.
        rest: `(c,)` field (uT) of the pad at rest.
        kelvin: `(chips,)` warming of each chip (K).
        offset: `(c,)` standard normal numbers for the chips' own drifts.
        gain: Relative change of the magnets per kelvin.
        drift: Standard deviation of the chips' own drifts (uT/K).

    Returns:
        `(c,)` reading and `(c,)` drift of its zero (uT).
    """
    warmer = jnp.repeat(kelvin, 3)
    return reading * (1 + gain * warmer), warmer * (gain * rest + drift * offset)


def saturate(
    reading: Float[Array, " c"], rest: Float[Array, " c"], range_xy: Size = RANGE_XY_UT, range_z: Size = RANGE_Z_UT
) -> Float[Array, " c"]:
    """Limit a reading where the field along each axis reaches the chip's full scale.

    16 bits: 2^15 steps of 0.150 uT (x, y) and 0.242 uT (z) at gain 7 and resolution 0 (MLX90393 data sheet, sensitivity
    table; its list of features gives 5 mT as the smallest range).

    Args:
        reading: `(c,)` change of the field (uT).
        rest: `(c,)` field (uT) from which the change begins.
        range_xy: Full scale of x and y (uT); 0 for no limit.
        range_z: Full scale of z (uT); 0 for no limit.

    Returns:
        `(c,)` change (uT) that is read.
    """
    limit = jnp.tile(jnp.array([range_xy, range_xy, range_z]), reading.shape[-1] // 3)
    limit = jnp.where(limit > 0, limit, jnp.inf)
    # Written as a correction, so that a reading in range stays exact and is not rounded to the field at rest.
    total = rest + reading
    over = total - jnp.clip(total, -limit, limit)
    return reading - over + (rest - jnp.clip(rest, -limit, limit))
