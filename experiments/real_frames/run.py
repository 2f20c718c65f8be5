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

from typing import Any

import numpy as np

from experiments.common.intervals import with_interval
from experiments.common.runs import begin, write_json
from experiments.real_frames.arguments import RealFrames
from experiments.real_frames.figures import figure, figure_f200
from experiments.real_frames.frames import FRAMES, OBJECTS, compare, draw_sites, f200_patches, frames, summary
from i2t import viz
from i2t.objects import read_mesh
from i2t.rendering.render import prepare_surface


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


def show_f200(cfg: RealFrames, name: str) -> dict[str, Any]:
    """Patches of a frame without poses: drawn, and how much of them was seen."""
    depth, pixels, patches = f200_patches(cfg, name)
    viz.save_figure(figure_f200(name, depth, pixels, patches), cfg.out / f"f200_{name}.png")
    return {
        "measured": float(np.isfinite(depth).mean()),
        "depth_quartiles_m": [float(q) for q in np.nanpercentile(depth, [25, 50, 75])],
        "seen": [float(share) for share in patches.valid_mask.mean((1, 2))],
        "filled": [float(share) for share in patches.inpainted_mask.mean((1, 2))],
        "relief_mm": [1e3 * float(np.ptp(np.percentile(d[s], [5, 95]))) if s.any() else None
                      for d, s in zip(patches.patch.depth, patches.valid_mask, strict=True)],
    }  # fmt: skip


def report(metrics: dict[str, Any]) -> None:
    """The table a person reads."""
    print("real against imagined patches, each patch's bias taken off; 95 % interval over sites; mm")
    print(
        f"{'object':18}{'window':>8}{'patches':>9}{'median |d|':>22}{'IQR':>7}{'bias':>22}{'> 5 mm':>8}{'compared':>10}"
    )
    for name, windows in metrics["objects"].items():
        for window, values in windows.items():
            median = with_interval(values["median_absolute_mm"], *values["interval_95_mm"], digits=2)
            first, third = values["bias_quartiles_mm"]
            bias = f"{values['bias_median_mm']:+.2f} ({first:+.2f}, {third:+.2f})"
            print(
                f"{name:18}{window:>8}{values['patches']:>9}{median:>22}{values['interquartile_range_mm']:7.2f}{bias:>22}"
                f"{100 * values['over_5_mm']:7.1f}%{100 * values['compared']:9.0f}%"
            )
    for name, values in metrics["f200"].items():
        seen = ", ".join(f"{100 * share:.0f}" for share in values["seen"])
        print(f"F200 {name}: {100 * values['measured']:.0f} % of the image measured; seen of the patches: {seen} %")
