"""Shape from touches: one press to the surface that it met, many touches to the surface of an object."""

from i2t.reconstruction.library import build_library, sample_contacts
from i2t.reconstruction.local_shape import PatchLibrary, PatchLikelihood, PatchPosterior, PressModel, infer_patch
from i2t.reconstruction.press_curves import simulate_press_curve
from i2t.reconstruction.press_models import imagine_presses
from i2t.reconstruction.tip import TipModel, TipPosterior, imagine_tip, infer_tip

__all__ = [
    "PatchLibrary",
    "PatchLikelihood",
    "PatchPosterior",
    "PressModel",
    "TipModel",
    "TipPosterior",
    "build_library",
    "imagine_presses",
    "imagine_tip",
    "infer_patch",
    "infer_tip",
    "sample_contacts",
    "simulate_press_curve",
]
