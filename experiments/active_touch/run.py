"""Question: which policy recognises objects with the fewest touches?

    python -m experiments.active_touch --out runs/active_touch      six prisms of one height, 16 touches
    python -m experiments.active_touch --preset debug               every step once, too small for meaningful results

An object is within 1 mm and 1 degree of its expected pose, and is touched at 16 of 36 sites that are safe on every
object (`i2t.recognition.environment`, with tabulated touches). Three policies choose sites by the same posterior, which
treats each pad as calibrated: random, the paper's heuristic, and expected information. Intervals are over pads.
Everything is simulated. Results: metrics.json, config.json, accuracy.png. It takes a few minutes on two cores.
"""

from typing import Any

import jax
import numpy as np

from experiments.active_touch.arguments import PRESETS, ActiveTouchArgs, ActiveTouchSizes
from experiments.common.runs import begin, write_json
from experiments.common.tables import cell, markdown
from experiments.recognize import figures
from i2t import viz
from i2t.intervals import Estimate, rate_interval
from i2t.recognition.environment import EnvironmentConfig, EnvironmentParams, TouchEnvironment
from i2t.recognition.environment_beliefs import with_beliefs
from i2t.recognition.rollout import POLICIES, rollout
from i2t.recognition.touch_table import make_environment, tabulate


def run(args: ActiveTouchArgs) -> dict[str, Any]:
    """Run every policy in one environment; write metrics.json, config.json and a figure."""
    sizes = PRESETS[args.preset]
    begin(args, sizes)
    key_lab, _, key_test = jax.random.split(jax.random.key(args.seed), 3)
    environment, params = make_lab(key_lab, args, sizes)
    curves: dict[str, Estimate] = {}
    rng = np.random.default_rng(args.seed)
    truth, pad = (rng.permutation(np.arange(sizes.episodes) % n) for n in (len(args.objects), sizes.test_pads))
    for name, policy in POLICIES.items():
        print(name, flush=True)
        _, posterior = rollout(jax.random.clone(key_test), environment, params, policy, truth, pad)
        curves[name] = rate_interval(posterior.argmax(-1) == truth[:, None], [pad])
    report = {
        "source": "simulated",
        "objects": list(args.objects),
        "episodes": sizes.episodes,
        "test_pads": sizes.test_pads,
        "accuracy": {name: np.stack(curve, axis=1).tolist() for name, curve in curves.items()},
        "seed": args.seed,
    }
    write_json(args.out / "metrics.json", report)
    viz.save_figure(figures.accuracy(curves, "Which object is it?", simulated=True), args.out / "accuracy.png")
    print(table(curves))
    return report


def make_lab(
    key: jax.Array, args: ActiveTouchArgs, sizes: ActiveTouchSizes
) -> tuple[TouchEnvironment, EnvironmentParams]:
    """Draw sites and pads, tabulate the touches of the test pads, and add beliefs of calibrated pads."""
    _, key_touch, key_belief = jax.random.split(key, 3)
    environment, params = make_environment(
        args.objects, config=EnvironmentConfig(touches=sizes.touches, law=None), sites=sizes.sites,
        pads=sizes.other_pads + sizes.test_pads, seed=args.seed,
    )  # fmt: skip
    params = with_beliefs(key_belief, environment, params, sizes.particles)
    test = params.with_pads(slice(sizes.other_pads, None))
    return environment, tabulate(key_touch, environment, test, sizes.placements)


def table(curves: dict[str, Estimate]) -> str:
    """Format the accuracy after some touches, with 95 % intervals over pads."""
    touches = len(next(iter(curves.values())).mean)
    shown = [n for n in (1, 2, 3, 4, 5, 8, 12, 16) if n <= touches]
    rows = [[name, *(cell([part[n - 1] for part in curve], 2) for n in shown)] for name, curve in curves.items()]
    return markdown(["policy", *map(str, shown)], rows)
