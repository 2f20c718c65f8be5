"""Shape from touches: the surface met at one press, as a posterior over local surfaces.

Names are imported when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from i2t.reconstruction.library import build_library as build_library
    from i2t.reconstruction.library import load_library as load_library
    from i2t.reconstruction.library import sample_contacts as sample_contacts
    from i2t.reconstruction.library import save_library as save_library
    from i2t.reconstruction.local_shape import CONTACT_CLASSES as CONTACT_CLASSES
    from i2t.reconstruction.local_shape import PatchLibrary as PatchLibrary
    from i2t.reconstruction.local_shape import PatchLikelihood as PatchLikelihood
    from i2t.reconstruction.local_shape import PatchPosterior as PatchPosterior
    from i2t.reconstruction.local_shape import PressModel as PressModel
    from i2t.reconstruction.local_shape import infer_patch as infer_patch
    from i2t.reconstruction.press_curves import simulate_press_curve as simulate_press_curve
    from i2t.reconstruction.press_models import imagine_presses as imagine_presses
    from i2t.reconstruction.press_models import model_presses as model_presses
    from i2t.reconstruction.tip import TipModel as TipModel
    from i2t.reconstruction.tip import TipPosterior as TipPosterior
    from i2t.reconstruction.tip import imagine_tip as imagine_tip
    from i2t.reconstruction.tip import infer_tip as infer_tip

_MODULES = {
    "library": ("build_library", "load_library", "sample_contacts", "save_library"),
    "local_shape": (
        "CONTACT_CLASSES",
        "PatchLibrary",
        "PatchLikelihood",
        "PatchPosterior",
        "PressModel",
        "infer_patch",
    ),
    "press_curves": ("simulate_press_curve",),
    "press_models": ("imagine_presses", "model_presses"),
    "tip": ("TipModel", "TipPosterior", "imagine_tip", "infer_tip"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name in _MODULE_OF:
        return getattr(import_module(f"i2t.reconstruction.{_MODULE_OF[name]}"), name)
    raise AttributeError(f"module 'i2t.reconstruction' has no attribute {name!r}")
