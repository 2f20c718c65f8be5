"""The ports of a UR controller, in one loop that also keeps its time."""

import json
import selectors
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Iterator

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import plane
from i2t.emulators.ur_program import PLAYING, TICK, Controller

SCRIPT, DASHBOARD, RTDE, FAULTS = 30003, 29999, 30004, 30100


class Client:
    """One connection, with what has arrived and not been used."""

    def __init__(self, connection: socket.socket, port: int) -> None:
        self.socket, self.port, self.buffer, self.waiting = connection, port, b"", b""
        self.inputs: dict[int, rtde_protocol.Recipe] = {}
        self.names: tuple[str, ...] = ()
        self.layout = struct.Struct("")
        self.every, self.streaming = 1, False


class Server:
    """All ports in one loop that also keeps time."""

    def __init__(
        self,
        controller: Controller,
        host: str,
        timed: list[tuple[float, str]],
        latency: float = 0.0,
        tethered: bool = False,
    ) -> None:
        self.controller, self.timed, self.latency = controller, sorted(timed), latency
        self.coming: deque[tuple[float, dict[str, rtde_protocol.Value]]] = deque()
        self.stalled = self.muted = False
        self.ticks = 0
        self.selector = selectors.DefaultSelector()
        self.clients: list[Client] = []
        for port in (RTDE, DASHBOARD, SCRIPT, FAULTS):
            listener = socket.create_server((host, port))
            listener.setblocking(False)
            self.selector.register(listener, selectors.EVENT_READ, port)
        if tethered:
            self.selector.register(sys.stdin, selectors.EVENT_READ, None)

    def run(self) -> None:
        """Serve until interrupted, or until a tethered one's standard input ends."""
        due = time.monotonic()
        while True:
            for key, _ in self.selector.select(max(0.0, due - time.monotonic())):
                if isinstance(key.data, Client):
                    self._receive(key.data)
                elif key.data is None:
                    return
                else:
                    self._accept(key.fileobj, key.data)  # type: ignore[arg-type]
            now = time.monotonic()
            if now - due > 0.1:  # this process was kept waiting: the robot's time stood still
                due = now
            while due <= now:
                self._tick()
                due += TICK

    def _accept(self, listener: socket.socket, port: int) -> None:
        connection, _ = listener.accept()
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client = Client(connection, port)
        self.clients.append(client)
        self.selector.register(connection, selectors.EVENT_READ, client)
        if port == DASHBOARD:
            self._send(client, b"Connected: Universal Robots Dashboard Server\n")

    def _tick(self) -> None:
        controller = self.controller
        while self.coming and self.coming[0][0] <= controller.clock:
            controller.write(self.coming.popleft()[1])
        controller.step()
        self.ticks += 1
        while self.timed and controller.started and controller.clock >= controller.started + self.timed[0][0]:
            self.fault(self.timed.pop(0)[1])
        wanting = [c for c in self.clients if c.streaming and self.ticks % c.every == 0]
        if wanting and not self.stalled:
            controller.observe()
            for client in wanting:
                values = (controller.output(name) for name in client.names)
                self._send(client, rtde_protocol.encode(1, client.layout, values))

    def _send(self, client: Client, data: bytes) -> None:
        if self.muted and client.port != FAULTS:
            return
        client.waiting += data
        try:
            client.waiting = client.waiting[client.socket.send(client.waiting) :]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
        if len(client.waiting) > 1 << 20:  # nobody reads
            self._drop(client)

    def _drop(self, client: Client) -> None:
        if client in self.clients:
            self.clients.remove(client)
            self.selector.unregister(client.socket)
            client.socket.close()

    def _receive(self, client: Client) -> None:
        try:
            data = client.socket.recv(1 << 16)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        client.buffer += data
        try:
            if client.port == RTDE:
                packets, client.buffer = rtde_protocol.split(client.buffer)
                for kind, body in packets:
                    self._rtde(client, kind, body)
            elif client.port == SCRIPT:
                self._script(client)
            else:
                for line in self._lines(client):
                    answer = self.dashboard(line) if client.port == DASHBOARD else self.fault(line)
                    self._send(client, answer.encode() + b"\n")
        except (ValueError, ArithmeticError, struct.error) as error:
            print(f"{error}: connection to port {client.port} closed", file=sys.stderr, flush=True)
            self._drop(client)

    @staticmethod
    def _lines(client: Client) -> Iterator[str]:
        while b"\n" in client.buffer:
            line, client.buffer = client.buffer.split(b"\n", 1)
            yield line.decode().strip()

    def _rtde(self, client: Client, kind: int, body: bytes) -> None:
        if kind == rtde_protocol.PROTOCOL:
            self._send(client, rtde_protocol.packet(kind, bytes([body == b"\x00\x02"])))
        elif kind == rtde_protocol.VERSION:
            self._send(client, rtde_protocol.packet(kind, struct.pack(">4I", 5, 11, 0, 108249)))
        elif kind == rtde_protocol.OUTPUTS:
            (frequency,) = struct.unpack_from(">d", body)
            wanted = rtde_protocol.recipe(body[8:].decode(), rtde_protocol.OUTPUT_TYPES)
            client.every = max(1, round(1 / TICK / frequency))
            if wanted.known:
                client.names, client.layout = wanted.names, wanted.layout
            self._send(client, rtde_protocol.packet(kind, bytes([wanted.known]) + ",".join(wanted.types).encode()))
        elif kind == rtde_protocol.INPUTS:
            wanted = rtde_protocol.recipe(body.decode(), rtde_protocol.INPUT_TYPES)
            number = len(client.inputs) + 1 if wanted.known else 0
            if wanted.known:
                client.inputs[number] = wanted
            self._send(client, rtde_protocol.packet(kind, bytes([number]) + ",".join(wanted.types).encode()))
        elif kind in (rtde_protocol.START, rtde_protocol.PAUSE):
            client.streaming = kind == rtde_protocol.START and bool(client.names)
            self._send(client, rtde_protocol.packet(kind, bytes([kind == rtde_protocol.PAUSE or client.streaming])))
        elif kind == rtde_protocol.DATA and not self.muted:
            self.coming.append((self.controller.clock + self.latency, rtde_protocol.decode(body, client.inputs)))

    def _script(self, client: Client) -> None:
        # Only the client's own program is known here; it ends with the first line that is "end" without indentation.
        if b"def rtde_control():" in client.buffer and b"\nend\n" in client.buffer and not self.muted:
            client.buffer = b""
            self.controller.upload()

    def dashboard(self, line: str) -> str:
        """Answer a line on the dashboard port."""
        controller = self.controller
        match line.lower():
            case "polyscopeversion":
                return "URSoftware 5.11.0.108249 (Jan 01 2022)"
            case "get serial number":
                return "20200000001"
            case "is in remote control":
                return "false" if controller.local else "true"
            case "running":
                return f"Program running: {str(controller.runtime == PLAYING).lower()}"
            case "robotmode":
                return "Robotmode: RUNNING"
            case "safetystatus":
                return f"Safetystatus: {'PROTECTIVE_STOP' if controller.protective else 'NORMAL'}"
            case "stop":
                controller.kill()
                return "Stopped"
            case "unlock protective stop":
                released = controller.unlock()
                return (
                    "Protective stop releasing"
                    if released
                    else "Cannot unlock protective stop until 5s after occurrence"
                )
            case "close safety popup" | "close popup":
                return f"closing {line.split(' ', 1)[1].lower()}"
        return f"could not understand: '{line}'"

    def fault(self, line: str) -> str:
        """Do what a line on the fault port asks."""
        controller, robot = self.controller, self.controller.robot
        try:
            match line.split():
                case ["protective"]:
                    controller.protect()
                case ["stall" | "resume" as word]:
                    self.stalled = word == "stall"
                case ["mute"]:
                    self.muted = True
                case ["kill-program"]:
                    controller.kill()
                case ["drop-control" | "drop-state" as word]:
                    for client in [each for each in self.clients if each.port == RTDE]:
                        if bool(client.inputs) == (word == "drop-control"):
                            self._drop(client)
                case ["local" | "remote" as word]:
                    controller.local = word == "local"
                case ["wrench", *numbers]:
                    robot.extra = np.array([float(number) for number in numbers]).reshape(6)
                case ["plane", height, stiffness]:
                    robot.contact = plane(float(height), float(stiffness))
                case ["speed", fraction]:
                    robot.scaling = min(1.0, max(0.0, float(fraction)))
                case ["status"]:
                    return json.dumps(controller.status())
                case _:
                    return f"unknown: {line}"
        except ValueError:
            return f"unknown: {line}"
        return "ok"
