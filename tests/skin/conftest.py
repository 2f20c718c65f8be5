"""The packages that skins are compared with, imported once: they warn when they are, and warnings are errors."""

import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import ContactMechanics.Systems  # noqa: F401
    import magpylib  # noqa: F401
    import skfem.helpers  # noqa: F401
