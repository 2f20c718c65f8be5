"""Which programs use a serial port, and why a port may not be opened, as far as the system shows it.

A port may be open in several programs at once; each byte then reaches one of them. The lock that pyserial takes holds
off only programs that ask for it; `TIOCEXCL` holds off all that are opened later (root's excepted). Programs that have
a port open are found by the links in /proc/PID/fd (Linux; those of other users show to root alone).
"""

import contextlib
import os
from pathlib import Path
from typing import Any

try:
    import fcntl
    import grp
    import termios
except ImportError:  # Windows, where a port can be opened once only
    fcntl = grp = termios = None  # type: ignore[assignment]

PROCESSES = Path("/proc")
OFTEN_READ_PORTS = "ModemManager or a serial monitor"


def users_of(port: str) -> dict[int, str]:
    """Find the programs that have a port open.

    Args:
        port: Name of the port, or a link to it.

    Returns:
        The names of the programs by process id, without those that the system does not show to this user.
    """
    target, users = os.path.realpath(port), {}
    for folder in PROCESSES.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # ended meanwhile, or another user's
            if any(_leads_to(folder / "fd" / name, target) for name in os.listdir(folder / "fd")):
                users[int(folder.name)] = (folder / "comm").read_text().strip()
    return users


def _leads_to(link: Path, target: str) -> bool:
    try:
        return os.readlink(link) == target
    except OSError:  # closed meanwhile
        return False


def other_users(port: str) -> str:
    """Name the other programs that have a port open.

    Args:
        port: Name of the port, or a link to it.

    Returns:
        A list such as "cat (process 12) and screen (process 34)"; "" where no other program is found.
    """
    others = {process: name for process, name in users_of(port).items() if process != os.getpid()}
    return " and ".join(f"{name} (process {process})" for process, name in sorted(others.items()))


def keep_others_out(line: Any, keep: bool = True) -> None:
    """Let no other program open a port that is open here; without effect where the system has no such thing.

    Args:
        line: The open port, a `serial.Serial`.
        keep: Whether to keep other programs out; False lets them in again.
    """
    if termios is not None:
        with contextlib.suppress(OSError, ValueError, TypeError):  # closed already, or no terminal
            fcntl.ioctl(line.fileno(), termios.TIOCEXCL if keep else termios.TIOCNXCL)


def why_forbidden(port: str) -> str:
    """Say why this user may not open a port, and what to do.

    Args:
        port: Name of the port.

    Returns:
        A sentence without a full stop.
    """
    if grp is None:
        return f"{port} may not be opened; it may be in use by another program: close that one"
    group, members = "dialout", list[str]()
    with contextlib.suppress(OSError, KeyError):
        number = os.stat(port).st_gid
        group, _, _, members = grp.getgrgid(number)
        if number in (*os.getgroups(), os.getegid()):
            return f"{port} may not be opened by its group, {group}, in which you are; allow it: sudo chmod g+rw {port}"
    if os.environ.get("USER") in members:
        return f"{port} may not be opened yet, as you joined its group, {group}, after you logged in; log in again"
    return f"{port} may not be opened; add yourself to its group and log in again: sudo usermod -aG {group} $USER"
