"""Scene "explore": a click on an object presses the skin there, and the page shows what it would read.

The tool pose at the clicked point is that of `i2t.contact_pose`. `i2t.Predictor` predicts the reading, and a pad of
one's choice simulates it without errors of arm and sensor.
"""

import textwrap
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from i2t import viz
from i2t.contact.press import PressLimits
from i2t.dataset import holds_simulated
from i2t.objects.named import describe_placement
from i2t.objects.poses import contact_pose, point_on_ray
from i2t.objects.solids import Object
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading, TouchBatch
from i2t.rendering.render import prepare_surface
from i2t.simulation.sites import explain_unsafe
from i2t.simulation.touches import SimulationErrors, touch_simulator
from i2t.skin.boards import same_board
from i2t.types import Array, Board, Pad, ReturnCode, Surface
from i2t.view.drawing import SkinNode, add_mesh, place
from i2t.view.server import Page
from i2t.viz.skins import common_scale

NONE = "none"  # name of the choice of no pad


class Explorer(NamedTuple):
    """State of the scene: object, predictors and pads by name and the chosen ones, load, and the touch."""

    object: Object
    surface: Surface
    predictors: Mapping[str, Predictor]
    pads: Mapping[str, Pad]
    predictor: str  # name of the chosen predictor
    pad: str  # name of the chosen pad
    load: float  # N, or m of travel, as the predictor takes it
    message: str
    T_o_t: Array | None = None  # (4, 4) tool pose of the touch
    seen: TouchBatch | None = None  # patch and view there; None if the touch is refused
    readings: Mapping[str, Reading] = {}  # predicted and simulated ones, of one board
    board: Board | None = None  # board of the readings


class Clicked(NamedTuple):
    """Event: a click on the object, as a ray from the camera."""

    origin: Array  # (3,) m
    direction: Array  # (3,)


class Moved(NamedTuple):
    """Event: the skin was moved or turned."""

    T_o_t: Array  # (4, 4)


class Loaded(NamedTuple):
    """Event: another load, N or m of travel."""

    load: float


class Chosen(NamedTuple):
    """Event: another predictor or pad was chosen."""

    predictor: str
    pad: str


def begin(thing: Object, predictors: Mapping[str, Predictor], pads: Mapping[str, Pad]) -> Explorer:
    """Make the state before the first touch.

    Args:
        thing: The object.
        predictors: Predictors by name, at least one.
        pads: Pads to simulate with, by name.

    Returns:
        The state, with the first predictor and the first pad.
    """
    first = next(iter(predictors))
    message = "\n\n".join(filter(None, ["Click the object to press the skin there.", describe_placement(thing)]))
    surface, pad = prepare_surface(thing.mesh), next(iter(pads), NONE)
    return Explorer(thing, surface, predictors, pads, first, pad, usual_load(predictors[first]), message)


def usual_load(predictor: Predictor) -> float:
    """Return the load of the typical training touch of a predictor.

    Args:
        predictor: The predictor.

    Returns:
        Force (N) or travel (m), as the predictor takes it.
    """
    return predictor.default_force if predictor.load == "force" else predictor.default_travel


def update(state: Explorer, event: Any) -> Explorer:
    """Press the skin where an event asks for it.

    Args:
        state: The state before the event.
        event: The event, of one of this module's types.

    Returns:
        The state after it. A touch that is refused has no readings, and the message gives the reason.
    """
    match event:
        case Clicked(origin, direction):
            point = point_on_ray(state.object.mesh, origin, direction)
            if point is None:
                return state
            try:
                return _touched(state._replace(T_o_t=contact_pose(state.object.mesh, point)))
            except ValueError as error:
                T_o_t = np.eye(4)
                T_o_t[:3, 3] = point
                return _refused(state._replace(T_o_t=T_o_t), error)
        case Moved(T_o_t):
            return _touched(state._replace(T_o_t=np.asarray(T_o_t, np.float64)))
        case Loaded(load):
            return _touched(state._replace(load=load))
        case Chosen(predictor, pad):
            same = state.predictors[predictor].load == state.predictors[state.predictor].load
            load = state.load if same else usual_load(state.predictors[predictor])
            return _touched(state._replace(predictor=predictor, pad=pad, load=load))
    return state


def _touched(state: Explorer) -> Explorer:
    """Predict and simulate the touch at the state's pose."""
    if state.T_o_t is None:
        return state
    predictor, pad = state.predictors[state.predictor], state.pads.get(state.pad)
    try:
        seen = predictor.render_touches(state.surface, state.T_o_t[None])
        load: dict[str, Any] = {predictor.load: state.load}
        mean, std = predictor.predict(seen, **load)
    except ValueError as error:
        return _refused(state, error)
    readings, board, lines = {"predicted": Reading(mean[0], std[0])}, predictor.board, []
    if pad is not None and predictor.load != "force":
        lines.append("The pad is pressed by force and this predictor by travel, so the touch is not simulated.")
    elif pad is not None:
        touch = simulate(state.surface, pad, state.load)(state.T_o_t)
        simulated = Reading(touch.reading, np.zeros_like(touch.reading))
        if int(touch.code) == ReturnCode.AIR:
            lines.append("The simulated press meets nothing.")
        elif board is not None and same_board(pad.board, board):
            readings["simulated"] = simulated
        else:
            readings, board = {"simulated": simulated}, Board(*map(np.asarray, pad.board))
            lines.append("Pad and predictor are of different boards, so only the simulated reading is drawn.")
    if unsafe := explain_unsafe(state.surface, state.T_o_t):
        lines.append(f"An arm would not touch here: {unsafe}.")
    pressed = f"{state.load:.2f} N" if predictor.load == "force" else f"{1e3 * state.load:.2f} mm of travel"
    message = "\n\n".join([f"**{state.object.name}, {pressed}**", *lines])
    return state._replace(seen=seen, readings=readings, board=board, message=message)


def simulate(surface: Surface, pad: Pad, force: float) -> Callable[[Array], Any]:
    """Make a function that simulates a press up to a force, without errors of arm, camera and sensor.

    Args:
        surface: The touched surface.
        pad: The pad.
        force: Force (N) at which the press ends.

    Returns:
        A function of a tool pose that returns the touch.
    """
    limits = PressLimits(force=force, skin_change=1e9, overshoot=0.0)
    return touch_simulator(jax.random.key(0), surface, pad, errors=SimulationErrors.error_free(), limits=limits)


def _refused(state: Explorer, error: ValueError) -> Explorer:
    reason = str(error).removeprefix("point: ")
    return state._replace(seen=None, readings={}, board=None, message=f"**No touch here:** {reason}")


class ExploreScene:
    """Nodes and widgets of the scene.

    Args:
        state: State before the first touch.
    """

    def __init__(self, state: Explorer) -> None:
        self.state = state
        self.update = update

    def build(self, page: Page) -> None:
        """Add the object, the skin with its handles, and the widgets."""
        state, gui, self._scene = self.state, page.server.gui, page.server.scene
        page.look_at(state.object.mesh.vertices)
        mesh = add_mesh(self._scene, "/object", state.object.mesh)
        mesh.on_click(lambda click: page.send(Clicked(click.ray_origin, click.ray_direction)))
        self._handles = self._scene.add_transform_controls("/tool", scale=0.03, line_width=1.5, visible=False)
        self._handles.on_update(lambda change: page.send(Moved(pose_of(change.target))))
        self._skin = SkinNode(self._scene, "/tool")
        forces = gui.add_slider("force (N)", 0.1, 4.0, 0.05, min(state.load, 4.0))
        travels = gui.add_slider("travel (mm)", 0.05, 4.0, 0.05, min(1e3 * state.load, 4.0))
        page.on(forces.on_update, lambda: Loaded(float(forces.value)))
        page.on(travels.on_update, lambda: Loaded(1e-3 * travels.value))
        self._loads = {"force": forces, "travel": travels}
        predictors = gui.add_dropdown("predictor", tuple(state.predictors), initial_value=state.predictor)
        pads = gui.add_dropdown("simulated pad", (NONE, *state.pads), initial_value=state.pad)
        for choice in (predictors, pads):
            page.on(choice.on_update, lambda: Chosen(predictors.value, pads.value))
        self._picture = gui.add_image(np.full((8, 8, 3), 255, np.uint8), format="png", visible=False)
        self._numbers = gui.add_markdown("")

    def draw(self, state: Explorer) -> None:
        """Show the touch: first skin and numbers, then the picture, which takes longer."""
        for load, slider in self._loads.items():
            slider.visible = load == state.predictors[state.predictor].load
        self._scene.remove_by_name("/refusal")
        if state.T_o_t is None:
            return
        self._handles.visible = True
        place(self._handles, state.T_o_t)
        self._picture.visible = bool(state.readings)
        if state.seen is None or state.board is None:
            self._skin.clear()
            self._numbers.content = ""
            reason = state.message.removeprefix("**No touch here:** ")
            text = textwrap.shorten(reason, 60, placeholder=" ...")
            self._scene.add_label("/refusal", text, position=state.T_o_t[:3, 3])
            return
        scale = common_scale(np.stack([reading.mean for reading in state.readings.values()]))
        self._skin.draw(state.board, state.readings, scale)
        self._numbers.content = describe(state)
        self._picture.image = viz.pixels(_figure(state))

    def close(self) -> None:
        """Nothing is held."""


def pose_of(node: Any) -> Array:
    """Return the pose of a node in its parent's frame.

    Args:
        node: Node of the scene.

    Returns:
        `(4, 4)` pose (m).
    """
    import viser.transforms

    return viser.transforms.SE3.from_rotation_and_translation(
        viser.transforms.SO3(np.asarray(node.wxyz, np.float64)), np.asarray(node.position, np.float64)
    ).as_matrix()


def describe(state: Explorer) -> str:
    """Write pose and readings of a touch as text that can be copied.

    Args:
        state: State with a touch.

    Returns:
        Markdown: the tool pose as Python's nested lists (m), and a table of the readings (uT) in the board's order.
    """
    pose = np.array2string(np.asarray(state.T_o_t), precision=7, separator=", ", suppress_small=True)
    head = ["chip", *state.readings]
    rows = [head, ["---"] * len(head)]
    for chip in range(next(iter(state.readings.values())).mean.size // 3):
        row = [str(chip)]
        for mean, std in state.readings.values():
            values = zip(mean.reshape(-1, 3)[chip], std.reshape(-1, 3)[chip], strict=True)
            row.append(", ".join(f"{value:.1f}" + f" ± {spread:.1f}" * bool(spread) for value, spread in values))
        rows.append(row)
    table = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return f"T_o_t (m)\n```\n{pose}\n```\nx, y, z in the chips' axes (µT)\n\n{table}"


def _figure(state: Explorer) -> Any:
    assert state.seen is not None
    assert state.board is not None
    predictor = state.predictors[state.predictor]
    source = (predictor.metadata or {}).get("source", "simulated")
    return viz.plot_predicted_touches(
        state.seen.patch, {name: reading.mean[None] for name, reading in state.readings.items()}, [""], state.board, "",
        "simulated" in state.readings or holds_simulated(source),
        std={name: reading.std[None] for name, reading in state.readings.items() if reading.std.any()},
        views=state.seen.view, window=predictor.window, reach=predictor.reach,
    )  # fmt: skip
