"""Types of a touch: its site, the skins on the tool, its outcome and its errors.

Frames: W world, B robot base, T tool, S skin, C camera; `T_a_b` maps points in b to a. Metres, newtons, microtesla.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from i2t.depth.camera import Camera
from i2t.errors import DeviceError
from i2t.hardware.protocols import Skin, SkinCounters, StopReason, View
from i2t.types import Array, Board, ReturnCode

TOOL = ""  # key, in a touch's dictionaries of skins, of the skin that presses the object


@dataclass
class SkinOnTool:
    """A skin on the tool (the pressing skin or a further one): driver, board, pose (m) in the tool frame, and names."""

    name: str  # name of the skin in a touch and in files; TOOL for the pressing skin
    skin: Skin
    board: Board
    T_tool_skin: Float[Array, "4 4"] = field(default_factory=lambda: np.eye(4))
    pad: str = ""  # name of the skin in the data set
    note: str = ""  # remark on the positions of its board's chips


class Site(NamedTuple):
    """Site to touch: its number, and the pose (m) of the pressing skin in W at which it just touches the surface."""

    number: int
    T_w_t: Float[Array, "4 4"]


class SeenPatch(NamedTuple):
    """Depth patch (m) in front of a skin as the camera saw it before the touch, its larger view, the position (m) of
    its nearest point along tool z, and the fraction of its pixels that were measured.
    """

    patch: Float[Array, "48 48"]  # m
    view: Float[Array, "72 72"]  # m, the patch with its surroundings
    nearest: float  # m, distance of the nearest surface point along tool z from the tool's origin; negative before it
    visible_share: float  # fraction of the patch's pixels that were measured


class SkinTouch(NamedTuple):
    """Measurements of one skin in a touch: pose, ambient field and change (uT), force (N), travel (m) and patch (m)."""

    T_w_s: Float[Array, "4 4"]  # pose of the skin at the end of the press
    code: ReturnCode  # code of how the press ended if this skin detected it, else AIR
    ambient: Float[Array, " c"]  # uT, mean reading before contact
    reading: Float[Array, " c"]  # uT, mean reading in contact minus ambient
    force: float  # N, force along the skin's z; NaN unless this skin alone detected the press
    travel: float  # m past first contact; NaN if this skin felt nothing, or if it cannot be estimated
    seen: SeenPatch | None  # patch in front of this skin; None in a history, where images would fill the memory
    counters: SkinCounters  # counts of samples and losses during this touch


class TouchResult(NamedTuple):
    """Measurements of all skins in one touch, the reason why the press stopped, and the camera's view with its pose.
    The properties are those of the pressing skin.
    """

    site: Site
    attempt: int
    reason: StopReason
    skins: Mapping[str, SkinTouch]  # results of the skins by their names
    camera_view: View | None  # view of the camera before the touch; None in a history
    T_w_c: Float[Array, "4 4"]  # pose of the camera when the view was taken

    @property
    def code(self) -> ReturnCode:
        """How the press ended, as a return code; AIR if it met nothing or only a further skin detected it."""
        return self.skins[TOOL].code

    @property
    def T_w_t(self) -> Float[Array, "4 4"]:
        """Pose (m) of the tool in the world frame at the end of the press."""
        return self.skins[TOOL].T_w_s

    @property
    def reading(self) -> Float[Array, " c"]:
        """Mean reading (uT) in contact minus the ambient reading before it, three values for each chip."""
        return self.skins[TOOL].reading

    @property
    def force(self) -> float:
        """Force (N) along tool z, positive in compression; NaN unless the pressing skin alone detected the press."""
        return self.skins[TOOL].force

    @property
    def travel(self) -> float:
        """Travel (m) of the tool past first contact; NaN if the skin felt nothing or it cannot be estimated."""
        return self.skins[TOOL].travel


class SiteOutcome(NamedTuple):
    """Outcome of the attempts to touch one site: return code, reason, the touch (None if all attempts failed), and
    whether the arm can reach the site. The next site may be chosen from it.
    """

    site: Site
    code: ReturnCode
    reason: str
    touch: TouchResult | None = None
    reachable: bool = True  # whether the arm can reach the site


class TouchFailedError(DeviceError):
    """A touch cannot be made at this site; another site may succeed."""


class UnreachableError(TouchFailedError):
    """The arm cannot or may not move to a site, so that another attempt would not help."""


class MissedContactError(TouchFailedError):
    """A press met nothing at a site where the camera sees a surface."""


ChooseSite: TypeAlias = Callable[[Sequence[SiteOutcome]], Site | None]
ExtractPatch: TypeAlias = Callable[[View, Camera, Array, Array], SeenPatch]  # view, camera, T_w_c, T_w_t
