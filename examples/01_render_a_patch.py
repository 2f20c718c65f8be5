"""Render a depth patch, the surface in front of the skin, from a mesh and a tool pose.

python examples/01_render_a_patch.py
"""

import numpy as np

import i2t


def main(out: str = "runs/patch.png") -> i2t.Patch:
    """Render the head of a hammer from above, draw the patch, and return it."""
    mesh = i2t.make_object("hammer").mesh  # or i2t.load_mesh("examples/data/mug.stl", "mm")
    highest = mesh.vertices[np.argmax(mesh.vertices[:, 2])]
    T_o_t = i2t.contact_pose(mesh, highest, normal=(0, 0, 1))  # tool z points into the object
    patch = i2t.render_patch(i2t.prepare_surface(mesh), T_o_t)

    inside = np.asarray(patch.depth) < 4e-3  # metres behind the nearest point, clipped to 4 mm
    print(f"{inside.mean():.0%} of the window shows a surface; its nearest point is at {1e3 * patch.nearest:.2f} mm")
    figure = i2t.viz.plot_patches(
        np.asarray(patch.depth)[None], ["hammer"], "Surface in front of the skin", simulated=True
    )
    print(f"figure: {i2t.viz.save_figure(figure, out)}")
    return patch


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
