"""Collect touches of an object: an arm looks, presses and retreats, and every touch becomes a file.

    i2t collect                                        all simulated, for a first try
    i2t collect --arm emulated --skin emulated         the real drivers with emulators, in real time
    i2t collect --arm ur --host 192.168.1.10 --skin reskin --camera realsense --rig lab.toml \\
        --object mug.stl --unit mm --out DATA/mug --dry-run                checks everything, moves nothing
    i2t collect --arm acme_devices:AcmeArm ...         a device of another package

The same command resumes a collection where it stopped. Ctrl-C, SIGTERM or a closed terminal stops the arm and keeps
everything. The result is a data set, to which `i2t fit DATA` fits a predictor.
"""

from i2t.cli.exit_codes import command
from i2t.collect.arguments import CollectArgs


def _collect(args: CollectArgs) -> int:
    args.check()
    from i2t.collect.start import begin

    begun = begin(args)
    # Imported late, because JAX takes seconds and a refusal does not need it.
    from i2t.collect.session import collect

    return collect(begun)


main = command(
    CollectArgs,
    _collect,
    program="python -m i2t.collect",
    description=__doc__,
    interrupted=lambda args: f"stopped; everything is in {args.out}: the same command resumes the collection",
)
