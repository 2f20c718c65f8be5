"""Recognition of objects: predicted touches, the belief over objects and poses, and the next touch.

Each name is loaded when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)  # names of __init__.pyi
