"""The process that holds ur_rtde's connections to a UR controller; `i2t.hardware.ur.rtde_link` starts it.

ur_rtde 1.6 runs in a process of its own because of what it does when its control connection breaks: it reconnects, from
a thread of its own. That may crash the process (segmentation fault), and it restarts the program on the controller
without a watchdog. So once both connections exist, this process gives up the right to open another socket
(`RLIMIT_NOFILE`). An attempt ends the process; the controller, whose watchdog is no longer fed, ends the program. The
driver sees the end of the channel at once and sends "stop" to the dashboard.

In a loop of 10 ms the process reads the controller's state, brakes if a force or torque is above its limit, carries out
the driver's commands, and passes the driver's heartbeats on to the controller's watchdog. So the arm stops if either
process dies or hangs. When the channel ends, the process ends the program on the controller, and then itself.

The process also ends, without a command to the controller, if a state holds a value that is not finite, or if one of
the two connections has received nothing for the state timeout: the library keeps the last registers of a stalled
stream, and reports it as connected for another 2.5 s. The kernel reports when a connection last received data (Linux
only).

Messages are lines of JSON over a socket, which is standard input. The driver sends `{"heartbeat": true}` and
`{"command": name, "id": n, "arguments": {...}}`. It receives `{"ready": true}`, `{"state": {...}}`, `{"answer": n,
"error": null}` and, before the process ends, `{"error": sentence, "late": bool}`, where late means that a stream fell
silent. The process imports only the standard library and ur_rtde, so that it starts quickly and from any folder; the
safety limits come with the driver's request.
"""

import contextlib
import json
import math
import os
import signal
import socket
import struct
import sys
import threading
import time
from typing import Any, NamedTuple, TypeAlias

Message: TypeAlias = dict[str, Any]

POLL_S = 0.01  # s between two polls of the arm's state
STATE_RATE_HZ = 125.0  # Hz, rate at which the controller is asked to send states of the arm
RTDE_PORT = 30004  # TCP port of RTDE on a UR controller
# RTDE's runtime_state while a program plays, and two bits of RTDE's safety_status_bits
PLAYING, NORMAL, REDUCED = 2, 0x1, 0x2
# ms since data last arrived: field tcpi_last_data_recv of Linux's struct tcp_info
TCP_LAST_RECEIVED = struct.Struct("52xI")


class WorkerLimits(NamedTuple):
    """Safety limits (from `i2t.hardware.limits`) that the worker process between driver and UR controller needs.

    They are the rate of the heartbeats (Hz), timeouts (s), the deceleration of a stop (m/s^2), and the speed below
    which the tool counts as standing (m/s, rad/s).
    """

    watchdog_rate: float  # Hz, minimum rate of the heartbeats
    state_timeout: float  # s, maximum time for which a connection may receive nothing
    braking: float  # m/s^2, deceleration of a stop
    standing_speed: float  # m/s and rad/s, speed below which the tool counts as standing
    brake_settling: float  # s, time on the controller's clock after a brake in which states from before it may arrive
    start_timeout: float  # s, time in which a requested motion must show in the state
    exit_timeout: int  # s, time for the program on the controller to end, after which this process ends in any case


class Channel:
    """Message channel between driver and worker process: lines of JSON over a socket, usable from any thread.

    Args:
        end: One end of a pair of sockets.
    """

    def __init__(self, end: socket.socket) -> None:
        self._out, self._in = end, end.dup()  # two objects, because each has one timeout
        self._out.settimeout(1.0)  # s, for the other side to read
        self._sending = threading.Lock()
        self._rest = b""

    def send(self, message: Message) -> None:
        """Send a message to the other process.

        Args:
            message: Message of values that JSON can hold.

        Raises:
            OSError: The other process is gone, or has not read for a second.
        """
        with self._sending:
            self._out.sendall(json.dumps(message).encode() + b"\n")

    def receive(self, timeout_s: float) -> list[Message]:
        """Return the messages that have arrived from the other process, or wait for one.

        Args:
            timeout_s: Maximum wait in s.

        Returns:
            The messages in order; empty if none arrived in time.

        Raises:
            EOFError: The other process has ended.
        """
        self._in.settimeout(timeout_s)
        try:
            chunk = self._in.recv(1 << 16)
        except TimeoutError:
            return []
        except OSError as error:
            raise EOFError(str(error)) from error
        if not chunk:
            raise EOFError("the channel was closed")
        *lines, self._rest = (self._rest + chunk).split(b"\n")
        return [json.loads(line) for line in lines]

    def close(self) -> None:
        """Close the socket in both directions, so that the other process notices."""
        with contextlib.suppress(OSError):
            self._out.shutdown(socket.SHUT_RDWR)
        self._out.close()
        self._in.close()


class Streams:
    """The open connections of ur_rtde over which a UR controller streams its state, to detect silent ones."""

    def __init__(self) -> None:
        self._ends: list[socket.socket] = []
        for name in os.listdir("/dev/fd"):
            with contextlib.suppress(OSError):  # not a socket, or the folder itself
                end = socket.socket(fileno=int(name))
                with contextlib.suppress(OSError):  # not connected
                    if end.getpeername()[1:2] == (RTDE_PORT,):
                        self._ends.append(end)
                        continue
                end.detach()  # leave the library's socket open

    def silent_time(self) -> float:
        """Measure for how long the connection that has been silent longest received nothing.

        Returns:
            Time in s since that connection received data; 0 if the kernel does not report it, infinite if a connection
            is gone.
        """
        if not hasattr(socket, "TCP_INFO"):
            return 0.0
        try:
            ages = [end.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_LAST_RECEIVED.size) for end in self._ends]
        except OSError:
            return math.inf
        return max((1e-3 * float(TCP_LAST_RECEIVED.unpack(age)[0]) for age in ages), default=math.inf)


class Worker:
    """Worker process between driver and UR controller: reads states, guards motions and carries out commands.

    Args:
        channel: Channel to the driver.
        control: The RTDEControlInterface of ur_rtde.
        receive: The RTDEReceiveInterface of ur_rtde.
        limits: Safety limits of the worker process.
    """

    def __init__(self, channel: Channel, control: Any, receive: Any, limits: WorkerLimits) -> None:
        self.channel, self.control, self.receive = channel, control, receive
        self.limits, self.streams = limits, Streams()
        self.watchdog_set = False
        self.pendant_tcp = [0.0] * 6  # m, rad: the TCP that was set on the controller before ours
        self.heartbeat_time = -math.inf
        self.state: Message | None = None
        self.bounds: tuple[float, float] | None = None  # N, Nm, of the motion under way
        self.pending: tuple[int, float] | None = None  # operation before a requested motion, and time of the request
        self.braked_clock = -math.inf  # s, the controller's clock at the last brake

    def serve(self) -> None:
        """Serve the driver until it ends (EOFError), a connection breaks or sends bad states (ConnectionError), or one
        falls silent (TimeoutError).
        """
        while True:
            if not self.control.isConnected() or not self.receive.isConnected():
                raise ConnectionError("the controller closed it")
            silence = self.streams.silent_time()
            if not silence <= self.limits.state_timeout:
                raise TimeoutError(f"one of its streams has been silent for {silence:.2f} s")
            self.send_new_state()
            self.process(self.channel.receive(POLL_S))

    def process(self, messages: list[Message]) -> None:
        """Process the driver's messages: feed the controller's watchdog once for all heartbeats, and execute commands.

        Args:
            messages: Messages of the driver, in order.
        """
        if any("heartbeat" in message for message in messages):
            self.heartbeat_time = time.monotonic()
            if self.state is not None and self.state["program"]:
                self.control.kickWatchdog()
        for message in messages:
            if "command" in message:
                self.execute(message)

    def execute(self, message: Message) -> None:
        """Execute a command of the driver, send the state that results, and answer.

        Args:
            message: Command with its arguments and the number of its answer.
        """
        commands = {
            "set_watchdog": self.set_watchdog,
            "move": self.move,
            "brake": self.brake,
            "zero_wrench": self.control.zeroFtSensor,
            "end_program": self.control.stopScript,
        }
        error = None
        try:
            commands[message["command"]](**message["arguments"])
            self.send_new_state()
        except (RuntimeError, ValueError) as failure:
            error = str(failure)
        self.channel.send({"answer": message["id"], "error": error})

    def send_new_state(self) -> None:
        """Send the controller's state to the driver if it is new; brake if force or torque exceeds the motion's bounds.

        Raises:
            ConnectionError: A value of the state is not finite.
        """
        clock, last = self.receive.getTimestamp(), self.state
        if not (clock > 0.0 and (last is None or clock > last["clock"] or self.pending is not None)):
            return
        state = self.read_state(clock)
        for name in ("pose", "twist", "wrench", "joints"):
            if not all(map(math.isfinite, state[name])):
                raise ConnectionError(f"its {name} is {state[name]}, which is not finite")
        force, torque = math.hypot(*state["wrench"][:3]), math.hypot(*state["wrench"][3:])
        max_force, max_torque = self.bounds or (math.inf, math.inf)
        tripped = not (force <= max_force and torque <= max_torque)  # NaN trips too
        self.send_state(state, tripped)
        if tripped:
            self.brake()
        elif not state["moving"]:
            self.bounds = None

    def read_state(self, clock: float) -> Message:
        """Read the controller's state from ur_rtde as one message.

        Args:
            clock: Time of the state on the controller's clock, in s.

        Returns:
            The state in metres, radians and newtons; pose, twist and wrench along the axes of the robot's base.
        """
        receive, last = self.receive, self.state
        now = time.monotonic() if last is None or clock > last["clock"] else last["time"]
        progress = self.control.getAsyncOperationProgressEx()
        operation = progress.operationId()
        pending, timeout = self.pending, self.limits.start_timeout
        if pending is not None and (operation != pending[0] or now > pending[1] + timeout):
            self.pending = None
        twist = receive.getActualTCPSpeed()
        safe = bool(receive.getSafetyStatusBits() & (NORMAL | REDUCED))
        program = receive.getRuntimeState() == PLAYING
        # A program that has ended leaves its registers behind: then only the speed shows a motion.
        busy = program and safe and (progress.isAsyncOperationRunning() or self.pending is not None)
        braking = clock < self.braked_clock + self.limits.brake_settling
        return {
            "time": now,
            "clock": clock,
            "pose": receive.getActualTCPPose(),
            "twist": twist,
            "wrench": receive.getActualTCPForce(),
            "joints": receive.getActualQ(),
            "moving": bool(busy or braking or not math.hypot(*twist) <= self.limits.standing_speed),
            "safe": safe,
            "program": program,
            "speed_share": receive.getTargetSpeedFraction(),
        }

    def send_state(self, state: Message, tripped: bool = False) -> None:
        """Store a state of the controller as the newest, and send it to the driver.

        Args:
            state: State as `read_state` returns it.
            tripped: Whether force or torque exceeds the bounds of the motion, which is therefore stopped.
        """
        self.state = state
        self.channel.send({"state": state, "tripped": tripped})

    def set_watchdog(self) -> None:
        """Set the controller's watchdog to end the program when heartbeats stop; raise RuntimeError if refused."""
        if not self.control.setWatchdog(self.limits.watchdog_rate):
            raise RuntimeError("it did not take the watchdog")
        self.watchdog_set = True

    def move(self, pose: list[float], speed: float, acceleration: float, force: float, torque: float) -> None:
        """Start a straight motion of the tool that is stopped above a force or torque.

        Args:
            pose: Goal of the tool in the base: x, y, z (m) and a rotation vector (rad).
            speed: Speed in m/s.
            acceleration: Acceleration in m/s^2.
            force: Force in N.
            torque: Torque in Nm.

        Raises:
            RuntimeError: The watchdog would not end the motion, or the controller refused it.
        """
        if self.state is None or not self.state["program"]:
            raise RuntimeError("the program on the controller does not run")
        if not self.watchdog_set or time.monotonic() - self.heartbeat_time > 1 / self.limits.watchdog_rate:
            raise RuntimeError("its watchdog is not being fed")
        before = self.control.getAsyncOperationProgressEx().operationId()
        self.bounds, self.pending = None, (before, time.monotonic())
        if not self.control.moveL(pose, speed, acceleration, True):
            self.pending = None
            raise RuntimeError("it did not take the motion")
        # The margin is for rounding: the driver checks the same wrench in other axes.
        self.bounds = force * (1 + 1e-9), torque * (1 + 1e-9)

    def brake(self) -> None:
        """Brake the arm to a standstill, if i2t's program runs and the arm is not stopped for safety."""
        self.bounds = self.pending = None
        state = self.state
        if state is not None and state["program"] and state["safe"]:
            self.braked_clock = state["clock"]
            self.send_state({**state, "moving": True})  # until a later state says otherwise
            self.control.stopL(self.limits.braking, True)

    def end_program(self) -> None:
        """End the program on the controller, which then brakes; this process ends by the exit timeout at the latest."""
        signal.alarm(self.limits.exit_timeout)  # ends the process, whatever the library is doing
        if self.receive.getRuntimeState() == PLAYING:
            self.control.stopScript()


def connect(channel: Channel, request: Message) -> Worker:
    """Connect the worker process to a UR controller, and set tool and payload.

    Args:
        channel: Channel to the driver.
        request: Keys `host`, `tool` (six numbers or None), `payload` (or None) and `limits` (`WorkerLimits`).

    Returns:
        The worker that serves the driver.

    Raises:
        RuntimeError: The controller does not answer, or refuses.
    """
    import rtde_control
    import rtde_receive

    variables = ["timestamp", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force", "actual_q"]
    variables += ["target_speed_fraction", "runtime_state", "safety_status_bits"]
    receive = rtde_receive.RTDEReceiveInterface(request["host"], STATE_RATE_HZ, variables)
    control = rtde_control.RTDEControlInterface(request["host"])
    pendant_tcp = [0.0] * 6
    if request["tool"] is not None:
        pendant_tcp = list(control.getTCPOffset())
        control.setTcp(request["tool"])
    if request["payload"] is not None:
        control.setPayload(*request["payload"])
    worker = Worker(channel, control, receive, WorkerLimits(**request["limits"]))
    worker.pendant_tcp = pendant_tcp
    return worker


def forbid_new_connections() -> None:
    """Make every later attempt of this process to open a file or socket fail; open ones keep working."""
    import resource

    # Descriptors 0, 1 and 2 are the standard streams.
    for limit, soft in ((resource.RLIMIT_NOFILE, 3), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(limit, (soft, resource.getrlimit(limit)[1]))


def main(request: Message) -> None:
    """Run the worker process: serve the driver at the other end of standard input, then exit.

    Args:
        request: Request as `connect` takes it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the driver handles Ctrl-C
    channel = Channel(socket.socket(fileno=os.dup(0)))
    worker = None
    try:
        worker = connect(channel, request)
        forbid_new_connections()
        channel.send({"ready": True, "pendant_tcp": worker.pendant_tcp})
        worker.serve()
    except (EOFError, BrokenPipeError):
        with contextlib.suppress(Exception):
            if worker is not None:
                worker.end_program()
    except Exception as error:
        with contextlib.suppress(OSError):
            channel.send({"error": str(error), "late": isinstance(error, TimeoutError)})
    finally:
        os._exit(0)  # run neither the library's destructors nor its threads


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
