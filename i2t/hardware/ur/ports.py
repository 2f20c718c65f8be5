"""Which ports of a UR controller answer, and what a person has to change where one does not.

Sources: Universal Robots' manuals: security settings of PolyScope 5.10 (services, inbound access), RTDE guide (request
"v" for the version of URControl, which is 10 and later on PolyScope X), release notes of PolyScope X (there is no
dashboard server).
"""

import enum
import socket
import struct
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from i2t.hardware.ur.rtde_worker import RTDE_PORT

DASHBOARD_PORT, SCRIPT_PORT = 29999, 30003
PROTOCOL_REQUEST = b"\x00\x05V\x00\x02"  # asks an RTDE server for version 2 of its protocol
PROTOCOL_ANSWER_BYTES = 4
VERSION_REQUEST = b"\x00\x03v"  # asks for the version of URControl
VERSION_ANSWER = struct.Struct(">HB4I")  # size, type, major, minor, bug fix, build
POLYSCOPE_X_MAJOR = 10  # of URControl, from which PolyScope X runs
PROBE_TIMEOUT_S = 1.0  # of each step


class Port(NamedTuple):
    """A port that the driver needs."""

    number: int
    name: str
    service: str  # as the security settings of PolyScope 5 call it

    def __str__(self) -> str:
        return f"{self.number} ({self.name})"


RTDE = Port(RTDE_PORT, "RTDE", "RTDE")
DASHBOARD = Port(DASHBOARD_PORT, "dashboard", "Dashboard Server")
SCRIPT = Port(SCRIPT_PORT, "real-time client", "Real-Time Client Interface")
PORTS = (RTDE, DASHBOARD, SCRIPT)


class Answer(enum.Enum):
    """Outcome of an attempt to talk to a port; the values are what the controller does "on" that port."""

    ANSWERS = "answers"
    REFUSED = "refuses connections"
    CLOSED = "closes connections at once"
    MUTE = "accepts connections and does not answer"
    TIMED_OUT = "gives no sign"
    NO_ROUTE = "is out of reach"


def probe(host: str, port: Port) -> Answer:
    """Connect to a port, and wait for its greeting if its service has one.

    Args:
        host: Address of the controller.
        port: One of `PORTS`.

    Returns:
        The outcome of the attempt.
    """
    try:
        with socket.create_connection((host, port.number), PROBE_TIMEOUT_S) as connection:
            return _greeting(connection, port)
    except ConnectionRefusedError:
        return Answer.REFUSED
    except TimeoutError:
        return Answer.TIMED_OUT
    except OSError:
        return Answer.NO_ROUTE


def _greeting(connection: socket.socket, port: Port) -> Answer:
    if port == SCRIPT:  # it sends states or nothing, so a connection is enough
        return Answer.ANSWERS
    try:
        if port == RTDE:
            connection.sendall(PROTOCOL_REQUEST)
        return Answer.ANSWERS if connection.recv(PROTOCOL_ANSWER_BYTES) else Answer.CLOSED
    except TimeoutError:
        return Answer.MUTE
    except OSError:
        return Answer.CLOSED


def controller_version(host: str) -> tuple[int, ...]:
    """Ask the RTDE server of a controller for the version of URControl.

    Args:
        host: Address of the controller.

    Returns:
        The numbers major, minor, bug fix and build; an empty tuple where RTDE does not answer.
    """
    try:
        with socket.create_connection((host, RTDE.number), PROBE_TIMEOUT_S) as connection:
            connection.sendall(PROTOCOL_REQUEST)
            connection.recv(PROTOCOL_ANSWER_BYTES, socket.MSG_WAITALL)
            connection.sendall(VERSION_REQUEST)
            data = connection.recv(VERSION_ANSWER.size, socket.MSG_WAITALL)
    except OSError:
        return ()
    return VERSION_ANSWER.unpack(data)[2:] if len(data) == VERSION_ANSWER.size else ()


def why_no_answer(host: str) -> str:
    """Ask all ports of a controller that did not answer, and say what to change.

    Args:
        host: Address of the controller.

    Returns:
        A sentence; "" where all ports answer now.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no name of a machine"
        return f"The UR controller {host} is not known to this computer ({reason}): give its IP address."
    with ThreadPoolExecutor(len(PORTS)) as pool:
        answers = dict(zip(PORTS, pool.map(lambda port: probe(host, port), PORTS), strict=True))
    return explain(host, answers, controller_version(host) if answers[RTDE] is Answer.ANSWERS else ())


def explain(host: str, answers: Mapping[Port, Answer], version: tuple[int, ...] = ()) -> str:
    """Say which ports of a controller answer, which do not, and what to change.

    Args:
        host: Address of the controller.
        answers: The outcome for each of `PORTS`.
        version: The version of URControl, as `controller_version` gives it.

    Returns:
        A sentence; "" where all ports answer.
    """
    silent = {port: answer for port, answer in answers.items() if answer is not Answer.ANSWERS}
    if not silent:
        return ""
    kinds = sorted(set(answers.values()), key=lambda answer: answer is not Answer.ANSWERS)
    if len(kinds) == 1:
        return _explain_all_alike(host, kinds[0])
    parts = [f"{kind.value} on {_listed([port for port in answers if answers[port] is kind])}" for kind in kinds]
    if DASHBOARD in silent and version and version[0] >= POLYSCOPE_X_MAJOR:
        remedy = (
            f"it runs PolyScope X (URControl {version[0]}.{version[1]}), which has no dashboard server and cannot be "
            "moved by i2t; use a controller with PolyScope 5 or a driver of your own"
        )
    else:
        remedy = "; ".join(_remedy(port, answer, bool(version)) for port, answer in silent.items())
    return f"The UR controller at {host} {', but '.join(parts)}: {remedy}."


def _explain_all_alike(host: str, answer: Answer) -> str:
    ports, is_controller = _listed(list(PORTS)), "check that the address is the controller's"
    problem, remedy = {
        Answer.REFUSED: (
            f"a machine is there, and refuses connections on {ports}",
            f"{is_controller}, and that it has started",
        ),
        Answer.TIMED_OUT: (
            f"nothing comes from that address on {ports}",
            "check the address, the cable, that the controller is on, and that no firewall is between",
        ),
        Answer.NO_ROUTE: (
            "this computer has no way to that address",
            "check the cable, and that this computer has an address in the controller's network",
        ),
    }.get(answer, (f"it {answer.value} on {ports}", f"{is_controller}, and wait until it has started"))
    return f"The UR controller at {host} does not answer: {problem}; {remedy}."


def _remedy(port: Port, answer: Answer, older: bool) -> str:
    """Half a sentence on what to change so that a port answers; `older` controllers are known to have a dashboard."""
    if answer is Answer.MUTE:
        return f"wait until port {port.number} answers, or restart the controller"
    if answer is Answer.TIMED_OUT or answer is Answer.NO_ROUTE:
        change = f"allow port {port.number} under Settings > Security > General on its pendant and in every firewall"
    else:
        change = f"switch {port.service} on under Settings > Security > Services on its pendant"
    if port == DASHBOARD and not older:
        return f"{change}, unless it runs PolyScope X, which has no dashboard server and cannot be moved by i2t"
    return change


def _listed(ports: list[Port]) -> str:
    """Ports as part of a sentence, such as `ports 30004 (RTDE) and 29999 (dashboard)`."""
    *others, last = map(str, ports)
    return f"ports {', '.join(others)} and {last}" if others else f"port {last}"
