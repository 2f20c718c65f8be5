"""Motion of a stack of bonded elastic layers on a rigid base under a pressure on its surface.

`i2t.skin.elasticity` has a single layer; here each layer has its own thickness, Young's modulus E and Poisson's ratio
nu. A wave of wavenumber k moves each layer by u_z = W f and (u_x, u_y) = (d/dx, d/dy) U f / k. U and W are sums of four
solutions of Navier's equation, two for each sign s (Papkovich and Neuber), with zeta = k (z - z_s):

    (U, W) = (1, s) exp(s zeta),    (U, W) = (-zeta, kappa - s zeta) exp(s zeta),    kappa = 3 - 4 nu.

z_s is the layer's upper face for the solution that grows upwards (s = 1) and its lower face for the other, so that no
exponential exceeds 1. The base is at rest, displacement and traction are continuous between layers, and the surface
carries only the pressure (Burmister, J. Appl. Phys. 16, 1945): 4 n linear equations in 4 n unknowns for n layers.

NumPy in double precision, on the host. Metres, pascals; depths are below the surface.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Sheet(NamedTuple):
    """One homogeneous elastic layer in a stack: thickness (m), Young's modulus (Pa) and Poisson's ratio."""

    thickness: float  # m
    young: float  # Pa
    poisson: float

    @property
    def shear(self) -> float:
        """Shear modulus (Pa) of the layer."""
        return self.young / (2 * (1 + self.poisson))


class WaveMotion(NamedTuple):
    """Displacement and rotation of a stack of elastic layers under waves of pressure, at d depths.

    The displacement along z is per pressure (m/Pa). The displacement along the skin (m^2/Pa) and the rotation (m/Pa)
    are per slope of the pressure.
    """

    along: Float[np.ndarray, "d ..."]  # displacement along x (y) per slope of the pressure along x (y), m^2/Pa
    down: Float[np.ndarray, "d ..."]  # displacement along z per pressure, m/Pa
    turn: Float[np.ndarray, "d ..."]  # rotation per slope of the pressure, m/Pa


def stack_motion(
    sheets: Sequence[Sheet], wavenumbers: Float[np.ndarray, "..."], depths: Float[np.ndarray, " d"]
) -> WaveMotion:
    """Compute how a stack of bonded elastic layers on a rigid base moves under waves of pressure.

    Args:
        sheets: Layers from the surface down, each bonded to the next, and the last to the base.
        wavenumbers: Wavenumbers (1/m), >= 0.
        depths: d depths below the surface (m), from 0 to the thickness of the stack.

    Returns:
        The motion of each wave at each depth: displacement along z per pressure (m/Pa), and displacement along x (y)
        (m^2/Pa) and rotation (m/Pa) per slope of the pressure. A uniform pressure (wavenumber 0) has no slope, so its
        `along` and `turn` are 0.
    """
    k, place = np.unique(wavenumbers, return_inverse=True)
    faces = np.cumsum([0.0, *(-sheet.thickness for sheet in sheets)])  # z of each face
    unit, safe = sheets[0].shear, np.where(k == 0, -1 / faces[-1], k)
    weights = _weights(sheets, faces, safe, unit) / (2 * unit * safe)[:, None]
    layer = np.clip(np.searchsorted(-faces, depths, side="right") - 1, 0, len(sheets) - 1)
    along, down, turn = np.zeros((3, len(depths), len(k)))
    for i, (depth, j) in enumerate(zip(depths, layer, strict=True)):
        waves = _waves(sheets[j], faces[j], faces[j + 1], safe, -depth)
        own = weights[:, 4 * j : 4 * j + 4].T
        along[i], down[i], turn[i] = (np.sum(part * own, axis=0) for part in (waves.U / safe, waves.W, waves.turn))
        below = np.clip(faces[:-1], None, -depth) - np.clip(faces[1:], None, -depth)  # m of each layer
        down[i, k == 0] = -np.sum(below * [_uniaxial(sheet) for sheet in sheets])
    along[:, k == 0] = turn[:, k == 0] = 0.0
    shape = (len(depths), *np.shape(wavenumbers))
    return WaveMotion(*(part[:, place.reshape(-1)].reshape(shape) for part in (along, down, turn)))


def _uniaxial(sheet: Sheet) -> float:
    """Compute the strain per pressure (1/Pa) of a layer that cannot spread."""
    return (1 + sheet.poisson) * (1 - 2 * sheet.poisson) / (sheet.young * (1 - sheet.poisson))


class _Waves(NamedTuple):
    """The four solutions of one layer at some height, for each wavenumber: `(4, k)`."""

    U: np.ndarray
    W: np.ndarray
    normal: np.ndarray  # stress along z, in units of 2 mu k
    shear: np.ndarray  # shear stress in the same units, per slope over k
    turn: np.ndarray


def _waves(sheet: Sheet, top: float, bottom: float, k: np.ndarray, z: float) -> _Waves:
    nu, ones, zeros = sheet.poisson, np.ones_like(k), np.zeros_like(k)
    parts = []
    for s, face in ((1, top), (-1, bottom)):
        zeta = k * (z - face)
        fall = np.exp(s * zeta)
        gradient = (ones, s * ones, ones, s * ones, zeros)
        other = (-zeta, 3 - 4 * nu - s * zeta, 2 * (1 - nu) * s - zeta, 1 - 2 * nu - s * zeta, 2 * (1 - nu) * ones)
        parts += [[value * fall for value in solution] for solution in (gradient, other)]
    return _Waves(*(np.stack(part) for part in zip(*parts, strict=True)))


def _weights(sheets: Sequence[Sheet], faces: np.ndarray, k: np.ndarray, unit: float) -> np.ndarray:
    """Compute the weights (k, 4 n) of the four solutions of each layer under a pressure of 2 `unit` k."""
    equations = np.zeros((len(k), 4 * len(sheets), 4 * len(sheets)))
    for j, sheet in enumerate(sheets):
        for face, sign in ((j, -1.0), (j + 1, 1.0)):  # the rows of a face are the layer above it minus that below
            waves = _waves(sheet, faces[j], faces[j + 1], k, faces[face])
            stiff = sheet.shear / unit
            rows = np.stack([waves.U, waves.W, stiff * waves.normal, stiff * waves.shear])  # (4, 4, k)
            if face == 0:
                rows, sign = rows[2:], 1.0
            elif face == len(sheets):
                rows = rows[:2]
            first = 4 * face - 2 if face else 0
            equations[:, first : first + len(rows), 4 * j : 4 * j + 4] += sign * np.moveaxis(rows, -1, 0)
    pressure = np.zeros((len(k), 4 * len(sheets), 1))
    pressure[:, 0] = -1.0
    return np.linalg.solve(equations, pressure)[..., 0]
