"""How a command ends: its exit code, and the sentence that goes with it.

0    it did what was asked
1    it began and failed: a device, the disk, or a goal that was missed
2    it was used wrongly: options, files or folders with which it cannot do what was asked
130  Ctrl-C
"""

import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from i2t.errors import DeviceError

FAILED, WRONG_USE, INTERRUPTED_BY_USER = 1, 2, 130  # exit codes
NAMED_WRONGLY = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError, PermissionError)


def exit_code_of(work: Callable[[], Any], interrupted: str = "interrupted") -> int:
    """Do a command's work and say how it ended: what its user can mend in one sentence, after Ctrl-C how things stand.

    Args:
        work: Of the command; an int that it returns is the exit code.
        interrupted: The sentence after Ctrl-C.

    Returns:
        The exit code: that of `work` or 0; 2 if what was asked for cannot be done (a ValueError, or a file or folder
        that is not as the command line has it), 1 if a device or the disk failed, 130 after Ctrl-C.
    """
    try:
        code = work()
    except (ValueError, *NAMED_WRONGLY) as error:  # DataError is a ValueError
        print(f"error: {error}", file=sys.stderr)
        return WRONG_USE
    except (DeviceError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print(f"\n{interrupted}", file=sys.stderr)
        return INTERRUPTED_BY_USER
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
            raise SystemExit(WRONG_USE)
