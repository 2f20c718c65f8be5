"""Sites and views of a collection: an endless list of safe sites, and patches extracted from views.

The sites of an object are random, as in the paper (`i2t.simulation.sites`), and numbered. The same seed gives the same
list, however many of them are used, so that a collection can be resumed.
"""

from collections.abc import Collection
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Key

from i2t.collect.touch import SeenPatch, Site
from i2t.depth.camera import Camera
from i2t.depth.patches import view_from_depth
from i2t.geometry import full_precision, nearest_rigid
from i2t.hardware.protocols import View
from i2t.objects.solids import Object, highest_point, transform_mesh
from i2t.patches.dimensions import PATCH_PIXELS
from i2t.patches.views import PatchView, centre
from i2t.rendering.render import prepare_surface
from i2t.simulation.sites import SiteLimits, collect_sites
from i2t.types import Array


class SiteSampler:
    """Sequence of random safe sites of an object (by slope, free surroundings and height above the table; whether the
    arm reaches them is not checked), numbered in the order of touching.

    Args:
        target: The object to touch.
        T_w_o: `(4, 4)` pose of the object in the world frame W.
        limits: Conditions of a safe site.
        seed: Seed of the random sites.
        name: Name of the object, for messages.
        batch: Number of sites that are drawn at once. Another number gives other sites for the same seed.
    """

    def __init__(
        self, target: Object, T_w_o: Float[Array, "4 4"], limits: SiteLimits, seed: int, name: str, *, batch: int = 32
    ) -> None:
        self.mesh = target.mesh
        self.placed = transform_mesh(target.mesh, np.asarray(T_w_o))
        self.top = highest_point(target, T_w_o)  # m, in W
        self._surface = prepare_surface(self.placed)
        rest = target.obstacles
        self._obstacles = None if rest is None else prepare_surface(transform_mesh(rest, np.asarray(T_w_o)))
        self.limits, self._seed, self._name, self._batch = limits, seed, name, batch
        self._sites: list[Site] = []

    def site(self, number: int) -> Site:
        """Return the safe site with a number; the same number always gives the same site.

        Args:
            number: Number of the site, from 0.

        Returns:
            The site with its pose (m) in W.

        Raises:
            ValueError: If the object has too few safe sites.
        """
        while number >= len(self._sites):
            key = jax.random.fold_in(jax.random.key(self._seed), len(self._sites) // self._batch)
            poses = np.asarray(self._draw(key), float)
            self._sites += [Site(len(self._sites) + i, nearest_rigid(pose)) for i, pose in enumerate(poses)]
        return self._sites[number]

    def _draw(self, key: Key[Array, ""]) -> Float[Array, "n 4 4"]:
        return collect_sites(key, self._surface, self._batch, self.limits, self._name, obstacles=self._obstacles)

    def next(self, done: Collection[int]) -> Site:
        """Return the safe site of the lowest number that was not done yet.

        Args:
            done: Numbers of the sites that were tried already.

        Returns:
            The site with its pose (m) in W.

        Raises:
            ValueError: If the object has too few safe sites.
        """
        return self.site(next(number for number in count() if number not in done))


def extract_patch(view: View, camera: Camera, T_w_c: Array, T_w_t: Array) -> SeenPatch:
    """Extract a patch from a view as the simulation does from its own views, so that a model trained on one applies to
    the other.

    Args:
        view: View of the camera, with its depth image (m).
        camera: Intrinsics of the camera. The function is compiled once for each.
        T_w_c: `(4, 4)` pose of the camera.
        T_w_t: `(4, 4)` pose of the tool in front of which the patch lies.

    Returns:
        The patch, its view, and the fraction of its pixels that were measured.
    """
    depth, *poses = (jnp.asarray(part, jnp.float32) for part in (view.depth, T_w_c, T_w_t))
    seen, visible_share = jax.device_get(_extract(depth, camera, *poses))
    return SeenPatch(seen.patch.depth, seen.depth, float(seen.patch.nearest), float(visible_share))


@full_precision
def _extract(
    depth: Float[Array, "h w"], camera: Camera, T_w_c: Float[Array, "4 4"], T_w_t: Float[Array, "4 4"]
) -> tuple[PatchView, Array]:
    seen = view_from_depth(depth, camera, T_w_c, T_w_t)
    share = jnp.mean(centre(seen.known_mask, PATCH_PIXELS))
    return seen.view, share


_extract = jax.jit(_extract, static_argnums=1)
