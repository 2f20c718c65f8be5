"""The page in the browser: a viser server, the scene that it shows, and the thread in which the scene changes.

A scene is one of `explore`, `recognize`, `replay` and `live`. It holds its whole state in one named tuple, and
`update(state, event)` returns the state after an event, such as a click. The page calls `update` and then draws the new
state. Events are handled one at a time; an event that waits is replaced by a newer one of its kind, so that a slider
that moves faster than readings are predicted does not lag behind. All windows of the page show the same scene.
"""

import contextlib
import html
import io
import logging
import socket
import threading
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from i2t.cli.signals import ended_by_ctrl_c
from i2t.errors import I2TError, require_extra

TEXT = "margin:.3em .9em;font-size:.85em;line-height:1.4"  # CSS of texts
log = logging.getLogger(__name__)


class Scene(ABC):
    """A scene of the page.

    Args:
        state: The first state, a named tuple with a field `message`, a sentence for the user.
    """

    update: Callable[[Any, Any], Any]  # returns the state after an event; raises ValueError to refuse the event
    ticks: tuple[type, ...] = ()  # events that come many times a second and are handled at once

    def __init__(self, state: Any) -> None:
        self.state = state

    @abstractmethod
    def build(self, page: "Page") -> None:
        """Add the scene's nodes and widgets, which send events to the page.

        Args:
            page: The page.
        """

    @abstractmethod
    def draw(self, state: Any) -> None:
        """Show a state.

        Args:
            state: The state to show.
        """

    def close(self) -> None:  # noqa: B027  # most scenes hold nothing
        """Release what the scene holds, such as a device."""


class ShowScene(NamedTuple):
    """Event: another scene was chosen."""

    name: str


class Page:
    """The page, which listens from its creation on.

    Args:
        scenes: Functions that make the scenes, by name. Each is called when its scene is chosen.
        host: Address to listen on.
        port: Port to listen on; the next free one if it is taken.

    Raises:
        MissingExtraError: viser is not installed.
        ValueError: The address is not one of this machine.
    """

    def __init__(self, scenes: Mapping[str, Callable[[], Scene]], *, host: str, port: int) -> None:
        require_extra("viser", "the page in the browser")
        import viser

        _require_address(host)
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own greeting
            self.server = viser.ViserServer(host=host, port=port, label="i2t", verbose=False)
        name = "localhost" if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
        self.address = f"http://{name}:{self.server.get_port()}"
        self._scenes = scenes
        self._scene: Scene | None = None
        self._events: dict[type, Any] = {}  # by their kind, in order of time
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._work, name="page", daemon=True)
        self._ended = threading.Event()  # set by the thread, as an interrupted join forgets a thread that still runs
        self.said = ""  # message that the page shows

    def send(self, event: Any) -> None:
        """Put an event into the queue. It replaces one of the same kind that still waits.

        Args:
            event: The event, a named tuple of the shown scene.
        """
        with self._changed:
            self._events.pop(type(event), None)
            self._events[type(event)] = event
            self._changed.notify()

    def on(self, register: Callable[[Any], Any], event: Callable[[], Any]) -> None:
        """Send an event whenever a user changes a widget, but not when the program does.

        Args:
            register: Method of the widget that takes a callback, such as `on_update`.
            event: Function that makes the event.
        """
        register(lambda change: self.send(event()) if change.client is not None else None)

    def say(self, message: str) -> None:
        """Show a message at the top of the page.

        Args:
            message: Lines of text, of which the first is the title.
        """
        self.said = message
        self._write(message)

    def _write(self, message: str) -> None:
        title, *lines = (html.escape(line) for line in message.split("\n"))
        below = "".join(f"<br>{line}" for line in lines if line)
        self._message.content = f"<p style='{TEXT}'><b>{title}</b>{below}</p>"

    def look_at(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Point the camera of each window at some points, from their front and above.

        Args:
            points: Points (m), such as the vertices of an object.
        """
        low, high = np.min(points, axis=0), np.max(points, axis=0)
        middle, size = (low + high) / 2, float(np.linalg.norm(high - low)) + 0.03
        clients: list[Any] = [client.camera for client in self.server.get_clients().values()]
        for camera in [self.server.initial_camera, *clients]:
            camera.near = 1e-3
            # left of the middle, of which the panel hides the right
            camera.position = middle + size * np.array([0.02, -0.6, 0.45])
            camera.look_at = middle + size * np.array([0.12, 0.0, 0.0])

    def run(self, first: str) -> None:
        """Show a scene, and serve until the thread that calls is interrupted.

        Args:
            first: Name of the first scene.
        """
        self._thread.start()
        self.send(ShowScene(first))
        self._ended.wait()

    def close(self) -> None:
        """Close the shown scene and stop listening, once a computation that runs has ended."""
        self.send(None)
        with ended_by_ctrl_c():
            if not self._ended.wait(1.0):
                log.warning("the page ends after the present computation")
        while not self._ended.is_set():
            with ended_by_ctrl_c():  # a second Ctrl-C cannot end a computation either
                self._ended.wait()
        try:
            self._leave()
        finally:
            with contextlib.redirect_stdout(io.StringIO()):
                self.server.stop()

    def _work(self) -> None:
        try:
            while (event := self._next()) is not None:
                self._answer(event)
        finally:
            self._ended.set()

    def _next(self) -> Any:
        """Wait for an event, and take it from the queue."""
        with self._changed:
            self._changed.wait_for(lambda: self._events)
            return self._events.pop(next(iter(self._events)))

    def _answer(self, event: Any) -> None:
        """Handle an event, and show why if that is impossible."""
        ticks = isinstance(event, self._scene.ticks if self._scene else ())
        busy = threading.Timer(0.3, self._say_busy)
        if not ticks:
            busy.start()
        try:
            if isinstance(event, ShowScene):
                self._show(event.name)
            elif (scene := self._scene) is not None:
                doubts = []
                if ticks:
                    scene.state = scene.update(scene.state, event)
                else:
                    with warnings.catch_warnings(record=True) as caught:
                        warnings.simplefilter("always", UserWarning)
                        scene.state = scene.update(scene.state, event)
                    doubts = [str(doubt.message) for doubt in caught if issubclass(doubt.category, UserWarning)]
                self.say("\n".join([scene.state.message, *doubts]))
                scene.draw(scene.state)
        except (I2TError, ValueError, OSError) as error:
            self.say(str(error))
            if isinstance(event, ShowScene):  # a wrong option of the command line
                log.error("%s: %s", event.name, error)
        except Exception as error:
            log.exception("the page could not handle %s", type(event).__name__)
            self.say(f"that failed ({type(error).__name__}: {error}); the terminal has the details")
        finally:
            if not ticks:
                busy.cancel()
                busy.join()
                self._write(self.said)  # without "computing ..."

    def _say_busy(self) -> None:
        self._write(f"{self.said}\ncomputing ...")

    def _leave(self) -> None:
        """Close the shown scene, and forget its events."""
        scene, self._scene = self._scene, None
        if scene is not None:
            scene.close()
        with self._changed:
            self._events = {kind: event for kind, event in self._events.items() if event is None}

    def _show(self, name: str) -> None:
        """Close the shown scene, and build another one."""
        self._leave()
        gui = self.server.gui
        self.server.scene.reset()
        self.server.scene.set_up_direction("+z")
        self.server.scene.configure_default_lights(cast_shadow=False)  # which takes long without a graphics card
        gui.reset()
        gui.set_panel_label(f"i2t: {name}")
        gui.configure_theme(show_logo=False, show_share_button=False)  # a share would make the page public
        choice = gui.add_button_group("scene", tuple(self._scenes))
        self.on(choice.on_click, lambda: ShowScene(choice.value))
        self._message = gui.add_html("")
        self.say(f"{name}: loading ...")
        self._scene = scene = self._scenes[name]()
        scene.build(self)
        self.say(scene.state.message)
        scene.draw(scene.state)


def _require_address(host: str) -> None:
    """Refuse an address that is not one of this machine, at which viser would wait forever (ValueError)."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as test:
            test.bind(address)
    except OSError as error:
        raise ValueError(f"--host {host}: is not an address of this machine; give 127.0.0.1 or 0.0.0.0") from error
