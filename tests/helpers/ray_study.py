"""A study of three pads on a Ray cluster of this machine, a head and two workers, of which one is killed while it is
at a pad: `python ray_study.py OUT`; with `--serial OUT` in this process.
"""

import os
import sys
import threading
import time
from pathlib import Path

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

from ray.cluster_utils import Cluster

from experiments.train import __main__ as train

STUDY = ("--preset", "debug", "--pads", "0", "1", "2", "--epochs", "2")


def kill_at_work(cluster, node, out: Path) -> None:
    """Kill a worker node, with all its processes, once both have begun a pad."""
    while len(list(out.glob("pad-*/*.log"))) < 2:
        time.sleep(0.1)
    time.sleep(2)
    cluster.remove_node(node, allow_graceful=False)
    print("a worker was killed", flush=True)


if __name__ == "__main__":
    out = Path(sys.argv[-1])
    if sys.argv[1] == "--serial":
        sys.exit(train.main([*STUDY, "--out", str(out)]))
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    _, doomed = cluster.add_node(num_cpus=1), cluster.add_node(num_cpus=1)
    threading.Thread(target=kill_at_work, args=(cluster, doomed, out), daemon=True).start()
    code = train.main([*STUDY, "--out", str(out), "--executor", "ray", "--address", cluster.address])
    cluster.shutdown()
    sys.exit(code)
