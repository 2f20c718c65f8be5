"""Diagnosis of the ports of a UR controller: which ones answer, and what to change if one does not.

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

PROTOCOL_REQUEST = b"\x00\x05V\x00\x02"  # RTDE packet that requests version 2 of the protocol
VERSION_REQUEST = b"\x00\x03v"  # RTDE packet that requests the version of the controller's software (URControl)


class Port(NamedTuple):
    """A TCP port of a UR controller that the driver needs: number, name, and service in the pendant's settings."""

    number: int
    name: str
    service: str  # name of the service in the security settings of PolyScope 5

    def __str__(self) -> str:
        return f"{self.number} ({self.name})"


# Ports of a UR controller that the driver needs.
RTDE = Port(RTDE_PORT, name="RTDE", service="RTDE")
DASHBOARD = Port(29999, name="dashboard", service="Dashboard Server")
SCRIPT = Port(30003, name="real-time client", service="Real-Time Client Interface")
PORTS = (RTDE, DASHBOARD, SCRIPT)


class Answer(enum.Enum):
    """Outcome of an attempt to talk to a controller's port; messages use the values, as in "refuses connections"."""

    ANSWERS = "answers"
    REFUSED = "refuses connections"
    CLOSED = "closes connections at once"
    MUTE = "accepts connections and does not answer"
    TIMED_OUT = "gives no sign"
    NO_ROUTE = "is out of reach"


def probe(host: str, port: Port, timeout: float = 1.0) -> Answer:
    """Test whether a port of a UR controller answers: connect, and wait for the greeting of a service that sends one.

    Args:
        host: Address of the controller.
        port: Port to probe, one of `PORTS`.
        timeout: Maximum time in s of each step.

    Returns:
        The outcome of the attempt.
    """
    try:
        with socket.create_connection((host, port.number), timeout) as connection:
            return _greeting(connection, port)
    except ConnectionRefusedError:
        return Answer.REFUSED
    except TimeoutError:
        return Answer.TIMED_OUT
    except OSError:
        return Answer.NO_ROUTE


def _greeting(connection: socket.socket, port: Port) -> Answer:
    if port == SCRIPT:  # it sends no greeting, so a connection is enough
        return Answer.ANSWERS
    try:
        if port == RTDE:
            connection.sendall(PROTOCOL_REQUEST)
        return Answer.ANSWERS if connection.recv(4) else Answer.CLOSED
    except TimeoutError:
        return Answer.MUTE
    except OSError:
        return Answer.CLOSED


def controller_version(host: str, timeout: float = 1.0) -> tuple[int, ...]:
    """Ask the RTDE server of a UR controller for the version of its software, URControl.

    Args:
        host: Address of the controller.
        timeout: Maximum time in s of each step.

    Returns:
        The numbers major, minor, bug fix and build; an empty tuple if RTDE does not answer.
    """
    layout = struct.Struct(">HB4I")  # size, type, major, minor, bug fix, build
    try:
        with socket.create_connection((host, RTDE.number), timeout) as connection:
            connection.sendall(PROTOCOL_REQUEST)
            connection.recv(4, socket.MSG_WAITALL)
            connection.sendall(VERSION_REQUEST)
            data = connection.recv(layout.size, socket.MSG_WAITALL)
    except OSError:
        return ()
    return layout.unpack(data)[2:] if len(data) == layout.size else ()


def explain_no_answer(host: str) -> str:
    """Probe all ports of a UR controller that did not answer, and explain the problem and its remedy.

    Args:
        host: Address of the controller.

    Returns:
        A sentence; empty if all ports answer now.
    """
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not a valid host name"
        return f"The UR controller {host} is not known to this computer ({reason}): give its IP address."
    with ThreadPoolExecutor(len(PORTS)) as pool:
        answers = dict(zip(PORTS, pool.map(lambda port: probe(host, port), PORTS), strict=True))
    return explain(host, answers, controller_version(host) if answers[RTDE] is Answer.ANSWERS else ())


def explain(host: str, answers: Mapping[Port, Answer], version: tuple[int, ...] = ()) -> str:
    """Explain which ports of a UR controller answer, which do not, and what to change.

    Args:
        host: Address of the controller.
        answers: The outcome for each of `PORTS`.
        version: The version of URControl, as `controller_version` gives it.

    Returns:
        A sentence; empty if all ports answer.
    """
    silent = {port: answer for port, answer in answers.items() if answer is not Answer.ANSWERS}
    if not silent:
        return ""
    kinds = sorted(set(answers.values()), key=lambda answer: answer is not Answer.ANSWERS)
    if len(kinds) == 1:
        return _explain_all_alike(host, kinds[0])
    parts = [f"{kind.value} on {_listed([port for port in answers if answers[port] is kind])}" for kind in kinds]
    if DASHBOARD in silent and version and version[0] >= 10:
        remedy = (
            f"it runs PolyScope X (URControl {version[0]}.{version[1]}), which has no dashboard server and cannot be "
            "moved by i2t; use a controller with PolyScope 5 or a driver of your own"
        )
    else:
        remedy = "; ".join(_remedy(port, answer, bool(version)) for port, answer in silent.items())
    return f"The UR controller at {host} {', but '.join(parts)}: {remedy}."


def _explain_all_alike(host: str, answer: Answer) -> str:
    ports, check_address = _listed(list(PORTS)), "check that the address is the controller's"
    problem, remedy = {
        Answer.REFUSED: (
            f"a machine is there, and refuses connections on {ports}",
            f"{check_address}, and that it has started",
        ),
        Answer.TIMED_OUT: (
            f"no reply comes from that address on {ports}",
            "check the address, the cable, that the controller is on, and that no firewall blocks it",
        ),
        Answer.NO_ROUTE: (
            "this computer has no route to that address",
            "check the cable, and that this computer has an address in the controller's network",
        ),
    }.get(answer, (f"it {answer.value} on {ports}", f"{check_address}, and wait until it has started"))
    return f"The UR controller at {host} does not answer: {problem}; {remedy}."


def _remedy(port: Port, answer: Answer, older: bool) -> str:
    """Clause with the remedy for a silent port; a controller of `older` software certainly has a dashboard."""
    if answer is Answer.MUTE:
        return f"wait until port {port.number} answers, or restart the controller"
    if answer is Answer.TIMED_OUT or answer is Answer.NO_ROUTE:
        change = f"allow port {port.number} under Settings > Security > General on its pendant and in every firewall"
    else:
        change = f"enable {port.service} under Settings > Security > Services on its pendant"
    if port == DASHBOARD and not older:
        return f"{change}, unless it runs PolyScope X, which has no dashboard server and cannot be moved by i2t"
    return change


def _listed(ports: list[Port]) -> str:
    """List ports for a sentence, such as `ports 30004 (RTDE) and 29999 (dashboard)`."""
    *others, last = map(str, ports)
    return f"ports {', '.join(others)} and {last}" if others else f"port {last}"
