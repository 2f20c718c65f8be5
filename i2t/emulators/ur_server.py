"""The ports of a UR controller, in one loop that also keeps its time."""

import json
import selectors
import socket
import struct
import sys
import time
from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import plane
from i2t.emulators.ur_program import PLAYING, TICK, Controller

SCRIPT_PORT, DASHBOARD_PORT, RTDE_PORT, FAULT_PORT = 30003, 29999, 30004, 30100
MAX_UNREAD_BYTES = 1 << 20  # of a client that does not read, which is then dropped
MAX_LATE_S = 0.1  # that this process may be kept waiting before the robot's time stands still
SCRIPT_BEGIN, SCRIPT_END = b"def rtde_control():", b"\nend\n"  # of the only program that is known here
CONTROLLER_VERSION = (5, 11, 0, 108249)
OK, UNKNOWN = "ok", "unknown: {}"  # answers of the fault port


class Client:
    """One connection, with what has arrived and not been used, and what waits to be sent.

    Args:
        connection: Accepted.
        port: Of the server.
    """

    def __init__(self, connection: socket.socket, port: int) -> None:
        self.socket, self.port, self.received, self.unsent = connection, port, b"", b""
        self.inputs: dict[int, rtde_protocol.Recipe] = {}
        self.names: tuple[str, ...] = ()  # of the outputs that it is sent
        self.layout = struct.Struct("")
        self.every, self.streaming = 1, False  # ticks between two packets

    @property
    def controls(self) -> bool:
        """Tell whether it is a client that writes registers, not one that only listens."""
        return bool(self.inputs)


class Server:
    """All ports of a controller, and its time.

    Args:
        controller: What runs.
        host: Address of this machine to listen on.
        timed_faults: Seconds after a program has started, and the line of the fault port that is done then.
        latency: s that a client's registers take to reach the program.
        tethered: Whether to end when standard input closes.
    """

    def __init__(
        self,
        controller: Controller,
        host: str,
        timed_faults: Sequence[tuple[float, str]] = (),
        latency: float = 0.0,
        tethered: bool = False,
    ) -> None:
        self.controller, self.timed_faults, self.latency = controller, sorted(timed_faults), latency
        self.delayed_inputs: deque[tuple[float, dict[str, rtde_protocol.Value]]] = deque()  # clock, values
        self.stalled = self.muted = False
        self.ticks = 0
        self.selector = selectors.DefaultSelector()
        self.clients: list[Client] = []
        for port in (RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT, FAULT_PORT):
            listener = socket.create_server((host, port))
            listener.setblocking(False)
            self.selector.register(listener, selectors.EVENT_READ, port)
        if tethered:
            self.selector.register(sys.stdin, selectors.EVENT_READ, None)

    def run(self) -> None:
        """Serve until interrupted, or until the standard input of a tethered server ends."""
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
            if now - due > MAX_LATE_S:
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
        if port == DASHBOARD_PORT:
            self._send(client, b"Connected: Universal Robots Dashboard Server\n")

    def _tick(self) -> None:
        controller = self.controller
        while self.delayed_inputs and self.delayed_inputs[0][0] <= controller.clock:
            controller.write(self.delayed_inputs.popleft()[1])
        controller.step()
        self.ticks += 1
        while (
            self.timed_faults
            and controller.start_clock
            and controller.clock >= controller.start_clock + self.timed_faults[0][0]
        ):
            self.fault(self.timed_faults.pop(0)[1])
        due = [client for client in self.clients if client.streaming and self.ticks % client.every == 0]
        if due and not self.stalled:
            controller.observe()
            for client in due:
                values = (controller.output(name) for name in client.names)
                self._send(client, rtde_protocol.encode(1, client.layout, values))

    def _send(self, client: Client, data: bytes) -> None:
        if self.muted and client.port != FAULT_PORT:
            return
        client.unsent += data
        try:
            client.unsent = client.unsent[client.socket.send(client.unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
        if len(client.unsent) > MAX_UNREAD_BYTES:
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
        client.received += data
        try:
            if client.port == RTDE_PORT:
                packets, client.received = rtde_protocol.split(client.received)
                for kind, body in packets:
                    self._rtde(client, kind, body)
            elif client.port == SCRIPT_PORT:
                self._script(client)
            else:
                for line in self._lines(client):
                    answer = self.dashboard(line) if client.port == DASHBOARD_PORT else self.fault(line)
                    self._send(client, answer.encode() + b"\n")
        except (ValueError, ArithmeticError, struct.error) as error:
            print(f"{error}: connection to port {client.port} closed", file=sys.stderr, flush=True)
            self._drop(client)

    @staticmethod
    def _lines(client: Client) -> Iterator[str]:
        while b"\n" in client.received:
            line, client.received = client.received.split(b"\n", 1)
            yield line.decode().strip()

    def _rtde(self, client: Client, kind: int, body: bytes) -> None:
        if kind == rtde_protocol.PROTOCOL:
            self._send(client, rtde_protocol.packet(kind, bytes([body == b"\x00\x02"])))
        elif kind == rtde_protocol.VERSION:
            self._send(client, rtde_protocol.packet(kind, struct.pack(">4I", *CONTROLLER_VERSION)))
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
            self.delayed_inputs.append(
                (self.controller.clock + self.latency, rtde_protocol.decode(body, client.inputs))
            )

    def _script(self, client: Client) -> None:
        if SCRIPT_BEGIN in client.received and SCRIPT_END in client.received and not self.muted:
            client.received = b""
            self.controller.upload()

    def dashboard(self, line: str) -> str:
        """Do what a line on the dashboard port asks.

        Args:
            line: Of Universal Robots' dashboard.

        Returns:
            The answer.
        """
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
        """Do what a line on the fault port asks.

        Args:
            line: As in `i2t.emulators.ur_controller`.

        Returns:
            "ok", the status, or that the line is unknown.
        """
        controller, robot = self.controller, self.controller.robot
        try:
            match line.split():
                case ["protective"]:
                    controller.protective_stop()
                case ["stall" | "resume" as word]:
                    self.stalled = word == "stall"
                case ["mute"]:
                    self.muted = True
                case ["kill-program"]:
                    controller.kill()
                case ["drop-control" | "drop-state" as word]:
                    for client in [each for each in self.clients if each.port == RTDE_PORT]:
                        if client.controls == (word == "drop-control"):
                            self._drop(client)
                case ["local" | "remote" as word]:
                    controller.local = word == "local"
                case ["wrench", *numbers]:
                    robot.external_wrench = np.array([float(number) for number in numbers]).reshape(6)
                case ["plane", height, stiffness]:
                    robot.contact = plane(float(height), float(stiffness))
                case ["tcp", *numbers] if len(numbers) == 6:
                    controller.pendant_tcp = [float(number) for number in numbers]
                case ["speed", fraction]:
                    robot.speed_fraction = min(1.0, max(0.0, float(fraction)))
                case ["status"]:
                    return json.dumps(controller.status())
                case _:
                    return UNKNOWN.format(line)
        except ValueError:
            return UNKNOWN.format(line)
        return OK
