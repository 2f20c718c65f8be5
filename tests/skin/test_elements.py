"""The motion inside the layer against finite elements, which share no formula with the waves.

Taylor and Hood's elements (quadratic displacement, linear pressure, continuous), which do not lock at nu near 0.5, on
grids of rectangles. Boundary conditions: the base is bonded (u = 0), the top carries the load, and the walls are far
away and impermeable (u across them is 0).
"""

import jax
import jax.numpy as jnp
import numpy as np
import skfem
from scipy.sparse import bmat
from scipy.sparse.linalg import splu
from skfem.helpers import ddot, div, sym_grad

from i2t.skin import elasticity
from i2t.skin.elasticity import FINE_GRID, Grid
from i2t.skin.layered import Sheet, stack_motion
from i2t.skin.pad import nominal_pad

PAD = nominal_pad()
THICKNESS, YOUNG, NU = (float(value) for value in (PAD.thickness, PAD.young, PAD.poisson))
SHEAR = YOUNG / (2 * (1 + NU))
LAME = 2 * SHEAR * NU / (1 - 2 * NU)
WIDE = 16e-3  # m from the load to the walls: eight thicknesses
RADIUS = 2e-3  # m of the loads
DEPTHS = np.array([0, 0.5, 1.0, 1.5]) * 1e-3
MAX_ERROR = 0.02  # of the largest displacement


def cap(distance):
    """Compute a pressure (Pa) like that of a tip."""
    return 4e4 * np.maximum(1 - (distance / RADIUS) ** 2, 0)


def displacement(axes, load, around_axis=False, stiffness=lambda z: 1.0):
    """Compute the displacement (components, nodes of each axis, z first) under `load(places) -> components` (Pa) on the
    top, at the corners, edges and middles of the elements with the edges `axes` (m, x and then z from -THICKNESS to 0).
    The end walls are impermeable. With `around_axis`, x is the distance from an axis of symmetry; `stiffness` is the
    factor on Young's modulus at a height.
    """
    mesh = skfem.MeshQuad.init_tensor(*axes)
    square = skfem.ElementVector(skfem.ElementQuad2())
    basis = skfem.Basis(mesh, square, intorder=4)
    scalar = basis.with_element(skfem.ElementQuad1())
    top = skfem.FacetBasis(mesh, square, facets=mesh.facets_satisfying(lambda x: x[-1] > -1e-9))

    def measure(w):
        return w.x[0] if around_axis else 1.0

    @skfem.BilinearForm
    def shearing(u, v, w):
        hoop = u[0] * v[0] / w.x[0] ** 2 if around_axis else 0.0
        return 2 * SHEAR * stiffness(w.x[1]) * (ddot(sym_grad(u), sym_grad(v)) + hoop) * measure(w)

    @skfem.BilinearForm
    def swelling(u, q, w):
        return (div(u) + (u[0] / w.x[0] if around_axis else 0.0)) * q * measure(w)

    @skfem.BilinearForm
    def squeezing(p, q, w):
        return p * q / (LAME * stiffness(w.x[1])) * measure(w)

    @skfem.LinearForm
    def loading(v, w):
        return sum(part * v[i] for i, part in enumerate(load(w.x))) * measure(w)

    coupling = swelling.assemble(basis, scalar)
    matrix = bmat([[shearing.assemble(basis), -coupling.T], [-coupling, -squeezing.assemble(scalar)]]).tocsc()
    entities = [basis.nodal_dofs, basis.facet_dofs, basis.interior_dofs]
    parts = [np.concatenate([np.asarray(dofs)[i] for dofs in entities]) for i in range(2)]  # in the same order of nodes
    places = basis.doflocs[:, parts[0]]
    held = [dofs[np.isclose(places[1], -THICKNESS)] for dofs in parts]
    held += [parts[0][np.isclose(places[0], axes[0][end])] for end in (0, -1)]
    right, solution = np.zeros((2, matrix.shape[0]))
    right[: basis.N] = loading.assemble(top)
    free = np.setdiff1d(np.arange(len(right)), np.concatenate(held))
    solution[free] = splu(matrix[free][:, free]).solve(right[free])
    order = np.lexsort(np.round(places, 9))
    return np.stack([solution[dofs[order]].reshape([2 * len(axis) - 1 for axis in reversed(axes)]) for dofs in parts])


def interpolate(axis, places):
    """Compute weights (places, nodes) of quadratic interpolation within elements, and of its slope."""
    element = np.clip(np.searchsorted(axis, places) - 1, 0, len(axis) - 2)
    width = axis[element + 1] - axis[element]
    t = (places - axis[element]) / width
    values, slopes = np.zeros((2, len(places), 2 * len(axis) - 1))
    rows = np.arange(len(places))
    shapes = [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)]
    rises = [4 * t - 3, 4 - 8 * t, 4 * t - 1]
    for i in range(3):
        values[rows, 2 * element + i] = shapes[i]
        slopes[rows, 2 * element + i] = rises[i] / width
    return values, slopes


def graded(edge, far, fine, coarse):
    """Make element edges from 0 to `far` (m): `fine` up to `edge`, then `coarse`."""
    return np.concatenate([np.arange(0, edge, fine), np.linspace(edge, far, round((far - edge) / coarse) + 1)])


DEEP = np.linspace(-THICKNESS, 0, 9)


def test_a_round_press_agrees_with_finite_elements():
    radial = graded(4e-3, WIDE, 0.25e-3, 1e-3)
    fem = displacement((radial, DEEP), lambda x: (0, -cap(x[0])), around_axis=True)
    places = np.arange(0.125e-3, 6e-3, 0.25e-3)  # cell centres of FINE
    exact = np.einsum("cij,di,rj->dcr", fem, interpolate(DEEP, -DEPTHS)[0], interpolate(radial, places)[0])
    # No cell centre lies on the axis, so the load's middle is moved to a centre.
    middle = FINE_GRID.centres[40]
    y, x = np.meshgrid(FINE_GRID.centres, FINE_GRID.centres, indexing="ij")
    pressure = jnp.asarray(cap(np.hypot(x - middle, y - middle)), jnp.float32)
    load = elasticity.load(PAD, pressure, None, FINE_GRID)
    inside = jax.jit(
        lambda depth: elasticity.interior(PAD, load, depth, FINE_GRID, np.append(middle, middle + places))[0]
    )
    for depth, expected in zip(DEPTHS, exact, strict=True):
        ours = np.asarray(inside(depth))[:, 0, 1:]  # along x from the axis
        assert np.abs(ours[[0, 2]] - expected).max() < MAX_ERROR * np.abs(exact).max()


def test_a_round_press_of_two_layers_agrees_with_finite_elements():
    """A soft layer on a stiff one and the reverse are tested at the surface and inside."""
    radial, deep = graded(4e-3, WIDE, 0.25e-3, 1e-3), np.linspace(-THICKNESS, 0, 33)  # stress jumps between layers
    places = np.arange(0.125e-3, 6e-3, 0.25e-3)
    middle = FINE_GRID.centres[40]
    y, x = np.meshgrid(FINE_GRID.centres, FINE_GRID.centres, indexing="ij")
    pressure = jnp.asarray(cap(np.hypot(x - middle, y - middle)), jnp.float32)
    load = elasticity.load(PAD, pressure, None, FINE_GRID)
    k = np.hypot(FINE_GRID.wavenumbers[:, None], FINE_GRID.wavenumbers[None, :])
    for upper, lower in ((0.5, 2.0), (2.0, 0.5)):
        fem = displacement(
            (radial, deep), lambda x: (0, -cap(x[0])), around_axis=True,
            stiffness=lambda z, a=upper, b=lower: np.where(z > -THICKNESS / 2, a, b),
        )  # fmt: skip
        exact = np.einsum("cij,di,rj->dcr", fem, interpolate(deep, -DEPTHS)[0], interpolate(radial, places)[0])
        sheets = [Sheet(THICKNESS / 2, factor * YOUNG, NU) for factor in (upper, lower)]
        waves = stack_motion(sheets, k, DEPTHS)
        for i, expected in enumerate(exact):
            moved = jnp.stack([waves.along[i] * load.slopes[0], waves.down[i] * load.pressure])
            ours = np.asarray(elasticity.evaluate(moved, FINE_GRID, np.append(middle, middle + places)))[:, 0, 1:]
            assert np.abs(ours - expected).max() < MAX_ERROR * np.abs(exact).max()


def test_a_dragged_strip_agrees_with_finite_elements():
    """Plane strain under a pressure, and a traction across the strip that is off its middle: displacement and rotation,
    in a series whose period is loaded along its whole length.
    """
    half = graded(5e-3, WIDE, 0.25e-3, 1e-3)
    across = np.concatenate([-half[:0:-1], half])
    fem = displacement((across, DEEP), lambda x: (0.7 * cap(x[0] - 0.9e-3), -cap(x[0])))
    grid = Grid(128, 128, 2 * WIDE)
    x = np.broadcast_to(grid.centres, (128, 128))
    pressure, along = (jnp.asarray(cap(x - shift), jnp.float32) for shift in (0, 0.9e-3))
    traction = 0.7 * jnp.stack([along, jnp.zeros_like(along)])
    load = elasticity.load(PAD._replace(mount_compliance=jnp.zeros(())), pressure, traction, grid)
    places = np.linspace(-6e-3, 6e-3, 50)
    inside = jax.jit(lambda depth: elasticity.interior(PAD, load, depth, grid, places))
    values, slopes = interpolate(across, places)
    for depth in (0.125e-3, 0.625e-3, 1.125e-3, 1.625e-3):
        high, steep = interpolate(DEEP, np.array([-depth]))
        moved = np.einsum("cij,di,rj->cr", fem, high, values)
        turned = (fem[0].T @ steep[0] @ values.T - slopes @ (high[0] @ fem[1])) / 2
        displaced, rotated = (np.asarray(part)[:, len(places) // 2] for part in inside(depth))
        assert np.abs(displaced[[0, 2]] - moved).max() < MAX_ERROR * np.abs(fem).max()
        assert np.abs(rotated[1] - turned).max() < MAX_ERROR * np.abs(turned).max()
        assert np.abs(displaced[1]).max() < 1e-3 * np.abs(fem).max()
