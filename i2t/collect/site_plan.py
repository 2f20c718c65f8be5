"""What a collection touches and sees: an endless list of safe sites, patches cut from views, and a picture of both.

The sites of an object are random, as in the paper (`i2t.simulation.sites`), and numbered: the same seed gives the same
list, however many of them are used, so that a collection goes on where it stopped.
"""

from collections.abc import Collection, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from i2t.collect.procedure import Cut, SeenPatch, Site
from i2t.depth.camera import Camera
from i2t.depth.patches import patch_from_depth
from i2t.geometry import full_precision
from i2t.hardware.protocols import View
from i2t.objects.solids import Mesh, transform_mesh
from i2t.rendering.render import prepare_surface
from i2t.simulation import touches
from i2t.simulation.sites import Limits, collect_sites
from i2t.types import PATCH_PIXELS, WIDE_PIXELS, WIDE_WINDOW, Array

BATCH = 32  # sites that are drawn at once
TAIL = 15.0  # mm, of the arrows that a picture draws along the motion of presses
DEEP = 80e-3  # m behind the nearest point, down to which a view is followed


class Plan:
    """Safe sites of an object that stands at T_w_o, in the order in which they are to be touched."""

    def __init__(self, mesh: Mesh, T_w_o: Array, limits: Limits, seed: int, name: str) -> None:
        placed = transform_mesh(mesh, np.asarray(T_w_o))
        self.top = float(placed.vertices[:, 2].max())  # m, in W
        self.outline = placed
        self._surface = prepare_surface(placed)
        self._limits, self._seed, self._name = limits, seed, name
        self._sites: list[Site] = []

    def site(self, number: int) -> Site:
        """A site by its number. Raises ValueError for an object that has too few."""
        while number >= len(self._sites):
            key = jax.random.fold_in(jax.random.key(self._seed), len(self._sites) // BATCH)
            poses = np.asarray(collect_sites(key, self._surface, BATCH, self._limits, self._name), float)
            self._sites += [Site(len(self._sites) + i, orthonormal(pose)) for i, pose in enumerate(poses)]
        return self._sites[number]

    def next(self, done: Collection[int]) -> Site:
        """The first site that is not done."""
        number = 0
        while number in done:
            number += 1
        return self.site(number)


def patch_extractor() -> Cut:
    """Cuts patches out of views as the simulation does out of its own (`i2t.simulation.touches.cut`), so that what was
    learned from one fits the other.
    """

    def cut(view: View, camera: Camera, T_w_c: Array, T_w_t: Array) -> SeenPatch:
        wide, patch, nearest, share = jax.device_get(
            _cut(
                jnp.asarray(view.depth, jnp.float32),
                camera,
                jnp.asarray(T_w_c, jnp.float32),
                jnp.asarray(T_w_t, jnp.float32),
            )
        )
        return SeenPatch(patch, wide, float(nearest), float(share))

    return cut


@full_precision
def _cut(
    depth: Float[Array, "h w"], camera: Camera, T_w_c: Float[Array, "4 4"], T_w_t: Float[Array, "4 4"]
) -> tuple[Array, Array, Array, Array]:
    cut = patch_from_depth(depth, camera, T_w_c, T_w_t, window=WIDE_WINDOW, pixels=WIDE_PIXELS, reach=DEEP)
    known = cut.valid_mask | cut.inpainted_mask
    margin = (WIDE_PIXELS - PATCH_PIXELS) // 2
    z = jnp.where(known & (cut.patch.depth < DEEP), cut.patch.nearest + cut.patch.depth, jnp.inf)
    wide, patch = touches.cut(z)
    share = jnp.mean(known[margin:-margin, margin:-margin])
    return wide, patch.depth, patch.nearest, share


_cut = jax.jit(_cut, static_argnums=1)


def picture(plan: Plan, sites: Sequence[Site], refused: Collection[int], box: Array, path: Path, title: str) -> None:
    """Draw an object and its sites from above and from the side, the numbers that the arm `refused` marked, with the
    box (2, 3) m in W that the tool keeps to, where it comes near.
    """
    # Not above: matplotlib takes a third of a second, and most collections draw no picture.
    from matplotlib.collections import PolyCollection
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    from i2t.viz import touches as plots

    figure = Figure(figsize=(12, 6.5), layout="constrained")
    corners = plots.MILLI * plan.outline.vertices[plan.outline.faces]
    places = plots.MILLI * np.array([site.T_w_t[:3, 3] for site in sites])
    back = -TAIL * np.array([site.T_w_t[:3, 2] for site in sites])
    good = np.array([site.number not in refused for site in sites])
    low, high = plots.MILLI * box
    drawn = np.concatenate([corners.reshape(-1, 3), places + back])
    for axes, plane, names in zip(figure.subplots(1, 2), ([0, 1], [0, 2]), ("xy", "xz"), strict=True):
        axes.add_collection(
            PolyCollection(list(corners[..., plane]), facecolor="0.88", edgecolor="0.75", linewidth=0.3)
        )
        axes.add_artist(
            Rectangle(low[plane], *(high - low)[plane], fill=False, color=plots.RED, linestyle="--", label="the box")
        )
        for which, colour, label in ((good, plots.BLUE, "reached"), (~good, plots.PINK, "cannot be reached")):
            if which.any():
                axes.quiver(
                    *(places + back)[which][:, plane].T, *-back[which][:, plane].T, angles="xy", scale_units="xy",
                    scale=1, width=3e-3, color=colour, label=label,
                )  # fmt: skip
                axes.plot(*places[which][:, plane].T, ".", color=colour, markersize=4)
        if names == "xy":
            for site, tail in zip(sites, places + back, strict=True):
                axes.annotate(str(site.number), tail[plane], (3, 3), textcoords="offset points", fontsize=7)
        least, most = drawn[:, plane].min(0) - 5, drawn[:, plane].max(0) + 5
        axes.set(xlim=(least[0], most[0]), ylim=(least[1], most[1]), aspect="equal")
        axes.set(xlabel=f"{names[0]} in the world (mm)", ylabel=f"{names[1]} (mm)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(title)
    plots.save(figure, path)


def orthonormal(pose: Array) -> Array:
    """A pose in float32 whose rotation is one to the last digit of float64."""
    u, _, vt = np.linalg.svd(pose[:3, :3])
    return np.block([[u @ vt, pose[:3, 3:]], [np.zeros((1, 3)), np.ones((1, 1))]])
