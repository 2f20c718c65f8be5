"""Which object is it, by touch?

    python -m experiments.recognize                simulated episodes on a finished run of experiments.train
    python -m experiments.recognize --dataset DIR  recorded touches, each session an episode
    python -m experiments.recognize live           an arm, real or not, that touches where the belief wants it to
    python -m experiments.recognize recorded       tables of labelled readings of any sensor, without any geometry

Each has its own --help: python -m experiments.recognize simulate --help. Without a subcommand it simulates, or reads
--dataset.
"""

import sys

from experiments.common.commands import command_of_parts
from experiments.recognize.arguments import DatasetArgs, LiveArgs, RecordedArgs, SimulateArgs

PARTS = {
    "simulate": (SimulateArgs, "experiments.recognize.run"),
    "dataset": (DatasetArgs, "experiments.recognize.recorded"),
    "live": (LiveArgs, "experiments.recognize.live"),
    "recorded": (RecordedArgs, "experiments.recognize.readings"),
}
main = command_of_parts("experiments.recognize", PARTS, by_option={"--dataset": "dataset"})

if __name__ == "__main__":
    sys.exit(main())
