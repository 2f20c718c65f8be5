"""Simulated skins are pressed 400 times a second: what the compiler spends on fast code is earned back here."""

import jax
import pytest


@pytest.fixture(autouse=True)
def _optimised(monkeypatch):
    jax.config.update("jax_disable_most_optimizations", False)
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "0")
