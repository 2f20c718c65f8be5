"""Scene "replay": the touches of a session or data set, one at a time, measured against predicted."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from i2t import viz
from i2t.errors import DataError
from i2t.geometry import inverse
from i2t.objects.solids import Mesh
from i2t.prediction.predictor import Predictor
from i2t.prediction.touch_model import Reading
from i2t.types import ReturnCode
from i2t.view.contents import Contents, mesh_of
from i2t.view.drawing import SkinNode, add_discs, add_mesh, measured, picture_of, place
from i2t.view.page import plot_time_course
from i2t.view.server import Page, Scene
from i2t.viz.scene import touch_colours
from i2t.viz.skins import common_scale
from i2t.viz.style import titled

EVERY = "all"  # choice of a filter that leaves nothing out


class Replay(NamedTuple):
    """State of the scene: the touches, their predicted readings, the filters, and the shown touch."""

    contents: Contents
    predicted: Reading  # (n, c) uT; NaN where nothing was predicted
    error: Float[np.ndarray, " n"]  # uT, root mean square difference of predicted and measured reading
    labels: np.ndarray  # (3, n) texts: object, session and code of each touch
    rows: Int[np.ndarray, " m"]  # touches that pass the filters, in their order
    note: str  # how well the touches are predicted, or why they are not
    message: str = ""
    at: int = 0  # position of the shown touch among them
    chosen: tuple[str, str, str] = (EVERY, EVERY, EVERY)  # values of the filters
    worst_first: bool = False

    @property
    def row(self) -> int:
        """Index of the shown touch in the data set."""
        return int(self.rows[self.at])


class TouchShown(NamedTuple):
    """Event: show a touch by its position among those that pass the filters."""

    at: int


class TouchStepped(NamedTuple):
    """Event: show the next touch (1) or the previous one (-1)."""

    by: int


class TouchClicked(NamedTuple):
    """Event: show a touch by its index in the data set."""

    row: int


class Filtered(NamedTuple):
    """Event: other values of the filters, or another order."""

    chosen: tuple[str, str, str]
    worst_first: bool


def begin(contents: Contents, predictor: Predictor | None) -> Replay:
    """Predict the touches of a data set that the predictor can predict.

    Args:
        contents: The session or data set.
        predictor: Predictor of the skin's readings; None for no prediction.

    Returns:
        The state that shows the first touch.
    """
    dataset, note = contents.dataset, ""
    touches = dataset.touches
    reading = touches.reading
    predicted = Reading(np.full(reading.shape, np.nan), np.full(reading.shape, np.nan))
    usable = np.flatnonzero(np.isfinite(reading).all(1) & (touches.code != ReturnCode.AIR))
    if predictor is not None:
        try:
            score = predictor.score(dataset, usable)
            for column, values in zip(predicted, score.predicted, strict=True):
                column[usable] = values
            by = " by a predictor of simulated touches" * predictor.simulated
            note = f"{len(usable)} touches predicted{by}, R² {score.r2.mean:.2f}" + _used(score.used)
        except (DataError, ValueError) as reason:
            note = f"nothing is predicted: {reason}"
    error = np.sqrt(np.mean((predicted.mean - reading) ** 2, axis=1))
    labels = np.array([
        [dataset.objects[i] for i in touches.object], [dataset.sessions[i] for i in touches.session],
        [ReturnCode(int(code)).name.lower() for code in touches.code],
    ])  # fmt: skip
    return _worded(Replay(contents, predicted, error, labels, np.arange(len(dataset)), note))


def _used(count: int | None) -> str:
    return f"; {count} of them were used in its fit" if count else ""


def update(state: Replay, event: Any) -> Replay:
    """Show another touch, or filter and sort the touches.

    Args:
        state: The state before the event.
        event: The event, of one of this module's types.

    Returns:
        The state after it.

    Raises:
        ValueError: No touch passes the filters.
    """
    match event:
        case TouchShown(at):
            state = state._replace(at=max(0, min(at, len(state.rows) - 1)))
        case TouchStepped(by):
            state = state._replace(at=max(0, min(state.at + by, len(state.rows) - 1)))
        case TouchClicked(row) if row in state.rows:
            state = state._replace(at=int(np.flatnonzero(state.rows == row)[0]))
        case Filtered(chosen, worst_first):
            pairs = zip(state.labels, chosen, strict=True)
            passed = [np.full(len(column), True) if value == EVERY else column == value for column, value in pairs]
            rows = np.flatnonzero(np.all(passed, axis=0))
            if not len(rows):
                raise ValueError("no touch passes these filters; choose others")
            if worst_first:
                rows = rows[np.argsort(-np.nan_to_num(state.error[rows], nan=-1.0), kind="stable")]
            state = state._replace(rows=rows, at=0, chosen=chosen, worst_first=worst_first)
    return _worded(state)


def _worded(state: Replay) -> Replay:
    """Describe the shown touch."""
    touches, row, contents = state.contents.dataset.touches, state.row, state.contents
    thing, session, code = state.labels[:, row]
    numbers = [(touches.force[row], "N"), (1e3 * touches.travel[row], "mm of travel"), (state.error[row], "µT error")]
    values_shown = [f"{value:.2f} {unit}" for value, unit in numbers if np.isfinite(value)]
    title = titled(f"touch {row + 1} of {len(contents.dataset)}: {thing}", contents.simulated)
    return state._replace(message=f"{title}\n{session}, ended by {code}; {', '.join(values_shown)}\n{state.note}")


class ReplayScene(Scene):
    """Nodes and widgets of the scene."""

    update = staticmethod(update)
    _mesh: Mesh | None = None  # of the shown object

    def build(self, page: Page) -> None:
        """Add the skin and the widgets.

        Args:
            page: The page.
        """
        state, gui, self._page, self._scene = self.state, page.server.gui, page, page.server.scene
        self._time: Any = gui.add_slider("touch", 1, max(2, len(state.rows)), 1, 1)
        page.on(self._time.on_update, lambda: TouchShown(int(self._time.value) - 1))
        steps = gui.add_button_group("go to", ("previous", "next"))
        page.on(steps.on_click, lambda: TouchStepped(1 if steps.value == "next" else -1))
        filters = [
            gui.add_dropdown(name, (EVERY, *np.unique(column).tolist()))
            for name, column in zip(("object", "session", "code"), state.labels, strict=True)
        ]
        worst = gui.add_checkbox("worst first", False, disabled=not np.isfinite(state.error).any())

        def filtered() -> Filtered:
            thing, session, code = (choice.value for choice in filters)
            return Filtered((thing, session, code), worst.value)

        for choice in (*filters, worst):
            page.on(choice.on_update, filtered)
        self._picture = gui.add_image(np.full((8, 8, 3), 255, np.uint8), format="png")
        self._series = gui.add_image(np.full((8, 8, 3), 255, np.uint8), format="png", visible=False)
        self._tool = self._scene.add_frame("/tool", axes_length=0.01, axes_radius=3e-4)
        self._skin = SkinNode(self._scene, "/tool")

    def draw(self, state: Replay) -> None:
        """Show the touch on its object, its reading, its patch and its time course.

        Args:
            state: The state to show.
        """
        dataset, row = state.contents.dataset, state.row
        touches = dataset.touches
        self._time.max, self._time.value = max(2, len(state.rows)), state.at + 1
        mesh, T_o_t = mesh_of(state.contents, row), inverse(touches.T_w_o) @ touches.T_w_t
        placed = np.isfinite(T_o_t).all((1, 2))  # poses are unknown in some recordings
        if mesh is not self._mesh:
            self._scene.remove_by_name("/object")
            if mesh is not None:
                self._page.look_at(mesh.vertices)
                add_mesh(self._scene, "/object", mesh)
        self._mesh = mesh
        if placed[row]:  # otherwise the skin stays where it is drawn first
            place(self._tool, T_o_t[row])
        same = state.rows[(touches.object[state.rows] == touches.object[row]) & placed[state.rows]]
        order = np.argsort(np.argsort(np.nan_to_num(state.error[same])))
        colours = np.where(np.isfinite(state.error[same])[:, None], touch_colours(len(same))[order], 0.5)
        discs = add_discs(self._scene, "/touches", T_o_t[same], colours)
        discs.on_click(lambda click: self._page.send(TouchClicked(int(same[click.instance_index]))))
        readings = {"measured": measured(touches.reading[row])}
        if np.isfinite(state.predicted.mean[row]).all():
            readings["predicted"] = Reading(state.predicted.mean[row], state.predicted.std[row])
        self._skin.draw(dataset.board, readings, common_scale(np.nan_to_num(touches.reading[row])))
        self._picture.image = picture_of(
            touches.patch[[row]], readings, dataset.board, state.labels[0, row], state.contents.simulated,
            window=dataset.window, reach=dataset.reach,
        )  # fmt: skip
        record = state.contents.record(row)
        self._series.visible = "tactile" in record.series
        if self._series.visible:
            self._series.image = viz.pixels(plot_time_course(record, state.contents.simulated, row))
