"""A stand-in for a Universal Robots controller, as a process of its own, that the real ur_rtde client accepts.

    python -m i2t.stand_ins.ur_controller --host 127.0.0.9

It opens the ports the client uses (30004 RTDE, 29999 dashboard, 30003 script) and plays the part of the script that the
client uploads: commands and results pass through registers. A tool without arm or joints moves in time, in straight
lines with a trapezoidal speed profile, and meets a springy horizontal plane. Joint values are therefore zero.
Any 127.0.0.x is a robot of its own.

Faults on demand. A fourth port, 30100, takes a line and answers one, for instance
`echo protective | nc -q1 127.0.0.9 30100`; `--after SECONDS COMMAND` does the same once a program has started:

    protective            protective stop; the dashboard's "unlock protective stop" releases it after --unlock-delay
    stall | resume        RTDE packets stop, connections stay open | and come again
    mute                  every port still connects, and answers nothing more
    kill-program          the running program ends at once, as when someone presses stop on the pendant
    local | remote        control is refused: local mode, scripts are ignored | and allowed again
    wrench X Y Z A B C    a constant force (N) and torque (Nm) on the tool, base axes, besides the plane's
    plane Z STIFFNESS     move the plane: height in metres, newtons per metre; stiffness 0 removes it
    speed FRACTION        the speed slider on the pendant
    status                a JSON object: pose, twist, force, program, commands taken, greatest speed so far, since when
                          the tool stands and when the client was heard last (s on the controller's clock)

Sources: Universal Robots' RTDE guide, dashboard server and URScript manuals (watchdog: `rtde_set_watchdog` with the
action "stop"); the register handshake was observed from ur_rtde 1.6.5. The stopping distance, the lever by which
rotation counts as travel, how force mode gives way, the 5 N that end moveUntilContact, and the delays of a real
controller are not modelled on measurements. Of the client's commands those on straight lines and speeds of the tool,
force mode, payload, tool, zeroing, watchdog and stopping are played; any other ends the program, and says so.
"""

import argparse
import contextlib
import json
import selectors
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from i2t.stand_ins import rtde
from i2t.stand_ins.motion import Array, Compliant, Constant, Robot, plane, rotation

TICK = 0.002  # s
SCRIPT, DASHBOARD, RTDE, FAULTS = 30003, 29999, 30004, 30100
STOPPED, PLAYING, PAUSED = 1, 2, 4
MOVE_L, FORCE_MODE, FORCE_MODE_STOP, ZERO_FT, SPEED_L, SPEED_STOP, PAYLOAD, TCP = 3, 6, 7, 8, 10, 15, 17, 29
PROTECTIVE, STOP_L, WATCHDOG, TCP_OFFSET, STEADY, UNTIL_CONTACT, STOP_SCRIPT = 31, 33, 35, 40, 47, 51, 255
UNANSWERED = (FORCE_MODE, SPEED_L)  # repeated as long as the register holds them
TOUCHED = 5.0  # N
READY, DONE = 1, 2


class Controller:
    """The program that the client uploads, played on the robot, and what the safety system does to it."""

    def __init__(self, robot: Robot, unlock_delay: float, limit: float) -> None:
        self.robot, self.unlock_delay, self.limit = robot, unlock_delay, limit
        self.clock = self.heard = self.started = self.stopped_at = self.stood = 0.0
        self.runtime, self.protective, self.local = STOPPED, False, False
        self.ints, self.doubles = [0] * 48, [0.0] * 48
        self.out_ints, self.out_doubles = [0] * 48, [0.0] * 48
        self.slider, self.fraction = 0, 1.0
        self.watchdog: float | None = None
        self.busy: Callable[[], bool] | None = None
        self.running, self.operation, self.writes = False, 0, 0
        self.payload, self.cog, self.offset = 0.0, [0.0] * 3, [0.0] * 6
        self.taken: list[int] = []

    def upload(self) -> None:
        """Start the client's program; whatever ran before ends."""
        if self.local or self.protective:
            return
        self.robot.stop()
        self.runtime, self.started, self.watchdog, self.busy = PLAYING, self.clock, None, None
        self.out_ints[:2] = [READY, 0]
        self._set_running(False)

    def kill(self) -> None:
        """End the program without a word to the client; the robot slows down."""
        self.robot.stop()
        self.runtime, self.watchdog, self.busy = STOPPED, None, None

    def protect(self) -> None:
        """Protective stop: the robot brakes and the program is paused."""
        self.robot.stop(10.0)
        self.protective, self.stopped_at = True, self.clock
        self.runtime = PAUSED if self.runtime == PLAYING else self.runtime

    def unlock(self) -> bool:
        """Release the protective stop, if it is old enough; the program has to be started again."""
        if self.protective and self.clock - self.stopped_at < self.unlock_delay:
            return False
        self.protective, self.runtime = False, STOPPED
        return True

    def write(self, values: dict[str, rtde.Value]) -> None:
        """Take registers from the client; whatever it writes tells the watchdog that it lives."""
        for name, value in values.items():
            kind, _, index = name.rpartition("_")
            if kind == "input_int_register":
                self.ints[int(index)] = int(value)  # type: ignore[arg-type]
                self.heard = self.clock if index == "0" else self.heard
            elif kind == "input_double_register":
                self.doubles[int(index)] = float(value)  # type: ignore[arg-type]
            elif name == "speed_slider_mask":
                self.slider = int(value)  # type: ignore[arg-type]
            elif name == "speed_slider_fraction" and self.slider:
                self.robot.scaling = min(1.0, max(0.0, float(value)))  # type: ignore[arg-type]

    def step(self) -> None:
        """Advance robot, safety and program by a tick."""
        self.clock += TICK
        self.robot.step(TICK)
        if self.robot.motion is not None:
            self.stood = self.clock
        if not self.protective and np.linalg.norm(self.robot.felt()[:3]) > self.limit:
            self.protect()
        if self.running and self.robot.motion is None:
            self._set_running(False)
        if self.runtime == PLAYING and not self.protective:
            if self.watchdog is not None and self.clock - self.heard > self.watchdog:
                self.kill()
            else:
                self._program()

    def _program(self) -> None:
        command, state = self.ints[0], self.out_ints[0]
        if self.busy is not None:
            if self.busy():
                self.busy, self.out_ints[0] = None, DONE
        elif state == DONE and command == 0:
            self.out_ints[0] = READY
        elif state == READY and command != 0:
            if command not in UNANSWERED or self.taken[-1:] != [command]:
                self.taken.append(command)
            try:
                self._execute(command)
            except (ArithmeticError, ValueError) as error:  # as the controller ends a program at a runtime error
                print(f"command {command}: {error}: the program ends", file=sys.stderr, flush=True)
                self.kill()

    def _execute(self, command: int) -> None:
        d, robot = self.doubles, self.robot

        def at_rest() -> bool:
            return robot.motion is None

        finished: Callable[[], bool] = lambda: True  # noqa: E731
        if command == SPEED_L:
            robot.motion = Constant(np.array(d[:6]), d[6])
            return
        if command == FORCE_MODE:
            chosen = np.array(self.ints[2:8], float)
            robot.motion = Compliant(rotation(np.array(d[3:6])), chosen, np.array(d[6:12]), np.array(d[12:18]))
            return
        if command == MOVE_L:
            robot.line_to(np.array(d[:6]), d[6], d[7])
            self._set_running(bool(self.ints[1]))
            finished = finished if self.ints[1] else at_rest
        elif command in (STOP_L, SPEED_STOP):
            robot.stop(d[0])
            finished = finished if command == STOP_L and self.ints[1] else at_rest
        elif command == FORCE_MODE_STOP:
            robot.stop()
        elif command == UNTIL_CONTACT:
            finished = self._until_contact(np.array(d[:6]), d[12])
        elif command == WATCHDOG:
            self.watchdog, self.heard = 1 / d[0], self.clock
        elif command == ZERO_FT:
            robot.zero = robot.felt() + robot.bias
        elif command == PAYLOAD:
            self.payload, self.cog = d[0], d[1:4]
        elif command == TCP:
            self.offset = d[:6]
        elif command == TCP_OFFSET:
            self.out_doubles[:6] = self.offset
        elif command == STEADY:
            self.out_ints[1] = int(robot.motion is None)
        elif command == PROTECTIVE:
            self.protect()
            return
        elif command == STOP_SCRIPT:
            self.kill()
            return
        else:
            print(f"command {command} is not played here: the program ends", file=sys.stderr, flush=True)
            self.kill()
            return
        self.busy = finished

    def _until_contact(self, twist: Array, acceleration: float) -> Callable[[], bool]:
        robot, met = self.robot, [False]
        before, free = robot.felt()[:3], [robot.pose]
        robot.motion = Constant(twist, acceleration)

        def finished() -> bool:
            change = float(np.linalg.norm(robot.felt()[:3] - before))
            if not met[0] and change < 1e-9:
                free[0] = robot.pose
            elif not met[0] and change > TOUCHED:
                met[0] = True
                robot.line_to(free[0], 0.01, acceleration)  # back to where contact began
            self.out_ints[1] = int(met[0])
            return met[0] and robot.motion is None

        return finished

    def _set_running(self, running: bool) -> None:
        if running:
            self.operation = (self.operation + 1) % 128
        self.running, self.writes = running, (self.writes + 1) % 128
        self.out_ints[2] = self.operation << 24 | self.writes << 16 | running << 15

    def output(self, name: str) -> rtde.Value:
        """The value of an output now."""
        kind, _, index = name.rpartition("_")
        if kind == "output_int_register":
            return self.out_ints[int(index)]
        if kind == "output_double_register":
            return self.out_doubles[int(index)]
        return self.state.get(name, nothing(name))

    def observe(self) -> None:
        """Gather what every client is told at this tick."""
        robot, pose = self.robot, tuple(self.robot.pose)
        force, twist = tuple(robot.measured()), tuple(robot.twist)
        self.state: dict[str, rtde.Value] = {
            "timestamp": self.clock,
            "actual_TCP_pose": pose,
            "target_TCP_pose": pose,
            "actual_TCP_speed": twist,
            "target_TCP_speed": twist,
            "actual_TCP_force": force,
            "ft_raw_wrench": force,
            "robot_mode": 7,
            "safety_mode": 3 if self.protective else 1,
            "safety_status_bits": 0x4 if self.protective else 0x1,
            "robot_status_bits": 0x1 | 0x2 * (self.runtime == PLAYING),
            "runtime_state": self.runtime,
            "speed_scaling": robot.scaling,
            "target_speed_fraction": robot.scaling,
            "payload": self.payload,
            "payload_cog": self.cog,
        }

    def status(self) -> dict[str, Any]:
        """What a test or a person wants to know, past the client."""
        robot = self.robot
        return {
            "clock": self.clock,
            "pose": robot.pose.tolist(),
            "twist": robot.twist.tolist(),
            "moving": robot.motion is not None,
            "stood": self.stood,
            "heard": self.heard,
            "force": robot.told().tolist(),
            "fastest": robot.fastest,
            "runtime": self.runtime,
            "protective": self.protective,
            "watchdog": self.watchdog,
            "payload": self.payload,
            "commands": self.taken,
        }


def nothing(name: str) -> rtde.Value:
    """The value of an output that has no counterpart here."""
    return {"VECTOR6D": (0.0,) * 6, "VECTOR3D": (0.0,) * 3, "VECTOR6INT32": (0,) * 6}.get(rtde.OUTPUT_TYPES[name], 0)


class Client:
    """One connection, with what has arrived and not been used."""

    def __init__(self, connection: socket.socket, port: int) -> None:
        self.socket, self.port, self.buffer, self.waiting = connection, port, b"", b""
        self.inputs: dict[int, rtde.Recipe] = {}
        self.names: tuple[str, ...] = ()
        self.layout = struct.Struct("")
        self.every, self.streaming = 1, False


class Server:
    """All ports in one loop that also keeps time."""

    def __init__(self, controller: Controller, host: str, timed: list[tuple[float, str]]) -> None:
        self.controller, self.timed = controller, sorted(timed)
        self.stalled = self.muted = False
        self.ticks = 0
        self.selector = selectors.DefaultSelector()
        self.clients: list[Client] = []
        for port in (RTDE, DASHBOARD, SCRIPT, FAULTS):
            listener = socket.create_server((host, port))
            listener.setblocking(False)
            self.selector.register(listener, selectors.EVENT_READ, port)

    def run(self) -> None:
        """Serve until interrupted."""
        due = time.monotonic()
        while True:
            for key, _ in self.selector.select(max(0.0, due - time.monotonic())):
                if isinstance(key.data, Client):
                    self._receive(key.data)
                else:
                    self._accept(key.fileobj, key.data)  # type: ignore[arg-type]
            now = time.monotonic()
            if now - due > 0.5:  # this process was kept waiting: the robot's time stood still
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
        controller.step()
        self.ticks += 1
        while self.timed and controller.started and controller.clock >= controller.started + self.timed[0][0]:
            self.fault(self.timed.pop(0)[1])
        wanting = [c for c in self.clients if c.streaming and self.ticks % c.every == 0]
        if wanting and not self.stalled:
            controller.observe()
            for client in wanting:
                values = (controller.output(name) for name in client.names)
                self._send(client, rtde.encode(1, client.layout, values))

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
                packets, client.buffer = rtde.split(client.buffer)
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
        if kind == rtde.PROTOCOL:
            self._send(client, rtde.packet(kind, bytes([body == b"\x00\x02"])))
        elif kind == rtde.VERSION:
            self._send(client, rtde.packet(kind, struct.pack(">4I", 5, 11, 0, 108249)))
        elif kind == rtde.OUTPUTS:
            (frequency,) = struct.unpack_from(">d", body)
            wanted = rtde.recipe(body[8:].decode(), rtde.OUTPUT_TYPES)
            client.every = max(1, round(1 / TICK / frequency))
            if wanted.known:
                client.names, client.layout = wanted.names, wanted.layout
            self._send(client, rtde.packet(kind, bytes([wanted.known]) + ",".join(wanted.types).encode()))
        elif kind == rtde.INPUTS:
            wanted = rtde.recipe(body.decode(), rtde.INPUT_TYPES)
            number = len(client.inputs) + 1 if wanted.known else 0
            if wanted.known:
                client.inputs[number] = wanted
            self._send(client, rtde.packet(kind, bytes([number]) + ",".join(wanted.types).encode()))
        elif kind in (rtde.START, rtde.PAUSE):
            client.streaming = kind == rtde.START and bool(client.names)
            self._send(client, rtde.packet(kind, bytes([kind == rtde.PAUSE or client.streaming])))
        elif kind == rtde.DATA and not self.muted:
            self.controller.write(rtde.decode(body, client.inputs))

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


@contextlib.contextmanager
def process(host: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run the stand-in beside this process, from when it is ready until the block is left."""
    command = [sys.executable, "-m", "i2t.stand_ins.ur_controller", "--host", host, *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as running:
        try:
            assert running.stdout is not None
            if not running.stdout.readline():
                raise RuntimeError(f"The UR stand-in did not start on {host}.")
            yield running
        finally:
            running.kill()


def ask(host: str, line: str) -> str:
    """Send a line to the fault port of a running stand-in; returns its answer."""
    with socket.create_connection((host, FAULTS), 5.0) as connection, connection.makefile("rw") as lines:
        lines.write(line + "\n")
        lines.flush()
        return lines.readline().strip()


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m i2t.stand_ins.ur_controller",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--host", default="127.0.0.9", help="address to listen on (default %(default)s)")
    parser.add_argument(
        "--pose",
        type=float,
        nargs=6,
        default=(0.4, 0.0, 0.3, np.pi, 0.0, 0.0),
        metavar=("X", "Y", "Z", "RX", "RY", "RZ"),
        help="tool's pose at the start, metres and rotation vector (default: pointing down, 0.3 m high)",
    )
    parser.add_argument("--plane", type=float, default=0.0, help="height of the plane in m (default %(default)s)")
    parser.add_argument("--stiffness", type=float, default=0.0, help="of the plane in N/m; 0: no plane")
    parser.add_argument("--bias", type=float, nargs=3, default=(0, 0, 0), help="N, what the sensor tells in the air")
    parser.add_argument("--noise", type=float, default=0.0, help="of the force sensor, N, one sigma per axis")
    parser.add_argument("--force-limit", type=float, default=150.0, help="N, protective stop above (default 150)")
    parser.add_argument("--unlock-delay", type=float, default=5.0, help="s, before a protective stop can be released")
    parser.add_argument(
        "--after", nargs=2, action="append", default=[], metavar=("SECONDS", "COMMAND"), help="fault after the start"
    )
    args = parser.parse_args(arguments)
    contact, bias = plane(args.plane, args.stiffness), np.array([*args.bias, 0.0, 0.0, 0.0], float)
    robot = Robot(np.array(args.pose), contact, bias, args.noise)
    try:
        timed = [(float(seconds), command) for seconds, command in args.after]
        server = Server(Controller(robot, args.unlock_delay, args.force_limit), args.host, timed)
    except (OSError, ValueError) as error:
        sys.exit(f"The stand-in cannot start on {args.host}: {error}.")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    print(f"simulated UR controller on {args.host}, ready", flush=True)
    with contextlib.suppress(KeyboardInterrupt):
        server.run()


if __name__ == "__main__":
    main()
