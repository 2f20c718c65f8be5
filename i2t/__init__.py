"""i2t: imagine a touch before making it.

A surface and a pose become a depth patch; the patch and a skin become a touch; touches become a belief about the
object. Importing this package imports no JAX, so that the hardware layer stays free of it.
"""

from typing import TYPE_CHECKING, Any

from i2t._version import __version__ as __version__

if TYPE_CHECKING:
    from i2t.prediction.predictor import load_predictor as load_predictor


def __getattr__(name: str) -> Any:
    if name == "load_predictor":
        from i2t.prediction.predictor import load_predictor

        return load_predictor
    raise AttributeError(f"module 'i2t' has no attribute {name!r}")
