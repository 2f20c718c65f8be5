"""Tasks of active touch: which object it is, or where it is.

A task says how an object may stand, what a prediction is and how wrong it is. Another task, say which shape an object
has, is another class with these methods (`TouchTask`); nothing else of an environment changes.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from i2t.geometry import random_motion, so3_exp, transform
from i2t.simulation.touches import SimulationErrors

SAFETY_STEPS = (-1.0, 0.0, 1.0)  # of each of a planar pose's numbers, where touches must be safe


@runtime_checkable
class TouchTask(Protocol):
    """Task to be solved by touch."""

    @property
    def name(self) -> str:
        """Name by which it is registered."""

    def prediction_size(self, objects: int) -> int:
        """Number of values of a prediction.

        Args:
            objects: of the environment.

        Returns:
            The number.
        """

    def placement(self, key: Key[Array, ""], errors: SimulationErrors) -> Float[Array, "4 4"]:
        """Pose of an object in an episode, T_w_o.

        Args:
            key: random key.
            errors: of the lab.

        Returns:
            T_w_o.
        """

    def safety_placements(self) -> Float[np.ndarray, "h 4 4"]:
        """Poses at which objects may be thought to stand: a touch has to be safe on each object at each of these.

        Returns:
            T_w_o of the hypotheses.
        """

    def target(self, which: Int[Array, ""], T_w_o: Float[Array, "4 4"], objects: int) -> Float[Array, " p"]:
        """Prediction that is perfect.

        Args:
            which: the object that is there.
            T_w_o: and where it is.
            objects: of the environment.

        Returns:
            The prediction without loss, or what a loss compares it with.
        """

    def loss(self, prediction: Float[Array, " p"], target: Float[Array, " p"]) -> Float[Array, ""]:
        """Error of a prediction; rewards are its negative.

        Args:
            prediction: of an agent.
            target: the truth.

        Returns:
            The loss.
        """


@dataclass(frozen=True)
class WhichObject:
    """Recognition of one of some objects. It stands where it is believed to, but for the lab's placement errors.

    A prediction is a logit of each object; the loss is the cross entropy (nats).
    """

    name: str = "which-object"

    def prediction_size(self, objects: int) -> int:
        """One logit for each object.

        Args:
            objects: of the environment.

        Returns:
            Their number.
        """
        return objects

    def placement(self, key: Key[Array, ""], errors: SimulationErrors) -> Float[Array, "4 4"]:
        """At the world's origin, up to the errors of placement.

        Args:
            key: random key.
            errors: of the lab.

        Returns:
            T_w_o.
        """
        return random_motion(key, errors.placement, errors.placement_angle)

    def safety_placements(self) -> Float[np.ndarray, "h 4 4"]:
        """The believed placement alone, as in a lab.

        Returns:
            The identity.
        """
        return np.eye(4, dtype=np.float32)[None]

    def target(self, which: Int[Array, ""], T_w_o: Float[Array, "4 4"], objects: int) -> Float[Array, " p"]:
        """The object that is there.

        Args:
            which: its index.
            T_w_o: where it is.
            objects: of the environment.

        Returns:
            1 for that object, 0 for others.
        """
        return jax.nn.one_hot(which, objects)

    def loss(self, prediction: Float[Array, " p"], target: Float[Array, " p"]) -> Float[Array, ""]:
        """Cross entropy.

        Args:
            prediction: logits.
            target: 1 for the object that is there.

        Returns:
            The loss (nats).
        """
        return -jnp.sum(target * jax.nn.log_softmax(prediction))


@dataclass(frozen=True)
class WhereIsIt:
    """Localisation of an object on the table. It was shifted and turned about the vertical, uniformly within bounds.

    A prediction is shift along x, shift along y and turn, each as a fraction of its bound; the loss is their mean
    square error.
    """

    name: str = "where-is-it"
    extent: float = 8e-3  # m, of the shift to either side
    turn: float = 0.5  # rad, to either side

    def prediction_size(self, objects: int) -> int:
        """Shift and turn.

        Args:
            objects: of the environment.

        Returns:
            Three.
        """
        return 3

    def placement(self, key: Key[Array, ""], errors: SimulationErrors) -> Float[Array, "4 4"]:
        """Anywhere within the bounds.

        Args:
            key: random key.
            errors: of the lab, which do not matter within such bounds.

        Returns:
            T_w_o.
        """
        return self._pose(jax.random.uniform(key, (3,), minval=-1.0, maxval=1.0))

    def safety_placements(self) -> Float[np.ndarray, "h 4 4"]:
        """The middle and the ends of each bound.

        Returns:
            T_w_o of 27 placements.
        """
        numbers = np.stack(np.meshgrid(*[SAFETY_STEPS] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(jax.vmap(self._pose)(jnp.asarray(numbers, jnp.float32)))

    def target(self, which: Int[Array, ""], T_w_o: Float[Array, "4 4"], objects: int) -> Float[Array, " p"]:
        """Shift and turn, as fractions of their bounds.

        Args:
            which: the object.
            T_w_o: where it is.
            objects: of the environment.

        Returns:
            Three numbers between -1 and 1.
        """
        turn = jnp.arctan2(T_w_o[1, 0], T_w_o[0, 0])
        return jnp.stack([T_w_o[0, 3] / self.extent, T_w_o[1, 3] / self.extent, turn / self.turn])

    def loss(self, prediction: Float[Array, " p"], target: Float[Array, " p"]) -> Float[Array, ""]:
        """Mean square error.

        Args:
            prediction: fractions of the bounds.
            target: likewise.

        Returns:
            The loss; 1/3 for whoever always says 0.
        """
        return jnp.mean((prediction - target) ** 2)

    def _pose(self, number: Float[Array, "3"]) -> Float[Array, "4 4"]:
        """T_w_o of fractions of the bounds."""
        zero = jnp.zeros(())
        shift = jnp.stack([self.extent * number[0], self.extent * number[1], zero])
        return transform(so3_exp(jnp.stack([zero, zero, self.turn * number[2]])), shift)
