"""Objects to touch: procedural solids, and meshes from files. Imports no JAX.

Each name is loaded when it is first used: reading mesh files needs libraries that take seconds to import, and a command
that only asks which objects there are need not wait for them.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from i2t.objects.catalogue import NAMES as NAMES
    from i2t.objects.catalogue import PRIMITIVES as PRIMITIVES
    from i2t.objects.catalogue import STAMPS as STAMPS
    from i2t.objects.catalogue import TOOLS as TOOLS
    from i2t.objects.catalogue import make_object as make_object
    from i2t.objects.catalogue import random_object as random_object
    from i2t.objects.catalogue import surrogate_unknown as surrogate_unknown
    from i2t.objects.mesh_cleaning import CleaningReport as CleaningReport
    from i2t.objects.mesh_cleaning import clean_mesh as clean_mesh
    from i2t.objects.mesh_files import load_mesh as load_mesh
    from i2t.objects.mesh_files import load_object as load_object
    from i2t.objects.mesh_files import read_mesh as read_mesh
    from i2t.objects.poses import contact_pose as contact_pose
    from i2t.objects.solids import Mesh as Mesh
    from i2t.objects.solids import Object as Object
    from i2t.objects.solids import place_on_table as place_on_table
    from i2t.objects.solids import transform_mesh as transform_mesh

_HOMES = {
    "catalogue": (
        "NAMES", "PRIMITIVES", "STAMPS", "TOOLS", "make_object", "random_object", "surrogate_unknown",
    ),
    "mesh_cleaning": ("CleaningReport", "clean_mesh"),
    "mesh_files": ("load_mesh", "load_object", "read_mesh"),
    "poses": ("contact_pose",),
    "solids": ("Mesh", "Object", "place_on_table", "transform_mesh"),
}  # fmt: skip
_HOME_OF = {name: f"i2t.objects.{module}" for module, names in _HOMES.items() for name in names}

__all__ = [
    "NAMES", "PRIMITIVES", "STAMPS", "TOOLS", "CleaningReport", "Mesh", "Object", "clean_mesh", "contact_pose",
    "load_mesh", "load_object", "make_object", "place_on_table", "random_object", "read_mesh",
    "surrogate_unknown", "transform_mesh",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'i2t.objects' has no attribute {name!r}")
    found = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
