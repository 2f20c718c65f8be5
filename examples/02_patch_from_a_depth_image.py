"""Extract the same patch from a depth image, the camera's intrinsics and two poses.

python examples/02_patch_from_a_depth_image.py
"""

import numpy as np

import i2t


def main() -> float:
    """View a star on a table from 104 mm above, extract a patch, and return its median error (m) against the mesh."""
    mesh = i2t.make_object("star").mesh
    camera = i2t.Camera(640, 360, fx=322.0, fy=322.0, cx=319.5, cy=179.5)
    point = np.array([12e-3, 4e-3, 30e-3])  # on the star's top
    T_w_t = i2t.contact_pose(mesh, point)
    T_w_c = T_w_t @ np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.104], [0, 0, 0, 1]])  # view along tool z

    # A real image comes from a driver or a file: i2t.depth.camera.read_depth. Metres, NaN or 0 in unmeasured pixels.
    triangles = np.concatenate([mesh.vertices[mesh.faces], i2t.simulation.table_triangles(np.eye(4))])
    image, _ = i2t.simulation.render_view(triangles, T_w_c, camera)
    seen = i2t.patch_from_depth(image.astype(np.float32), camera, T_w_c.astype(np.float32), T_w_t.astype(np.float32))

    exact = i2t.render_patch(i2t.prepare_surface(mesh), T_w_t)
    error = float(np.median(np.abs(np.asarray(seen.patch.depth - exact.depth))))
    print(f"{float(seen.valid_mask.mean()):.0%} of the pixels measured; median error {1e6 * error:.1f} um (simulated)")
    return error


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
