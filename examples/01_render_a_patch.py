"""View of the skin: a mesh and a tool pose become a depth patch.

python examples/01_render_a_patch.py
"""

import numpy as np

import i2t


def main(out: str = "runs/patch.png") -> i2t.Patch:
    """Render the hammer's head as the skin would meet it from above, draw it, and return the patch."""
    mesh = i2t.make_object("hammer").mesh  # or i2t.load_mesh("examples/data/mug.stl", "mm")
    highest = mesh.vertices[np.argmax(mesh.vertices[:, 2])]
    T_o_t = i2t.contact_pose(mesh, highest, normal=(0, 0, 1))  # tool z points into the object
    patch = i2t.render_patch(i2t.prepare_surface(mesh), T_o_t)

    inside = np.asarray(patch.depth) < 4e-3  # metres behind the nearest point, clipped to 4 mm
    print(f"{inside.mean():.0%} of the window shows a surface; it begins {1e3 * patch.nearest:.2f} mm from the skin")
    figure = i2t.viz.plot_patches(
        np.asarray(patch.depth)[None], ["hammer"], "What lies before the skin", simulated=True
    )
    print(f"drawn into {i2t.viz.save_figure(figure, out)}")
    return patch


if __name__ == "__main__":
    i2t.use_compile_cache()
    main()
