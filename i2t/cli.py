"""How a command ends."""

import sys
from collections.abc import Callable
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
