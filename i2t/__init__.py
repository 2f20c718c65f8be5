"""i2t: imagine a touch before making it.

A surface and a pose become a depth patch; the patch and a skin become a touch; touches become a belief about the
object.

    import i2t

    mesh = i2t.make_object("hammer").mesh
    T_o_t = i2t.contact_pose(mesh, mesh.vertices[0])
    patch = i2t.render_patch(i2t.prepare_surface(mesh), T_o_t)

The names below are the public face: what a user types first, and every type that these functions take. Each is loaded
when it is first used, so importing this package imports no JAX and the hardware layer stays free of it. The second
tier, documented as well, is the packages `i2t.paper`, `i2t.simulation`, `i2t.prediction`, `i2t.recognition`,
`i2t.hardware`, `i2t.viz` and `i2t.skin_models`, which are loaded in the same way.
"""

import lazy_loader

from i2t._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
