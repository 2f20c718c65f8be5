"""Recognition of objects by touch.

    python -m experiments.recognize                simulated episodes on a finished run of experiments.train
    python -m experiments.recognize --dataset DIR  recorded touches, each session an episode
    python -m experiments.recognize live           a real or simulated arm, with sites chosen by the belief
    python -m experiments.recognize recorded       tables of labelled readings of any sensor, without geometry

Each part has its own --help, such as python -m experiments.recognize simulate --help. Without a subcommand, the command
simulates episodes, or reads --dataset.
"""

import sys

from experiments.common.commands import command_of_parts
from experiments.recognize.arguments import DatasetArgs, LiveArgs, RecordedArgs, SimulateArgs

main = command_of_parts(
    "experiments.recognize",
    {
        "simulate": (SimulateArgs, "experiments.recognize.run"),
        "dataset": (DatasetArgs, "experiments.recognize.recorded"),
        "live": (LiveArgs, "experiments.recognize.live"),
        "recorded": (RecordedArgs, "experiments.recognize.readings"),
    },
    by_option={"--dataset": "dataset"},
)

if __name__ == "__main__":
    sys.exit(main())
