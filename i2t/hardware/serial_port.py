"""Users of a serial port, and reasons why it cannot be opened, as far as the system reveals them.

A port may be open in several programs at once; each byte then reaches only one of them. The lock of pyserial excludes
only programs that request it; `TIOCEXCL` excludes all programs that open the port later (except root's). The links in
/proc/PID/fd show which programs have a port open (Linux; only root sees those of other users).
"""

import contextlib
import os
from pathlib import Path
from typing import Any

try:
    import fcntl
    import grp
    import termios
except ImportError:  # Windows, where a port can be opened only once
    fcntl = grp = termios = None  # type: ignore[assignment]

COMMON_PORT_USERS = "ModemManager or a serial monitor"  # programs that commonly occupy a serial port, for messages


def users_of(port: str) -> dict[int, str]:
    """Find the programs that have a serial port open.

    Args:
        port: Name of the port, or a link to it.

    Returns:
        The names of the programs by process id, as far as the system shows them to this user.
    """
    target, users = os.path.realpath(port), {}
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is another user's
            if any(_leads_to(folder / "fd" / name, target) for name in os.listdir(folder / "fd")):
                users[int(folder.name)] = (folder / "comm").read_text().strip()
    return users


def _leads_to(link: Path, target: str) -> bool:
    try:
        return os.readlink(link) == target
    except OSError:  # it has been closed
        return False


def other_users(port: str) -> str:
    """List the other programs that have a serial port open, for a message.

    Args:
        port: Name of the port, or a link to it.

    Returns:
        A list such as "cat (process 12) and screen (process 34)"; empty if no other program is found.
    """
    others = {process: name for process, name in users_of(port).items() if process != os.getpid()}
    return " and ".join(f"{name} (process {process})" for process, name in sorted(others.items()))


def set_exclusive(line: Any, exclusive: bool = True) -> None:
    """Prevent other programs from opening a serial port that this program has open, if the system can.

    Args:
        line: Open port, a `serial.Serial`.
        exclusive: Whether to exclude other programs; False admits them again.
    """
    if termios is not None:
        with contextlib.suppress(OSError, ValueError, TypeError):  # it is closed, or not a terminal
            fcntl.ioctl(line.fileno(), termios.TIOCEXCL if exclusive else termios.TIOCNXCL)


def explain_no_access(port: str) -> str:
    """Explain why this user may not open a serial port, and what to do.

    Args:
        port: Name of the port.

    Returns:
        A sentence without a full stop.
    """
    if grp is None:
        return f"{port} may not be opened; another program may be using it: close that program"
    group, members = "dialout", list[str]()
    with contextlib.suppress(OSError, KeyError):
        number = os.stat(port).st_gid
        group, _, _, members = grp.getgrgid(number)
        if number in (*os.getgroups(), os.getegid()):
            return f"{port} may not be opened by your group, {group}; allow it: sudo chmod g+rw {port}"
    if os.environ.get("USER") in members:
        return f"{port} may not be opened yet, because you joined its group, {group}, after you logged in; log in again"
    return f"{port} may not be opened; add yourself to its group and log in again: sudo usermod -aG {group} $USER"
