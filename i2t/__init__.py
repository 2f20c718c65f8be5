"""i2t: imagine a touch before making it.

A surface and a pose become a depth patch; the patch and a skin become a touch; touches become a belief about the
object.

    import i2t

    mesh = i2t.make_object("hammer").mesh
    T_o_t = i2t.contact_pose(mesh, mesh.vertices[0])
    patch = i2t.render_patch(i2t.prepare_surface(mesh), T_o_t)

The names below are the public face. Each is loaded when it is first used, so importing this package imports no JAX and
the hardware layer stays free of it. The second tier, documented as well, is `i2t.recognition`, `i2t.hardware`,
`i2t.viz` and `i2t.skin_models`.
"""

import importlib
from typing import TYPE_CHECKING, Any

from i2t._version import __version__ as __version__

if TYPE_CHECKING:
    from i2t.dataset.sets import Dataset
    from i2t.dataset.store import load_dataset, save_dataset
    from i2t.depth.camera import Camera
    from i2t.depth.patches import patch_from_depth
    from i2t.depth.pixel_pose import pose_at_pixel
    from i2t.errors import DataError, DeviceError, I2TError
    from i2t.objects.catalogue import make_object
    from i2t.objects.mesh_files import load_mesh
    from i2t.objects.poses import contact_pose
    from i2t.objects.solids import Mesh
    from i2t.prediction.predictor import Predictor, Reading, load_predictor
    from i2t.recognition.pad_model_files import load_pad_model
    from i2t.recognition.recognizer import ObjectRecognizer
    from i2t.registration.depth import register_by_depth
    from i2t.registration.estimate import PoseEstimate
    from i2t.registration.touch import register_by_touch
    from i2t.rendering.render import prepare_surface, render_patch
    from i2t.runtime.compile_cache import use_compile_cache
    from i2t.simulation.sites import sample_touch_sites
    from i2t.simulation.touches import simulate_touches
    from i2t.skin.boards import anyskin_board, reskin_board
    from i2t.skin.files import load_pad, save_pad
    from i2t.skin.pad import nominal_pad, press, sample_pad
    from i2t.skin_models.calibration import calibrate, load_calibration
    from i2t.types import Board, Pad, Patch, Surface, Touches

_HOMES = {
    "skin_models.calibration": ("calibrate", "load_calibration"),
    "runtime.compile_cache": ("use_compile_cache",),
    "dataset.sets": ("Dataset",),
    "dataset.store": ("load_dataset", "save_dataset"),
    "depth.camera": ("Camera",),
    "depth.patches": ("patch_from_depth",),
    "depth.pixel_pose": ("pose_at_pixel",),
    "errors": ("DataError", "DeviceError", "I2TError"),
    "objects.catalogue": ("make_object",),
    "objects.poses": ("contact_pose",),
    "objects.mesh_files": ("load_mesh",),
    "objects.solids": ("Mesh",),
    "prediction.predictor": ("Predictor", "Reading", "load_predictor"),
    "recognition.pad_model_files": ("load_pad_model",),
    "recognition.recognizer": ("ObjectRecognizer",),
    "registration.depth": ("register_by_depth",),
    "registration.estimate": ("PoseEstimate",),
    "registration.touch": ("register_by_touch",),
    "rendering.render": ("prepare_surface", "render_patch"),
    "simulation.sites": ("sample_touch_sites",),
    "simulation.touches": ("simulate_touches",),
    "skin.boards": ("anyskin_board", "reskin_board"),
    "skin.files": ("load_pad", "save_pad"),
    "skin.pad": ("nominal_pad", "press", "sample_pad"),
    "types": ("Board", "Pad", "Patch", "Surface", "Touches"),
}
_HOME_OF = {name: f"i2t.{module}" for module, names in _HOMES.items() for name in names}

__all__ = [
    "Board", "Camera", "DataError", "Dataset", "DeviceError", "I2TError", "Mesh", "ObjectRecognizer", "Pad", "Patch",
    "PoseEstimate", "Predictor", "Reading", "Surface", "Touches", "anyskin_board", "calibrate", "contact_pose",
    "load_calibration", "load_dataset", "load_mesh", "load_pad", "load_pad_model", "load_predictor", "make_object",
    "nominal_pad", "patch_from_depth", "pose_at_pixel", "prepare_surface", "press", "register_by_depth",
    "register_by_touch", "render_patch", "reskin_board", "sample_pad", "sample_touch_sites", "save_dataset", "save_pad",
    "simulate_touches", "use_compile_cache",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'i2t' has no attribute {name!r}")
    found = getattr(importlib.import_module(_HOME_OF[name]), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
