"""Question: how well does an imagined patch match one that a real depth camera saw?

    python -m experiments.real_frames --data DIR --out DIR

DIR holds `ycbvideo` (five frames of YCB-Video, an Asus Xtion at 0.5 to 0.65 m), `ycb_meshes` and `apc_depth` (two
frames of a RealSense F200). On each posed mesh of the five frames, sites are drawn that the camera sees in all of
them; there a real patch is extracted from the depth image, and the same patch is imagined from the mesh, at three sizes
of window. The frames follow each other within a second and show the same scene, so intervals are over sites. The F200's
frames have no poses of objects: patches are extracted along normals of the depth itself and shown. It takes about a
minute on two cores; the camera's own step is 1 mm and its noise about as much, so a median difference below 1 mm is
what can be expected. Results go to --out: metrics.json, config.json and figures.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from experiments.common.runs import begin, write_json
from experiments.real_frames.arguments import RealFrames
from i2t import viz
from i2t.depth.camera import Camera, Encoding, read_depth
from i2t.depth.distortion import pixel_rays
from i2t.depth.patches import DepthPatch, patch_from_depth
from i2t.geometry import contact_frame
from i2t.objects import read_mesh
from i2t.objects.solids import Mesh
from i2t.prediction.metrics import grouped_interval
from i2t.rendering.render import prepare_surface, render_patch
from i2t.types import PATCH_WINDOW, REACH, Patch, Surface
from i2t.viz import style

FRAMES = ("000001", "000002", "000003", "000004", "000005")
YCB_DEPTH_UNIT_M = 1e-4  # m, of both cameras' files


@dataclass(frozen=True)
class FrameObject:
    """An object of the frames: its class in the label images, and where YCB-Video's model frame lies in the mesh's."""

    name: str
    label: int
    offset: tuple[float, float, float]  # m; p_mesh = p_model + offset


OBJECTS = (
    FrameObject("009_gelatin_box", 8, (-21.31e-3, -8.69e-3, 18.10e-3)),
    FrameObject("025_mug", 14, (-17.11e-3, 16.62e-3, 38.43e-3)),
    FrameObject("061_foam_brick", 21, (-18.46e-3, 17.24e-3, 16.89e-3)),
)
# From the data set's cam.info.txt.
F200 = Camera(640, 480, 477.584259, 477.584167, 314.188080, 245.884354)


class Compared(NamedTuple):
    """Patches of one object at one window: (frames, sites) and their pixels."""

    real: DepthPatch
    imagined: Patch
    difference: np.ndarray  # (frames, sites, n, n) m, real minus imagined height; NaN where it is not compared
    bias: np.ndarray  # (frames, sites) m, median of the differences; NaN where there are too few


def run(cfg: RealFrames) -> dict[str, Any]:
    """Run the comparison, print its table and write metrics and figures."""
    cfg.check()
    begin(cfg.out, cfg, cfg, None, cfg.overwrite)
    objects: dict[str, Any] = {}
    for item in OBJECTS:
        mesh = read_mesh(cfg.data / "ycb_meshes" / f"{item.name}.stl", "m", table=False)[0].mesh
        camera, depths, labels, T_c_o = frames(cfg.data / "ycbvideo", item)
        T_o_t = draw_sites(cfg, item, mesh, camera, depths, labels, T_c_o)
        surface = prepare_surface(mesh)
        by_window = {window: compare(cfg, surface, camera, depths, T_c_o, T_o_t, window) for window in cfg.windows}
        objects[item.name] = {f"{1e3 * window:g} mm": summary(part) for window, part in by_window.items()}
        viz.save_figure(figure(item.name, by_window), cfg.out / f"{item.name}.png")
    metrics = {
        "source": "real depth, posed scans",
        "seed": cfg.seed,
        "frames": len(FRAMES),
        "objects": objects,
        "f200": {name: show_f200(cfg, name) for name in ("frame-000000", "frame-000007")},
    }
    write_json(cfg.out / "metrics.json", metrics)
    report(metrics)
    return metrics


def frames(folder: Path, item: FrameObject) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """The camera, depth (frames, h, w) m, labels (frames, h, w) and poses T_c_o (frames, 4, 4) of the mesh."""
    with np.load(folder / "meta.npz", allow_pickle=False) as meta:
        K = meta[f"{FRAMES[0]}/intrinsic_matrix"]
        T_c_m = np.tile(np.eye(4), (len(FRAMES), 1, 1))
        for pose, frame in zip(T_c_m, FRAMES, strict=True):
            (which,) = np.flatnonzero(meta[f"{frame}/cls_indexes"][:, 0] == item.label)
            pose[:3] = meta[f"{frame}/poses"][:, :, which]
    T_m_o = np.eye(4)
    T_m_o[:3, 3] = -np.array(item.offset)
    depths = np.stack([read_depth(folder / f"{frame}-depth.png", YCB_DEPTH_UNIT_M) for frame in FRAMES])
    labels = np.stack([np.asarray(Image.open(folder / f"{frame}-label.png")) for frame in FRAMES])
    height, width = depths.shape[1:]
    camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    return camera, depths, labels, (T_c_m @ T_m_o).astype(np.float32)


def draw_sites(
    cfg: RealFrames, item: FrameObject, mesh: Mesh, camera: Camera, depths: np.ndarray, labels: np.ndarray,
    T_c_o: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Contact frames T_o_t (sites, 4, 4) that the camera sees in all frames, drawn uniformly over the mesh's area."""
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(whole, 200 * cfg.sites, seed=cfg.seed)
    normals = whole.face_normals[faces]
    visible = np.ones(len(points), bool)
    for depth, label, T in zip(depths, labels, T_c_o, strict=True):
        at, n = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
        facing = -np.sum(n * at, 1) / np.linalg.norm(at, axis=1)
        u = np.rint(at[:, 0] / at[:, 2] * camera.fx + camera.cx).astype(int)
        v = np.rint(at[:, 1] / at[:, 2] * camera.fy + camera.cy).astype(int)
        near = cfg.border_px
        inside = (u >= near) & (u < camera.width - near) & (v >= near) & (v < camera.height - near)
        u, v = np.where(inside, u, near), np.where(inside, v, near)
        own = np.ones(len(points), bool)
        for i in (-near, 0, near):
            for j in (-near, 0, near):
                own &= label[v + i, u + j] == item.label
        # A hole compares false, and so is not visible.
        visible &= inside & own & (facing >= cfg.min_cosine) & (np.abs(depth[v, u] - at[:, 2]) <= cfg.max_occlusion_m)
    chosen = np.flatnonzero(visible)[: cfg.sites]
    if not len(chosen):
        raise ValueError(f"{item.name} is not visible in these frames; check its poses and labels")
    return np.asarray(jax.vmap(contact_frame)(jnp.float32(points[chosen]), jnp.float32(normals[chosen])))


def compare(
    cfg: RealFrames, surface: Surface, camera: Camera, depths: np.ndarray, T_c_o: np.ndarray, T_o_t: np.ndarray,
    window: float,
) -> Compared:  # fmt: skip
    """Real and imagined patches at the same poses; the reach grows with the window."""
    reach = REACH * window / PATCH_WINDOW
    extract = partial(patch_from_depth, window=window, reach=reach + cfg.extra_reach_m)
    seen_in = jax.jit(jax.vmap(extract, (None, None, None, 0)), static_argnums=1)
    here = np.eye(4, dtype=np.float32)  # the camera's frame serves as the world's
    real = [seen_in(depth, camera, here, T @ T_o_t) for depth, T in zip(depths, T_c_o, strict=True)]
    real = jax.device_get(jax.tree.map(lambda *parts: jnp.stack(parts), *real))
    draw = jax.jit(jax.vmap(partial(render_patch, window=window, reach=reach), (None, 0)))
    once = jax.device_get(draw(surface, T_o_t))
    imagined = Patch(*(np.broadcast_to(field, (len(depths), *field.shape)) for field in once))
    # Which pixels are compared is decided by the imagined depth alone: by the real one, its noise would be cut off.
    both = (imagined.depth < reach) & real.valid_mask & (real.patch.depth < reach + cfg.extra_reach_m)
    difference = np.where(both, heights(real.patch) - heights(imagined), np.nan)
    enough = np.isfinite(difference).mean((2, 3)) >= cfg.min_share
    bias = np.full(enough.shape, np.nan)
    bias[enough] = np.nanmedian(difference[enough], axis=(1, 2))
    return Compared(real, imagined, difference, bias)


def heights(patch: Patch) -> np.ndarray:
    """Tool z (m) of every pixel."""
    return np.asarray(patch.depth) + np.asarray(patch.nearest)[..., None, None]


def summary(part: Compared) -> dict[str, Any]:
    """Median absolute difference once each patch's bias is taken off, with its interval over sites, and the spread."""
    used = np.isfinite(part.bias)
    bias, sites = part.bias[used], np.nonzero(used)[1]
    rest = part.difference[used] - bias[:, None, None]
    of_patch = np.nanmedian(np.abs(rest), axis=(1, 2))
    low, high = grouped_interval(lambda rows: float(np.median(of_patch[rows])), sites)
    quartiles = np.nanpercentile(rest, [25, 75])
    return {
        "sites": len(np.unique(sites)),
        "patches": len(bias),
        "too_few_pixels": int(np.sum(~used)),
        "median_absolute_mm": 1e3 * float(np.median(of_patch)),
        "interval_95_mm": [1e3 * low, 1e3 * high],
        "interquartile_range_mm": 1e3 * float(quartiles[1] - quartiles[0]),
        "bias_median_mm": 1e3 * float(np.median(bias)),
        "bias_quartiles_mm": [1e3 * float(q) for q in np.percentile(bias, [25, 75])],
        "over_5_mm": float(np.mean(np.abs(rest[np.isfinite(rest)]) > 5e-3)),
        "compared": float(np.mean(np.isfinite(rest))),
        "seen": float(part.real.valid_mask.mean()),
        "filled": float(part.real.inpainted_mask.mean()),
    }


def figure(name: str, by_window: dict[float, Compared], count: int = 4) -> Figure:
    """Rows of sites; for the smallest and the largest window the real patch, the imagined one and the difference."""
    windows = (min(by_window), max(by_window))
    sites = np.flatnonzero(np.isfinite(by_window[windows[0]].bias[0]) & np.isfinite(by_window[windows[1]].bias[0]))[
        :count
    ]
    result = Figure(figsize=(14, 2.4 * len(sites) + 1.0), layout="constrained")
    axes = result.subplots(len(sites), 6, squeeze=False)
    for row, site in zip(axes, sites, strict=True):
        for half, window in enumerate(windows):
            part, reach = by_window[window], REACH * window / PATCH_WINDOW
            near = part.imagined.nearest[0, site] + part.bias[0, site]
            known = part.real.valid_mask[0, site] | part.real.inpainted_mask[0, site]
            real = np.clip(heights(part.real.patch)[0, site] - near, 0, reach)
            left, middle, right = row[3 * half : 3 * half + 3]
            image = draw(left, np.where(known, real, np.nan), window, reach)
            draw(middle, part.imagined.depth[0, site], window, reach)
            rest = part.difference[0, site] - part.bias[0, site]
            extent = np.array([-1, 1, -1, 1]) * 1e3 * window / 2
            change = right.imshow(1e3 * rest, origin="lower", extent=extent, cmap="PuOr", vmin=-4, vmax=4)
            right.set_facecolor("#DDDDDD")
            left.set_title(f"real, {1e3 * window:g} mm", fontsize=9)
            middle.set_title("imagined", fontsize=9)
            right.set_title(f"difference, bias {1e3 * part.bias[0, site]:+.1f} mm", fontsize=9)
            if site == sites[-1]:
                first = 3 * half
                for axis in row[first : first + 3]:
                    axis.set_xlabel("tool x (mm)")
                result.colorbar(
                    image,
                    ax=axes[:, first : first + 2],
                    label="depth behind nearest (mm)",
                    location="bottom",
                    shrink=0.6,
                )
                result.colorbar(
                    change, ax=axes[:, first + 2], label="difference, bias taken off (mm)", location="bottom"
                )
        row[0].set_ylabel(f"site {site}\ntool y (mm)")
    result.suptitle(
        f"{name}: real depth (Xtion, first frame) against the posed scan; grey was not seen or not compared"
    )
    return result


def draw(axes: Axes, patch: np.ndarray, window: float, reach: float):
    """A patch with what is not known in grey."""
    axes.set_facecolor("#DDDDDD")
    return viz.draw_patch(axes, patch, window, reach)


def show_f200(cfg: RealFrames, name: str, count: int = 5) -> dict[str, Any]:
    """Cut patches from a frame without poses, along normals of planes through what is around a pixel, and draw them."""
    depth = read_depth(cfg.data / "apc_depth" / f"{name}.depth.png", YCB_DEPTH_UNIT_M, Encoding.ROTATED)
    x, y = np.asarray(pixel_rays(F200))
    points = np.stack([x * depth, y * depth, depth], -1)
    rng = np.random.default_rng(cfg.seed)
    pixels, frames_at = [], []
    for row, column in rng.permutation(np.argwhere(np.isfinite(depth))):
        centre = points[row, column]
        half = int(np.ceil(PATCH_WINDOW / 2 / centre[2] * F200.fx))
        around = points[max(row - half, 0) : row + half + 1, max(column - half, 0) : column + half + 1].reshape(-1, 3)
        around = around[np.linalg.norm(around - centre, axis=1) < PATCH_WINDOW / 2]
        if len(around) < half**2:  # a third of the disc's pixels
            continue
        middle = around.mean(0)
        normal = np.linalg.svd(around - middle, full_matrices=False)[2][2]
        normal *= -np.sign(normal @ middle)  # towards the camera
        if -normal @ middle < cfg.min_cosine * np.linalg.norm(middle):
            continue
        pixels.append((column, row))
        frames_at.append((middle, normal))
        if len(frames_at) == count:
            break
    if not frames_at:
        raise ValueError(f"{name} holds no point with enough measured pixels around it; check its encoding")
    T_w_t = jax.jit(jax.vmap(contact_frame))(*(jnp.float32(np.array(part)) for part in zip(*frames_at, strict=True)))
    extract = jax.vmap(partial(patch_from_depth, fill=cfg.f200_fill_m), (None, None, None, 0))
    patches = jax.device_get(jax.jit(extract, static_argnums=1)(depth, F200, np.eye(4, dtype=np.float32), T_w_t))
    viz.save_figure(figure_f200(name, depth, pixels, patches), cfg.out / f"f200_{name}.png")
    return {
        "measured": float(np.isfinite(depth).mean()),
        "depth_quartiles_m": [float(q) for q in np.nanpercentile(depth, [25, 50, 75])],
        "seen": [float(share) for share in patches.valid_mask.mean((1, 2))],
        "filled": [float(share) for share in patches.inpainted_mask.mean((1, 2))],
        "relief_mm": [1e3 * float(np.ptp(np.percentile(d[s], [5, 95]))) if s.any() else None
                      for d, s in zip(patches.patch.depth, patches.valid_mask, strict=True)],
    }  # fmt: skip


def figure_f200(name: str, depth: np.ndarray, pixels: list[tuple[int, int]], patches: DepthPatch) -> Figure:
    """The depth image with the points, and their patches."""
    result = Figure(figsize=(3.6 + 2.4 * len(pixels), 3.2), layout="constrained")
    axes = result.subplots(1, 1 + len(pixels), width_ratios=[1.6] + [1.0] * len(pixels))
    low, high = np.nanpercentile(depth, [2, 98])
    axes[0].set_facecolor("#DDDDDD")
    image = axes[0].imshow(depth, cmap="cividis_r", vmin=low, vmax=high)
    result.colorbar(image, ax=axes[0], label="depth (m)", location="left")
    axes[0].set(xlabel="column", ylabel="row", title="real")
    for i, (column, row) in enumerate(pixels):
        axes[0].plot(column, row, "o", color=style.RED, ms=4)
        axes[0].annotate(str(i), (column, row), color=style.RED, xytext=(4, 4), textcoords="offset points")
        known = patches.valid_mask[i] | patches.inpainted_mask[i]
        image = draw(axes[i + 1], np.where(known, patches.patch.depth[i], np.nan), PATCH_WINDOW, REACH)
        axes[i + 1].set_title(f"real, point {i}", fontsize=9)
        axes[i + 1].set_xlabel("tool x (mm)")
    axes[1].set_ylabel("tool y (mm)")
    result.colorbar(image, ax=axes[-1], label="depth behind nearest (mm)")
    result.suptitle(f"RealSense F200, {name}: patches along normals of the depth; grey was not measured or not seen")
    return result


def report(metrics: dict[str, Any]) -> None:
    """The table a person reads."""
    print("real against imagined patches, each patch's bias taken off; 95 % interval over sites; mm")
    print(
        f"{'object':18}{'window':>8}{'patches':>9}{'median |d|':>22}{'IQR':>7}{'bias':>22}{'> 5 mm':>8}{'compared':>10}"
    )
    for name, windows in metrics["objects"].items():
        for window, values in windows.items():
            low, high = values["interval_95_mm"]
            median = f"{values['median_absolute_mm']:.2f} [{low:.2f}, {high:.2f}]"
            first, third = values["bias_quartiles_mm"]
            bias = f"{values['bias_median_mm']:+.2f} ({first:+.2f}, {third:+.2f})"
            print(
                f"{name:18}{window:>8}{values['patches']:>9}{median:>22}{values['interquartile_range_mm']:7.2f}{bias:>22}"
                f"{100 * values['over_5_mm']:7.1f}%{100 * values['compared']:9.0f}%"
            )
    for name, values in metrics["f200"].items():
        seen = ", ".join(f"{100 * share:.0f}" for share in values["seen"])
        print(f"F200 {name}: {100 * values['measured']:.0f} % of the image measured; seen of the patches: {seen} %")
