"""Objects to touch: procedural solids, and meshes from files. Imports no JAX.

Each name is loaded when it is first used: reading mesh files needs libraries that take seconds to import, and a command
that only asks which objects there are need not wait for them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
