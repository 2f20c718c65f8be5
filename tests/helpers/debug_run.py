"""The run of `experiments.train` that tests share: its debug preset, and with a network that is given the force, which
only a study trains.
"""

import sys

NAMES = ("nearest", "nearest-measured", "ridge", "ridge-measured", "paper-depth", "paper-depth-force", "gp")
COMMAND = (sys.executable, "-m", "experiments.train", "--preset", "debug", "--methods", *NAMES)
