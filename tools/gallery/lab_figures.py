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

BELIEVED_OFF = (6e-3, -5e-3, 2e-3, 0.0, 0.0, np.radians(8.0))  # m and rad, of the object before it is touched
BELIEF_STD = (6e-3, np.radians(8.0))  # m and rad, which the registration is told
REGISTERED_AFTER = (2, 4, 8, 16, 24)  # touches
OUTLINE_WINDOW_M, OUTLINE_PIXELS = 0.34, 680
MONITOR_REST_S, MONITOR_PRESS_S = 2.3, 2.1  # until the emulated board rests, and from then until its press is deepest


def registration(story: Story) -> Figure:
    """An object's pose, before and after it was touched at known poses."""
    surface = i2t.prepare_surface(i2t.make_object(HIDDEN_OBJECT).mesh)
    errors = SimulationErrors(placement=0.0, placement_angle=0.0)
    pad = i2t.sample_pad(jax.random.key(1))
    touches = i2t.simulate_touches(jax.random.key(0), [surface], pad, errors, REGISTERED_AFTER[-1])
    T_w_believed = np.asarray(exp(np.array(BELIEVED_OFF)), np.float32)
    T_w_contact, met = contact_poses(touches)
    found = [
        i2t.register_by_touch(
            jax.random.key(2), surface, T_w_believed, T_w_contact, np.asarray(met) & (np.arange(len(met)) < count),
            translation_std=BELIEF_STD[0], rotation_std=BELIEF_STD[1],
        ).T_w_o
        for count in REGISTERED_AFTER
    ]  # fmt: skip
    off = np.abs([np.asarray(log(np.asarray(T, float))) for T in (T_w_believed, *found)])
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    figure.suptitle(titled(f"A {HIDDEN_OBJECT} found by touching it", True))
    above, errors_axes = figure.subplots(1, 2, width_ratios=(1.5, 1))
    _outline_from_above(above, surface, np.eye(4), Colour.GREY, "where it stands")
    _outline_from_above(above, surface, T_w_believed, Colour.ORANGE, "where it was believed")
    _outline_from_above(above, surface, np.asarray(found[-1]), Colour.BLUE, f"after {REGISTERED_AFTER[-1]} touches")
    above.plot(*(MM_PER_M * np.asarray(T_w_contact)[np.asarray(met), :2, 3].T), "k.", ms=5, label="contacts")
    above.set(xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
    above.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, frameon=False)
    counts = (0, *REGISTERED_AFTER)
    errors_axes.semilogy(
        counts, MM_PER_M * np.linalg.norm(off[:, :3], axis=1), "o-", color=Colour.BLUE, label="position (mm)"
    )
    turned = np.degrees(np.linalg.norm(off[:, 3:], axis=1))
    errors_axes.semilogy(counts, turned, "s--", color=Colour.ORANGE, label="rotation (degrees)")
    errors_axes.set(xlabel="touches", ylabel="error", xticks=counts)
    errors_axes.legend(fontsize=9)
    return figure


def rig(story: Story) -> Figure:
    """A lab's rig as it is drawn before anything moves: frames, tool, camera and the box that the tool stays in."""
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
    """Output of `python -m i2t.hardware.reskin` for an emulated board while something presses it."""
    with reskin_board.run_board("--press", "1", "--seed", "0") as (port, _), ReSkin(port) as skin:
        time.sleep(MONITOR_REST_S)
        rest = skin.read(skin_monitor.REST_SAMPLES).reading.mean(0)
        time.sleep(MONITOR_PRESS_S)
        shown = skin.since(int(skin.latest().number[-1]) - skin_monitor.SHOWN_SAMPLES)
        lines = skin_monitor.table(skin.counters, shown, rest)
    figure = Figure(figsize=(8.6, 2.4), facecolor="#101418")
    title = titled("$ python -m i2t.hardware.reskin", True)
    text = "\n".join([title, "", *lines])
    figure.text(0.02, 0.98, text, family="monospace", fontsize=9, color="#e6e6e6", va="top", linespacing=1.25)
    return figure


# --- pieces ---


def _outline_from_above(axes: Axes, surface: i2t.Surface, T_w_o: np.ndarray, colour: str, label: str) -> None:
    """An object's outline seen from above."""
    heights = render_heights(surface, jnp.asarray(LOOKING_DOWN @ T_w_o, jnp.float32), OUTLINE_WINDOW_M, OUTLINE_PIXELS)
    half = MM_PER_M * OUTLINE_WINDOW_M / 2
    at = np.linspace(-half, half, OUTLINE_PIXELS)
    axes.contour(at, -at, np.isfinite(heights), levels=[0.5], colors=colour, linewidths=1.5)
    axes.plot([], [], color=colour, lw=1.5, label=label)
