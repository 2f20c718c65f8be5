"""How a command ends."""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from i2t.errors import DeviceError


def ended(work: Callable[[], Any], interrupted: str = "interrupted") -> int:
    """The exit code of a command that does `work`: what its user can mend is said in one sentence (2), and after Ctrl-C
    how things stand (130). An exit code that `work` returns is passed on.
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
