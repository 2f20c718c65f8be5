"""The process that holds ur_rtde's connections to a UR controller; `i2t.hardware.ur.rtde_link` starts it.

ur_rtde 1.6 has a process of its own because of what it does when its control connection breaks: it connects again, from
a thread of its own. That may crash the process (segmentation fault), and it starts the program on the controller anew,
without a watchdog. Here it can do no harm. Once both connections are made, this process gives up the right to open
another socket (`RLIMIT_NOFILE`); an attempt ends the process, and the controller, which is no longer fed, ends the
program. The driver sees the end of the channel at once and says "stop" to the dashboard.

In a loop of 10 ms the process reads the controller's state, brakes if a force or torque is above its limit, does what
the driver asks, and passes the driver's heartbeats on to the controller's watchdog. So the arm stops if either process
dies or hangs. When the channel ends, the process ends the program on the controller, and itself. So it does, without a
word to the controller, where a state holds what is no number, and where one of the two connections has received
nothing for the state timeout: the library keeps the last registers of a stalled stream, and calls it connected for 2.5
s more. What a connection received last is asked of the kernel, which only Linux tells.

Messages are lines of JSON over a socket, which is standard input. The driver sends `{"heartbeat": true}` and
`{"command": name, "id": n, "arguments": {...}}`. It is sent `{"ready": true}`, `{"state": {...}}`, `{"answer": n,
"error": null}` and, before the process ends, `{"error": sentence}`. Only the standard library and ur_rtde are imported,
so that it starts quickly and from any folder.
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
from typing import Any, TypeAlias

Message: TypeAlias = dict[str, Any]

POLL_S = 0.01  # between two looks at the state
SEND_TIMEOUT_S = 1.0
STATE_RATE_HZ = 125.0
BRAKE_MPS2 = 2.0
STANDING_SPEED = 1e-3  # m/s and rad/s, below which the tool stands
BRAKE_SETTLING_S = 0.05  # of the controller's clock after a brake: states of before may still be on their way
START_OF_MOTION_S = 0.5  # in which a motion that was asked for shows in the state
EXIT_GRACE_S = 2  # to end the program on the controller, after which this process ends in any case
ROUNDING = 1 + 1e-9  # of limits, as the driver judges the same wrench in other axes
STANDARD_STREAMS = 3  # file descriptors 0, 1 and 2
RTDE_PORT = 30004
NUMBERS = ("pose", "twist", "wrench", "joints")  # of a state
SINCE_RECEIVED = struct.Struct("52xI")  # tcpi_last_data_recv of Linux's tcp_info, ms
PLAYING, NORMAL, REDUCED = 2, 0x1, 0x2  # runtime state; bits of the safety status
VARIABLES = [
    "timestamp",
    "actual_TCP_pose",
    "actual_TCP_speed",
    "actual_TCP_force",
    "actual_q",
    "target_speed_fraction",
    "runtime_state",
    "safety_status_bits",
]


class Channel:
    """Lines of JSON over a socket, from any thread.

    Args:
        end: Of a pair of sockets.
        send_timeout_s: s, for which a message may wait for the other side to read.
    """

    def __init__(self, end: socket.socket) -> None:
        self._out, self._in = end, end.dup()  # two objects, as each has one timeout
        self._out.settimeout(SEND_TIMEOUT_S)
        self._sending = threading.Lock()
        self._rest = b""

    def send(self, message: Message) -> None:
        """Send a message.

        Args:
            message: That JSON can hold.

        Raises:
            OSError: The other side is gone, or has not read for a second.
        """
        with self._sending:
            self._out.sendall(json.dumps(message).encode() + b"\n")

    def receive(self, timeout_s: float) -> list[Message]:
        """The messages that have come, at once or within a time.

        Args:
            timeout_s: s.

        Returns:
            The messages, in order; maybe none.

        Raises:
            EOFError: The other side has ended.
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
        """Close both directions, so that the other side sees it."""
        with contextlib.suppress(OSError):
            self._out.shutdown(socket.SHUT_RDWR)
        self._out.close()
        self._in.close()


class Streams:
    """The library's connections that a controller streams to, as they are when this is made."""

    def __init__(self) -> None:
        self._ends: list[socket.socket] = []
        for name in os.listdir("/dev/fd"):
            with contextlib.suppress(OSError):  # no socket, or the folder's own
                end = socket.socket(fileno=int(name))
                with contextlib.suppress(OSError):  # not connected
                    if end.getpeername()[1:2] == (RTDE_PORT,):
                        self._ends.append(end)
                        continue
                end.detach()  # it is not ours to close

    def silence(self) -> float:
        """Time since the one that has been silent longest received anything.

        Returns:
            s; 0 where the kernel does not tell, infinite where a connection is gone.
        """
        if not hasattr(socket, "TCP_INFO"):
            return 0.0
        try:
            ages = [end.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, SINCE_RECEIVED.size) for end in self._ends]
        except OSError:
            return math.inf
        return max((1e-3 * float(SINCE_RECEIVED.unpack(age)[0]) for age in ages), default=math.inf)


class Worker:
    """Reads the state, guards the motion and obeys the driver.

    Args:
        channel: To the driver.
        control: An RTDEControlInterface.
        receive: An RTDEReceiveInterface.
        watchdog_rate: Hz, how often the controller must hear from us.
        state_timeout: s, that a connection may receive nothing.
    """

    def __init__(
        self, channel: Channel, control: Any, receive: Any, watchdog_rate: float, state_timeout: float
    ) -> None:
        self.channel, self.control, self.receive = channel, control, receive
        self.watchdog_rate, self.state_timeout, self.streams = watchdog_rate, state_timeout, Streams()
        self.watchdog_set = False
        self.pendant_tcp = [0.0] * 6  # m, rad: the TCP that the controller had before it was told another
        self.heartbeat_time = -math.inf
        self.state: Message | None = None
        self.limits: tuple[float, float] | None = None  # N, Nm, of the motion under way
        self.pending: tuple[int, float] | None = None  # operation before a motion that was asked for, and when
        self.braked_clock = -math.inf  # s, the controller's clock at the last brake

    def serve(self) -> None:
        """Work until the driver ends (EOFError), or a connection breaks or lies (ConnectionError)."""
        while True:
            if not self.control.isConnected() or not self.receive.isConnected():
                raise ConnectionError("the controller closed it")
            silence = self.streams.silence()
            if not silence <= self.state_timeout:
                raise ConnectionError(f"one of its streams has been silent for {silence:.2f} s")
            self.observe()
            self.process(self.channel.receive(POLL_S))

    def process(self, messages: list[Message]) -> None:
        """Feed the watchdog once for all heartbeats, and obey the commands.

        Args:
            messages: In order.
        """
        if any("heartbeat" in message for message in messages):
            self.heartbeat_time = time.monotonic()
            if self.state is not None and self.state["program"]:
                self.control.kickWatchdog()
        for message in messages:
            if "command" in message:
                self.obey(message)

    def obey(self, message: Message) -> None:
        """Carry out a command and answer; the state that it leads to is sent before the answer.

        Args:
            message: A command with its arguments and the number of its answer.
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
            self.observe()
        except (RuntimeError, ValueError) as failure:
            error = str(failure)
        self.channel.send({"answer": message["id"], "error": error})

    def observe(self) -> None:
        """Send the controller's newest state, if it is new, and brake if it is above the limits of the motion.

        Raises:
            ConnectionError: The state holds what is no number.
        """
        clock, last = self.receive.getTimestamp(), self.state
        if not (clock > 0.0 and (last is None or clock > last["clock"] or self.pending is not None)):
            return
        state = self.read_state(clock)
        wrong = [name for name in NUMBERS if not all(map(math.isfinite, state[name]))]
        if wrong:
            raise ConnectionError(f"its {wrong[0]} is {state[wrong[0]]}, which is no number")
        force, torque = math.hypot(*state["wrench"][:3]), math.hypot(*state["wrench"][3:])
        most_force, most_torque = self.limits or (math.inf, math.inf)
        tripped = not (force <= most_force and torque <= most_torque)  # NaN trips too
        self.send_state(state, tripped)
        if tripped:
            self.brake()
        elif not state["moving"]:
            self.limits = None

    def read_state(self, clock: float) -> Message:
        """State as ur_rtde knows it, as one message.

        Args:
            clock: s, the controller's own time of this state.

        Returns:
            The state: metres, radians, newtons and the controller's own frame.
        """
        receive, last = self.receive, self.state
        now = time.monotonic() if last is None or clock > last["clock"] else last["time"]
        progress = self.control.getAsyncOperationProgressEx()
        operation = progress.operationId()
        if self.pending is not None and (operation != self.pending[0] or now > self.pending[1] + START_OF_MOTION_S):
            self.pending = None
        twist = receive.getActualTCPSpeed()
        safe = bool(receive.getSafetyStatusBits() & (NORMAL | REDUCED))
        program = receive.getRuntimeState() == PLAYING
        # A program that has ended leaves its registers behind: then only the speed tells.
        busy = program and safe and (progress.isAsyncOperationRunning() or self.pending is not None)
        braking = clock < self.braked_clock + BRAKE_SETTLING_S
        return {
            "time": now,
            "clock": clock,
            "pose": receive.getActualTCPPose(),
            "twist": twist,
            "wrench": receive.getActualTCPForce(),
            "joints": receive.getActualQ(),
            "moving": bool(busy or braking or not math.hypot(*twist) <= STANDING_SPEED),
            "safe": safe,
            "program": program,
            "speed_share": receive.getTargetSpeedFraction(),
        }

    def send_state(self, state: Message, tripped: bool = False) -> None:
        """Keep a state and tell the driver.

        Args:
            state: As in `read_state`.
            tripped: Whether it is above the limits of the motion, which is therefore stopped.
        """
        self.state = state
        self.channel.send({"state": state, "tripped": tripped})

    def set_watchdog(self) -> None:
        """Have the controller end the program when it is fed no longer; raises RuntimeError."""
        if not self.control.setWatchdog(self.watchdog_rate):
            raise RuntimeError("it did not take the watchdog")
        self.watchdog_set = True

    def move(self, pose: list[float], speed: float, acceleration: float, force: float, torque: float) -> None:
        """Start a straight motion that is stopped above a force or torque.

        Args:
            pose: (x, y, z, rotation vector), m and rad, of the tool in the base.
            speed: m/s.
            acceleration: m/s^2.
            force: N.
            torque: Nm.

        Raises:
            RuntimeError: The watchdog would not end it, or the controller did not take it.
        """
        if self.state is None or not self.state["program"]:
            raise RuntimeError("the program on the controller does not run")
        if not self.watchdog_set or time.monotonic() - self.heartbeat_time > 1 / self.watchdog_rate:
            raise RuntimeError("its watchdog is not being fed")
        before = self.control.getAsyncOperationProgressEx().operationId()
        self.limits, self.pending = None, (before, time.monotonic())
        if not self.control.moveL(pose, speed, acceleration, True):
            self.pending = None
            raise RuntimeError("it did not take the motion")
        self.limits = ROUNDING * force, ROUNDING * torque

    def brake(self) -> None:
        """Slow down to a stand, if a program runs that obeys."""
        self.limits = self.pending = None
        state = self.state
        if state is not None and state["program"] and state["safe"]:
            self.braked_clock = state["clock"]
            self.send_state({**state, "moving": True})  # until a later state says otherwise
            self.control.stopL(BRAKE_MPS2, True)

    def end_program(self) -> None:
        """End the program on the controller, which then brakes; gives up after some seconds."""
        signal.alarm(EXIT_GRACE_S)  # its default action ends the process, whatever the library is doing
        if self.receive.getRuntimeState() == PLAYING:
            self.control.stopScript()


def connect(channel: Channel, request: Message) -> Worker:
    """Connect to the controller, set tool and payload.

    Args:
        channel: To the driver.
        request: Host, tool (6,) or None, payload or None, watchdog rate (Hz) and state timeout (s).

    Returns:
        A worker that serves the driver.

    Raises:
        RuntimeError: The controller does not answer or refuses.
    """
    import rtde_control
    import rtde_receive

    receive = rtde_receive.RTDEReceiveInterface(request["host"], STATE_RATE_HZ, VARIABLES)
    control = rtde_control.RTDEControlInterface(request["host"])
    pendant_tcp = [0.0] * 6
    if request["tool"] is not None:
        pendant_tcp = list(control.getTCPOffset())  # what it was told before
        control.setTcp(request["tool"])
    if request["payload"] is not None:
        control.setPayload(*request["payload"])
    worker = Worker(channel, control, receive, request["watchdog_rate"], request["state_timeout"])
    worker.pendant_tcp = pendant_tcp
    return worker


def forbid_new_connections() -> None:
    """Make every later attempt to open a file or socket fail; those that are open go on working."""
    import resource

    for limit, soft in ((resource.RLIMIT_NOFILE, STANDARD_STREAMS), (resource.RLIMIT_CORE, 0)):
        resource.setrlimit(limit, (soft, resource.getrlimit(limit)[1]))


def main(request: Message) -> None:
    """Serve the driver at the other end of standard input; ends the process.

    Args:
        request: As `connect` takes it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # what Ctrl-C means is the driver's to say
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
            channel.send({"error": str(error)})
    finally:
        os._exit(0)  # neither the library's destructors nor its threads may do more


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
