"""Scene "recognise": candidates in a row, the belief after each touch, and the site that tells most next.

An episode either grows, by simulated touches of one of the candidates, or was recorded. Candidates stand side by side,
each in its own frame O.
"""

import html
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.colors import to_rgb

from i2t.dataset import Dataset, source_phrase
from i2t.objects.solids import Mesh
from i2t.recognition.recognizer import ChosenSite, ObjectRecognizer, RecognizerConfig, RecognizerState
from i2t.recognition.sessions import RecognizedSessions, recognize
from i2t.rendering.render import prepare_surface
from i2t.simulation.touches import SimulationErrors, touch_simulator
from i2t.skin.boards import same_board
from i2t.skin_models.pad_model import KnownPad
from i2t.types import Array, Board, Pad, ReturnCode
from i2t.view.drawing import SkinNode, add_discs, add_mesh, measured, place, quaternions
from i2t.view.server import TEXT, Page, Scene
from i2t.viz.skins import common_scale
from i2t.viz.style import Colour

CONFIG = RecognizerConfig(num_sites=12, num_particles=32)  # half of the default, so that an episode begins sooner


class EpisodeTouch(NamedTuple):
    """A touch of the episode, and the probabilities of the candidates after it."""

    T_o_t: Float[Array, "4 4"]  # end of the press, in the object's believed frame
    reading: Float[Array, " c"]  # uT
    contact: bool
    probability: Float[Array, " candidates"]


class RecognitionState(NamedTuple):
    """State of the scene: the candidates, what makes or recorded the touches, and the touches so far."""

    meshes: Mapping[str, Mesh]
    board: Board
    message: str
    touched: str  # name of the touched object
    session: str  # name of the recorded session; empty if touches are simulated
    note: str = ""  # what each message ends with
    steps: tuple[EpisodeTouch, ...] = ()
    shown: int = 0  # number of touches after which the belief is shown
    recognizer: ObjectRecognizer | None = None
    pad: Pad | None = None  # pad of the simulated touches
    states: tuple[RecognizerState, ...] = ()  # before the first touch and after each
    touch: Callable[[Array], Any] | None = None  # makes a simulated touch at a tool pose
    recorded: RecognizedSessions | None = None

    @property
    def probability(self) -> Float[np.ndarray, " candidates"]:
        """Probabilities of the candidates after the shown touches."""
        return self.steps[self.shown - 1].probability if self.shown else np.full(len(self.meshes), 1 / len(self.meshes))


class Touch(NamedTuple):
    """Event: touch a site, by default the one that tells most."""

    site: int | None = None


class TouchesShown(NamedTuple):
    """Event: show the belief after a number of touches."""

    touches: int


class Begun(NamedTuple):
    """Event: begin an episode with a touched object, or show a recorded session."""

    name: str


def begin(meshes: Mapping[str, Mesh], pad_model: KnownPad, pad: Pad, touched: str, note: str = "") -> RecognitionState:
    """Prepare episodes of simulated touches.

    Args:
        meshes: Candidates by name, at least two.
        pad_model: Pad model that predicts the readings.
        pad: Pad that touches.
        touched: Name of the touched candidate.
        note: Sentence that each message ends with.

    Returns:
        The state before the first touch.

    Raises:
        ValueError: Pad and pad model are of different boards.
    """
    if not same_board(pad.board, pad_model.board):
        raise ValueError("pad and pad model are of different boards; give --pads a pad on the board of --pad-model")
    recognizer = ObjectRecognizer(jax.random.key(0), pad_model.model, meshes, config=CONFIG)
    state = RecognitionState(meshes, pad_model.board, "", touched, "", note, recognizer=recognizer, pad=pad)
    return update(state, Begun(touched))


def begin_recorded(meshes: Mapping[str, Mesh], dataset: Dataset, pad_model: KnownPad) -> RecognitionState:
    """Compute the beliefs of recorded sessions.

    Args:
        meshes: Candidates by name, at least two.
        dataset: The touches.
        pad_model: Pad model of the skin that made them.

    Returns:
        The state after the touches of the first session.

    Raises:
        DataError: The touches are of another skin, or no session has enough of them.
    """
    recorded = recognize(meshes, dataset, pad_model)
    state = RecognitionState(meshes, dataset.board, "", "", "", recorded=recorded)
    return update(state, Begun(recorded.sessions[0]))


def update(state: RecognitionState, event: Any) -> RecognitionState:
    """Make a touch, begin an episode, or go through its touches.

    Args:
        state: The state before the event.
        event: The event, of one of this module's types.

    Returns:
        The state after it, whose message tells what the belief says.
    """
    match event:
        case Touch(site) if state.recognizer is not None:
            kept = state._replace(steps=state.steps[: state.shown], states=state.states[: state.shown + 1])
            state = _touched(kept, state.recognizer, site)
        case TouchesShown(touches):
            state = state._replace(shown=max(0, min(touches, len(state.steps))))
        case Begun(name) if state.recorded is not None:
            steps = _recorded_steps(state.recorded, name)
            touched = state.recorded.touched[state.recorded.sessions.index(name)]
            state = state._replace(session=name, touched=touched, steps=steps, shown=len(steps))
        case Begun(name) if state.recognizer is not None and state.pad is not None:
            surface = prepare_surface(state.meshes[name])
            touch = touch_simulator(jax.random.key(1), surface, state.pad, errors=SimulationErrors())
            state = state._replace(touched=name, steps=(), shown=0, states=(state.recognizer.init(),), touch=touch)
    return state._replace(message=_message(state))


def _touched(state: RecognitionState, recognizer: ObjectRecognizer, number: int | None) -> RecognitionState:
    """Touch a site, or the one that the belief chooses; the state stays if no more touch is needed."""
    assert state.touch is not None
    before = state.states[-1]
    if number is None:
        site = recognizer.choose_touch(before)
    elif np.isfinite(recognizer.expected_information(before)[number]):
        site = ChosenSite(number, recognizer.site_pose(number))
    else:
        raise ValueError("this site was touched already, or a touch there may be unsafe; choose another one")
    if site is None and recognizer.stop_reason(before) is None:
        raise ValueError("no site is left where a touch is probably safe; begin again")
    if site is None:
        return state
    touch = state.touch(site.T_w_t)
    contact = int(touch.code) != ReturnCode.AIR
    observation = recognizer.observe(site, touch.reading, force=float(touch.force), T_w_t=touch.T_w_t, contact=contact)
    after, info = recognizer.update(before, observation)
    steps = (*state.steps, EpisodeTouch(touch.T_w_t, touch.reading, contact, info.probability))
    return state._replace(steps=steps, shown=len(steps), states=(*state.states, after))


def _recorded_steps(recorded: RecognizedSessions, session: str) -> tuple[EpisodeTouch, ...]:
    """List the touches of a recorded session with the beliefs after them."""
    row = recorded.sessions.index(session)
    touches, T_o_t, beliefs = recorded.episodes.observations, recorded.episodes.T_w_t[row], recorded.probability[row]
    columns = (np.asarray(touches.reading[row]), np.asarray(touches.contact[row]))
    return tuple(map(EpisodeTouch, T_o_t, columns[0], map(bool, columns[1]), beliefs))


def _message(state: RecognitionState) -> str:
    p, names = state.probability, list(state.meshes)
    source = "simulated" if state.recorded is None else source_phrase(state.recorded.source)
    head = f"{state.shown} of {len(state.steps)} touches of the {state.touched} ({source})"
    lines = [
        head,
        f"most probable: {names[int(p.argmax())]}, {p.max():.0%}" if state.shown else "not touched yet",
    ]
    if state.shown and not state.steps[state.shown - 1].contact:
        lines.append("this touch met nothing")
    if state.recognizer is not None and (reason := state.recognizer.stop_reason(state.states[state.shown])):
        lines.append(f"no further touch: {reason}")
    return "\n".join(filter(None, [*lines, state.note]))


class RecognizeScene(Scene):
    """Nodes and widgets of the scene."""

    update = staticmethod(update)

    def build(self, page: Page) -> None:
        """Add the candidates in a row, and the widgets.

        Args:
            page: The page.
        """
        state, self._page, self._scene = self.state, page, page.server.scene
        widths = [float(np.ptp(mesh.vertices, axis=0)[0]) + 0.03 for mesh in state.meshes.values()]
        self._columns = np.cumsum(widths) - np.array(widths) / 2  # m, x of the middle of each candidate
        self._frames = {}
        for column, (name, mesh) in enumerate(state.meshes.items()):
            position = np.array([self._columns[column], 0, 0])
            self._frames[name] = f"/candidates/{column}"
            self._scene.add_frame(self._frames[name], show_axes=False, position=position)
            add_mesh(self._scene, f"{self._frames[name]}/mesh", mesh)
            high = float(np.max(mesh.vertices, axis=0)[2]) + 0.03
            self._scene.add_label(f"{self._frames[name]}/label", name, position=(0, 0, high))
        at = zip(state.meshes.values(), self._columns, strict=True)
        page.look_at(np.concatenate([mesh.vertices + np.array([x, 0, 0]) for mesh, x in at]))
        gui, recorded = page.server.gui, state.recorded
        choices = tuple(state.meshes) if recorded is None else recorded.sessions
        begun = state.touched if recorded is None else state.session
        label = "touched object" if recorded is None else "session"
        choice = gui.add_dropdown(label, choices, initial_value=begun)
        page.on(choice.on_update, lambda: Begun(choice.value))
        if recorded is None:
            touch = gui.add_button("touch where it asks", hint="or click a site; bright sites tell most")
            page.on(touch.on_click, lambda: Touch())
            again = gui.add_button("begin again")
            page.on(again.on_click, lambda: Begun(choice.value))
        self._slider: Any = gui.add_slider("touches", 0, 1, 1, 0)
        page.on(self._slider.on_update, lambda: TouchesShown(int(self._slider.value)))
        self._bars = gui.add_html("")

    def draw(self, state: RecognitionState) -> None:
        """Show the belief after the shown touches, and the sites of the next one.

        Args:
            state: The state to show.
        """
        p = state.probability
        self._slider.max = max(1, len(state.steps))
        self._slider.value = state.shown
        shares = zip(state.meshes, p, strict=True)
        rows = [f"{share:4.0%} {name:13.13} {'█' * round(14 * share)}" for name, share in shares]
        self._bars.content = f"<pre style='{TEXT}'>{html.escape(chr(10).join(rows))}</pre>"
        recognizer = state.recognizer
        if recognizer is not None:
            now = state.states[state.shown]
            gain, asked = recognizer.expected_information(now), recognizer.choose_touch(now)
        for column, (name, frame) in enumerate(self._frames.items()):
            self._draw_touches(state, frame, name, leads=state.shown > 0 and column == p.argmax())
            if recognizer is not None:
                self._draw_ghosts(state, recognizer, frame, name)
                self._draw_sites(recognizer, gain, asked, frame, column)

    def _draw_touches(self, state: RecognitionState, frame: str, name: str, *, leads: bool) -> None:
        """Draw the last shown touch on the most probable candidate, with its reading."""
        self._scene.remove_by_name(f"{frame}/tool")
        if leads:
            step = state.steps[state.shown - 1]
            place(self._scene.add_frame(f"{frame}/tool", show_axes=False), step.T_o_t)
            skin = SkinNode(self._scene, f"{frame}/tool")
            skin.draw(state.board, {name: measured(step.reading)}, common_scale(step.reading))

    def _draw_ghosts(self, state: RecognitionState, recognizer: ObjectRecognizer, frame: str, name: str) -> None:
        """Draw the most probable poses of a candidate."""
        poses, weights = recognizer.particle_poses(state.states[state.shown], name)
        mesh = state.meshes[name]
        self._scene.add_batched_meshes_simple(
            f"{frame}/ghosts", mesh.vertices, mesh.faces, quaternions(poses[:, :3, :3]), poses[:, :3, 3], opacity=0.25,
            batched_opacities=weights / weights.max(), batched_colors=(86, 180, 233), lod="off", cast_shadow=False,
        )  # fmt: skip

    def _draw_sites(
        self, recognizer: ObjectRecognizer, gain: np.ndarray, asked: ChosenSite | None, frame: str, column: int
    ) -> None:
        """Draw the sites of a candidate, coloured by the information that is expected there; red is the asked one."""
        numbers = np.flatnonzero(np.asarray(recognizer.sites.owner) == column)
        share = gain[numbers] / max(float(np.nanmax(gain, initial=0.0)), 1e-9)
        colours = np.where(np.isfinite(share)[:, None], colormaps["cividis"](0.1 + 0.85 * share)[:, :3], 0.35)
        if asked is not None:
            colours[numbers == asked.number] = to_rgb(Colour.RED)
        sites = add_discs(self._scene, f"{frame}/sites", np.asarray(recognizer.sites.T_w_t)[numbers], colours)
        sites.on_click(lambda click: self._page.send(Touch(int(numbers[click.instance_index]))))
