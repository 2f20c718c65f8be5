"""Contact of a tool that carries several skins: each meets the scene at its own pose, and their forces add up.

Frames: B robot base, T tool, S skin; `T_a_b` maps points in b to a. Metres, newtons.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from i2t.emulators.scene import ContactModel, TouchableScene
from i2t.types import Array


class CarriedContact:
    """The contact of a skin that is not in the tool's frame.

    Args:
        model: Of the skin.
        T_tool_skin: (4, 4) where it is.
    """

    def __init__(self, model: ContactModel, T_tool_skin: Float[Array, "4 4"]) -> None:
        self.model, self._T_tool_skin = model, np.asarray(T_tool_skin, float)

    def pose(self, position: Float[Array, "3"], turned: Float[Array, "3 3"]) -> tuple[Array, Array]:
        """Pose of the skin.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.

        Returns:
            Position (3,) m and rotation (3, 3) of the skin in the base.
        """
        return position + turned @ self._T_tool_skin[:3, 3], turned @ self._T_tool_skin[:3, :3]

    def __call__(self, position: Float[Array, "3"], turned: Float[Array, "3 3"]) -> Float[Array, "6"]:
        """Wrench of the skin's contact.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.

        Returns:
            Wrench (6,) on the tool about its own origin, N and Nm, base axes.
        """
        at, own_turned = self.pose(position, turned)
        wrench = self.model(at, own_turned)
        lever = np.cross(at - position, wrench[:3])
        return np.concatenate([wrench[:3], wrench[3:] + lever])


class SeveralContacts:
    """The contact of a tool with several skins, as an `i2t.emulators.robot_motion.Robot` asks for it.

    Args:
        own: Of the skin in the tool's frame.
        carried: Of the others.
    """

    def __init__(self, own: ContactModel, carried: Sequence[CarriedContact]) -> None:
        self.own, self.carried = own, list(carried)

    @property
    def scene(self) -> TouchableScene:
        """Scene that the skin in the tool's frame meets."""
        return self.own.scene

    @property
    def busy(self) -> bool:
        """Tell whether the contact ahead of a skin is being worked out."""
        return self.own.busy or any(each.model.busy for each in self.carried)

    def __call__(self, position: Float[Array, "3"], turned: Float[Array, "3 3"]) -> Float[Array, "6"]:
        """Wrench on the tool at a pose.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.

        Returns:
            (6,) N and Nm, base axes.
        """
        return np.asarray(sum((each(position, turned) for each in self.carried), start=self.own(position, turned)))

    def far(self, position: Float[Array, "3"], turned: Float[Array, "3 3"]) -> bool:
        """Test whether no skin is near what it will meet.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.

        Returns:
            False where the motion has to be followed in small steps.
        """
        return self.own.far(position) and all(each.model.far(each.pose(position, turned)[0]) for each in self.carried)

    def stands(self, position: Float[Array, "3"], turned: Float[Array, "3 3"]) -> None:
        """Work out what is ahead of each skin of a tool that stands somewhere.

        Args:
            position: (3,) m, of the tool in the base.
            turned: (3, 3) rotation of the tool in the base.
        """
        self.own.stands(position, turned)
        for each in self.carried:
            each.model.stands(*each.pose(position, turned))
