"""The result of a registration: an object's pose with its covariance."""

from typing import NamedTuple

from jaxtyping import Array, Float

from i2t.types import in_one_line


@in_one_line
class PoseEstimate(NamedTuple):
    """An object's pose in the world, the covariance (m^2) of its twist, the residual (m) and weight of each touch or
    point, and the cost (minus the log density of the posterior).

    Example:
        estimate = i2t.register_by_depth(mesh, T_w_o, depth, camera, T_w_c)
        estimate.T_w_o, jnp.sqrt(jnp.diag(estimate.covariance))  # the pose and its standard deviations (m)
    """

    T_w_o: Float[Array, "4 4"]  # the object's estimated pose in the world
    # m^2, of the twist x (`i2t.geometry.from_twist`) in T_w_o from_twist(x), prior included
    covariance: Float[Array, "6 6"]
    residual: Float[Array, " n"]  # m, residual of each touch or point
    weight: Float[Array, " n"]  # weight of each residual, from 0 for an outlier to about 1
    cost: Float[Array, ""]  # minus the logarithm of the posterior density, up to a constant
