"""Sites and views of a collection: an endless list of safe sites, patches extracted from views, and a picture.

The sites of an object are random, as in the paper (`i2t.simulation.sites`), and numbered: the same seed gives the same
list, however many of them are used, so that a collection goes on where it stopped.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from i2t.collect.touch import ExtractPatch, SeenPatch, Site
from i2t.depth.camera import Camera
from i2t.depth.patches import view_from_depth
from i2t.geometry import full_precision, inverse, nearest_rigid
from i2t.hardware.protocols import View
from i2t.hardware.rig import Rig
from i2t.objects.solids import Mesh, transform_mesh
from i2t.rendering.render import prepare_surface
from i2t.simulation.sites import SiteLimits, collect_sites
from i2t.types import PATCH_PIXELS, Array
from i2t.views import centre

MM_PER_M = 1e3
SITE_BATCH = 32  # sites that are drawn at once
ARROW_LENGTH_MM = 15.0  # of the arrows that a picture draws along the motion of presses


class SiteSampler:
    """Safe sites of an object, in the order in which they are to be touched.

    Args:
        mesh: The object, m.
        T_w_o: (4, 4) where it stands.
        limits: What makes a site safe.
        seed: Of the sites.
        name: Of the object, for errors.
    """

    def __init__(self, mesh: Mesh, T_w_o: Float[Array, "4 4"], limits: SiteLimits, seed: int, name: str) -> None:
        self.mesh = mesh
        self.placed = transform_mesh(mesh, np.asarray(T_w_o))
        self.top = float(self.placed.vertices[:, 2].max())  # m, in W
        self._surface = prepare_surface(self.placed)
        self._limits, self._seed, self._name = limits, seed, name
        self._sites: list[Site] = []

    def site(self, number: int) -> Site:
        """A site by its number.

        Args:
            number: From 0.

        Returns:
            The site.

        Raises:
            ValueError: The object has too few safe sites.
        """
        while number >= len(self._sites):
            key = jax.random.fold_in(jax.random.key(self._seed), len(self._sites) // SITE_BATCH)
            poses = np.asarray(collect_sites(key, self._surface, SITE_BATCH, self._limits, self._name), float)
            self._sites += [Site(len(self._sites) + i, nearest_rigid(pose)) for i, pose in enumerate(poses)]
        return self._sites[number]

    def next(self, done: Collection[int]) -> Site:
        """The first site that is not done.

        Args:
            done: Numbers of sites.

        Returns:
            The site.

        Raises:
            ValueError: The object has too few safe sites.
        """
        number = 0
        while number in done:
            number += 1
        return self.site(number)


def patch_extractor() -> ExtractPatch:
    """A function that extracts patches from views as the simulation does from its own, so that what was trained on one
    fits the other.

    Returns:
        The function, which is compiled once for each camera.
    """

    def extract(view: View, camera: Camera, T_w_c: Array, T_w_t: Array) -> SeenPatch:
        wide, patch, nearest, visible_share = jax.device_get(
            _extract(
                jnp.asarray(view.depth, jnp.float32),
                camera,
                jnp.asarray(T_w_c, jnp.float32),
                jnp.asarray(T_w_t, jnp.float32),
            )
        )
        return SeenPatch(patch, wide, float(nearest), float(visible_share))

    return extract


@full_precision
def _extract(
    depth: Float[Array, "h w"], camera: Camera, T_w_c: Float[Array, "4 4"], T_w_t: Float[Array, "4 4"]
) -> tuple[Array, Array, Array, Array]:
    seen = view_from_depth(depth, camera, T_w_c, T_w_t)
    share = jnp.mean(centre(seen.known_mask, PATCH_PIXELS))
    return seen.view.wide, seen.view.patch.depth, seen.view.patch.nearest, share


_extract = jax.jit(_extract, static_argnums=1)


def draw_plan(
    sampler: SiteSampler,
    sites: Sequence[Site],
    refused: Collection[int],
    *,
    box: Float[Array, "2 3"],
    path: Path,
    title: str,
) -> None:
    """Draw an object and its sites from above and from the side, with the box that the tool keeps to.

    Args:
        sampler: Of the sites.
        sites: To draw.
        refused: Numbers of those that the arm cannot reach.
        box: (2, 3) m in W, lowest and highest position of the tool; its edges are drawn where they come near.
        path: Of the picture.
        title: Above it.
    """
    # Not above: matplotlib takes a third of a second, and most collections draw no picture.
    from matplotlib.figure import Figure

    from i2t.viz import style as plots

    figure = Figure(figsize=(12, 6.5), layout="constrained")
    for axes, plane, names in zip(figure.subplots(1, 2), ([0, 1], [0, 2]), ("xy", "xz"), strict=True):
        _draw_projection(axes, plane, names, sampler, sites, refused=refused, box=box)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    figure.suptitle(title)
    plots.save_figure(figure, path)


def _draw_projection(
    axes: Any,
    plane: list[int],
    names: str,
    sampler: SiteSampler,
    sites: Sequence[Site],
    *,
    refused: Collection[int],
    box: Array,
) -> None:
    """One view of the plan, on two of the world's axes."""
    from matplotlib.collections import PolyCollection
    from matplotlib.patches import Rectangle

    from i2t.viz import style as plots

    corners = MM_PER_M * sampler.placed.vertices[sampler.placed.faces]
    tips = MM_PER_M * np.array([site.T_w_t[:3, 3] for site in sites])
    tails = tips - ARROW_LENGTH_MM * np.array([site.T_w_t[:3, 2] for site in sites])
    reached = np.array([site.number not in refused for site in sites])
    low, high = MM_PER_M * box
    axes.add_collection(PolyCollection(list(corners[..., plane]), facecolor="0.88", edgecolor="0.75", linewidth=0.3))
    axes.add_artist(
        Rectangle(low[plane], *(high - low)[plane], fill=False, color=plots.RED, linestyle="--", label="the box")
    )
    for which, colour, label in ((reached, plots.BLUE, "reached"), (~reached, plots.PINK, "cannot be reached")):
        if which.any():
            axes.quiver(
                *tails[which][:, plane].T,
                *(tips - tails)[which][:, plane].T,
                angles="xy",
                scale_units="xy",
                scale=1,
                width=3e-3,
                color=colour,
                label=label,
            )
            axes.plot(*tips[which][:, plane].T, ".", color=colour, markersize=4)
    if names == "xy":
        for site, tail in zip(sites, tails, strict=True):
            axes.annotate(str(site.number), tail[plane], (3, 3), textcoords="offset points", fontsize=7)
    drawn = np.concatenate([corners.reshape(-1, 3), tails])[:, plane]
    least, most = drawn.min(0) - 5, drawn.max(0) + 5
    axes.set(xlim=(least[0], most[0]), ylim=(least[1], most[1]), aspect="equal")
    axes.set(xlabel=f"{names[0]} in the world (mm)", ylabel=f"{names[1]} (mm)")


def draw_rig(
    rig: Rig,
    vertices: Float[Array, "v 3"],
    faces: Int[Array, "f 3"],
    T_w_t: Float[Array, "4 4"],
    *,
    path: Path,
    title: str,
) -> None:
    """Draw a rig: base, box, object, and the tool with its camera at a site, for a person to compare with the lab.

    Args:
        rig: The lab's calibration.
        vertices: m, of the object in its own frame.
        faces: Vertex numbers.
        T_w_t: Where the tool is drawn.
        path: Of the picture.
        title: Above it.
    """
    from i2t.viz.rig_scene import RigScene, plot_rig
    from i2t.viz.style import save_figure

    T_w_o = rig.T_world_object
    scene = RigScene(
        vertices=np.asarray(vertices) @ T_w_o[:3, :3].T + T_w_o[:3, 3],
        faces=np.asarray(faces),
        T_w_b=rig.T_world_base,
        T_w_t=np.asarray(T_w_t),
        T_t_f=inverse(rig.T_flange_tool),
        T_t_c=rig.T_tool_camera,
        box=rig.limits.box,
        looking_distance=rig.looking_distance,
        view_edges=(rig.camera.width / rig.camera.fx, rig.camera.height / rig.camera.fy),
    )
    save_figure(plot_rig(scene, title), path)
