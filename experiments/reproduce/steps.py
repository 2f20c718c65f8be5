"""What is run again, in which order, and where its numbers appear: one step for each command of the documents."""

from pathlib import Path
from typing import NamedTuple


class Step(NamedTuple):
    """A command whose metrics the documents show."""

    name: str  # of the step, of its folder below --out, and of its file in docs/results
    command: str  # as a user types it, without --out and --trained-run
    uses: str | None = None  # the step whose folder it takes as --trained-run
    minutes: int = 5  # on two cores, roughly
    needs: str | None = None  # what is not part of the project: a folder of $I2T_DATA

    def arguments(self, out: Path, resume: bool) -> list[str]:
        """The command's words after `python`.

        Args:
            out: Folder of all steps.
            resume: Whether an unfinished run is there.
        """
        words = [*self.command.split(), "--out", str(out / self.name)]
        if self.uses:
            words += ["--trained-run", str(out / self.uses)]
        return words + (["--resume"] if resume else [])


STEPS = (
    Step("train", "-m experiments.train", minutes=4),
    Step("study", "-m experiments.train --preset study", minutes=30),
    Step(
        "paper",
        "-m experiments.recognize simulate --method paper --paper-episodes 100",
        uses="study",
        minutes=25,
    ),
    Step(
        "recognize",
        "-m experiments.recognize simulate --pads 0 1 2 3 4 --episodes 20 --paper-episodes 20",
        uses="study",
        minutes=60,
    ),
    Step("policy", "-m experiments.studies policy --episodes 10", uses="study", minutes=20),
    Step("open_set", "-m experiments.studies open_set --episodes 10", uses="study", minutes=40),
    Step("new_pad", "-m experiments.studies new_pad --episodes 10", uses="study", minutes=30),
    Step("planar", "-m experiments.studies planar --episodes 10", uses="study", minutes=20),
    Step("registered", "-m experiments.studies registered --episodes 10", uses="study", minutes=20),
    Step("sensitivity", "-m experiments.studies sensitivity --episodes 10", uses="study", minutes=60),
    Step("placement", "-m experiments.studies placement --episodes 10", uses="study", minutes=20),
    Step("mismatch", "-m experiments.studies mismatch --episodes 10", uses="study", minutes=60),
    Step("sites", "-m experiments.studies sites", uses="study", minutes=15),
    Step("pose_error", "-m experiments.studies pose_error", uses="study", minutes=20),
    Step("object_count", "-m experiments.studies object_count", uses="study", minutes=30),
)
