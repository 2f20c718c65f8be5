"""Quickly compiled programs give the usual results everywhere, and floats of configurations are traced."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers.compilations import compilations

from i2t.runtime import compiling
from i2t.runtime.compiling import compiles_slowly, jit_quickly, traced_floats


def curve(x: jax.Array, power: int) -> jax.Array:
    return jnp.cumsum(jnp.sin(x)) ** power


QUICK = jit_quickly(curve, static_argnames="power")
X = jnp.linspace(0.0, 1.0, 50)


def test_quick_programs_equal_the_function_alone_nested_and_batched() -> None:
    np.testing.assert_allclose(QUICK(X, power=2), curve(X, 2), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(lambda x: 2 * QUICK(x, power=2))(X), 2 * curve(X, 2), rtol=1e-6)
    of_constant = jax.jit(lambda x: x + QUICK(np.asarray(X), power=2))  # of arguments that are numbers
    np.testing.assert_allclose(of_constant(X), X + curve(X, 2), rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(lambda x: QUICK(x, power=2))(X[None]), curve(X, 2)[None], rtol=1e-6)
    slope = jax.grad(lambda x: QUICK(x, power=2)[-1])(X)
    np.testing.assert_allclose(slope, 2 * curve(X, 1)[-1] * jnp.cos(X), rtol=1e-5)


def test_a_compiler_without_the_options_compiles_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(compiling.QUICK_OPTIONS, "xla_of_another_version", True)
    compiling._options.cache_clear()
    assert compiling._options() is None
    np.testing.assert_allclose(jit_quickly(curve, static_argnames="power")(X, power=3), curve(X, 3), rtol=1e-6)
    compiling._options.cache_clear()


@compiles_slowly("a sum", seconds=20)
def slow_sum(x: jax.Array) -> jax.Array:
    return x.sum()


class Timer:
    """Replacement of `threading.Timer` that the test rings."""

    def __init__(self, _: float, function: Callable[..., None], args: tuple[str]) -> None:
        self.ring, self.cancelled = partial(function, *args), False
        TIMERS.append(self)

    def start(self) -> None:
        """Begin to wait."""

    def cancel(self) -> None:
        """Note the request."""
        self.cancelled = True


TIMERS: list[Timer] = []


@pytest.fixture
def timers(monkeypatch: pytest.MonkeyPatch) -> list[Timer]:
    """The timers that are started in the test."""
    TIMERS.clear()
    monkeypatch.setattr(compiling.threading, "Timer", Timer)
    return TIMERS


def test_a_slow_compilation_is_announced_once_it_has_lasted_a_while(timers, caplog, monkeypatch) -> None:
    monkeypatch.setattr(compiling, "_slow_programs", dict(compiling._slow_programs))
    caplog.set_level("INFO", compiling.log.name)
    jax.jit(slow_sum)(X)
    (timer,) = timers  # of no other program
    assert timer.cancelled  # at the end
    timer.ring()
    assert caplog.messages == ["compiling a sum, about 20 s on two quiet cores, only the first time"]
    jax.jit(slow_sum)(X[1:])  # of another shape
    assert len(timers) == 1


def test_a_program_from_the_cache_is_not_announced(timers) -> None:
    jax.monitoring.record_scalar(compiling.COMPILE_EVENT, 0.0, fun_name="jit(slow_sum)")
    (timer,) = timers
    assert not timer.cancelled
    jax.monitoring.record_event(compiling.CACHE_HIT_EVENT)
    assert timer.cancelled


@traced_floats
@dataclass(frozen=True)
class Line:
    slope: float = 2.0
    copies: int = 1


@traced_floats
@dataclass(frozen=True)
class Drawing:
    line: Line = Line()
    offset: float = 0.5
    spacing: float = field(default=1.0, metadata={"static": True})

    def __post_init__(self) -> None:
        if not self.offset >= 0:
            raise ValueError(f"offset is {self.offset}")


@jax.jit
def draw(drawing: Drawing) -> jax.Array:
    line = replace(drawing.line, slope=2 * drawing.line.slope)
    x = np.arange(0.0, 3.0, drawing.spacing)
    return jnp.tile(line.slope * x + drawing.offset, line.copies)


def test_floats_of_a_configuration_are_traced_and_other_fields_static() -> None:
    np.testing.assert_array_equal(draw(Drawing()), [0.5, 4.5, 8.5])
    with compilations() as compiled:
        other = draw(Drawing(Line(-1.0), 1e-3))
    assert compiled == []
    np.testing.assert_allclose(other, [1e-3, 1e-3 - 2, 1e-3 - 4], rtol=1e-6)
    for static, shape in ((Drawing(Line(copies=2)), 6), (Drawing(spacing=0.5), 6)):
        with compilations() as compiled:
            assert draw(static).shape == (shape,)
        assert compiled == ["jit(draw)"]


def test_a_configuration_outside_compiled_programs_holds_plain_numbers() -> None:
    assert hash(Drawing()) == hash(Drawing(Line(2.0, 1)))
    assert jax.tree.leaves(Drawing()) == [2.0, 0.5]
    assert jax.tree.map(lambda leaf: -leaf, Drawing()).offset == -0.5
    with pytest.raises(ValueError, match=r"offset is -0\.5"):
        Drawing(offset=-0.5)
    paths = [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(Drawing())]
    assert paths == [".line.slope", ".offset"]
