"""Section `environment` of the benchmark: steps of the environments of active touch, tabulated and with exact physics,
next to touches simulated with the whole physics (`i2t.simulation.touches`).

All are on the same prisms with random pads, many side by side. Exact means contacts at cells of 1 mm and a reading that
is linear in the pressure; what that changes is tested in tests/environments/test_press.py.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from experiments.benchmark.timing import BenchmarkRow, compare, interleave
from i2t.environments.core import EnvironmentParams, EnvironmentState, TouchAction, TouchEnvironment
from i2t.environments.tables import make_environment, tabulate
from i2t.rendering.ops import element
from i2t.simulation.press import PressLimits
from i2t.simulation.touches import SimulationErrors, simulate_touches


@dataclass(frozen=True)
class EnvironmentBenchmark:
    """Sizes of the environments."""

    objects: tuple[str, ...] = ("star", "hexagon", "cylinder", "cross")
    sites: int = 16
    pads: int = 4
    placements: int = 16  # of the table
    episodes: int = 256  # side by side
    steps: int = 512  # of the table, in one call; exact ones are fewer
    exact_steps: int = 4
    touches: int = 64  # simulated by the peer


def section(setup: EnvironmentBenchmark, turns: int) -> list[BenchmarkRow]:
    """Seconds of a step, of either speed."""
    environment, params = make_environment(setup.objects, sites=setup.sites, pads=setup.pads)
    table = tabulate(jax.random.key(1), environment, params, setup.placements)
    tabulated = _stepper(environment, setup.episodes, setup.steps)
    exact = _stepper(environment, setup.episodes, setup.exact_steps)
    surface, pad = element(params.surfaces, 0), element(params.pads, 0)
    key = jax.random.key(2)

    def whole() -> None:
        simulate_touches(
            jax.random.clone(key), [surface], pad, SimulationErrors(), setup.touches, limits=PressLimits(),
            sites=environment.config.safety, touches_per_session=setup.touches,
        )  # fmt: skip

    seconds = interleave({"table": lambda: tabulated(table), "exact": lambda: exact(params), "whole": whole}, turns)
    counts = {
        "table": setup.episodes * setup.steps, "exact": setup.episodes * setup.exact_steps, "whole": setup.touches,
    }  # fmt: skip
    each = {name: [s / counts[name] for s in values] for name, values in seconds.items()}
    work = f"of {setup.episodes} episodes"
    return [
        compare("environment", f"a tabulated step {work}", each["table"], "exact physics", each["exact"]),
        compare("environment", f"a step with exact physics {work}", each["exact"], "simulate_touches", each["whole"]),
    ]


def _stepper(environment: TouchEnvironment, episodes: int, steps: int) -> Callable[[EnvironmentParams], object]:
    """Steps at random sites, compiled."""

    def run(params: EnvironmentParams) -> jax.Array:
        key_reset, key_steps = jax.random.split(jax.random.key(0))
        _, state = jax.vmap(lambda k: environment.reset(k, params))(jax.random.split(key_reset, episodes))
        step = jax.vmap(partial(environment.step, params=params))

        def one(state: EnvironmentState, key: jax.Array) -> tuple[EnvironmentState, jax.Array]:
            key_site, key_touch = jax.random.split(key)
            site = jax.random.randint(key_site, (episodes,), 0, params.sites)
            action = TouchAction(site, jnp.zeros((episodes, params.objects)))
            obs, state, reward, _, _ = step(jax.random.split(key_touch, episodes), state, action)
            return state, reward + obs.reading.sum(1)

        return jax.lax.scan(one, state, jax.random.split(key_steps, steps))[1].sum()

    compiled = jax.jit(run)
    return lambda params: jax.block_until_ready(compiled(params))
