"""Question: how near to a mesh's patches are those of a point cloud that was sampled from it?

    python -m experiments.clouds [--out DIR]

Points are sampled uniformly over three shapes, with and without noise along the normal, and covered with disks
(`i2t.objects.point_clouds.surface_from_points`) of the radius that `suggest_radius` gives for the cloud. Both surfaces
are rendered at the same random safe sites. `holes` is the share of pixels where the mesh shows a surface within 3 mm of
the nearest point and the disks show none within the reach; the other pixels of that kind give the median and the 95th
percentile of the absolute difference of heights, and `beyond` is the share of pixels that are empty on the mesh but not
on the disks, which reach over edges by up to their radius. Simulated; about half a minute on two cores.
"""

from typing import NamedTuple

import jax
import numpy as np
import trimesh

from experiments.clouds.arguments import CloudArgs
from experiments.common.runs import settings, write_json
from i2t.objects import Mesh, catalogue
from i2t.objects.point_clouds import suggest_radius, surface_from_points
from i2t.rendering.ops import element
from i2t.rendering.render import prepare_surface, render_patch, stack_surfaces
from i2t.simulation.sites import collect_sites
from i2t.types import REACH

MM_PER_M = 1e3
COMPARED_DEPTH_M = 3e-3  # behind the nearest point; what is deeper may leave the reach with that point's noise


class CloudRow(NamedTuple):
    """One cloud; lengths in millimetres."""

    shape: str
    points: int
    spacing: float
    noise: float
    radius: float
    median: float
    p95: float
    holes: float
    beyond: float


def run(args: CloudArgs) -> list[CloudRow]:
    """Measure every combination, print the table and write it down."""
    meshes = [catalogue.make_object(name).mesh for name in args.shapes]
    variants = [(spacing, noise) for spacing in args.spacings for noise in args.noises]
    clouds = [sample(mesh, *variant, args.seed) for mesh in meshes for variant in variants]
    radii = [suggest_radius(points) for points, _ in clouds]
    disks = [surface_from_points(points, radius, side) for (points, side), radius in zip(clouds, radii, strict=True)]
    surfaces = stack_surfaces([prepare_surface(mesh) for mesh in [*meshes, *disks]])  # one size class: one compilation
    look = jax.jit(jax.vmap(render_patch, (None, 0)))
    rows = []
    for i, (name, mesh) in enumerate(zip(args.shapes, meshes, strict=True)):
        poses = collect_sites(jax.random.key(args.seed + i), prepare_surface(mesh), args.sites, name=name)
        true = jax.device_get(look(element(surfaces, i), poses))
        for j, (spacing, noise) in enumerate(variants):
            k = i * len(variants) + j
            patches = jax.device_get(look(element(surfaces, len(meshes) + k), poses))
            cloud = len(clouds[k][0]), MM_PER_M * spacing, MM_PER_M * noise, MM_PER_M * radii[k]
            rows.append(CloudRow(name, *cloud, *compare(true, patches)))
    print(table(rows))
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        report = {"source": "simulated", "config": settings(args), "rows": [row._asdict() for row in rows]}
        write_json(args.out / "clouds.json", report)
    return rows


def sample(mesh: Mesh, spacing: float, noise: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals of a mesh, one to a square of this edge on average, moved along their normals."""
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, face = trimesh.sample.sample_surface(whole, int(whole.area / spacing**2), seed=seed)
    normals = whole.face_normals[face]
    return points + noise * np.random.default_rng(seed).normal(size=(len(points), 1)) * normals, normals


def compare(true, disks) -> tuple[float, float, float, float]:
    """Median and 95th percentile of the absolute difference of heights (mm), share of holes, share beyond edges."""
    heights, others = (patch.nearest[:, None, None] + patch.depth for patch in (true, disks))
    solid, empty = true.depth < COMPARED_DEPTH_M, true.depth >= REACH
    missing, covered = disks.depth >= REACH, disks.depth < COMPARED_DEPTH_M
    off = MM_PER_M * np.abs(heights - others)[solid & ~missing]
    return (
        float(np.median(off)),
        float(np.quantile(off, 0.95)),
        float(missing[solid].mean()),
        float(covered[empty].mean()) if empty.any() else 0.0,
    )


def table(rows: list[CloudRow]) -> str:
    """The rows as text."""
    lines = [f"{'shape':12s} {'points':>7s} spacing  noise radius  median    95 %   holes  beyond   (mm; simulated)"]
    lines += [
        f"{row.shape:12s} {row.points:7d} {row.spacing:7.2f} {row.noise:6.2f} {row.radius:6.2f} {row.median:7.3f}"
        f" {row.p95:7.3f} {row.holes:7.2%} {row.beyond:7.2%}"
        for row in rows
    ]
    return "\n".join(lines)
