"""Shape from touches: one press to the surface that it met, many touches to the surface of an object."""

from i2t.reconstruction.library import build_library, sample_contacts
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PatchPosterior, PressModel, infer_patch
from i2t.reconstruction.press_models import predict_presses

__all__ = [
    "PatchLibrary",
    "PatchLikelihood",
    "PatchPosterior",
    "PressModel",
    "build_library",
    "infer_patch",
    "predict_presses",
    "sample_contacts",
]
