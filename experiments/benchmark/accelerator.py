"""Section `accelerator` of the benchmark: rates on one GPU, with the arithmetic that can be counted.

Rates are of full batches that stay on the GPU. The peer for patches is `warp-lang`, which traverses a software bounding
volume hierarchy: one orthographic ray per pixel by `mesh_query_ray`, with the poses on the GPU too. The other rows have
neither peer nor goal. The section also runs on CPUs, slowly because of its large batches.
"""

from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import i2t
from experiments.benchmark import rendering, skin
from experiments.benchmark import training as paper_training
from experiments.benchmark.contests import Contest, Work, finish
from i2t import training as learning
from i2t.geometry import full_precision
from i2t.paper import loss, network
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, STANDOFF
from i2t.recognition.belief import sample_particles
from i2t.recognition.environment import EpisodeState, TouchAction
from i2t.recognition.outcomes import placement_std, predict_contact
from i2t.recognition.touch_table import make_environment, tabulate
from i2t.simulation.sites import RECOGNITION_LIMITS, collect_sites
from i2t.simulation.touches import PressLimits, SimulationErrors, sample_session_errors, simulate_touch
from i2t.skin.contact import solve
from i2t.skin.elasticity import GRID, compliance, convolve
from i2t.skin_models.reading_model import LOADS_N
from i2t.training import Learner
from i2t.types import Surface, Touches


def patches(small: bool) -> Iterator[Contest]:
    """Compare patches with warp's, if it is installed."""
    if find_spec("warp") is None:
        print("patches are skipped: install their peer with python -m pip install warp-lang")
        return
    batch = 4 if small else 4096
    for name, mesh in {
        "sphere of 80 faces": trimesh.creation.icosphere(1, 0.03),
        "sphere of 20480 faces": trimesh.creation.icosphere(5, 0.03),
        **{name: i2t.make_object(name).mesh for name in ("hexagon", "screwdriver")},
    }.items():
        surface = jax.device_put(i2t.prepare_surface(mesh))
        poses = jax.device_put(rendering.random_poses(surface, batch))
        render, cast = jax.jit(jax.vmap(i2t.render_patch, (None, 0))), warp_caster(mesh, np.asarray(poses))
        seen = jax.device_get(render(surface, poses))
        rendering.check(name, "warp", seen.depth, seen.nearest, cast().numpy())
        yield Contest(
            f"{name}, batch of {batch}", partial(finish, render, surface, poses), "warp", partial(_wait, cast),
            our_calls=1 / batch, peer_calls=1 / batch, unit="s a patch", steady=0.0 if small else 0.5,
        )  # fmt: skip
        if small:
            return


def rates(small: bool) -> Iterator[Contest]:
    """Yield rates of contacts, simulated and predicted touches, training examples, and environment steps."""
    steady = 0.0 if small else 0.5
    for section in (contacts, touches, predictions, trainings, environments):
        for name, call, count in section(small):
            yield Contest(name, call, our_calls=1 / count, unit="1/s", steady=steady)


Rate: TypeAlias = tuple[str, Work, int]  # name, function, and number of items per call


def contacts(small: bool) -> Iterator[Rate]:
    """Solve contacts of the default layer, and count the arithmetic of their convolutions."""
    count, pad = (8, 4096)[not small], i2t.nominal_pad()
    heights, depths = jax.device_put(skin.touches(GRID, list(skin.SHAPES), count))
    run = jax.jit(jax.vmap(lambda height, indentation: solve(pad, height, indentation, GRID)))
    cost = jax.jit(convolve).lower(compliance(pad, GRID), heights[0]).compile().cost_analysis() or {}
    flops = float(np.mean(run(heights, depths).steps)) * cost.get("flops", 0.0)
    yield f"contacts, {flops / 1e6:.2g} Mflop each, batch of {count}", partial(finish, run, heights, depths), count


def touches(small: bool) -> Iterator[Rate]:
    """Simulate touches of one object with the errors of a lab, without those of the sensor."""
    count, pad, errors = (4, 2048)[not small], i2t.nominal_pad(), SimulationErrors()
    surface, T_w_t = _sites(count)

    @jax.jit
    @full_precision
    def run(seed: jax.Array, T_w_t: jax.Array) -> Touches:
        key_session, key_touches = jax.random.split(jax.random.key(seed))
        session = sample_session_errors(key_session, errors)
        simulate = partial(simulate_touch, session=session, pad=pad, errors=errors, limits=PressLimits())
        return jax.vmap(simulate, (0, None, None, 0))(jax.random.split(key_touches, count), surface, jnp.eye(4), T_w_t)

    yield f"simulated touches, batch of {count}", partial(finish, run, jnp.uint32(0), T_w_t), count


def predictions(small: bool) -> Iterator[Rate]:
    """Predict touches on an object in many poses, as for the belief."""
    sites, poses = (2, 2) if small else (64, 64)
    surface, T_w_t = _sites(sites)
    twists = sample_particles(placement_std(1e-3, np.radians(1)), poses).twist
    predict = partial(predict_contact, overtravel=PressLimits.overtravel)
    run = jax.jit(jax.vmap(jax.vmap(predict, (None, None, 0, None, None)), (None, None, None, 0, None)))
    arguments = surface, jnp.eye(4), twists, T_w_t, jnp.float32(LOADS_N)
    yield f"predicted touches, {sites} sites in {poses} poses", partial(finish, run, *arguments), sites * poses


def trainings(small: bool) -> Iterator[Rate]:
    """Train the paper's network for an epoch, with one seed and with many at once."""
    setup = paper_training.SMALL if small else paper_training.Setup()
    batch = jax.device_put(paper_training.random_touches(setup))
    for seeds in (1, 2) if small else (1, 8, 32):
        learner = Learner(setup.model, network.init, loss.losses, seeds)
        start = jax.jit(learning.init, static_argnums=(1, 2, 3))
        state = start(jax.random.key(0), learner, setup.train, setup.touches)
        flops = 6 * sum(leaf.size for leaf in jax.tree.leaves(state.params)) / seeds
        epoch = partial(finish, learning.compiled(learner, setup.train), state, batch, None)
        name = f"examples of the paper's network, {flops / 1e6:.3g} Mflop each, seeds: {seeds}"
        yield name, epoch, seeds * setup.touches


def environments(small: bool) -> Iterator[Rate]:
    """Step many environments with tabulated touches and random actions."""
    many, steps = (4, 2) if small else (8192, 64)
    environment, params = make_environment(("star", "hexagon"), sites=4 if small else 32, pads=1 if small else 4)
    params = jax.device_put(tabulate(jax.random.key(0), environment, params, placements=2 if small else 16))

    def step(states: EpisodeState, key: jax.Array) -> tuple[EpisodeState, jax.Array]:
        key_site, key_step = jax.random.split(key)
        site = jax.random.randint(key_site, (many,), 0, params.sites)
        action = TouchAction(site, jnp.zeros((many, params.objects)))
        _, after, reward, _, _ = jax.vmap(environment.step, (0, 0, 0, None))(
            jax.random.split(key_step, many), states, action, params
        )
        return after, reward

    @jax.jit
    def run(seed: jax.Array) -> jax.Array:
        key_reset, key_steps = jax.random.split(jax.random.key(seed))
        _, states = jax.vmap(environment.reset, (0, None))(jax.random.split(key_reset, many), params)
        return jax.lax.scan(step, states, jax.random.split(key_steps, steps))[1]

    yield f"steps of {many} environments", partial(finish, run, jnp.uint32(1)), many * steps


def warp_caster(mesh: Any, poses: np.ndarray) -> Callable[[], Any]:
    """Make a function that casts the rays of patches with `warp-lang` and returns their distances (n, 48, 48)."""
    import warp

    vertices = warp.array(np.asarray(mesh.vertices, np.float32), dtype=warp.vec3)
    scene = warp.Mesh(vertices, warp.array(np.asarray(mesh.faces, np.int32).ravel(), dtype=warp.int32))
    frames = warp.array(poses.astype(np.float32), dtype=warp.mat44)
    distance = warp.empty((len(poses), PATCH_PIXELS, PATCH_PIXELS), dtype=warp.float32)
    size, middle, standoff = PATCH_WINDOW / PATCH_PIXELS, PATCH_PIXELS / 2 - 0.5, STANDOFF

    @warp.kernel
    def cast(
        scene: warp.uint64,
        frames: warp.array(dtype=warp.mat44),
        distance: warp.array3d(dtype=warp.float32),
    ):
        frame, row, column = warp.tid()
        T = frames[frame]
        x = (warp.float32(column) - warp.float32(middle)) * warp.float32(size)
        y = (warp.float32(row) - warp.float32(middle)) * warp.float32(size)
        start = warp.transform_point(T, warp.vec3(x, y, -warp.float32(standoff)))
        query = warp.mesh_query_ray(scene, start, warp.transform_vector(T, warp.vec3(0.0, 0.0, 1.0)), 1.0)
        distance[frame, row, column] = warp.inf
        if query.result:
            distance[frame, row, column] = query.t

    def run() -> Any:
        warp.launch(cast, distance.shape, [scene.id, frames, distance])
        return distance

    return run


def _wait(cast: Callable[[], Any]) -> None:
    import warp

    cast()
    warp.synchronize()


def _sites(count: int) -> tuple[Surface, jax.Array]:
    surface = jax.device_put(i2t.prepare_surface(i2t.make_object("star").mesh))
    return surface, jnp.asarray(collect_sites(jax.random.key(1), surface, count, RECOGNITION_LIMITS, "star"))
