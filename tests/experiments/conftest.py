"""What the tests of experiments share."""

import pytest

from experiments.recognize import trained_run as loader


@pytest.fixture(scope="session")
def pad_models_fitted_once():
    """All commands fit the same pad model to the same touches: once for each world is enough."""
    known, load = {}, loader.load_trained_run

    def load_trained_run(key, folder, errors, limits):
        world = str(folder), errors, limits
        if world not in known:
            known[world] = load(key, folder, errors, limits)
        return known[world]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loader, "load_trained_run", load_trained_run)
        yield
