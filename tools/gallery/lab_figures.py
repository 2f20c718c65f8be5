"""Figures of a lab: an object found by touches, a rig with its frames, and the monitor of a skin."""

import time

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import i2t
from i2t.emulators import reskin_board
from i2t.geometry import exp, inverse, log
from i2t.hardware.reskin import monitor as skin_monitor
from i2t.hardware.reskin.driver import ReSkin
from i2t.hardware.rig import Rig
from i2t.registration import contact_poses
from i2t.rendering.render import render_heights
from i2t.simulation.touches import SimulationErrors
from i2t.viz.rig_scene import RigScene, plot_rig
from i2t.viz.style import MM_PER_M, Colour, titled
from tools.gallery.story import HIDDEN_OBJECT, LOOKING_DOWN, Story

REGISTERED_AFTER = (2, 4, 8, 16, 24)  # touches


def registration(story: Story) -> Figure:
    """Pose of an object estimated from touches at known poses."""
    surface = i2t.prepare_surface(i2t.make_object(HIDDEN_OBJECT).mesh)
    errors = SimulationErrors(placement=0.0, placement_angle=0.0)
    pad = i2t.sample_pad(jax.random.key(1))
    touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, REGISTERED_AFTER[-1])
    offset = np.array([6e-3, -5e-3, 2e-3, 0.0, 0.0, np.radians(8.0)])  # m and rad
    T_w_nominal = np.asarray(exp(offset), np.float32)
    T_w_contact, met = contact_poses(touches)
    estimates = [
        i2t.register_by_touch(
            jax.random.key(2), surface, T_w_nominal, T_w_contact, np.asarray(met) & (np.arange(len(met)) < count),
            translation_std=6e-3, rotation_std=np.radians(8.0),
        ).T_w_o
        for count in REGISTERED_AFTER
    ]  # fmt: skip
    errors_of_pose = np.abs([np.asarray(log(np.asarray(T, float))) for T in (T_w_nominal, *estimates)])
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    figure.suptitle(titled(f"Pose of a {HIDDEN_OBJECT} from touches", True))
    above, errors_axes = figure.subplots(1, 2, width_ratios=(1.5, 1))
    _outline_from_above(above, surface, np.eye(4), Colour.GREY, "true pose")
    _outline_from_above(above, surface, T_w_nominal, Colour.ORANGE, "nominal pose")
    _outline_from_above(above, surface, np.asarray(estimates[-1]), Colour.BLUE, f"after {REGISTERED_AFTER[-1]} touches")
    above.plot(*(MM_PER_M * np.asarray(T_w_contact)[np.asarray(met), :2, 3].T), "k.", ms=5, label="contacts")
    above.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    above.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, frameon=False)
    counts = (0, *REGISTERED_AFTER)
    errors_axes.semilogy(
        counts, MM_PER_M * np.linalg.norm(errors_of_pose[:, :3], axis=1), "o-", color=Colour.BLUE, label="position (mm)"
    )
    turned = np.degrees(np.linalg.norm(errors_of_pose[:, 3:], axis=1))
    errors_axes.semilogy(counts, turned, "s--", color=Colour.ORANGE, label="rotation (degrees)")
    errors_axes.set(xlabel="touches", ylabel="error", xticks=counts)
    errors_axes.legend(fontsize=9)
    return figure


def rig(story: Story) -> Figure:
    """A rig with its frames, tool, camera and the workspace of the tool."""
    lab, mesh = Rig(), i2t.make_object(HIDDEN_OBJECT).mesh
    T_w_o = lab.T_world_object
    site = i2t.sample_touch_sites(mesh, 1, seed=0).T_o_t[0]
    scene = RigScene(
        vertices=np.asarray(mesh.vertices) @ T_w_o[:3, :3].T + T_w_o[:3, 3],
        faces=np.asarray(mesh.faces),
        T_w_b=lab.T_world_base,
        T_w_t=T_w_o @ np.asarray(site, float),
        T_t_f=inverse(lab.T_flange_tool),
        T_t_c=lab.T_tool_camera,
        box=lab.limits.box,
        looking_distance=lab.looking_distance,
        view_edges=(lab.camera.width / lab.camera.fx, lab.camera.height / lab.camera.fy),
    )
    return plot_rig(scene, titled("The rig of the emulators", True))


def monitor(story: Story) -> Figure:
    """Output of `i2t skin` for an emulated board during a press."""
    with reskin_board.run_board("--press", "1", "--seed", "0") as (port, _), ReSkin(port) as skin:
        time.sleep(2.3)  # until the emulated board is at rest
        rest = skin.read(skin_monitor.REST_SAMPLES).reading.mean(0)
        time.sleep(2.1)  # until its press is deepest
        shown = skin.since(int(skin.latest().number[-1]) - skin_monitor.SHOWN_SAMPLES)
        lines = skin_monitor.table(skin.counters, shown, rest)
    figure = Figure(figsize=(8.6, 2.4), facecolor="#101418")
    title = titled("$ i2t skin", True)
    text = "\n".join([title, "", *lines])
    figure.text(0.02, 0.98, text, family="monospace", fontsize=9, color="#e6e6e6", va="top", linespacing=1.25)
    return figure


# --- pieces ---


def _outline_from_above(axes: Axes, surface: i2t.Surface, T_w_o: np.ndarray, colour: str, label: str) -> None:
    """Draw an object's outline seen from above."""
    window, pixels = 0.34, 680  # m
    heights = render_heights(surface, jnp.asarray(LOOKING_DOWN @ T_w_o, jnp.float32), window, pixels)
    half = MM_PER_M * window / 2
    at = np.linspace(-half, half, pixels)
    axes.contour(at, -at, np.isfinite(heights), levels=[0.5], colors=colour, linewidths=1.5)
    axes.plot([], [], color=colour, lw=1.5, label=label)
