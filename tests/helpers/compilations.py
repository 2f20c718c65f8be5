"""Programs that XLA compiles, or reads from the cache on disk, while something runs."""

from collections.abc import Iterator
from contextlib import contextmanager

import jax

_programs: list[str] = []


def _note(event: str, duration_secs: float, **about: str | int) -> None:
    if event == "/jax/core/compile/backend_compile_duration":
        _programs.append(str(about.get("fun_name")))


jax.monitoring.register_event_duration_secs_listener(_note)


@contextmanager
def compilations() -> Iterator[list[str]]:
    """Names of the programs compiled in the block, in a list that is filled at its end."""
    before, names = len(_programs), []
    yield names
    names += _programs[before:]
