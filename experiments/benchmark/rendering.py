"""Section `rendering` of the benchmark: depth patches against the ray casters Open3D and embreex, both based on Embree.

The input is a batch of poses and the output is depth, with the scene built beforehand; Open3D is also timed with rays
computed beforehand. Poses are contact frames over the whole mesh, rotated about their normals at random.
"""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

from experiments.benchmark.contests import Contest, Work
from i2t.geometry import contact_frame
from i2t.objects import catalogue
from i2t.patches.dimensions import PATCH_PIXELS, PATCH_WINDOW, REACH, STANDOFF
from i2t.rendering.render import prepare_surface, render_patch
from i2t.simulation import sites
from i2t.types import Surface

BYTES_PER_GB = 1e9
SPHERES = (1, 3, 5, 6)  # subdivisions of an icosahedron
SHAPES = ("hexagon", "star", "flower", "cylinder", "hammer", "screwdriver", "spanner", "scissors")


def rendering(small: bool) -> Iterator[Contest]:
    """Compare meshes, then batch sizes on one sphere, then memory on the largest sphere."""
    spheres, shapes, batch = ((1,), ("star",), 4) if small else (SPHERES, SHAPES, 256)
    meshes = {f"sphere of {20 * 4**k} faces": trimesh.creation.icosphere(k, 0.03) for k in spheres}
    meshes |= {
        f"{name}, {len(mesh.faces)} faces": mesh for name in shapes if (mesh := catalogue.make_object(name).mesh)
    }
    for name, mesh in meshes.items():
        yield from contests(name, mesh, batch)
    names = list(meshes)
    middle, last = names[max(len(spheres) - 2, 0)], names[len(spheres) - 1]
    for size in (1,) if small else (1, 16, 1024, 4096):
        yield from contests(middle, meshes[middle], size)
    yield memory(last, meshes[last], 8 if small else 4096)


def contests(name: str, mesh: Any, batch: int) -> Iterator[Contest]:
    """Compare one mesh and batch size with every peer."""
    surface = jax.tree.map(jnp.asarray, prepare_surface(mesh))
    poses = random_poses(surface, batch)
    render = jax.jit(jax.vmap(render_patch, (None, 0)))
    open3d, embreex = open3d_caster(mesh), embreex_caster(mesh)
    rays = rays_of(poses)
    seen = jax.device_get(render(surface, poses))
    for peer, cast in (("Open3D", open3d), ("embreex", embreex)):
        check(name, peer, seen.depth, seen.nearest, cast(rays).reshape(batch, PATCH_PIXELS, PATCH_PIXELS))
    peers: dict[str, Work] = {
        "Open3D": lambda: open3d(rays_of(poses)),
        "embreex": lambda: embreex(rays_of(poses)),
        "Open3D, rays given": lambda: open3d(rays),
    }
    for peer, work in peers.items():
        yield Contest(
            f"{name}, batch of {batch}", lambda: jax.block_until_ready(render(surface, poses)), peer, work,
            unit="s a batch", steady=0.3,
        )  # fmt: skip


def random_poses(surface: Surface, count: int) -> np.ndarray:
    """Contact frames (count, 4, 4), uniform over the area."""
    key_points, key_spin = jax.random.split(jax.random.key(0))
    points, normals = sites.sample_points(key_points, surface, count)
    spins = jax.random.uniform(key_spin, (count,), maxval=2 * jnp.pi)
    return np.asarray(jax.jit(jax.vmap(contact_frame))(points, normals, spins))


def rays_of(poses: np.ndarray) -> np.ndarray:
    """Origins and directions (poses x pixels, 6) of the patches' rays."""
    at = ((np.arange(PATCH_PIXELS, dtype=np.float32) + 0.5) / PATCH_PIXELS - 0.5) * np.float32(PATCH_WINDOW)
    x, y = np.meshgrid(at, at)
    start = np.stack([x.ravel(), y.ravel(), np.full(x.size, -STANDOFF, np.float32), np.ones(x.size, np.float32)])
    rays = np.empty((len(poses), x.size, 6), np.float32)
    rays[..., :3] = (poses[:, :3].astype(np.float32) @ start).swapaxes(1, 2)
    rays[..., 3:] = poses[:, None, :3, 2]
    return rays.reshape(-1, 6)


def open3d_caster(mesh: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Make a function from rays (n, 6) to distances (n,) with Open3D."""
    try:
        import open3d
    except (ImportError, OSError) as error:  # the package is installed, but a system library is missing
        raise ValueError("Open3D cannot be loaded; install the system packages libusb-1.0-0 and libgl1") from error
    scene = open3d.t.geometry.RaycastingScene()
    tensor: Any = open3d.core.Tensor
    vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
    scene.add_triangles(tensor(vertices), tensor(faces))
    return lambda rays: scene.cast_rays(tensor.from_numpy(rays))["t_hit"].numpy()


def embreex_caster(mesh: Any) -> Callable[[np.ndarray], np.ndarray]:
    """Make a function from rays (n, 6) to distances (n,) with embreex, which trimesh uses."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.asarray(mesh.vertices, np.float32)[np.asarray(mesh.faces)])

    def cast(rays: np.ndarray) -> np.ndarray:
        distance = scene.run(np.ascontiguousarray(rays[:, :3]), np.ascontiguousarray(rays[:, 3:]), query="DISTANCE")
        return np.where(distance < 1e30, distance, np.inf)

    return cast


def check(name: str, peer: str, depth: np.ndarray, nearest: np.ndarray, distance: np.ndarray) -> None:
    """Raise `ValueError` if patches differ from those computed from the peer's distances (n, 48, 48).

    One pixel in 10 000 may differ, because rays within rounding of an edge may pass on either side.
    """
    heights = distance - STANDOFF
    least = heights.min((1, 2), keepdims=True)
    theirs = np.where(np.isfinite(least), np.minimum(heights - np.where(np.isfinite(least), least, 0), REACH), REACH)
    ours = np.where(np.isfinite(nearest)[:, None, None], depth, REACH)
    different = np.mean(np.abs(theirs - ours) > 1e-5)
    if different > 1e-4:
        raise ValueError(f"{name}: {different:.2%} of the pixels differ from {peer}'s by more than 0.01 mm")


def memory(name: str, mesh: Any, batch: int) -> Contest:
    """Compare the temporary and output memory of a batch with the rays and distances of a ray caster."""

    def ours() -> float:
        surface = prepare_surface(mesh)
        shapes = jax.tree.map(lambda field: jax.ShapeDtypeStruct(field.shape, field.dtype), surface)
        poses = jax.ShapeDtypeStruct((batch, 4, 4), jnp.float32)
        plan = jax.jit(jax.vmap(render_patch, (None, 0))).lower(shapes, poses).compile().memory_analysis()
        assert plan is not None  # available from XLA on CPU and GPU
        return float(plan.temp_size_in_bytes + plan.output_size_in_bytes) / BYTES_PER_GB

    theirs = batch * PATCH_PIXELS**2 * 7 * 4 / BYTES_PER_GB
    work = f"{name}, batch of {batch}"
    return Contest(work, ours, "rays and distances", lambda: theirs, unit="GB", measured=True)
