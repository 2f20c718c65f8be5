"""Reference packages, imported here once because they warn on import, and warnings are errors in the tests."""

import warnings

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import ContactMechanics.Systems  # noqa: F401
    import magpylib  # noqa: F401
    import skfem.helpers  # noqa: F401
