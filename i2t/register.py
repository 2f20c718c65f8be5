"""Where an object really is: its pose from touches that probe it, or from a depth image, and how well either tells it.

The object is believed at `T_w_o` and stands at `T_w_o exp(x)`, where x (6,) is a twist in its own frame as in
`i2t.refine`: three translations (m), then three rotations times `LEVER`, all in metres.

Touches. At first contact the skin's flat square face just meets the surface: the gap to the lowest surface point inside
the square (`i2t.touch.nearest_in_square`) is zero up to noise. On a steep facet a sideways error changes the gap more
than itself, so a residual is the gap over the length of its derivative by translations, the distance along the normal
(Sampson, "Fitting conic sections to very scattered data", 1982). With x normal before and residuals distributed as
Student's t (Lange, Little and Taylor, "Robust statistical modeling using the t distribution", 1989), the most probable
x is sought by Levenberg-Marquardt steps on the reweighted squares, while the noise shrinks from the size of the prior's
own errors to what it is (deterministic annealing; Rose, "Deterministic annealing for clustering, compression,
classification, regression, and related optimization problems", 1998). The contact of edges and corners is not smooth,
so the search starts from several draws of the prior and keeps the most probable end. The inverse of the last
Gauss-Newton matrix is the covariance (Laplace's method); what no touch tells keeps the prior's.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Key

from i2t.geometry import full_precision, invert
from i2t.refine import EASE, LEVER, STIFFEN, motion
from i2t.touch import nearest_in_square
from i2t.types import PAD_WINDOW, STANDOFF, ReturnCode, Surface, Touches

FREEDOM = 4.0  # degrees of freedom of Student's t: the usual compromise of Lange et al.
LEAST_DAMPING, MOST_DAMPING = 1e-3, 1e6  # of the Gauss-Newton matrix's diagonal
UNSEEN = 1e3  # m, residual of a motion that was not looked at yet: worse than any


@dataclass(frozen=True)
class Probing:
    """How a pose is sought from touches."""

    starts: int = 12  # draws of the prior; the first is its mean
    cooling: int = 10  # steps while the noise shrinks
    steps: int = 10  # and at its true size
    half: float = PAD_WINDOW / 2  # m, half edge of the face
    faces: int = 128  # of the surface at each touch: those that could come nearest


class Registered(NamedTuple):
    """A pose, how well it is known, and how well it explains what was measured."""

    T_w_o: Float[Array, "4 4"]
    covariance: Float[Array, "6 6"]  # m^2, of the twist x in T_w_o exp(x)
    residual: Float[Array, " n"]  # m, of each touch or point
    weight: Float[Array, " n"]  # of each, from 0 for an outlier to about 1
    cost: Float[Array, ""]  # minus the logarithm of the posterior density, up to a constant


class _Seen(NamedTuple):
    """What a motion leaves, with derivatives by the motion in standard deviations of the prior."""

    residual: Float[Array, " n"]  # m, along the surface's normal
    slopes: Float[Array, "n 6"]
    stretch: Float[Array, " n"]  # of the gap along tool z against that


class _Probe(NamedTuple):
    """The best motion so far, in standard deviations of the prior, what it leaves, and what to try next."""

    z: Float[Array, "6"]
    seen: _Seen
    trial: Float[Array, "6"]
    damping: Float[Array, ""]


def first_contacts(touches: Touches) -> tuple[Float[Array, "n 4 4"], Bool[Array, " n"]]:
    """Poses of first contact of recorded touches, and which of them met the object: each is the pose at the end of the
    press, taken back along tool z by the measured travel past contact.
    """
    met = jnp.isfinite(touches.depth)
    met &= (touches.code == ReturnCode.SKIN) | (touches.code == ReturnCode.WRENCH)
    back = jnp.where(met, touches.depth, 0.0)
    return touches.T_w_t.at[:, :3, 3].add(-back[:, None] * touches.T_w_t[:, :3, 2]), met


@full_precision
def by_touch(
    key: Key[Array, ""],
    surface: Surface,
    T_w_o: Float[Array, "4 4"],
    T_w_contact: Float[Array, "n 4 4"],
    weight: Float[Array, " n"] | Bool[Array, " n"],
    distance: float | Float[Array, ""],
    angle: float | Float[Array, ""],
    noise: float | Float[Array, ""] = 0.1e-3,
    how: Probing = Probing(),
) -> Registered:
    """The most probable pose of an object believed at `T_w_o` that was met at the tool poses `T_w_contact`.

    Before, each axis is normal with standard deviation `distance` (m) and `angle` (rad); contact is known to `noise`
    (m), which counts the arm, the skin's tilt times its half edge, and the object's shape. `weight` 0 (or false) leaves
    a touch out, whatever its pose holds: one in air. Iterations and starts are static.
    """
    spread = jnp.stack([jnp.asarray(distance, jnp.float32)] * 3 + [jnp.asarray(angle * LEVER, jnp.float32)] * 3)
    weight = jnp.asarray(weight, jnp.float32)
    T_w_t = jnp.where((weight > 0)[:, None, None], T_w_contact, jnp.eye(4)[None])
    T_t_o = jax.vmap(lambda T: invert(T) @ T_w_o)(T_w_t)
    triangles = jax.vmap(lambda T: _candidates(surface, T, how, 3 * distance, 3 * angle))(T_t_o)

    def look_once(x, T, triangles):
        face = triangles[jnp.argmin(_gaps(triangles, T @ motion(x), how.half))]
        gap, slope = jax.value_and_grad(lambda x: _gap(face, T @ motion(x), how.half))(x)
        stretch = jnp.maximum(jnp.linalg.norm(slope[:3]), 1.0)
        return _Seen(gap / stretch, slope / stretch, stretch)

    def look(z):
        seen = jax.vmap(look_once, (None, 0, 0))(spread * z, T_t_o, triangles)
        told = (weight > 0) & jnp.isfinite(seen.slopes).all(axis=1)
        return _Seen(
            jnp.where(weight > 0, seen.residual, 0.0),
            jnp.where(told[:, None], seen.slopes * spread[None], 0.0),
            jnp.where(told, seen.stretch, 1.0),
        )

    def cost(z, seen, scale):
        """Minus the logarithm of the posterior."""
        surprise = (FREEDOM + 1) / 2 * jnp.log1p((seen.residual / scale) ** 2 / FREEDOM) + jnp.log(seen.stretch)
        return 0.5 * z @ z + weight @ surprise

    def normal(seen, scale):
        """Weights of the squares that have the t distribution's slope, and the Gauss-Newton matrix."""
        share = weight * (FREEDOM + 1) / (FREEDOM + (seen.residual / scale) ** 2)
        return share, seen.slopes.T @ (share[:, None] * seen.slopes) / scale**2 + jnp.eye(6)

    def step(probe, scale):
        """Look where the last step led, keep it if it is better, and lead on from what was kept."""
        seen = probe._replace(z=probe.trial, seen=look(probe.trial), damping=probe.damping * EASE)
        back = probe._replace(damping=probe.damping * STIFFEN)
        better = cost(seen.z, seen.seen, scale) <= cost(back.z, back.seen, scale)
        probe = jax.tree.map(lambda new, old: jnp.where(better, new, old), seen, back)
        share, matrix = normal(probe.seen, scale)
        gradient = probe.seen.slopes.T @ (share * probe.seen.residual) / scale**2 + probe.z
        damping = jnp.clip(probe.damping, LEAST_DAMPING, MOST_DAMPING)
        damped = matrix + damping * jnp.diag(jnp.diagonal(matrix))
        trial = probe.z - jax.scipy.linalg.solve(damped, gradient, assume_a="pos")
        return probe._replace(trial=trial, damping=damping), None

    noise = jnp.asarray(noise, jnp.float32)
    wide = jnp.maximum(noise, jnp.hypot(spread[0], spread[3]))  # how far the prior may be off at the face
    fraction = jnp.minimum(jnp.arange(how.cooling + how.steps) / how.cooling, 1.0)
    scales = wide ** (1 - fraction) * noise**fraction

    def search(z):
        blind = _Seen(jnp.full(len(weight), UNSEEN), jnp.zeros((len(weight), 6)), jnp.ones(len(weight)))
        end, _ = jax.lax.scan(step, _Probe(z, blind, z, jnp.float32(LEAST_DAMPING)), scales)
        return end, cost(end.z, end.seen, noise)

    drawn = jax.random.normal(key, (how.starts, 6)).at[0].set(0.0)
    ends, costs = jax.lax.map(search, drawn)
    best = jnp.argmin(costs)
    end = jax.tree.map(lambda leaf: leaf[best], ends)
    share, matrix = normal(end.seen, noise)
    covariance = spread[:, None] * jnp.linalg.inv(matrix) * spread[None]
    return Registered(T_w_o @ motion(spread * end.z), covariance, end.seen.residual, share, costs[best])


def _gap(triangle: Float[Array, "3 3"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, ""]:
    """Gap (m) between the square face and a triangle, negative where they overlap; one beside the face is far off."""
    gap = nearest_in_square(Surface(triangle[None]), T_t_o, half)
    return jnp.where(gap < jnp.inf, gap, STANDOFF)


def _gaps(triangles: Float[Array, "k 3 3"], T_t_o: Float[Array, "4 4"], half: float | Array) -> Float[Array, " k"]:
    return jax.vmap(_gap, (0, None, None))(triangles, T_t_o, half)


def _candidates(
    surface: Surface, T_t_o: Float[Array, "4 4"], how: Probing, distance: float | Array, angle: float | Array
) -> Float[Array, "k 3 3"]:
    """The faces that come nearest when the object moves sideways by up to `distance` (m) and turns by `angle` (rad)."""
    triangles = jnp.asarray(surface.triangles)
    arm = jnp.linalg.norm(T_t_o[:3, 3])
    gaps = _gaps(triangles, T_t_o, how.half + distance + angle * arm)
    _, nearest = jax.lax.top_k(-gaps, min(how.faces, len(triangles)))
    return triangles[nearest]
