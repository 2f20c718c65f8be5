"""Who may have a UR arm: its dashboard, and what must be true before the client library is let near it.

The library's constructors wait for ever, and hold the interpreter, if the controller does not answer; and a second
client replaces the first without a word. So both are asked for before: the controller by its ports and its dashboard,
other programs of this machine by a lock, those of other machines by whether a program runs already.

Source: Universal Robots' dashboard server manual.
"""

import fcntl
import os
import socket
import tempfile
from pathlib import Path
from typing import Any

from i2t.errors import DeviceError

RTDE, DASHBOARD = 30004, 29999


def ask_dashboard(host: str, line: str, timeout: float = 1.0) -> str:
    """One line to the controller's dashboard, and its answer; raises OSError if there is none in time."""
    with socket.create_connection((host, DASHBOARD), timeout) as connection, connection.makefile("rw") as lines:
        lines.readline()
        lines.write(line + "\n")
        lines.flush()
        answer = lines.readline().strip()
    if not answer:
        raise OSError("the dashboard closed the connection")
    return answer


def take_lock(host: str) -> Any:
    """Keep other programs of this machine from the arm until what is returned is closed; raises DeviceError."""
    path = Path(tempfile.gettempdir()) / f"i2t-ur-{host}.lock"
    try:
        lock = path.open("a+")
    except OSError as error:
        raise DeviceError(f"The lock of the arm, {path}, cannot be opened: {error.strerror}.") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        owner = lock.read().strip() or "unknown"
        lock.close()
        raise DeviceError(
            f"The arm at {host} is in use by process {owner}: end it first, as a second client would "
            "replace it silently."
        ) from None
    lock.truncate(0)
    lock.write(str(os.getpid()))
    lock.flush()
    return lock


def greet(host: str) -> None:
    """Ask a controller whether it speaks RTDE; raises DeviceError where it does not answer."""
    try:
        with socket.create_connection((host, RTDE), 1.0) as connection:
            connection.sendall(b"\x00\x05V\x00\x02")
            if not connection.recv(4):
                raise OSError(f"port {RTDE} was closed")
    except OSError as error:
        raise DeviceError(f"The UR controller at {host} does not answer: {error}.") from error


def probe(host: str) -> None:
    """Ask a controller whether it could be controlled now; raises DeviceError where not."""
    greet(host)
    try:
        if ask_dashboard(host, "is in remote control") == "false":
            raise DeviceError(f"The robot at {host} is in local mode: choose remote control on its pendant.")
        if "PROTECTIVE" in ask_dashboard(host, "safetystatus"):
            raise DeviceError(f"The robot at {host} is in a protective stop: clear its cause, then recover().")
        if ask_dashboard(host, "running") == "Program running: true":
            raise DeviceError(f"A program runs on the controller at {host}, perhaps for another client: end it first.")
    except OSError as error:
        raise DeviceError(f"The UR controller at {host} does not answer: {error}.") from error


def release(host: str) -> None:
    """Release a protective stop, if there is one; raises DeviceError."""
    try:
        if "PROTECTIVE" in ask_dashboard(host, "safetystatus"):
            answer = ask_dashboard(host, "unlock protective stop")
            if answer != "Protective stop releasing":
                raise DeviceError(f"The protective stop of {host} cannot be released: {answer}.")
    except OSError as error:
        raise DeviceError(f"The dashboard of {host} does not answer: {error}.") from error
