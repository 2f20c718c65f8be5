"""Objects to touch: procedural solids, and meshes from files. This package imports no JAX.

Each name is loaded when it is first used. The libraries that read mesh files take seconds to import, and a command that
only lists the objects need not wait for them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
