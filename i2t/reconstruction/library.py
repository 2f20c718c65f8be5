"""A library of patches: surfaces met on many shapes, rendered once, and the press of a nominal pad into each.

Sites are drawn on every shape, safe ones (`i2t.simulation.sites`) or any, and the approach is tilted against the
surface's normal by an angle between two bounds, about a random axis: how an unknown surface lies is not known either.
There the flat face meets the shape, its heights are rendered, and a layer of nominal stiffness is pressed onto them
with each of a few loads. None of this depends on a pad, so that one library serves all of them; what a pad reads at it
is imagined by `i2t.reconstruction.press_models`.

Metres, newtons, radians; frames as in `i2t.types`.
"""

import math
from collections.abc import Callable, Sequence
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
from i2t.runtime.batching import filled_batches, map_batches, spread
from i2t.runtime.compiling import jit_quickly
from i2t.simulation import sites as touch_sites
from i2t.simulation.site_limits import SiteLimits
from i2t.skin.contact import CELL_GRID, GRID
from i2t.skin.pad import nominal_pad
from i2t.types import Pad, Surface

LIBRARY_LOADS_N = (0.25, 0.8, 2.5, 8.0)  # from below what a 25 uT press takes to the force at which a press ends
TILT_RANGE_RAD = (math.radians(1.0), math.radians(6.0))
BATCH = 64
FEW_FACES = 512  # the size class of shapes of no more faces; larger ones, which would slow them down, have another
SITE_CANDIDATES = 4  # for each safe site
SITES = 16  # of a shape at a time, so that any number of them compiles once


class Contacts(NamedTuple):
    """First contacts with one shape, and the patches met."""

    T_o_t: Float[Array, "n 4 4"]  # tool pose at first contact
    patch: Float[Array, "n p p"]  # m beyond the plane of contact, clipped to the reach
    height: Float[Array, "n g g"]  # m, over the cells of `i2t.skin.contact.GRID`, uncut
    coarse: Float[Array, "n h h"]  # m, over cells of 1 mm
    met: Bool[Array, " n"]  # false where the way met nothing, or too few sites are safe


def build_library(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    count: int,
    *,
    tilt: tuple[float, float] = TILT_RANGE_RAD,
    limits: SiteLimits | None = touch_sites.COLLECTION_LIMITS,
) -> PatchLibrary:
    """Render patches of many shapes and press a nominal layer onto them.

    Args:
        key: Random key.
        surfaces: Of the shapes, each standing in its own frame.
        count: Patches of the library at most; as many of each shape, but where a shape has too few safe sites.
        tilt: rad, between these the approach is tilted against the normal.
        limits: Of safe sites; None takes any point of the surface.

    Returns:
        The library, on the host.

    Raises:
        ValueError: There is no shape, or none could be touched.
    """
    return library_of(*sample_contacts(key, surfaces, count, tilt=tilt, limits=limits))


def sample_contacts(
    key: Key[Array, ""],
    surfaces: Sequence[Surface],
    count: int,
    *,
    tilt: tuple[float, float] = TILT_RANGE_RAD,
    limits: SiteLimits | None = touch_sites.COLLECTION_LIMITS,
) -> tuple[Contacts, np.ndarray]:
    """Meet many shapes at random sites.

    Args:
        key: Random key.
        surfaces: Of the shapes.
        count: Contacts at most.
        tilt: rad, between these the approach is tilted against the normal.
        limits: Of safe sites; None takes any point of the surface.

    Returns:
        Contacts that met something, on the host, and the index of each one's shape.

    Raises:
        ValueError: There is no shape, or none could be touched.
    """
    if not len(surfaces) or count < 1:
        raise ValueError("a library needs at least one shape and one patch; give meshes, and a count above 0")
    each = -(-count // len(surfaces))
    parts, objects = [], []
    for i, surface in enumerate(to_few_sizes(surfaces)):
        key_shape = jax.random.fold_in(key, i)
        rounds = [
            jax.device_get(_meet(jax.random.fold_in(key_shape, start), surface, tilt, limits))
            for start in range(0, each, SITES)
        ]
        drawn = jax.tree.map(lambda *fields: np.concatenate(fields)[:each], *rounds)
        parts.append(jax.tree.map(lambda field, met=drawn.met: field[met], drawn))
        objects.append(np.full(len(parts[-1].met), i, np.int32))
    contacts = jax.tree.map(lambda *fields: np.concatenate(fields), *parts)
    if not len(contacts.met):
        raise ValueError("no shape could be touched; relax the limits of sites, or check the unit of the meshes")
    # What is too many is left out at random.
    kept = np.sort(np.random.default_rng(0).permutation(len(contacts.met))[:count])
    return jax.tree.map(lambda field: field[kept], contacts), np.concatenate(objects)[kept]


def library_of(contacts: Contacts, objects: np.ndarray) -> PatchLibrary:
    """The library of contacts that were met: a nominal layer is pressed onto each.

    Args:
        contacts: As of `sample_contacts`.
        objects: (n,) index of each one's shape.

    Returns:
        The library, on the host.
    """
    pressure, indentation = press_batches(nominal_pad(), np.asarray(contacts.coarse), LIBRARY_LOADS_N)
    return PatchLibrary(
        patch=np.asarray(contacts.patch, np.float16),
        height=np.asarray(contacts.coarse, np.float32),
        object=np.asarray(objects, np.int32),
        loads=np.asarray(LIBRARY_LOADS_N, np.float32),
        newtons=newtons_on_cells(pressure, CELL_GRID).reshape(*indentation.shape, -1).astype(np.float16),
        indentation=np.asarray(indentation, np.float32),
        centre=np.asarray(centre_of_pressure(pressure, CELL_GRID), np.float32),
    )


def press_batches(
    pad: Pad, heights: Float[np.ndarray, "n g g"], loads: Sequence[float] | Float[np.ndarray, " l"]
) -> tuple[Float[np.ndarray, "n l g g"], Float[np.ndarray, "n l"]]:
    """Press a pad onto many surfaces with each of some loads, in batches of one size: one compilation serves all.

    Args:
        pad: The skin.
        heights: m, of the surfaces over cells of 1 mm, beyond the plane of first contact.
        loads: N.

    Returns:
        Pressures (Pa), and indentations (m) past first contact, on the host.
    """
    heights, shared = np.asarray(heights, np.float32), (pad, np.asarray(loads, np.float32))
    return in_batches(_chains, heights, shared=shared)


def in_batches(
    function: Callable[..., PyTree], *rows: Float[np.ndarray, "n ..."], shared: tuple[PyTree, ...]
) -> PyTree:
    """A compiled function of patches, `BATCH` of them at a time.

    Args:
        function: Of some rows and what is shared by all; axis 0 of its results counts the rows.
        rows: Its first arguments.
        shared: Those that follow.

    Returns:
        Its results for all rows, on the host.
    """
    batches = filled_batches(np.arange(len(rows[0])), BATCH)
    parts = spread(function, (tuple(each[some] for each in rows) for some in batches), shared=shared)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(rows[0])], *parts)


def to_few_sizes(surfaces: Sequence[Surface]) -> list[Surface]:
    """Bring surfaces to two size classes, and so to two compilations.

    Args:
        surfaces: Prepared surfaces of any sizes.

    Returns:
        The same, those of few faces padded to `FEW_FACES` and those of many alike in size.
    """
    small = [len(surface.triangles) <= FEW_FACES for surface in surfaces]
    sized: list[Surface] = list(surfaces)
    for wanted in (True, False):
        group = [i for i, is_small in enumerate(small) if is_small == wanted]
        if group:
            stacked = stack_surfaces([surfaces[i] for i in group], faces=FEW_FACES)
            for row, i in enumerate(group):
                sized[i] = jax.tree.map(lambda field, row=row: field[row], stacked)
    return sized


@jit_quickly
def _meet(key: Array, surface: Surface, tilt: tuple[Array, Array], limits: SiteLimits | None) -> Contacts:
    """A few sites of one surface, approached at a tilt."""
    count = SITES
    key_sites, key_tilt, key_about = jax.random.split(key, 3)
    if limits is None:
        key_points, key_spin = jax.random.split(key_sites)
        points, normals = touch_sites.sample_points(key_points, surface, count)
        spins = jax.random.uniform(key_spin, (count,), maxval=2 * jnp.pi)
        frames, safe = jax.vmap(contact_frame)(points, normals, spins), jnp.ones(count, bool)
    else:
        frames, safe = touch_sites.sample_sites(key_sites, surface, count, limits, SITE_CANDIDATES)
    angle = jax.random.uniform(key_tilt, (count,), minval=tilt[0], maxval=tilt[1])
    about = jax.random.uniform(key_about, (count,), maxval=2 * jnp.pi)

    def meet(T_o_site: Array, angle: Array, about: Array) -> Contacts:
        axis = jnp.stack([jnp.cos(about), jnp.sin(about), jnp.zeros(())])
        turn = jnp.eye(4).at[:3, :3].set(so3_exp(angle * axis))
        T_o_t, _, hit = first_contact(surface, T_o_site @ turn)
        patch, height, coarse = _heights(surface, inverse(T_o_t))
        return Contacts(T_o_t, jnp.clip(patch, 0, REACH), height, coarse, hit & jnp.isfinite(jnp.min(coarse)))

    contacts = map_batches(lambda each: meet(*each), (frames, angle, about), batch_size=count)
    return contacts._replace(met=contacts.met & safe)


def _heights(surface: Surface, T_t_o: Array) -> tuple[Array, Array, Array]:
    """Heights (m) over the pixels of a patch and the cells of both grids: one compiled renderer draws all three, with
    lengths along x and y scaled to the patch's pixels.
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
