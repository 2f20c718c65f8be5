"""A library of patches: local surfaces of many shapes, rendered once, and the press of a nominal pad into each.

Sites are drawn on every shape, either safe sites (`i2t.simulation.sites`) or any sites. The approach is tilted against
the surface's normal by an angle between two bounds, about a random axis, because the orientation of an unknown surface
is not known either. The heights of the shape at first contact of the flat face are rendered, and a layer of nominal
stiffness is pressed onto them with each of a few loads. None of this depends on a pad, so one library serves all pads;
`i2t.reconstruction.press_models` predicts what a pad reads at its patches.

Units are metres, newtons and radians; frames as in `i2t.types`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from i2t.contact.approach import first_contact
from i2t.contact.pressure import centre_of_pressure, newtons_on_cells, press_heights
from i2t.geometry import contact_frame, inverse, so3_exp
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH
from i2t.patches.views import centre
from i2t.reconstruction.local_shape import PatchLibrary
from i2t.rendering.render import render_heights, stack_surfaces
from i2t.runtime.batching import filled_batches, map_batches, map_on_devices
from i2t.runtime.compiling import jit_quickly
from i2t.simulation import sites as touch_sites
from i2t.simulation.site_limits import SiteLimits
from i2t.skin.contact import CELL_GRID, GRID
from i2t.skin.pad import nominal_pad
from i2t.types import Pad, Surface


@dataclass(frozen=True)
class LibraryConfig:
    """Loads and tilts of the presses in a library of patches, and the batches in which it is computed."""

    # N, loads of the presses, from below that of a 25 uT press to the force at which a press ends
    loads: tuple[float, ...] = (0.25, 0.8, 2.5, 8.0)
    tilt: tuple[float, float] = (
        math.radians(1.0),
        math.radians(6.0),
    )  # rad, smallest and largest angle of a press against the normal
    batch_size: int = 64  # number of patches pressed at a time
    # Shapes with at most this many faces form a size class, because larger shapes would slow them down.
    small_faces: int = 512
    candidates_per_site: int = 4  # number of candidates for each safe site
    sites_per_batch: int = 16  # number of sites of one shape at a time, so that any number of sites compiles once


_LIBRARY = LibraryConfig()  # default loads and tilts of the presses in a library of patches, and batch sizes


class FirstContacts(NamedTuple):
    """n first contacts of the tool with shapes: tool poses, depths (m) of the surface beyond the plane of contact over
    the patch and over fine and coarse cells of the pad, and whether the tool met the shape at a safe site.
    """

    T_o_t: Float[Array, "n 4 4"]  # (4, 4) tool pose at first contact
    patch: Float[Array, "n p p"]  # m, depth beyond the plane of contact, clipped to the reach
    height: Float[Array, "n g g"]  # m, height over the cells of `i2t.skin.contact.GRID`, not clipped
    coarse: Float[Array, "n h h"]  # m, height over cells of 1 mm
    met: Bool[Array, " n"]  # False where the tool met nothing, or where too few sites are safe


def build_library(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    count: int,
    *,
    tilt: tuple[float, float] = _LIBRARY.tilt,
    limits: SiteLimits | None = touch_sites.COLLECTION_LIMITS,
) -> PatchLibrary:
    """Render patches of many shapes and press a nominal layer onto them.

    Args:
        key: Random key.
        surfaces: Surfaces of the shapes, each in its own frame.
        count: Maximum number of patches. Each shape gives the same number, unless it has too few safe sites.
        tilt: Smallest and largest angle (rad) of the approach against the normal.
        limits: Limits of safe sites; None takes any point of the surface.

    Returns:
        Library of the patches and their presses, on the host.

    Raises:
        ValueError: No shape is given, or no shape can be touched.
    """
    return library_from_contacts(*sample_contacts(key, surfaces, count, tilt=tilt, limits=limits))


def sample_contacts(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    count: int,
    *,
    tilt: tuple[float, float] = _LIBRARY.tilt,
    limits: SiteLimits | None = touch_sites.COLLECTION_LIMITS,
) -> tuple[FirstContacts, np.ndarray]:
    """Simulate first contacts with many shapes at random sites.

    Args:
        key: Random key.
        surfaces: Surfaces of the shapes, each in its own frame.
        count: Maximum number of contacts.
        tilt: Smallest and largest angle (rad) of the approach against the normal.
        limits: Limits of safe sites; None takes any point of the surface.

    Returns:
        Contacts that met a surface, on the host, and the index of the shape of each.

    Raises:
        ValueError: No shape is given, or no shape can be touched.
    """
    if not len(surfaces) or count < 1:
        raise ValueError("a library needs at least one shape and one patch; give meshes, and a count above 0")
    per_shape = -(-count // len(surfaces))
    parts, objects = [], []
    for i, surface in enumerate(pad_to_size_classes(surfaces)):
        key_shape = jax.random.fold_in(key, i)
        rounds = [
            jax.device_get(_meet(jax.random.fold_in(key_shape, start), surface, tilt, limits))
            for start in range(0, per_shape, _LIBRARY.sites_per_batch)
        ]
        drawn = jax.tree.map(lambda *fields: np.concatenate(fields)[:per_shape], *rounds)
        parts.append(jax.tree.map(lambda field, met=drawn.met: field[met], drawn))
        objects.append(np.full(len(parts[-1].met), i, np.int32))
    contacts = jax.tree.map(lambda *fields: np.concatenate(fields), *parts)
    if not len(contacts.met):
        raise ValueError("no shape could be touched; relax the limits of sites, or check the unit of the meshes")
    # Surplus contacts are dropped at random.
    kept = np.sort(np.random.default_rng(0).permutation(len(contacts.met))[:count])
    return jax.tree.map(lambda field: field[kept], contacts), np.concatenate(objects)[kept]


def library_from_contacts(contacts: FirstContacts, objects: np.ndarray) -> PatchLibrary:
    """Press a nominal layer onto each of the given contacts.

    Args:
        contacts: Contacts from `sample_contacts`.
        objects: (n,) index of the shape of each contact.

    Returns:
        Library of the patches and their presses, on the host.
    """
    pressure, indentation = press_batches(nominal_pad(), np.asarray(contacts.coarse), _LIBRARY.loads)
    return PatchLibrary(
        patch=np.asarray(contacts.patch, np.float16),
        height=np.asarray(contacts.coarse, np.float32),
        object=np.asarray(objects, np.int32),
        loads=np.asarray(_LIBRARY.loads, np.float32),
        newtons=newtons_on_cells(pressure, CELL_GRID).reshape(*indentation.shape, -1).astype(np.float16),
        indentation=np.asarray(indentation, np.float32),
        centre=np.asarray(centre_of_pressure(pressure, CELL_GRID), np.float32),
    )


def press_batches(
    pad: Pad, heights: Float[np.ndarray, "n g g"], loads: Sequence[float] | Float[np.ndarray, " l"]
) -> tuple[Float[np.ndarray, "n l g g"], Float[np.ndarray, "n l"]]:
    """Press a pad onto n surfaces with each of l loads, in batches of one size, so that it compiles once.

    Args:
        pad: The skin.
        heights: `(n, g, g)` heights (m) of the surfaces over g x g cells of 1 mm, beyond the plane of first contact.
        loads: `(l,)` normal forces (N).

    Returns:
        `(n, l, g, g)` pressures (Pa) and `(n, l)` indentations (m) past first contact, on the host.
    """
    heights, shared = np.asarray(heights, np.float32), (pad, np.asarray(loads, np.float32))
    return in_batches(_chains, heights, shared=shared)


def in_batches(
    function: Callable[..., PyTree], *rows: Float[np.ndarray, "n ..."], shared: tuple[PyTree, ...]
) -> PyTree:
    """Apply a compiled function to patches, 64 of them at a time.

    Args:
        function: Function of some rows and of arguments that all rows share; axis 0 of its results counts the rows.
        rows: First arguments of the function.
        shared: Arguments that follow.

    Returns:
        Results of the function for all rows, on the host.
    """
    batches = filled_batches(np.arange(len(rows[0])), _LIBRARY.batch_size)
    parts = map_on_devices(function, (tuple(values[batch] for values in rows) for batch in batches), shared=shared)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(rows[0])], *parts)


def pad_to_size_classes(surfaces: Sequence[Surface]) -> list[Surface]:
    """Pad surfaces to two size classes, so that only two programs are compiled.

    Args:
        surfaces: Prepared surfaces of any sizes.

    Returns:
        The same surfaces in order: those with few faces padded to 512, the others to one common size.
    """
    small = [len(surface.triangles) <= _LIBRARY.small_faces for surface in surfaces]
    sized: list[Surface] = list(surfaces)
    for wanted in (True, False):
        group = [i for i, is_small in enumerate(small) if is_small == wanted]
        if group:
            stacked = stack_surfaces([surfaces[i] for i in group], faces=_LIBRARY.small_faces)
            for row, i in enumerate(group):
                sized[i] = jax.tree.map(lambda field, row=row: field[row], stacked)
    return sized


@jit_quickly
def _meet(key: Array, surface: Surface, tilt: tuple[Array, Array], limits: SiteLimits | None) -> FirstContacts:
    """Meet one surface at a batch of sites, with tilted approaches."""
    count = _LIBRARY.sites_per_batch
    key_sites, key_tilt, key_about = jax.random.split(key, 3)
    if limits is None:
        key_points, key_spin = jax.random.split(key_sites)
        points, normals = touch_sites.sample_points(key_points, surface, count)
        spins = jax.random.uniform(key_spin, (count,), maxval=2 * jnp.pi)
        frames, safe = jax.vmap(contact_frame)(points, normals, spins), jnp.ones(count, bool)
    else:
        frames, safe = touch_sites.sample_sites(key_sites, surface, count, limits, _LIBRARY.candidates_per_site)
    angle = jax.random.uniform(key_tilt, (count,), minval=tilt[0], maxval=tilt[1])
    about = jax.random.uniform(key_about, (count,), maxval=2 * jnp.pi)

    def meet(T_o_site: Array, angle: Array, about: Array) -> FirstContacts:
        axis = jnp.stack([jnp.cos(about), jnp.sin(about), jnp.zeros(())])
        turn = jnp.eye(4).at[:3, :3].set(so3_exp(angle * axis))
        T_o_t, _, hit = first_contact(surface, T_o_site @ turn)
        patch, height, coarse = _heights(surface, inverse(T_o_t))
        return FirstContacts(T_o_t, jnp.clip(patch, 0, REACH), height, coarse, hit & jnp.isfinite(jnp.min(coarse)))

    contacts = map_batches(lambda site: meet(*site), (frames, angle, about), batch_size=count)
    return contacts._replace(met=contacts.met & safe)


def _heights(surface: Surface, T_t_o: Array) -> tuple[Array, Array, Array]:
    """Render heights (m) over the pixels of a patch and the cells of both grids. One compiled renderer draws all three,
    with lengths along x and y scaled to the patch's pixels.
    """
    pitch = PATCH_WINDOW / PATCH_PIXELS
    scales = [1.0, pitch / GRID.spacing, pitch / CELL_GRID.spacing]
    stretch = np.asarray([[scale, scale, 1.0, 1.0] for scale in scales], np.float32)
    maps = stretch[:, :, None] * T_t_o[None]
    patch, fine, coarse = jax.vmap(lambda A: render_heights(surface, A, PATCH_WINDOW, PATCH_PIXELS))(maps)
    return patch, centre(fine, GRID.cells), centre(coarse, CELL_GRID.cells)


@jit_quickly
def _chains(heights: Array, pad: Pad, loads: Array) -> tuple[Array, Array]:
    nearest = jnp.min(heights, axis=(1, 2))
    press = jax.vmap(jax.vmap(partial(press_heights, pad), (None, 0)), (0, None))
    pressure, indentation = press(heights - nearest[:, None, None], loads)
    return pressure, nearest[:, None] + indentation
