"""Collect touches of an object: an arm looks, presses and retreats, and every touch becomes a file.

    python -m i2t.collect                                        all simulated: see how it goes
    python -m i2t.collect --arm emulated --skin emulated         the real drivers with emulators, in a lab's time
    python -m i2t.collect --arm ur --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml \\
        --object mug.stl --unit mm --out DATA/mug --dry-run                checks everything, moves nothing
    python -m i2t.collect --arm acme_devices:AcmeArm ...         a device of another package

The same command again goes on where it stopped. Ctrl-C, SIGTERM or a closed terminal stops the arm and keeps
everything. What it writes is a data set: `python -m experiments.train --dataset DATA`.
"""

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from i2t.cli.exit_codes import exit_code_of
from i2t.cli.options import read_options
from i2t.collect.arguments import CollectArgs

# A terminal that is closed ends its programs by SIGHUP, which Windows does not have.
ENDING_SIGNALS = [signal.Signals[name] for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Without the program's name; by default that of this process.

    Returns:
        The exit code.
    """
    args = read_options(CollectArgs, argv, program="python -m i2t.collect", description=__doc__)

    def work() -> int:
        args.check()
        from i2t.collect.beginning import begin

        begun = begin(args)
        from i2t.collect.session import collect  # not above: JAX takes seconds, which a refusal need not wait for

        return collect(begun)

    with left_by_signals():
        return exit_code_of(work, f"stopped; everything is in {args.out}: the same command goes on")


@contextmanager
def left_by_signals() -> Iterator[None]:
    """Within, what ends a program leaves it through every `finally`."""
    before = {number: signal.signal(number, end_by_signal) for number in ENDING_SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def end_by_signal(number: int, *_: Any) -> None:
    """Leave the program as the signal does, but through every `finally`.

    Args:
        number: Of the signal.
    """
    sys.exit(128 + number)
