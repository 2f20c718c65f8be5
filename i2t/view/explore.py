"""Scene "explore": a click on an object presses the skin there, and the page shows what it would read.

The tool pose at the clicked point is that of `i2t.contact_pose`. `i2t.Predictor` predicts the reading, and a pad of
one's choice simulates it without errors of arm and sensor.
"""

import textwrap
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
import viser.transforms

from i2t.contact.press import PressLimits
from i2t.objects.named import describe_placement
from i2t.objects.poses import contact_pose, point_on_ray
from i2t.objects.solids import Object
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch
from i2t.rendering.render import prepare_surface
from i2t.simulation.sites import explain_unsafe, sample_touch_sites
from i2t.simulation.touches import SimulationErrors, touch_simulator
from i2t.skin.boards import same_board
from i2t.types import Array, Board, Pad, ReturnCode, Surface
from i2t.view.drawing import SkinNode, add_mesh, measured, picture_of, place
from i2t.view.server import TEXT, Page, Scene
from i2t.viz.skins import common_scale

NO_PAD = "none"  # choice of no simulated pad
REFUSED = "No touch here: "  # begins the message about a touch that is refused
UNITS = {"force": ("N", 1.0), "travel": ("mm", 1e3)}  # in which a load is shown, with the factor


class Exploration(NamedTuple):
    """State of the scene: object, predictors and pads by name and the chosen ones, load, and the touch."""

    object: Object
    surface: Surface
    predictors: Mapping[str, Predictor]
    pads: Mapping[str, Pad]
    predictor: str  # name of the chosen predictor
    pad: str  # name of the chosen pad
    load: float  # N, or m of travel, as the predictor takes it
    note: str  # what each message ends with: how the mesh was placed
    message: str
    T_o_t: Array | None = None  # (4, 4) tool pose of the touch; None before the first and where none is possible
    refused_at: Array | None = None  # (3,) m, point at which a touch is refused
    dragged: bool = False  # whether the pose is that of the handles, which a person may still move
    seen: TouchBatch | None = None  # patch and view there; None if the touch is refused
    readings: Mapping[str, Reading] = {}  # predicted and simulated ones, of one board
    board: Board | None = None  # board of the readings


class ObjectClicked(NamedTuple):
    """Event: a click on the object, as a ray from the camera."""

    origin: Array  # (3,) m
    direction: Array  # (3,)


class Moved(NamedTuple):
    """Event: the skin was moved or turned."""

    T_o_t: Array  # (4, 4)


class Loaded(NamedTuple):
    """Event: another load."""

    shown: float  # N, or mm of travel


class Chosen(NamedTuple):
    """Event: another predictor or pad was chosen."""

    predictor: str
    pad: str


def begin(thing: Object, predictors: Mapping[str, Predictor], pads: Mapping[str, Pad]) -> Exploration:
    """Make the state before the first touch.

    Args:
        thing: The object.
        predictors: Predictors by name, at least one.
        pads: Pads to simulate with, by name.

    Returns:
        The state, with the first predictor and the first pad.
    """
    first, note = next(iter(predictors)), describe_placement(thing)
    surface, load = prepare_surface(thing.mesh), _usual_load(predictors[first])
    message = f"Click the object to press the skin there.\n{note}"
    return Exploration(thing, surface, predictors, pads, first, next(iter(pads), NO_PAD), load, note, message)


def update(state: Exploration, event: Any) -> Exploration:
    """Press the skin where an event asks for it.

    Args:
        state: The state before the event.
        event: The event, of one of this module's types.

    Returns:
        The state after it. A touch that is refused has no readings, and the message gives the reason.
    """
    match event:
        case ObjectClicked(origin, direction):
            point = point_on_ray(state.object.mesh, origin, direction)
            if point is None:
                return state
            try:
                T_o_t = contact_pose(state.object.mesh, point)
            except ValueError as error:
                return _refused(state._replace(T_o_t=None), error, point)
            touched = _touched(state._replace(T_o_t=T_o_t, dragged=False), T_o_t)
            if T_o_t[:3, 2] @ direction < 0:
                back = "You clicked the back of an open surface; the skin lies on its front."
                touched = touched._replace(message=f"{touched.message}\n{back}")
            return touched
        case Moved(T_o_t):
            state = state._replace(T_o_t=np.asarray(T_o_t, np.float64), dragged=True)
        case Loaded(shown):
            _, factor = UNITS[state.predictors[state.predictor].load]
            state = state._replace(load=shown / factor, dragged=False)
        case Chosen(predictor, pad):
            same = state.predictors[predictor].load == state.predictors[state.predictor].load
            load = state.load if same else _usual_load(state.predictors[predictor])
            state = state._replace(predictor=predictor, pad=pad, load=load, dragged=False)
    return state if state.T_o_t is None else _touched(state, state.T_o_t)


def _touched(state: Exploration, T_o_t: Array) -> Exploration:
    """Predict the touch at a pose, and simulate it."""
    predictor, pad = state.predictors[state.predictor], state.pads.get(state.pad)
    load: dict[str, Any] = {predictor.load: state.load}
    try:
        seen = predictor.render_touches(state.surface, T_o_t[None])
        mean, std = predictor.predict(seen, **load)
    except ValueError as error:
        return _refused(state, error, T_o_t[:3, 3])
    unit, factor = UNITS[predictor.load]
    readings, board = {"predicted": Reading(mean[0], std[0])}, predictor.board
    lines = [f"{state.object.name}, {factor * state.load:.2f} {unit}{' of travel' * (unit == 'mm')}"]
    if pad is not None and predictor.load != "force":
        lines.append("The pad is pressed by force and this predictor by travel, so the touch is not simulated.")
    elif pad is not None:
        limits = PressLimits(force=state.load, skin_change=1e9, overshoot=0.0)  # the force alone ends the press
        exact = SimulationErrors.error_free()
        touch = touch_simulator(jax.random.key(0), state.surface, pad, errors=exact, limits=limits)(T_o_t)
        if int(touch.code) == ReturnCode.AIR:
            lines.append("The simulated press meets nothing.")
        elif board is None or not same_board(pad.board, board):
            readings, board = {}, Board(*map(np.asarray, pad.board))
            lines.append("Pad and predictor are of different boards, so only the simulated reading is drawn.")
        readings["simulated"] = measured(touch.reading)
    if unsafe := explain_unsafe(state.surface, T_o_t):
        lines.append(f"An arm would not touch here, on a table at z = 0: {unsafe}.")
    message = "\n".join(filter(None, [*lines, state.note]))
    return state._replace(seen=seen, readings=readings, board=board, message=message, refused_at=None)


def _usual_load(predictor: Predictor) -> float:
    return predictor.default_force if predictor.load == "force" else predictor.default_travel


def _refused(state: Exploration, error: ValueError, point: Array) -> Exploration:
    reason = str(error).removeprefix("point: ").partition(";")[0]  # whose remedy is for programs
    remedy = "Click another place, or drag the skin onto the surface."
    message = f"{REFUSED}{reason}. {remedy}"
    return state._replace(seen=None, readings={}, message=message, refused_at=point)


class ExploreScene(Scene):
    """Nodes and widgets of the scene."""

    update = staticmethod(update)

    def build(self, page: Page) -> None:
        """Add the object, the skin with its handles, and the widgets; touch a first place.

        Args:
            page: The page.
        """
        state, gui, self._page, self._scene = self.state, page.server.gui, page, page.server.scene
        page.look_at(state.object.mesh.vertices)
        mesh = add_mesh(self._scene, "/object", state.object.mesh)
        mesh.on_click(lambda click: page.send(ObjectClicked(click.ray_origin, click.ray_direction)))
        self._handles = self._scene.add_transform_controls("/tool", scale=0.02, line_width=1.5, visible=False)
        page.on(self._handles.on_update, lambda: Moved(pose_of(self._handles)))
        self._skin = SkinNode(self._scene, "/tool")
        self._load: Any = gui.add_slider("force (N)", 0.1, 4.0, 0.01, 1.0)
        page.on(self._load.on_update, lambda: Loaded(self._load.value))
        predictors = gui.add_dropdown("predictor", tuple(state.predictors), initial_value=state.predictor)
        pads = gui.add_dropdown("simulated pad", (NO_PAD, *state.pads), initial_value=state.pad)
        for choice in (predictors, pads):
            page.on(choice.on_update, lambda: Chosen(predictors.value, pads.value))
        self._picture = gui.add_image(np.full((8, 8, 3), 255, np.uint8), format="png", visible=False)
        self._numbers = gui.add_html("")
        try:
            first = np.asarray(sample_touch_sites(state.object.mesh, 1, seed=0).T_o_t[0], np.float64)
            place(self._handles, first)
            page.send(Moved(first))
        except ValueError as error:  # no safe site
            self.state = state._replace(message=f"{state.message}\n{error!s}")

    def draw(self, state: Exploration) -> None:
        """Show the touch: first skin and numbers, then the picture, which takes longer.

        Args:
            state: The state to show.
        """
        load = state.predictors[state.predictor].load
        unit, factor = UNITS[load]
        self._load.label, self._load.value = f"{load} ({unit})", round(factor * state.load, 2)
        self._scene.remove_by_name("/refusal")
        self._handles.visible = state.T_o_t is not None
        if state.T_o_t is not None and not state.dragged:
            place(self._handles, state.T_o_t)
        self._picture.visible = bool(state.readings)
        self._numbers.content = f"<pre style='{TEXT}'>{describe(state)}</pre>" if state.readings else ""
        if state.refused_at is not None:
            text = textwrap.shorten(state.message.removeprefix(REFUSED), 60, placeholder=" ...")
            self._scene.add_label("/refusal", text, position=state.refused_at)
        if state.seen is None or state.board is None:
            self._skin.clear()
            return
        self._page.server.flush()  # numbers first: the picture keeps this program busy
        scale = common_scale(np.stack([reading.mean for reading in state.readings.values()]))
        self._skin.draw(state.board, state.readings, scale)
        predictor = state.predictors[state.predictor]
        self._picture.image = picture_of(
            state.seen.patch, state.readings, state.board, state.object.name,
            "simulated" in state.readings or predictor.simulated,
            views=state.seen.view, window=predictor.window, reach=predictor.reach,
        )  # fmt: skip


def pose_of(node: Any) -> Array:
    """Return the pose of a node in its parent's frame.

    Args:
        node: Node of the scene.

    Returns:
        `(4, 4)` pose (m).
    """
    rotation = viser.transforms.SO3(np.asarray(node.wxyz, np.float64))
    return viser.transforms.SE3.from_rotation_and_translation(rotation, np.asarray(node.position, float)).as_matrix()


def describe(state: Exploration) -> str:
    """Write pose and readings of a touch as text that can be copied.

    Args:
        state: State with a touch.

    Returns:
        The tool pose (m), and the readings (uT) with a row for each chip, as Python's nested lists.
    """
    shown = {"T_o_t (m)": np.asarray(state.T_o_t)}
    for name, (mean, std) in state.readings.items():
        shown |= {f"{name} (µT)": mean.reshape(-1, 3)} | ({"± std (µT)": std.reshape(-1, 3)} if std.any() else {})
    texts = {name: np.array2string(array, precision=7 - 6 * (array.shape[1] == 3), separator=", ",
                                   suppress_small=True) for name, array in shown.items()}  # fmt: skip
    return "\n".join(f"{name}\n{text}" for name, text in texts.items())
