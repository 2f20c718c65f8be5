"""Figures of a patch from a camera, and of stamps."""

import numpy as np
from matplotlib.figure import Figure

import i2t
from i2t import viz
from i2t.depth.patches import DepthPatch
from i2t.objects.catalogue import STAMPS
from i2t.patches.dimensions import PATCH_WINDOW, REACH
from i2t.simulation.depth_camera import add_depth_noise, render_view, table_triangles
from i2t.simulation.touches import SimulationErrors
from i2t.viz.skins import common_scale
from i2t.viz.style import MM_PER_M, titled
from tools.gallery.story import LOOKING_DOWN, Story

CAMERA = i2t.Camera(640, 360, fx=322.0, fy=322.0, cx=319.5, cy=179.5)


def from_depth(story: Story) -> Figure:
    """A depth image, the patch extracted from it, the patch rendered from the mesh, and their difference."""
    mesh = i2t.make_object("star").mesh
    T_o_t = i2t.contact_pose(mesh, np.array([12e-3, 4e-3, 30e-3]))  # on top
    image, seen = _view(mesh, T_o_t)
    exact = i2t.render_patch(i2t.prepare_surface(mesh), T_o_t)
    beyond = np.asarray(seen.patch.depth + seen.patch.nearest) - np.asarray(exact.depth + exact.nearest)
    both = (np.asarray(seen.patch.depth) < REACH) & (np.asarray(exact.depth) < REACH)
    error = MM_PER_M * np.where(both, beyond, np.nan)
    figure = Figure(figsize=(13, 3.7), layout="constrained")
    figure.suptitle(titled("From a depth image to a patch", True))
    parts = figure.subplots(1, 4)
    shown = parts[0].imshow(MM_PER_M * image[100:260, 240:400], cmap="cividis_r")
    figure.colorbar(shown, ax=parts[0], label="mm from the camera", shrink=0.8)
    parts[0].set_title("depth image", fontsize=10)
    parts[0].set(xlabel="pixel", ylabel="pixel")
    patch = viz.draw_patch(parts[1], seen.patch.depth)
    parts[1].set_title("patch from the image", fontsize=10)
    viz.draw_patch(parts[2], exact.depth)
    parts[2].set_title("patch from the mesh", fontsize=10)
    figure.colorbar(patch, ax=parts[1:3], label="mm behind the nearest point", shrink=0.8)
    difference = viz.draw_map(parts[3], error, PATCH_WINDOW, cmap="PuOr", low=-1.0, high=1.0)
    figure.colorbar(difference, ax=parts[3], label="mm too far from the camera", shrink=0.8, extend="both")
    parts[3].set_title("difference", fontsize=10)
    for axes in parts[1:]:
        axes.set(xlabel="x (mm)", ylabel="y (mm)")
    return figure


def stamps(story: Story) -> Figure:
    """The five stamps: patch and predicted reading at one force."""
    meshes = [i2t.make_object(name).mesh for name in STAMPS]
    depth = np.stack([i2t.render_patch(i2t.prepare_surface(mesh), LOOKING_DOWN).depth for mesh in meshes])
    reading, _ = i2t.load_predictor("nominal").predict(depth, force=1.0)
    scale = common_scale(reading)
    figure = Figure(figsize=(13, 5.4), layout="constrained")
    figure.suptitle(titled("Five stamps and the readings of one skin at 1 N", True))
    panels = figure.subplots(2, len(STAMPS))
    for number, (name, column) in enumerate(zip(STAMPS, panels.T, strict=True)):
        patch = viz.draw_patch(column[0], depth[number])
        viz.draw_skin(column[1])
        viz.draw_reading(column[1], i2t.reskin_board(), np.asarray(reading[number]), scale)
        column[0].set_title(name.removeprefix("stamp-"))
        column[1].set_xlabel("x (mm)")
    figure.colorbar(patch, ax=panels[0], label="mm behind the nearest point", shrink=0.8)
    panels[0, 0].set_ylabel("patch: y (mm)")
    panels[1, 0].set_ylabel("reading: y (mm)")
    return figure


def _view(mesh: i2t.Mesh, T_o_t: np.ndarray) -> tuple[np.ndarray, DepthPatch]:
    """Simulate a noisy depth image (m) of an object on a table along tool z, and extract the patch."""
    T_t_c = np.eye(4)
    T_t_c[2, 3] = -0.104
    T_o_c = T_o_t @ T_t_c
    triangles = np.concatenate([mesh.vertices[mesh.faces], table_triangles(np.eye(4))])
    view, _ = render_view(triangles, T_o_c, CAMERA)
    image = add_depth_noise(view, SimulationErrors(), np.random.default_rng(0))
    return image, i2t.patch_from_depth(image, CAMERA, T_o_c.astype(np.float32), T_o_t.astype(np.float32))
