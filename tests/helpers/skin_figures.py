"""The figures of `docs/physics.md`: `python tests/helpers/skin_figures.py` from the root of the checkout (about ten
minutes on two cores, most of them for finite elements).

Speeds are those of one run on one machine: read their ratios.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from i2t.skin import contact, elasticity
from i2t.skin import dipoles as field
from i2t.skin.dipoles import CELL_NODES, response
from i2t.skin.elasticity import FINE_GRID, GRID, Grid
from i2t.skin.friction import rest, shear
from i2t.skin.pad import nominal_pad, press, press_force, sample_pad

sys.path.insert(0, str(Path(__file__).parents[1] / "skin"))  # whose oracles these figures are of

from test_contact import PAD, SHAPES, _reference
from test_dipoles import _tip
from test_elements import THICKNESS, cap, displacement, interpolate

RANDOM = np.random.default_rng(1)
FINEST = Grid(160, 256)


def against_contact_mechanics() -> None:
    print("shape           force (N)  difference  pressure rms / peak  steps  ContactMechanics")
    solve = jax.jit(contact.solve)
    for name, (height, indentation) in SHAPES.items():
        start = time.perf_counter()
        pressure = _reference(height, indentation)
        seconds = time.perf_counter() - start
        found = solve(PAD, jnp.asarray(height, jnp.float32), indentation)
        force = pressure.sum() * GRID.spacing**2
        rms = np.sqrt(np.mean((found.pressure - pressure) ** 2)) / pressure.max()
        print(
            f"{name:15} {force:9.5f}  {found.force / force - 1:+.1e}  {rms:.1e}  {found.steps:5}  {1 / seconds:.0f}/s"
        )


def against_hertz() -> None:
    radius, indentation, grid = 2e-3, 0.03e-3, Grid(cells=64, modes=1024, window=2e-3)
    pad = PAD._replace(thickness=jnp.asarray(30e-3))
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    height = jnp.asarray((x**2 + y**2) / (2 * radius), jnp.float32)
    found = jax.jit(lambda pad, height: contact.solve(pad, height, indentation, grid))(pad, height)
    modulus = float(pad.young) / (1 - float(pad.poisson) ** 2)
    print(f"\nforce over Hertz's: {found.force / (4 / 3 * modulus * np.sqrt(radius) * indentation**1.5):.4f}")


def against_mindlin() -> None:
    """The sphere of `test_shear`, dragged: the force over Cattaneo's and Mindlin's at the same slide."""
    grid, radius, depth = Grid(32, 512, 1e-3), 2e-3, 0.03e-3
    pad = PAD._replace(thickness=jnp.asarray(8e-3), friction=jnp.asarray(0.6))
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    found = contact.solve(pad, jnp.asarray((x**2 + y**2) / (2 * radius), jnp.float32), depth, grid)
    a, load, nu = np.sqrt(radius * depth), float(found.force), float(pad.poisson)
    full = 3 * 0.6 * load * (2 - nu) * 2 * (1 + nu) / (16 * float(pad.young) * a)
    pressed = rest(pad, found.pressure, grid)
    print("\nshare of the slide to full slip: force over theirs, sticking radius over the contact's, and theirs, steps")
    for part in (0.2, 0.4, 0.6, 0.8, 0.95, 1.2):
        state = shear(pad, found.pressure, jnp.asarray([part * full, 0]), grid, before=pressed)
        force = float(jnp.sum(state.traction[0])) * grid.spacing**2
        theirs = 0.6 * load * (1 - max(1 - part, 0) ** 1.5)
        stuck = np.sum((np.asarray(found.pressure) > 0) & ~np.asarray(state.slipping)) * grid.spacing**2
        radii = np.sqrt(stuck / np.pi) / a, np.sqrt(max(1 - part, 0))
        print(f"{part:.2f}: {force / theirs:.4f}  {radii[0]:.2f} {radii[1]:.2f}  {state.steps}")


def free_sides() -> None:
    """The bonded pad in space, of 1 mm Taylor-Hood bricks, three through its thickness, half of it by symmetry."""
    pads = [PAD, *(sample_pad(jax.random.key(i)) for i in range(4))]
    pads = [
        pad._replace(thickness=PAD.thickness, young=PAD.young, mount_compliance=PAD.mount_compliance) for pad in pads
    ]  # bonded
    axes = np.linspace(-10e-3, 10e-3, 21), np.linspace(0, 10e-3, 11), np.linspace(-THICKNESS, 0, 4)
    half = GRID.centres[GRID.cells // 2 :]
    along, ahead = interpolate(axes[0], GRID.centres), interpolate(axes[1], half)
    mirror = np.array([1, -1, 1])[:, None, None], np.array([-1, 1, -1])[:, None, None]  # of a vector, of a rotation

    def inside(moved: np.ndarray, depth: float) -> tuple[np.ndarray, np.ndarray]:
        up = interpolate(axes[2], np.array([-depth]))
        pick = lambda x, y, z: np.einsum("czyx,ix,jy,z->cji", moved, along[x], ahead[y], up[z][0])  # noqa: E731
        u, by_x, by_y, by_z = pick(0, 0, 0), pick(1, 0, 0), pick(0, 1, 0), pick(0, 0, 1)
        turned = np.stack([by_y[2] - by_z[1], by_z[0] - by_x[2], by_x[1] - by_y[0]]) / 2
        both = zip(mirror, (u, turned), strict=True)
        return tuple(np.concatenate([sign * part[:, ::-1], part], 1) for sign, part in both)

    @jax.jit
    def read(pad, motions):
        depths, moments = field.sheets(pad)
        parts = [
            field._at_chips(pad, field._places(depth, GRID) + moved, field.turn(turned, sheet))
            for depth, sheet, (moved, turned) in zip(depths, moments, motions, strict=True)
        ]
        return pad.gains * pad.board.to_board(sum(parts) - field.rest_field(pad))

    y, x = np.meshgrid(FINE_GRID.centres, FINE_GRID.centres, indexing="ij")
    depths = np.asarray(field.sheets(PAD)[0], float)
    print("\na pad with free sides: sink under the load, largest error of the surface, change of the reading")
    push = 0.02e-3
    for name, centre in {
        "middle": 0,
        "1 h from the rim": 6e-3,
        "at the rim": 8e-3,
        "over it": 10e-3,
        "face": None,
    }.items():
        if centre is None:
            moved, force = displacement(axes, None, [(1, 0, 1)], pushed=push)
            found = contact.solve(PAD, jnp.zeros((80, 80)), push, FINE_GRID)
            pressure = np.asarray(found.pressure) * 2 * force / float(found.force)  # the same force
            print(f"{name}: {2 * force:.3f} N, {found.force:.3f} N without free sides")
        else:
            moved, _ = displacement(axes, lambda p, c=centre: (0, 0, -cap(np.hypot(p[0] - c, p[1]))), [(1, 0, 1)])
            pressure = cap(np.hypot(x - centre, y))
        pressure = jnp.asarray(pressure, jnp.float32)
        load = elasticity.load(PAD, pressure, None, FINE_GRID, GRID)
        top, ours = inside(moved, 0.0)[0], np.asarray(elasticity.interior(PAD, load, 0.0)[0])
        weight = np.asarray(pressure).reshape(40, 2, 40, 2).mean(axis=(1, 3))
        sink = np.sum(weight * ours[2]) / np.sum(weight * top[2]) - 1
        worst = np.abs(ours - top).max() / np.abs(top).max()
        motions = [tuple(jnp.asarray(part, jnp.float32) for part in inside(moved, depth)) for depth in depths]
        free = np.stack([read(pad, motions) for pad in pads])
        endless = np.stack([response(pad, pressure, FINE_GRID, dipoles=GRID) for pad in pads])
        change = np.sqrt(np.sum((endless - free) ** 2) / np.sum(free**2))
        print(
            f"{name}: {sink:+.1%}, {worst:.1%}, {change:.1%} ({np.linalg.norm(free, axis=1).round(1)} uT)", flush=True
        )


def _edge(x, y, angle, offset, slope):
    s = x * np.cos(angle) + y * np.sin(angle) - offset
    return np.minimum(np.maximum(s * slope, -s / slope), 4e-3)


def _corner(x, y, x0, y0, angles, slope):
    faces = [np.cos(a) * (x - x0) + np.sin(a) * (y - y0) for a in angles]
    return np.minimum(slope * np.max(faces, axis=0), 4e-3)


def _stamp(x, y, bars, tilt=0.0):
    inside = np.any([(abs(x - u) < w) & (abs(y - v) < h) for u, v, w, h in bars], axis=0)
    return np.where(inside, 0, 3.5e-3) + tilt * (x + 10e-3)


def _families() -> dict:
    tee = [(0, 0, 1e-3, 5e-3), (0, 4e-3, 5e-3, 1e-3)]
    cross = [(0, 0, 1e-3, 5e-3), (0, 0, 5e-3, 1e-3)]
    edges = [(RANDOM.uniform(0, 2 * np.pi), RANDOM.uniform(-5e-3, 5e-3), RANDOM.uniform(0.2, 1.2)) for _ in range(8)]
    corners = [
        (*RANDOM.uniform(-4e-3, 4e-3, 2), RANDOM.uniform(0, 2) + np.array([0, 2.1, 4.2]), RANDOM.uniform(0.4, 1))
        for _ in range(8)
    ]
    return {
        "tips at 0.8 N": ([_tip(*RANDOM.uniform(-7e-3, 7e-3, 2)) for _ in range(8)], 0.8),
        "stamps at 1 N": (
            [
                lambda x, y, bars=bars, tilt=tilt: _stamp(x, y, bars, tilt)
                for bars in (tee, cross)
                for tilt in (0, 0.02)
            ],
            1.0,
        ),
        "edges at 0.6 N": ([lambda x, y, e=e: _edge(x, y, *e) for e in edges], 0.6),
        "corners at 0.5 N": ([lambda x, y, c=c: _corner(x, y, *c) for c in corners], 0.5),
    }


def refinement() -> None:
    pads = [nominal_pad(), *(sample_pad(jax.random.key(i)) for i in range(4))]
    print("\nchange of the reading against 160 x 160 cells and 80 x 80 x 10 dipoles: pooled, median and worst press")
    levels = {
        "40, dipoles 40": (GRID, GRID),
        "80, dipoles 40": (FINE_GRID, GRID),
        "80, dipoles 80": (FINE_GRID, FINE_GRID),
    }
    for family, (shapes, force) in _families().items():
        readings = {}
        for name, (grid, dipoles, nodes) in {
            **{name: (*level, CELL_NODES) for name, level in levels.items()},
            "reference": (FINEST, FINE_GRID, 2 * CELL_NODES),
        }.items():
            y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
            heights = jnp.asarray(np.stack([shape(x, y) for shape in shapes]), jnp.float32)

            def one(pad, height, grid=grid, dipoles=dipoles, nodes=nodes, force=force):
                found = contact.solve_force(pad, height - jnp.min(height), force, grid)
                return response(pad, found.pressure, grid, dipoles=dipoles, nodes=nodes)

            each = jax.jit(lambda pad, heights, one=one: jax.lax.map(lambda height: one(pad, height), heights))
            readings[name] = np.stack([each(pad, heights) for pad in pads])
        exact = readings.pop("reference")
        for name, found in readings.items():
            change, size = np.linalg.norm(found - exact, axis=-1), np.linalg.norm(exact, axis=-1)
            pooled = np.sqrt(np.sum(change**2) / np.sum(size**2))
            each = change / size
            print(f"{family:17} {name}: {pooled:.2%}  {np.median(each):.2%}  {each.max():.2%}")


def speed() -> None:
    print("\nin batches of 64, at 0.3 mm")
    for name, grid in (("40 cells", GRID), ("80 cells", FINE_GRID)):
        y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
        places = RANDOM.uniform(-5e-3, 5e-3, (64, 2))
        heights = jnp.asarray(np.stack([_tip(*place)(x, y) for place in places]), jnp.float32)
        for task, function in (("contact", contact.solve), ("contact and reading", press)):
            run = jax.jit(jax.vmap(lambda pad, height, f=function, g=grid: f(pad, height, 0.3e-3, g), (None, 0)))
            jax.block_until_ready(run(PAD, heights))
            times = []
            for _ in range(5):
                start = time.perf_counter()
                jax.block_until_ready(run(PAD, heights))
                times.append(time.perf_counter() - start)
            print(f"{name}, {task}: {64 / min(times):.0f}/s")


def magnitudes() -> None:
    y, x = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
    heights = jnp.asarray(np.stack([_tip(*p)(x, y) for p in RANDOM.uniform(-7e-3, 7e-3, (32, 2))]), jnp.float32)
    forces = jnp.asarray(RANDOM.uniform(0.6, 1.0, 32), jnp.float32)
    pads = jax.jit(jax.vmap(sample_pad))(jax.random.split(jax.random.key(11), 200))
    each = jax.vmap(press_force, (None, 0, 0))
    found = jax.jit(lambda pads: jax.lax.map(lambda pad: each(pad, heights, forces), pads))(pads)
    norm = np.linalg.norm(found.reading, axis=-1)
    print("\n200 simulated pads, a tip of 4.6 mm at 0.6-1.0 N: 10, 50 and 90 % of the pads")
    print("median norm (uT)", np.quantile(np.median(norm, axis=1), [0.1, 0.5, 0.9]).round())
    print("95th percentile (uT)", np.quantile(np.quantile(norm, 0.95, axis=1), [0.1, 0.5, 0.9]).round())
    print("sensitivity (uT/N)", np.quantile(np.median(norm / np.asarray(forces), axis=1), [0.1, 0.5, 0.9]).round())
    chips = np.asarray(found.reading).reshape(200, 32, 5, 3)
    strongest = np.linalg.norm(chips, axis=-1).argmax(axis=-1)
    values = np.abs(np.take_along_axis(chips, strongest[..., None, None], axis=2)[:, :, 0])
    for axis, name in enumerate("xyz"):
        print(f"strongest chip's {name} (uT)", np.quantile(np.median(values[..., axis], 1), [0.1, 0.5, 0.9]).round())


if __name__ == "__main__":
    against_contact_mechanics()
    against_hertz()
    against_mindlin()
    free_sides()
    refinement()
    speed()
    magnitudes()
