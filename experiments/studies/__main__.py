"""`python -m experiments.studies --help`."""

import sys

from experiments.common.commands import command
from experiments.studies.arguments import StudyArgs

main = command(StudyArgs, "experiments.studies.run")

if __name__ == "__main__":
    sys.exit(main())
