"""`python -m experiments.studies --help`."""

import sys
from collections.abc import Sequence

from experiments.common.commands import run_command
from experiments.studies.arguments import StudyArgs

RENAMED_STUDIES = {
    "open": "open_set",
    "strangers": "open_set",
    "crossing": "pose_error",
    "many": "object_count",
    "pad": "new_pad",
}
RENAMED_STUDY_FLAGS = {
    "--run": "--trained-run",
    "--sittings": "--episodes",
    "--placements": "--pose-errors",
    "--rough": "--view-noise",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and words[0] in RENAMED_STUDIES:
        print(f"error: the study {words[0]} is called {RENAMED_STUDIES[words[0]]} now", file=sys.stderr)
        return 2
    return run_command(StudyArgs, words, "experiments.studies.run", renamed=RENAMED_STUDY_FLAGS)


if __name__ == "__main__":
    sys.exit(main())
