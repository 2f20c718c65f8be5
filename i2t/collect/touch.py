"""Touch of a session: its site, its outcome, its errors, and its recorder.

Frames: W world, B robot base, T tool, C camera; `T_a_b` maps points in b to a. Metres, newtons, microtesla.
"""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

from jaxtyping import Float

from i2t.collect.event_log import TouchLog
from i2t.depth.camera import Camera
from i2t.errors import DeviceError
from i2t.hardware.protocols import SkinCounters, StopReason, View
from i2t.skin.ambient import AmbientChange
from i2t.types import Array, ReturnCode


class Site(NamedTuple):
    """Site to touch: the skin's pose where it would just lie on the surface."""

    number: int
    T_w_t: Float[Array, "4 4"]


class SeenPatch(NamedTuple):
    """Patch in front of the skin, as the camera saw it."""

    patch: Float[Array, "48 48"]  # m
    wide: Float[Array, "72 72"]  # m
    nearest: float  # m
    visible_share: float  # of the patch's pixels, that were measured


class CarriedTouch(NamedTuple):
    """Reading of a further skin on the tool in one touch."""

    T_w_s: Float[Array, "4 4"]  # of the skin at the end of the press
    code: ReturnCode  # that of the touch where this skin felt it, else AIR
    ambient: Float[Array, " c"]  # uT
    reading: Float[Array, " c"]  # uT, mean in contact minus ambient
    force: float  # N, along the skin's z; NaN where not this skin alone felt the press
    depth: float  # m past first contact; NaN where this skin felt nothing, or it cannot be told
    seen: SeenPatch | None  # before this skin, in the same view
    counters: SkinCounters  # of this touch alone
    expected_ambient: Float[Array, " c"] | None = None  # uT, by the field fitted from free poses
    ambient_change: AmbientChange | None = None  # whether the ambient contradicts that field


class TouchResult(NamedTuple):
    """A touch as it was made."""

    site: Site
    attempt: int
    code: ReturnCode
    reason: StopReason
    T_w_t: Float[Array, "4 4"]  # at the end of the press
    ambient: Float[Array, " c"]  # uT
    reading: Float[Array, " c"]  # uT, mean in contact minus ambient
    force: float  # N, along tool z; NaN where a further skin felt the press too
    depth: float  # m past first contact; NaN where nothing was met
    seen: SeenPatch | None  # from the pose at the end; None in a history, where images would fill the memory
    view: View | None
    T_w_c: Float[Array, "4 4"]  # from where it was taken
    counters: SkinCounters  # of this touch alone
    expected_ambient: Float[Array, " c"] | None = None  # uT, by the field fitted from free poses
    ambient_change: AmbientChange | None = None  # whether the ambient contradicts that field
    carried: Mapping[str, CarriedTouch] = MappingProxyType({})  # of further skins, by their names


class SiteOutcome(NamedTuple):
    """Outcome of a site, for whoever chooses the next."""

    site: Site
    code: ReturnCode
    reason: str
    touch: TouchResult | None = None


@runtime_checkable
class TouchRecorder(Protocol):
    """Recorder of touches (`i2t.collect.recorder.Recorder`)."""

    def begin(self, site: Site, attempt: int) -> TouchLog:
        """Begin a touch.

        Args:
            site: Where.
            attempt: How often it was tried before.

        Returns:
            The log of this attempt.

        Raises:
            DeviceError: The touch could not be recorded.
        """

    def save(self, touch: TouchResult) -> None:
        """Keep a touch that was made; once this returns it is safe.

        Args:
            touch: The touch, with its patch and view.

        Raises:
            DeviceError: It could not be written.
        """

    def abandon(self, reason: str) -> None:
        """Give up a touch.

        Args:
            reason: Why, as a sentence.
        """


class TouchFailedError(DeviceError):
    """A touch cannot be made here; another site may do."""


class UnreachableError(TouchFailedError):
    """The arm may not go there: trying again is no use."""


class MissedContactError(TouchFailedError):
    """A press met nothing where the camera sees a surface."""


ChooseSite: TypeAlias = Callable[[Sequence[SiteOutcome]], Site | None]
ExtractPatch: TypeAlias = Callable[[View, Camera, Array, Array], SeenPatch]  # view, camera, T_w_c, T_w_t
