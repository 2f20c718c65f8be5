"""The elastic layer against independent solvers, closed forms and its own equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ContactMechanics import PeriodicFFTElasticHalfSpace
from ContactMechanics.Systems import NonSmoothContactSystem
from SurfaceTopography import Topography

from i2t.skin import contact, elasticity
from i2t.skin.elasticity import GRID, Grid
from i2t.skin.pad import nominal_pad
from tests.helpers.round_tips import round_tip

Y, X = np.meshgrid(GRID.centres, GRID.centres, indexing="ij")
PAD = nominal_pad()
SHAPE = np.cos(np.pi * X / 20e-3) ** 2 * np.cos(np.pi * Y / 20e-3) ** 2  # sinking of a skin clamped at its edge
STATIC = ("grid", "tolerance", "max_steps")
solve = jax.jit(contact.solve, static_argnames=STATIC)
solve_force = jax.jit(contact.solve_force, static_argnames=STATIC)


def _bar(x: float, y: float, half_width: float, half_height: float) -> np.ndarray:
    return (abs(X - x) < half_width) & (abs(Y - y) < half_height)


T = np.where(_bar(0, 0, 1e-3, 5e-3) | _bar(0, 4e-3, 5e-3, 1e-3), 0, 3.5e-3)
CORNER = [np.cos(angle) * (X - 1.2e-3) + np.sin(angle) * (Y + 2.1e-3) for angle in (0.4, 2.5, 4.6)]  # of three faces
SHAPES = {
    "sphere": (round_tip(X, Y, (0.3e-3, -1.1e-3), 8e-3), 0.6e-3),
    "flat punch": (np.where(X**2 + Y**2 < 4e-3**2, 0, np.inf), 0.2e-3),
    "stamp": (T, 0.2e-3),
    "tilted stamp": (T + 0.03 * (X + 5e-3), 0.3e-3),
    "edge": (np.maximum(0.5 * (X + 0.3 * Y), -(X + 0.3 * Y)), 0.2e-3),
    "corner": (np.minimum(0.6 * np.max(CORNER, axis=0), 4e-3), 0.3e-3),
}


def _rough(seeds: int) -> np.ndarray:
    """Make surfaces of random waves, tilted, with holes."""
    heights = []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        waves = random.normal(size=(6, 2)) * random.choice([200, 800])
        phases = random.uniform(0, 2 * np.pi, 6)
        height = sum(np.cos(k[0] * X + k[1] * Y + phase) for k, phase in zip(waves, phases, strict=True)) * 1e-4
        height += random.normal() * 0.05 * X + random.normal() * 0.05 * Y
        if seed % 3 == 0:
            height = np.where((X - random.uniform(-5e-3, 5e-3)) ** 2 + Y**2 < 6e-3**2, height, np.inf)
        heights.append(height - height.min())
    return np.stack(heights)


def _reference(height: np.ndarray, indentation: float) -> np.ndarray:
    """Compute the pressure (Pa) with the package ContactMechanics, on the same cells and period."""
    period = GRID.modes * GRID.spacing
    grid = (GRID.modes, GRID.modes)
    elastic = PeriodicFFTElasticHalfSpace(
        grid, float(PAD.young), (period, period), thickness=float(PAD.thickness), poisson=float(PAD.poisson)
    )
    surface = np.full(grid, -1.0)  # nothing within reach outside the pad
    surface[: GRID.cells, : GRID.cells] = -np.minimum(height, 1.0)
    system = NonSmoothContactSystem(elastic, Topography(surface, (period, period)))
    assert system.minimize_proxy(offset=indentation, pentol=1e-10).success
    return np.asarray(system.force)[: GRID.cells, : GRID.cells] / GRID.spacing**2


@pytest.mark.parametrize("name", SHAPES)
def test_agrees_with_contact_mechanics(name):
    height, indentation = SHAPES[name]
    solved = solve(PAD, jnp.asarray(height, jnp.float32), indentation)
    pressure = _reference(height, indentation)
    assert solved.converged
    # Required: the force within 0.1 %, the pressure (root mean square) within 2 % of its peak, here 0.1 % as well.
    np.testing.assert_allclose(solved.force, pressure.sum() * GRID.spacing**2, rtol=1e-3)
    assert np.sqrt(np.mean((solved.pressure - pressure) ** 2)) < 1e-3 * pressure.max()


def test_reproduces_hertz_where_it_holds():
    """A sphere with a contact much smaller than the layer: F = 4/3 E* sqrt(R) d^1.5 and an elliptic pressure."""
    radius, indentation = 2e-3, 0.03e-3  # contact radius 0.24 mm, 8 cells
    grid = Grid(cells=64, modes=1024, window=2e-3)
    pad = PAD._replace(thickness=jnp.asarray(30e-3))
    y, x = np.meshgrid(grid.centres, grid.centres, indexing="ij")
    solved = solve(pad, jnp.asarray((x**2 + y**2) / (2 * radius), jnp.float32), indentation, grid)
    modulus = float(PAD.young) / (1 - float(PAD.poisson) ** 2)
    # The bonded base stiffens by 1.13 a / h = 0.9 % (Dimitriadis et al., Biophys. J. 82, 2002) and the copies, 32 mm
    # away, by about as much; 3 % is required.
    np.testing.assert_allclose(solved.force, 4 / 3 * modulus * np.sqrt(radius) * indentation**1.5, rtol=0.03)
    peak = 2 * modulus / np.pi * np.sqrt(indentation / radius)
    hertz = peak * np.sqrt(np.maximum(1 - (x**2 + y**2) / (radius * indentation), 0))
    # The cells that the rim cuts, an eighth of the contact's, miss by up to a few hundredths of the peak each.
    assert np.sqrt(np.mean((solved.pressure - hertz)[hertz > 0] ** 2)) < 0.03 * peak


def test_a_flat_face_on_an_infinite_layer_is_a_spring():
    """With a period as long as the pad nothing bulges sideways, so p = indentation / G(0)."""
    grid = Grid(cells=16, modes=16)
    solved = solve(PAD, jnp.zeros((16, 16)), 1e-5, grid)
    nu, young, thickness = float(PAD.poisson), float(PAD.young), float(PAD.thickness)
    pressure = 1e-5 * young * (1 - nu) / (thickness * (1 + nu) * (1 - 2 * nu))
    np.testing.assert_allclose(solved.pressure, np.full((16, 16), pressure), rtol=1e-5)  # the solver's tolerance


@pytest.fixture(scope="module")
def sweeps():
    """Press 15 rough surfaces to 8 indentations, the first of which does not touch."""
    heights = jnp.asarray(_rough(15), jnp.float32)
    indentations = jnp.asarray([0.0, 1e-6, 1e-5, 5e-5, 1e-4, 2e-4, 4e-4, 8e-4])

    def press(height, indentation):
        return contact.solve(PAD, height, indentation)

    return heights, indentations, jax.jit(jax.vmap(jax.vmap(press, (None, 0)), (0, None)))(heights, indentations)


def _kernel_for_fft() -> np.ndarray:
    """Compute G(k) of a bonded layer in NumPy's order of wavenumbers."""
    h, e, nu = (float(value) for value in (PAD.thickness, PAD.young, PAD.poisson))
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(64, GRID.spacing), np.fft.rfftfreq(64, GRID.spacing), indexing="ij"))
    q = 2 * np.pi * k * h
    q[0, 0] = 1
    over = (3 - 4 * nu) * np.cosh(2 * q) + 2 * q**2 + 5 - 12 * nu + 8 * nu**2
    kernel = 2 * h * (1 - nu**2) / (e * q) * ((3 - 4 * nu) * np.sinh(2 * q) - 2 * q) / over
    kernel[0, 0] = h * (1 + nu) * (1 - 2 * nu) / (e * (1 - nu))
    return kernel


def test_contact_conditions_hold_and_force_grows_with_depth(sweeps):
    heights, indentations, solved = sweeps
    assert np.all(solved.converged)
    assert np.all(solved.pressure >= 0)
    deflection = np.max(solved.gap - heights[:, None] + indentations[None, :, None, None], axis=(2, 3))
    # The tolerance bounds the residual; float32 adds a few roundings of heights of about a millimetre.
    violation = contact.CONTACT_SOLVER.tolerance * deflection[..., None, None] + 4 * np.finfo(np.float32).eps * 1e-3
    assert np.all(solved.gap > -violation)
    touching = solved.pressure > 1e-3 * np.max(solved.pressure, axis=(2, 3), keepdims=True)
    assert np.all(np.where(touching, np.abs(solved.gap) < violation, True))
    # The gap follows from the pressure, here with NumPy's FFT.
    down = np.fft.irfft2(_kernel_for_fft() * np.fft.rfft2(solved.pressure, (64, 64)), (64, 64))[..., :40, :40]
    gap = heights[:, None] + down - indentations[None, :, None, None]
    assert np.all(np.where(np.isinf(heights[:, None]), True, np.abs(solved.gap - gap) < 2 * violation))
    force = np.asarray(solved.force)
    assert np.all(force[:, 0] == 0)
    assert np.all(np.diff(force, axis=1) > 0)
    # Contacts stiffen: the mean slope of the force never falls (its energy is convex), up to the tolerance.
    slope = np.diff(force, axis=1) / np.diff(indentations)
    assert np.all(np.diff(slope, axis=1) > -1e-3 * slope[:, 1:])


def test_force_control_inverts_depth_control_and_a_start_changes_only_the_effort(sweeps):
    heights, indentations, solved = sweeps
    for row in range(0, len(heights), 5):
        back = solve_force(PAD, heights[row], solved.force[row, -2])
        assert back.converged
        np.testing.assert_allclose(back.force, solved.force[row, -2], rtol=1e-5)
        # Both stop within the tolerance of the deepest deflection, which is at most a few times the indentation here.
        np.testing.assert_allclose(back.indentation, indentations[-2], rtol=10 * contact.CONTACT_SOLVER.tolerance)
    near = solved.pressure[row, -3]
    for start in (near, jnp.zeros((40, 40))):
        warm = solve(PAD, heights[row], indentations[-2], GRID, start=start)
        np.testing.assert_allclose(warm.force, solved.force[row, -2], rtol=10 * contact.CONTACT_SOLVER.tolerance)
    forced = solve_force(PAD, heights[row], solved.force[row, -2], GRID, start=near)
    np.testing.assert_allclose(forced.indentation, indentations[-2], rtol=10 * contact.CONTACT_SOLVER.tolerance)


def test_problems_of_a_batch_are_independent_and_an_unfinished_solution_is_marked(sweeps):
    heights, indentations, solved = sweeps
    for i in (0, 1):
        alone = solve(PAD, heights[i], indentations[-1])
        assert alone.steps == solved.steps[i, -1]
        np.testing.assert_allclose(alone.pressure, solved.pressure[i, -1], atol=1e-5 * float(alone.pressure.max()))
    stopped = solve(PAD, jnp.asarray(T, jnp.float32), 0.2e-3, GRID, max_steps=3)
    assert not stopped.converged
    assert stopped.residual > contact.CONTACT_SOLVER.tolerance
    assert stopped.steps == 3


# The motion inside is checked by the equations that determine it: equilibrium, a bonded base, the loads on top. Slopes
# are central differences. For waves up to about k = 2 / (2 mm) their error is (k STEP)^2 / 12 < 1e-3 of a term, and
# float32 adds 1e-7 u / STEP^2, again about 1e-3 of it. 1 % is enough for both.
STEP = 0.05e-3  # m
PLACES = np.arange(-2, 3) * STEP + 1.2e-3  # a 5 x 5 stencil off the load's axis
DIFFERENCES = 0.01


@pytest.fixture(scope="module")
def smooth_load():
    """Smooth loads about 2 mm wide, with displacement and rotation on the stencil as functions of depth."""
    pressure = jnp.asarray(2e4 * np.exp(-((X - 0.4e-3) ** 2 + 2 * Y**2) / (2 * 2e-3**2)), jnp.float32)
    drags = [1e4 * np.exp(-(X**2 + (Y - b) ** 2) / (2 * 2e-3**2)) for b in (0.5e-3, -1e-3)]
    traction = jnp.asarray(np.stack([drags[0], -0.6 * drags[1]]), jnp.float32)
    load = elasticity.load(PAD, pressure, traction)
    inside = jax.jit(lambda depth: elasticity.interior(PAD, load, depth, GRID, PLACES))
    return pressure, traction, lambda depth: tuple(np.asarray(field, float) for field in inside(depth))


def _slopes(inside, depth):
    """Compute du_i/dx_j in the middle of the stencil (j = x, y, z)."""
    u, _ = inside(depth)
    above, _ = inside(depth - STEP)
    below, _ = inside(depth + STEP)
    differences = [u[:, 2, 3] - u[:, 2, 1], u[:, 3, 2] - u[:, 1, 2], (above - below)[:, 2, 2]]
    return np.stack(differences, axis=1) / (2 * STEP)


def _second_difference(f: np.ndarray, a: int, b: int) -> np.ndarray:
    """Compute the central d2 f / (d axis a, d axis b) in the middle of (c, 3, 3, 3), times the step squared."""
    if a == b:
        line = np.moveaxis(f, a, 1)[:, :, 1, 1]
        return line[:, 2] - 2 * line[:, 1] + line[:, 0]
    part = np.moveaxis(f, (a, b), (1, 2))[:, :, :, 1]
    return (part[:, 2, 2] - part[:, 2, 0] - part[:, 0, 2] + part[:, 0, 0]) / 4


def test_interior_is_in_equilibrium_and_rotation_is_half_the_curl(smooth_load):
    *_, inside = smooth_load
    for depth in (0.2e-3, 1.0e-3, 1.7e-3):
        stack = np.stack([inside(depth - i * STEP)[0] for i in (-1, 0, 1)], axis=1)[:, :, 1:4, 1:4]  # (3, z, y, x)
        second = np.array([[_second_difference(stack, 3 - a, 3 - b) for b in range(3)] for a in range(3)]) / STEP**2
        laplacian, of_divergence = np.einsum("aac->c", second), np.einsum("acc->a", second)
        residual = (1 - 2 * float(PAD.poisson)) * laplacian + of_divergence
        assert np.all(np.abs(residual) < DIFFERENCES * np.abs(second).max())
        slope = _slopes(inside, depth)
        curl = np.array([slope[2, 1] - slope[1, 2], slope[0, 2] - slope[2, 0], slope[1, 0] - slope[0, 1]])
        assert np.all(np.abs(inside(depth)[1][:, 2, 2] - curl / 2) < DIFFERENCES * np.abs(slope).max())


def test_pressure_and_traction_are_reciprocal():
    """Betti's theorem: the work of the first load on the second one's motion equals that of the second on the first."""
    rng = np.random.default_rng(3)
    pressure, (first, second) = rng.random((40, 40)), rng.normal(size=(2, 2, 40, 40))
    pressure, first, second = (jnp.asarray(load, jnp.float32) for load in (pressure, first, second))
    none = jnp.zeros((40, 40))
    top = [elasticity.interior(PAD, elasticity.load(PAD, none, drag), 0.0)[0] for drag in (first, second)]
    # Traction does work on motion along it, pressure on motion down.
    np.testing.assert_allclose(jnp.sum(first * top[1][:2]), jnp.sum(second * top[0][:2]), rtol=1e-4)
    np.testing.assert_allclose(
        -jnp.sum(pressure * top[0][2]), jnp.sum(first * elasticity.tangential_displacement(PAD, pressure)), rtol=1e-3
    )


@pytest.mark.parametrize("mount_compliance", [2e-5, 2e-4])
def test_a_skin_clamped_at_its_edge_sinks_away_from_the_object(mount_compliance):
    """Its pressure is that of a bonded skin whose surface is lowered by the sinking under this pressure."""
    pad = PAD._replace(mount_compliance=jnp.asarray(mount_compliance))
    height, indentation = (jnp.asarray(value, jnp.float32) for value in SHAPES["tilted stamp"])
    solved, bonded = solve(pad, height, indentation), solve(PAD, height, indentation)
    assert solved.converged
    load = elasticity.clamped_load(solved.pressure)
    np.testing.assert_allclose(load, np.sum(np.asarray(solved.pressure) * SHAPE) * GRID.spacing**2, rtol=1e-5)
    sunk = mount_compliance * load * jnp.asarray(SHAPE, jnp.float32)
    again = solve(PAD, height + sunk, indentation)
    np.testing.assert_allclose(again.pressure, solved.pressure, atol=1e-3 * float(solved.pressure.max()))
    assert solved.force < bonded.force
    assert elasticity.load(PAD, bonded.pressure).centre_sinking == 0  # a bonded skin has no motion as a whole
    # The whole skin moves as a plate: equally through its thickness, about its middle, and with a rim at rest.
    moved, turned = elasticity.interior(pad, elasticity.load(pad, solved.pressure), 1e-3)
    alone, turned_alone = elasticity.interior(PAD, elasticity.load(PAD, solved.pressure), 1e-3)
    np.testing.assert_allclose((moved - alone)[2], -sunk, atol=1e-4 * float(sunk.max()))
    slope = [np.gradient(np.asarray(moved - alone)[2], GRID.spacing, axis=axis) for axis in (0, 1)]
    inner = np.s_[1:-1, 1:-1]  # central differences, whose relative error is (pi / 40)^2
    for tilt, expected in zip((turned - turned_alone)[:2], (slope[0], -slope[1]), strict=True):
        np.testing.assert_allclose(tilt[inner], expected[inner], atol=0.02 * np.abs(expected).max())
    forced = solve_force(pad, height, solved.force)
    np.testing.assert_allclose(forced.indentation, indentation, rtol=20 * contact.CONTACT_SOLVER.tolerance)


def test_the_surface_follows_the_indenter():
    """Under a solved contact the surface moves by minus the indentation at the deepest point (to 1e-7 m)."""
    height = jnp.asarray(round_tip(X, Y, (0.25e-3, 0.25e-3), 8e-3), jnp.float32)
    solved = solve(PAD, height, 0.6e-3)
    displacement, _ = elasticity.interior(PAD, elasticity.load(PAD, solved.pressure), 0.0)
    np.testing.assert_allclose(displacement[2, 20, 20], -0.6e-3, atol=1e-7)
