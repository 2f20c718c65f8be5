"""Rigid transforms and rotations on single examples; frames as in `i2t.types` (`T_a_b` maps points in b to a).

Rotation vectors follow Rodrigues' formula; it is written with sinc-like series near zero, so that values and gradients
stay finite there (Grassia, "Practical parameterization of rotations using the exponential map", 1998).

Products of poses are `full_precision`: an accelerator may otherwise round their factors to 10 bits, half a millimetre
at arm's length.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from i2t.types import RIGID

full_precision = jax.default_matmul_precision("highest")  # decorates functions that multiply poses


def transform(rotation: Float[Array, "3 3"], translation: Float[Array, "3"]) -> Float[Array, "4 4"]:
    """Build T_a_b from the rotation R_a_b and the position of b in a."""
    return jnp.eye(4).at[:3, :3].set(rotation).at[:3, 3].set(translation)


@full_precision
def inverse(T_a_b: Float[Array, "4 4"]) -> Float[Array, "4 4"]:
    """T_b_a of a rigid T_a_b."""
    R_b_a = T_a_b[:3, :3].T
    return transform(R_b_a, -R_b_a @ T_a_b[:3, 3])


@full_precision
def apply(T_a_b: Float[Array, "4 4"], points: Float[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    """Points in b, expressed in a."""
    return points @ T_a_b[:3, :3].T + jnp.broadcast_to(T_a_b[:3, 3], points.shape)


def is_rigid(T_a_b: Float[Array, "4 4"]) -> Bool[Array, ""]:
    """Whether it is a rotation (within `i2t.types.RIGID`) and a translation, all finite."""
    x, y, z = T_a_b[:3, :3].T
    products = jnp.stack([jnp.sum(x * x) - 1, jnp.sum(y * y) - 1, jnp.sum(x * y), *(jnp.cross(x, y) - z)])
    last = jnp.array_equal(T_a_b[3], jnp.array([0, 0, 0, 1], T_a_b.dtype))
    return jnp.all(jnp.abs(products) <= RIGID) & jnp.all(jnp.isfinite(T_a_b[:3, 3])) & last


@full_precision
def so3_exp(rotvec: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Rotation matrix of a rotation vector (axis times angle, radians)."""
    square = rotvec @ rotvec
    small = square < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    sine = jnp.where(small, 1 - square / 6, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 0.5 - square / 24, (1 - jnp.cos(angle)) / jnp.where(small, 1.0, square))
    x, y, z = rotvec
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return jnp.eye(3) + sine * cross + cosine * cross @ cross


@full_precision
def contact_frame(
    point: Float[Array, "3"], normal: Float[Array, "3"], spin: Float[Array, ""] | float = 0.0
) -> Float[Array, "4 4"]:
    """T_w_t of a skin that lies on `point`, z into the surface (minus its outward unit normal), turned about z by
    `spin` radians.

    Spin 0 turns the frame whose tool points straight down and whose x is the world's by the smallest rotation (the
    paper's alignment); straight up, where that rotation is not unique, it turns about the world's x.
    """
    z = -normal
    # Smallest rotation from down = (0, 0, -1) to z: I + [v] + [v]^2 / (1 + c) with v = down x z, c = down . z.
    c = -z[2]
    v = jnp.stack([z[1], -z[0], jnp.zeros_like(z[0])])
    cross = jnp.stack(
        [jnp.stack([0 * c, 0 * c, v[1]]), jnp.stack([0 * c, 0 * c, -v[0]]), jnp.stack([-v[1], v[0], 0 * c])]
    )
    square = v @ v  # (1 - c)(1 + c), which still knows 1 + c where the sum has lost it to rounding
    upright = (square < 1e-12) & (c < 0)
    scale = jnp.where(c > 0, 1 / jnp.where(c > 0, 1 + c, 1.0), (1 - c) / jnp.where(square < 1e-12, 1.0, square))
    turn = jnp.eye(3) + cross + scale * cross @ cross
    turn = jnp.where(upright, jnp.diag(jnp.array([1.0, -1.0, -1.0])), turn)
    down = jnp.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])  # R_w_t of the tool pointing straight down
    about_z = so3_exp(jnp.stack([0.0 * c, 0.0 * c, jnp.asarray(spin, c.dtype)]))
    return transform(turn @ down @ about_z, point)


def random_motion(key: Key[Array, ""], distance: float | Array, angle: float | Array) -> Float[Array, "4 4"]:
    """A small rigid motion: normal with standard deviation `distance` (m) and `angle` (rad) on each axis."""
    drawn = jax.random.normal(key, (6,))  # one draw: XLA compiles each for half a second
    return transform(so3_exp(angle * drawn[3:]), distance * drawn[:3])
