"""Access to a UR arm: its dashboard, its lock, and the conditions under which the client library may connect.

A second client replaces the first silently. So the driver first checks that the arm is free: a lock excludes other
programs of this user, and a program that already runs on the controller reveals other clients.

Source: Universal Robots' dashboard server manual.
"""

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from i2t.errors import DeviceError, MissingDriverError
from i2t.hardware.poses import pose_from_vector
from i2t.hardware.ur.ports import DASHBOARD, RTDE, SCRIPT, Answer, Port, explain_no_answer, probe
from i2t.installation import extra_advice
from i2t.types import Array


def explain_missing_library() -> str:
    """Explain how to install the library of UR arms.

    Returns:
        One sentence with the remedy.
    """
    return f"a UR arm needs ur_rtde: {extra_advice('hardware', 'ur-rtde')} on Python 3.11 or 3.12"


def is_on_this_machine(host: str) -> bool:
    """Test whether an address is one of this machine, where only an emulated controller is expected.

    Args:
        host: Address of a controller.

    Returns:
        Whether the address is localhost or begins with 127.
    """
    return host == "localhost" or host.startswith("127.")


def ask_dashboard(host: str, line: str) -> str:
    """Send one line to the dashboard server of a UR controller, and return its answer.

    Args:
        host: Address of the controller.
        line: Question or command.

    Returns:
        The answer of the dashboard, one line.

    Raises:
        OSError: No answer came in time.
    """
    address, timeout = (host, DASHBOARD.number), 1.0  # s
    with socket.create_connection(address, timeout) as connection, connection.makefile("rw") as lines:
        lines.readline()
        lines.write(line + "\n")
        lines.flush()
        answer = lines.readline().strip()
    if not answer:
        raise OSError("the dashboard closed the connection")
    return answer


def lock_folder() -> Path:
    """Return the folder of this user's locks on arms: in `$XDG_RUNTIME_DIR`, or in `~/.cache`."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    return (Path(runtime) if runtime else Path.home() / ".cache") / "i2t"


def take_lock(host: str) -> IO[str]:
    """Lock a UR arm, so that no other program of this user controls it.

    Args:
        host: Address of the controller.

    Returns:
        The lock file, held until it is closed.

    Raises:
        DeviceError: Another program holds the lock, or the file cannot be created.
    """
    try:
        import fcntl
    except ImportError as error:
        raise DeviceError("A UR arm is moved from Linux or macOS only: Windows has no lock for it here.") from error
    path = lock_folder() / f"ur-{host}.lock"
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        # Do not follow a symbolic link, and do not truncate the file before the lock is held.
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
    """Check that a port of a UR controller answers.

    Args:
        host: Address of the controller.
        port: Port to check, by default that of RTDE.

    Raises:
        DeviceError: The port does not answer; the message lists the ports that do, and the remedy.
    """
    with _no_answer(host):
        if (answer := probe(host, port)) is not Answer.ANSWERS:
            raise OSError(f"it {answer.value} on port {port}")


def check_controller(host: str) -> None:
    """Check that a UR controller lets this program control the arm now.

    Args:
        host: Address of the controller.

    Raises:
        DeviceError: The controller is in local mode or stopped for safety, has another client, or does not answer.
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
        # An answer in small letters comes from an old dashboard that does not know the question.
        if safety.isupper() and safety not in ("NORMAL", "REDUCED"):
            raise DeviceError(f"The robot at {host} is stopped for safety ({safety}): release it on the pendant.")
        if ask_dashboard(host, "running") == "Program running: true":
            raise DeviceError(f"A program runs on the controller at {host}, perhaps for another client: end it first.")
    check_reachable(host, SCRIPT)


def controller_serial(host: str) -> str:
    """Ask a UR controller for the robot's serial number.

    Args:
        host: Address of the controller.

    Returns:
        The serial number; empty if the dashboard does not report it (controllers before the e-Series).
    """
    try:
        answer = ask_dashboard(host, "get serial number")
    except OSError:
        return ""
    return answer if answer.isdecimal() else ""


@contextlib.contextmanager
def _no_answer(host: str) -> Iterator[None]:
    """Turn a failed connection into a DeviceError that lists the ports that answer."""
    try:
        yield
    except OSError as error:
        why = explain_no_answer(host) or f"The UR controller at {host} does not answer: {error}; connect again."
        raise DeviceError(why) from error


def tool_pose(host: str) -> Array:
    """Read the pose of a UR arm's tool without controlling the arm.

    Args:
        host: Address of the controller.

    Returns:
        (4, 4) T_b_t, m.

    Raises:
        DeviceError: The controller does not answer, or ur_rtde is missing.
    """
    check_reachable(host)
    try:
        import rtde_receive

        receiver = rtde_receive.RTDEReceiveInterface(host, 125.0, ["timestamp", "actual_TCP_pose"])
    except ImportError as error:
        raise MissingDriverError(explain_missing_library()) from error
    except RuntimeError as error:
        raise DeviceError(f"The controller at {host} sends no states: {error}.") from error
    try:
        return pose_from_vector(receiver.getActualTCPPose())
    finally:
        receiver.disconnect()
