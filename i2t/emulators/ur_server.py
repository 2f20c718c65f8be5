"""Ports of a UR controller, served in one loop that also keeps the controller's time."""

import asyncio
import contextlib
import json
import logging
import struct
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from functools import partial
from typing import TypeAlias

import numpy as np

from i2t.emulators import rtde_protocol
from i2t.emulators.robot_motion import plane
from i2t.emulators.rtde_protocol import PacketType
from i2t.emulators.ur_program import PLAYING, TICK, Controller

log = logging.getLogger(__name__)

Serve: TypeAlias = Callable[["Client"], Awaitable[None]]

SCRIPT_PORT, DASHBOARD_PORT, RTDE_PORT = 30003, 29999, 30004  # TCP ports of a UR controller
# TCP port on which the emulated controller takes requests to fail; a real controller has no such port
FAULT_PORT = 30100


class Client:
    """A client's connection to one port of the emulated controller.

    Args:
        reader: Stream of the bytes that the client sends.
        writer: Stream of the bytes to the client.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.inputs: dict[int, rtde_protocol.Recipe] = {}  # recipes of the registers that it writes
        self.outputs = rtde_protocol.recipe("")  # recipe of the outputs that it receives
        self.every, self.streaming = 1, False  # ticks between two packets

    def send(self, data: bytes) -> None:
        """Send bytes to the client; drop a client that has left more than a mebibyte unread.

        Args:
            data: Bytes to send.
        """
        transport = self.writer.transport
        if not transport.is_closing():
            transport.write(data)
        if transport.get_write_buffer_size() > 1 << 20:
            transport.abort()

    async def packets(self) -> AsyncIterator[tuple[int, bytes]]:
        """Read RTDE packets as type and body; raise ValueError for an impossible size."""
        while True:
            size, kind = rtde_protocol.PACKET_HEADER.unpack(await self.reader.readexactly(3))
            if size < rtde_protocol.PACKET_HEADER.size:
                raise ValueError(f"an RTDE packet cannot be {size} bytes long")
            yield kind, await self.reader.readexactly(size - rtde_protocol.PACKET_HEADER.size)


class Server:
    """Server of all ports of an emulated UR controller (script, dashboard, RTDE, faults), which runs it in real time.

    Args:
        controller: The emulated controller.
        host: Address of this machine to listen on.
        tethered: Whether to end when standard input closes.
    """

    def __init__(self, controller: Controller, host: str, tethered: bool = False) -> None:
        self.controller, self.host, self.tethered = controller, host, tethered
        self.stalled = self.stalled_control = self.muted = False
        self.rtde_clients: list[Client] = []

    async def run(self, ready: Callable[[], None]) -> None:
        """Serve all ports until cancelled, or until the standard input of a tethered server ends.

        Args:
            ready: Function that is called once all ports are open.

        Raises:
            OSError: If a port cannot be opened.
        """
        ports: dict[int, Serve] = {
            RTDE_PORT: self._rtde, DASHBOARD_PORT: self._dashboard, SCRIPT_PORT: self._script,
            FAULT_PORT: partial(self._answer_lines, self.fault),
        }  # fmt: skip
        for port, serve in ports.items():
            await asyncio.start_server(partial(self._accept, serve), self.host, port)
        ended = asyncio.Event()
        if self.tethered:
            asyncio.get_running_loop().add_reader(sys.stdin, ended.set)
        ready()
        due = time.monotonic()
        while not ended.is_set():
            await asyncio.sleep(max(0.0, due - time.monotonic()))
            for _ in range(3):  # passes in which received data reaches the program before its next tick
                await asyncio.sleep(0)
            now = time.monotonic()
            due = now if now - due > 0.1 else due  # the robot's time stands still while this process is suspended
            while due <= now:
                self._tick()
                due += TICK

    async def _accept(self, serve: Serve, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client until it ends or sends something impossible."""
        client = Client(reader, writer)
        try:
            await serve(client)
        except (asyncio.IncompleteReadError, asyncio.CancelledError, OSError):
            pass
        except (ValueError, ArithmeticError, struct.error) as error:
            log.warning("%s: a connection is closed", error)
        finally:
            with contextlib.suppress(ValueError):
                self.rtde_clients.remove(client)
            writer.close()

    def _tick(self) -> None:
        controller = self.controller
        controller.step()
        tick = round(controller.clock / TICK)
        due = [client for client in self.rtde_clients if client.streaming and tick % client.every == 0]
        if due and not self.stalled and not self.muted:
            controller.observe()
            for client in (client for client in due if not (self.stalled_control and client.inputs)):
                values = (controller.output(name) for name in client.outputs.names)
                client.send(rtde_protocol.encode(1, client.outputs.layout, values))

    async def _rtde(self, client: Client) -> None:
        self.rtde_clients.append(client)
        async for kind, body in client.packets():
            if self.muted:
                continue
            if kind == PacketType.DATA:
                self.controller.write(rtde_protocol.decode(body, client.inputs))
            elif answer := self._answer(client, kind, body):
                client.send(rtde_protocol.packet(kind, answer))

    def _answer(self, client: Client, kind: int, body: bytes) -> bytes:
        """Answer a request; the body is empty if there is no answer."""
        match kind:
            case PacketType.PROTOCOL:
                return bytes([body == b"\x00\x02"])
            case PacketType.VERSION:
                return struct.pack(">4I", 5, 11, 0, 108249)
            case PacketType.OUTPUTS:
                (frequency,) = struct.unpack_from(">d", body)
                wanted = rtde_protocol.recipe(body[8:].decode())
                client.every = max(1, round(1 / TICK / frequency))
                client.outputs = wanted if wanted.valid else client.outputs
                return bytes([wanted.valid]) + ",".join(wanted.types).encode()
            case PacketType.INPUTS:
                wanted = rtde_protocol.recipe(body.decode())
                number = len(client.inputs) + 1 if wanted.valid else 0
                if wanted.valid:
                    client.inputs[number] = wanted
                return bytes([number]) + ",".join(wanted.types).encode()
            case PacketType.START | PacketType.PAUSE:
                client.streaming = kind == PacketType.START and bool(client.outputs.names)
                return bytes([kind == PacketType.PAUSE or client.streaming])
        return b""

    async def _script(self, client: Client) -> None:
        received = b""
        while data := await client.reader.read(1 << 16):
            received += data
            # The only emulated program.
            if b"def rtde_control():" in received and b"\nend\n" in received and not self.muted:
                received = b""
                self.controller.upload()

    async def _dashboard(self, client: Client) -> None:
        if not self.muted:
            client.send(b"Connected: Universal Robots Dashboard Server\n")
        await self._answer_lines(lambda line: "" if self.muted else self.dashboard(line), client)

    async def _answer_lines(self, answer: Callable[[str], str], client: Client) -> None:
        """Answer lines of text. An empty answer is not sent."""
        while line := await client.reader.readline():
            if text := answer(line.decode().strip()):
                client.send(text.encode() + b"\n")

    def dashboard(self, line: str) -> str:
        """Execute a command that a client sent to the dashboard port.

        Args:
            line: Command of Universal Robots' dashboard.

        Returns:
            The dashboard's answer.
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
                controller.unlock()
                return "Protective stop releasing"
            case "close safety popup" | "close popup":
                return f"closing {line.split(' ', 1)[1].lower()}"
        return f"could not understand: '{line}'"

    def fault(self, line: str) -> str:
        """Execute a command that was sent to the fault port.

        Args:
            line: Command as in `i2t.emulators.ur_controller`.

        Returns:
            "ok", the status, or a message that the line is unknown.
        """
        controller, robot = self.controller, self.controller.robot
        try:
            match line.split():
                case ["protective"]:
                    controller.protective_stop()
                case ["stall" | "stall-control" | "resume" as word]:
                    self.stalled, self.stalled_control = word == "stall", word == "stall-control"
                case ["forge"]:
                    controller.forged.clear()
                case ["forge", name, *numbers] if numbers:
                    values = [float(number) for number in numbers]
                    size = struct.calcsize(rtde_protocol.STRUCT_CODES[rtde_protocol.recipe(name).types[0]]) // 8
                    controller.forged[name] = values[0] if size <= 1 else (values * size)[:size]
                case ["mute"]:
                    self.muted = True
                case ["kill-program"]:
                    controller.kill()
                case ["drop-control" | "drop-state" as word]:
                    for client in self.rtde_clients:
                        if bool(client.inputs) == (word == "drop-control"):
                            client.writer.transport.abort()
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
                    return f"unknown: {line}"
        except (ValueError, KeyError):
            return f"unknown: {line}"
        return "ok"
