"""Access to a UR arm: its dashboard, its lock, and the conditions under which the client library may connect.

A second client replaces the first without a word. So it is asked before whether somebody has the arm: other programs of
this user by a lock, anybody else by whether a program runs on the controller already.

Source: Universal Robots' dashboard server manual.
"""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from i2t.errors import DeviceError
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.ur.ports import DASHBOARD_PORT, PROBE_TIMEOUT_S, RTDE, SCRIPT, Answer, Port, probe, why_no_answer
from i2t.types import Array

NO_LIBRARY = "a UR arm needs ur_rtde: pip install 'imagine2touch[hardware]' on Python 3.11 or 3.12"
SAFE = ("NORMAL", "REDUCED")  # safety status in which an arm may be moved


def ask_dashboard(host: str, line: str) -> str:
    """Send one line to the controller's dashboard.

    Args:
        host: Address of the controller.
        line: The question or command.

    Returns:
        The answer.

    Raises:
        OSError: There is none in time.
    """
    address = host, DASHBOARD_PORT
    with socket.create_connection(address, PROBE_TIMEOUT_S) as connection, connection.makefile("rw") as lines:
        lines.readline()
        lines.write(line + "\n")
        lines.flush()
        answer = lines.readline().strip()
    if not answer:
        raise OSError("the dashboard closed the connection")
    return answer


def lock_folder() -> Path:
    """The folder of this user's locks: in `$XDG_RUNTIME_DIR`, or in `~/.cache`."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return (Path(runtime) if runtime else Path.home() / ".cache") / "i2t"


def take_lock(host: str) -> IO[str]:
    """Keep other programs of this user from an arm.

    Args:
        host: Address of the controller.

    Returns:
        The lock, held until it is closed.

    Raises:
        DeviceError: Another program has it, or it cannot be made.
    """
    try:
        import fcntl
    except ImportError as error:
        raise DeviceError("A UR arm is moved from Linux or macOS only: Windows has no lock for it here.") from error
    path = lock_folder() / f"ur-{host}.lock"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # A symbolic link is not followed, and nothing is truncated before the lock is ours.
        lock = os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600), "r+")
    except (OSError, RuntimeError) as error:  # RuntimeError: there is no home directory
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise DeviceError(f"The lock of the arm, {path}, cannot be opened: {reason}.") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        owner = lock.read().strip() or "unknown"
        lock.close()
        raise DeviceError(f"The arm at {host} is in use by process {owner}: end it first.") from None
    lock.truncate(0)
    lock.write(str(os.getpid()))
    lock.flush()
    return lock


def check_reachable(host: str, port: Port = RTDE) -> None:
    """Ask a controller whether a port of it answers, by default that of RTDE.

    Args:
        host: Its address.
        port: Of `i2t.hardware.ur.ports`.

    Raises:
        DeviceError: It does not; the message says which ports do, and what to change.
    """
    with _no_answer(host):
        if (answer := probe(host, port)) is not Answer.ANSWERS:
            raise OSError(f"it {answer.value} on port {port}")


def check_controller(host: str) -> None:
    """Ask a controller whether it could be controlled now.

    Args:
        host: Its address.

    Raises:
        DeviceError: It is in local mode or stopped for safety, has another client, or does not answer.
    """
    check_reachable(host)
    with _no_answer(host):
        if ask_dashboard(host, "is in remote control") == "false":
            raise DeviceError(
                f"The robot at {host} is in local mode: choose remote control on its pendant, which offers it once it "
                "is enabled under Settings > System > Remote Control."
            )
        safety = ask_dashboard(host, "safetystatus").removeprefix("Safetystatus: ")
        if "PROTECTIVE" in safety:
            raise DeviceError(
                f"The robot at {host} is in a protective stop: clear its cause, and release it on the pendant."
            )
        if (
            safety.isupper() and safety not in SAFE
        ):  # words in small letters: an old dashboard does not know the question
            raise DeviceError(f"The robot at {host} is stopped for safety ({safety}): release it on the pendant.")
        if ask_dashboard(host, "running") == "Program running: true":
            raise DeviceError(f"A program runs on the controller at {host}, perhaps for another client: end it first.")
    check_reachable(host, SCRIPT)


def controller_serial(host: str) -> str:
    """The serial number of a controller, as its dashboard tells it.

    Args:
        host: Its address.

    Returns:
        The number; empty where the dashboard does not tell (controllers before e-Series).
    """
    try:
        answer = ask_dashboard(host, "get serial number")
    except OSError:
        return ""
    return answer if answer.isdecimal() else ""


@contextlib.contextmanager
def _no_answer(host: str) -> Iterator[None]:
    """Turn a failed connection into an error of one sentence, which says which ports answer."""
    try:
        yield
    except OSError as error:
        why = why_no_answer(host) or f"The UR controller at {host} does not answer: {error}; connect again."
        raise DeviceError(why) from error


def tool_pose(host: str) -> Array:
    """Pose of a UR arm's tool now, without controlling it.

    Args:
        host: Address of the controller.

    Returns:
        (4, 4) T_b_t.

    Raises:
        DeviceError: The controller does not answer, or ur_rtde is missing.
    """
    check_reachable(host)
    try:
        import rtde_receive

        listening = rtde_receive.RTDEReceiveInterface(host, 125.0, ["timestamp", "actual_TCP_pose"])
    except ImportError as error:
        raise DeviceError(NO_LIBRARY) from error
    except RuntimeError as error:
        raise DeviceError(f"The controller at {host} gives no states: {error}.") from error
    try:
        return pose_from_vector(listening.getActualTCPPose())
    finally:
        listening.disconnect()
