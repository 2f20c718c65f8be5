"""Collect touches of an object: an arm looks, presses and retreats, and every touch becomes a file.

    python -m i2t.collect                                        all simulated, for a first try
    python -m i2t.collect --arm emulated --skin emulated         the real drivers with emulators, in real time
    python -m i2t.collect --arm ur --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml \\
        --object mug.stl --unit mm --out DATA/mug --dry-run                checks everything, moves nothing
    python -m i2t.collect --arm acme_devices:AcmeArm ...         a device of another package

The same command resumes a collection where it stopped. Ctrl-C, SIGTERM or a closed terminal stops the arm and keeps
everything. The result is a data set: `python -m experiments.train --dataset DATA`.
"""

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from i2t.cli.exit_codes import exit_code_of
from i2t.cli.options import read_options, refuse_renamed
from i2t.collect.arguments import CollectArgs


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command `python -m i2t.collect`.

    Args:
        argv: Arguments without the program's name; by default, those of `sys.argv`.

    Returns:
        The exit code of the process, as in `i2t.cli.exit_codes`.
    """
    if code := exit_code_of(partial(refuse_renamed, CollectArgs, argv)):
        return code
    args = read_options(CollectArgs, argv, program="python -m i2t.collect", description=__doc__)

    def work() -> int:
        args.check()
        from i2t.collect.start import begin

        begun = begin(args)
        # Imported late, because JAX takes seconds and a refusal does not need it.
        from i2t.collect.session import collect

        return collect(begun)

    with exiting_on_signals():
        return exit_code_of(work, f"stopped; everything is in {args.out}: the same command resumes the collection")


@contextmanager
def exiting_on_signals() -> Iterator[None]:
    """Within the block, make signals that end a program (SIGTERM, SIGHUP) run every `finally` before it ends."""
    # A terminal that is closed ends its programs by SIGHUP, which Windows does not have.
    signals = [signal.Signals[name] for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.signal(number, exit_on_signal) for number in signals}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def exit_on_signal(number: int, *_: Any) -> None:
    """Handle a signal: end the program with exit code 128 + `number`, but run every `finally` before.

    Args:
        number: Number of the signal.
    """
    sys.exit(128 + number)
