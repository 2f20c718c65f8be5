"""How a command ends."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from i2t.errors import DeviceError


def ended(work: Callable[[], Any], interrupted: str = "interrupted") -> int:
    """Do a command's work and say how it ended: what its user can mend in one sentence, after Ctrl-C how things stand.

    Args:
        work: Of the command; an int that it returns is the exit code.
        interrupted: The sentence after Ctrl-C.

    Returns:
        The exit code: that of `work` or 0, 2 after an error, 130 after Ctrl-C.
    """
    try:
        code = work()
    except (DeviceError, ValueError, OSError) as error:  # DataError is a ValueError
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\n{interrupted}", file=sys.stderr)
        return 130
    return code if isinstance(code, int) else 0


def renamed_flags(args: Sequence[str], renamed: Mapping[str, str]) -> None:
    """Answer flags of earlier versions with the name they have now.

    Args:
        args: The command line, without the program's name.
        renamed: Old flag to new flag or to what to do instead, such as `{"--strange": "--prior-unknown"}`.

    Raises:
        SystemExit: One of `args` is an old flag; its message says what it is called now.
    """
    for arg in args:
        flag = arg.split("=", 1)[0].replace("_", "-")
        if flag in renamed:
            print(f"error: {flag} is called {renamed[flag]} now", file=sys.stderr)
            raise SystemExit(2)
