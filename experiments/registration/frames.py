"""Question: how well does a rendered patch match the patch of a real depth camera?

    python -m experiments.registration frames --data DIR

DIR holds `ycbvideo` (five frames of YCB-Video, an Asus Xtion at 0.5 to 0.65 m), `ycb_meshes` and `apc_depth` (two
frames of a RealSense F200). On each posed mesh of the five frames, sites are drawn that are visible in all of them. At
each site a real patch is extracted from the depth image and the same patch is rendered from the mesh, with three window
sizes. The frames show one scene within a second, so intervals are over sites. For the F200's frames, which have no
object poses, the fraction of measured pixels is reported. Time: about a minute on two cores. Expect a median difference
below 1 mm, because the camera's depth step is 1 mm and its noise is similar. Results go to --out: metrics.json and
config.json.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from PIL import Image

from experiments.common.runs import begin, write_json
from experiments.common.tables import cell, text_table
from experiments.registration.arguments import FramesArgs
from i2t.depth.camera import Camera, Encoding, read_depth
from i2t.depth.patches import DepthPatch, patch_from_depth
from i2t.geometry import contact_frame
from i2t.intervals import grouped_interval
from i2t.objects import Mesh, read_mesh
from i2t.patches.dimensions import PATCH_WINDOW, REACH, STANDOFF
from i2t.rendering.render import prepare_surface, render_patch
from i2t.types import Patch, Surface

FRAMES = ("000001", "000002", "000003", "000004", "000005")
F200_FRAMES = ("frame-000000", "frame-000007")
DEPTH_UNIT_M = 1e-4  # of the depth files of both cameras


@dataclass(frozen=True)
class FrameObject:
    """An object of the frames, with its class in the label images and the offset of YCB-Video's model frame."""

    name: str
    label: int
    offset: tuple[float, float, float]  # m; p_mesh = p_model + offset


OBJECTS = (
    FrameObject("009_gelatin_box", 8, (-21.31e-3, -8.69e-3, 18.10e-3)),
    FrameObject("025_mug", 14, (-17.11e-3, 16.62e-3, 38.43e-3)),
    FrameObject("061_foam_brick", 21, (-18.46e-3, 17.24e-3, 16.89e-3)),
)


class Compared(NamedTuple):
    """Patches of one object at one window size, with leading axes (frames, sites)."""

    real: DepthPatch
    rendered: Patch
    difference: np.ndarray  # (frames, sites, n, n) m, real minus rendered height; NaN in pixels that are not compared
    bias: np.ndarray  # (frames, sites) m, median of the differences; NaN if too few pixels are compared


def run(args: FramesArgs) -> dict[str, Any]:
    """Compare the patches of all objects, print the table, write metrics.json and config.json."""
    args.check()
    begin(args, args)
    objects: dict[str, Any] = {}
    for item in OBJECTS:
        mesh = read_mesh(args.data / "ycb_meshes" / f"{item.name}.stl", "m", table=False)[0].mesh
        camera, depths, labels, T_c_o = frames(args.data / "ycbvideo", item)
        T_o_t = draw_sites(args, item, mesh, camera, depths, labels, T_c_o)
        surface = prepare_surface(mesh)
        objects[item.name] = {
            f"{1e3 * window:g} mm": summary(compare(surface, camera, depths, T_c_o, T_o_t, window))
            for window in args.windows
        }
    metrics = {
        "source": "real depth, posed scans",
        "seed": args.seed,
        "frames": len(FRAMES),
        "objects": objects,
        "f200_measured": {name: measured_share(args.data / "apc_depth" / f"{name}.depth.png") for name in F200_FRAMES},
    }
    write_json(args.out / "metrics.json", metrics)
    report(metrics)
    return metrics


def frames(folder: Path, item: FrameObject) -> tuple[Camera, np.ndarray, np.ndarray, np.ndarray]:
    """Load the camera, depth (frames, h, w) m, labels (frames, h, w) and poses T_c_o (frames, 4, 4) of the mesh."""
    with np.load(folder / "meta.npz", allow_pickle=False) as meta:
        K = meta[f"{FRAMES[0]}/intrinsic_matrix"]
        T_c_m = np.tile(np.eye(4), (len(FRAMES), 1, 1))
        for pose, frame in zip(T_c_m, FRAMES, strict=True):
            (which,) = np.flatnonzero(meta[f"{frame}/cls_indexes"][:, 0] == item.label)
            pose[:3] = meta[f"{frame}/poses"][:, :, which]
    T_m_o = np.eye(4)
    T_m_o[:3, 3] = -np.array(item.offset)
    depths = np.stack([read_depth(folder / f"{frame}-depth.png", DEPTH_UNIT_M) for frame in FRAMES])
    labels = np.stack([np.asarray(Image.open(folder / f"{frame}-label.png")) for frame in FRAMES])
    height, width = depths.shape[1:]
    camera = Camera(width, height, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    return camera, depths, labels, (T_c_m @ T_m_o).astype(np.float32)


def draw_sites(
    cfg: FramesArgs, item: FrameObject, mesh: Mesh, camera: Camera, depths: np.ndarray, labels: np.ndarray,
    T_c_o: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Draw contact frames T_o_t (sites, 4, 4) uniformly over the mesh's area that are visible in all frames.

    A visible site faces the camera within 60 degrees, is 3 pixels or more inside the object's label, and is within 8 mm
    of the measured depth; a larger difference means an occlusion.
    """
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, faces = trimesh.sample.sample_surface(whole, 200 * cfg.sites, seed=cfg.seed)
    normals = whole.face_normals[faces]
    visible = np.ones(len(points), bool)
    for depth, label, T in zip(depths, labels, T_c_o, strict=True):
        at, n = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
        facing = -np.sum(n * at, 1) / np.linalg.norm(at, axis=1)
        u = np.rint(at[:, 0] / at[:, 2] * camera.fx + camera.cx).astype(int)
        v = np.rint(at[:, 1] / at[:, 2] * camera.fy + camera.cy).astype(int)
        near = 3
        inside = (u >= near) & (u < camera.width - near) & (v >= near) & (v < camera.height - near)
        u, v = np.where(inside, u, near), np.where(inside, v, near)
        own = np.ones(len(points), bool)
        for i in (-near, 0, near):
            for j in (-near, 0, near):
                own &= label[v + i, u + j] == item.label
        # A hole in the depth image is NaN, fails the comparison, and is not visible.
        visible &= inside & own & (facing >= 0.5) & (np.abs(depth[v, u] - at[:, 2]) <= 8e-3)
    chosen = np.flatnonzero(visible)[: cfg.sites]
    if not len(chosen):
        raise ValueError(f"{item.name} is not visible in these frames; check its poses and labels")
    return np.asarray(jax.vmap(contact_frame)(jnp.float32(points[chosen]), jnp.float32(normals[chosen])))


def compare(
    surface: Surface, camera: Camera, depths: np.ndarray, T_c_o: np.ndarray, T_o_t: np.ndarray, window: float
) -> Compared:  # fmt: skip
    """Compare real and rendered patches at the same poses; the reach is proportional to the window.

    Real patches are extracted with extra reach, so that neither noise nor an object in front clips them.
    """
    reach = REACH * window / PATCH_WINDOW
    extract = partial(patch_from_depth, window=window, reach=reach + STANDOFF)
    seen_in = jax.jit(jax.vmap(extract, (None, None, None, 0)), static_argnums=1)
    here = np.eye(4, dtype=np.float32)  # the camera's frame serves as the world's
    real = [seen_in(depth, camera, here, T @ T_o_t) for depth, T in zip(depths, T_c_o, strict=True)]
    real = jax.device_get(jax.tree.map(lambda *parts: jnp.stack(parts), *real))
    draw = jax.jit(jax.vmap(partial(render_patch, window=window, reach=reach), (None, 0)))
    once = jax.device_get(draw(surface, T_o_t))
    rendered = Patch(*(np.broadcast_to(field, (len(depths), *field.shape)) for field in once))
    # The rendered depth alone selects the compared pixels, because a selection by the real depth would clip its noise.
    compared = (rendered.depth < reach) & real.valid_mask & (real.patch.depth < reach + STANDOFF)
    difference = np.where(compared, heights(real.patch) - heights(rendered), np.nan)
    enough = np.isfinite(difference).mean((2, 3)) >= 0.1
    bias = np.full(enough.shape, np.nan)
    bias[enough] = np.nanmedian(difference[enough], axis=(1, 2))
    return Compared(real, rendered, difference, bias)


def heights(patch: Patch) -> np.ndarray:
    """Tool z (m) of every pixel."""
    return np.asarray(patch.depth) + np.asarray(patch.nearest)[..., None, None]


def summary(part: Compared) -> dict[str, Any]:
    """Summarise the differences after removing each patch's bias: median absolute value with interval, and spread."""
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


def measured_share(path: Path) -> float:
    """Fraction of measured pixels in a depth image of the F200."""
    return float(np.isfinite(read_depth(path, DEPTH_UNIT_M, Encoding.ROTATED)).mean())


def report(metrics: dict[str, Any]) -> None:
    """Print the table."""
    print("real against rendered patches after removing each patch's bias; 95 % interval over sites; mm")
    rows = []
    for name, windows in metrics["objects"].items():
        for window, values in windows.items():
            median = cell((values["median_absolute_mm"], *values["interval_95_mm"]), 2)
            first, third = values["bias_quartiles_mm"]
            bias = f"{values['bias_median_mm']:+.2f} ({first:+.2f}, {third:+.2f})"
            shares = f"{100 * values['over_5_mm']:.1f} %", f"{100 * values['compared']:.0f} %"
            spread = cell(values["interquartile_range_mm"], 2)
            rows.append((name, window, str(values["patches"]), median, spread, bias, *shares))
    print(text_table(("object", "window", "patches", "median |d|", "IQR", "bias", "> 5 mm", "compared"), rows))
    for name, share in metrics["f200_measured"].items():
        print(f"F200 {name}: {100 * share:.0f} % of the pixels measured")
