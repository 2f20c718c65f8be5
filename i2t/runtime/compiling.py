"""Fewer programs to compile, and less time for those that take longer to compile than they run.

A configuration whose floats are traced (`traced_floats`) is an argument like an array: other sizes of an error or other
limits of a press run the program that was compiled before.

On a CPU, XLA's fusion emitters hand LLVM much code, and LLVM spends most of the time on optimising it. Without the
emitters and at LLVM's second level a session of simulated touches is compiled in half the time, and runs a tenth longer
(`python -m experiments.benchmark.programs` says what programs take). Other programs lose more: contact pressures
predicted from views and decisions where to touch take twice as long, registrations by touch three times. So it is
chosen for each program, and for some by how much there is to do.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from functools import cache, wraps
from typing import Any, TypeVar, get_type_hints

import jax
from jax.extend.core import get_opaque_trace_state

Config = TypeVar("Config")
_traced: set[type] = {float}  # types of fields, with the configurations themselves

QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}


def traced_floats(kind: type[Config]) -> type[Config]:
    """Make the floats of a configuration leaves of a tree, so that compiled functions trace them; a class decorator.

    Everything else is static: whole numbers, texts, truth values, grids, and floats that decide the shape of an array
    (`field(metadata={"static": True})`). Fields that are such configurations themselves belong to the tree. Outside
    compiled functions the floats stay Python's, so that configurations are compared, hashed and written as before.
    What JAX takes apart and puts together again is not checked by `__post_init__` a second time.

    Args:
        kind: A frozen dataclass.

    Returns:
        The same class.
    """
    hints = get_type_hints(kind)
    leaves: list[str] = []
    static: list[str] = []
    for field in fields(kind):  # type: ignore[arg-type]
        traced = hints[field.name] in _traced and not field.metadata.get("static")
        (leaves if traced else static).append(field.name)

    def flatten(config: Config) -> tuple[list[tuple[Any, Any]], tuple[Any, ...]]:
        children = [(jax.tree_util.GetAttrKey(name), getattr(config, name)) for name in leaves]
        return children, tuple(getattr(config, name) for name in static)

    def unflatten(rest: tuple[Any, ...], children: Iterable[Any]) -> Config:
        config = object.__new__(kind)
        for name, value in zip((*leaves, *static), (*children, *rest), strict=True):
            object.__setattr__(config, name, value)
        return config

    jax.tree_util.register_pytree_with_keys(kind, flatten, unflatten)
    _traced.add(kind)
    return kind


def jit_quickly(function: Callable[..., Any], *, static_argnames: str | tuple[str, ...] = ()) -> Callable[..., Any]:
    """`jax.jit` for a program that a process runs a few times. On other devices than CPUs, and while JAX traces another
    program, a batch or a derivative, it is `jax.jit`.

    Args:
        function: Pure.
        static_argnames: As of `jax.jit`.

    Returns:
        The compiled function.
    """
    usual = jax.jit(function, static_argnames=static_argnames)

    @cache
    def quick() -> Callable[..., Any]:
        return jax.jit(function, static_argnames=static_argnames, compiler_options=_options())

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        inside = get_opaque_trace_state() != _no_trace()  # where options of a compiler are refused
        return (usual if inside else quick())(*args, **named)

    call.compiler_options = _options  # type: ignore[attr-defined]  # for `i2t.runtime.batching`
    return call


def jit_by_amount(
    function: Callable[..., Any], few: int, *, static_argnames: str | tuple[str, ...] = ()
) -> Callable[[int], Callable[..., Any]]:
    """A program that is compiled quickly where there is little to do, and with all optimisations where there is much;
    last digits may differ between the two.

    Args:
        function: Pure.
        few: Largest amount of work for which compiling quickly pays.
        static_argnames: As of `jax.jit`.

    Returns:
        A function that takes the amount of work and returns the compiled function for it.
    """
    quick = jit_quickly(function, static_argnames=static_argnames)
    usual = jax.jit(function, static_argnames=static_argnames)
    return lambda amount: quick if amount <= few else usual


@cache
def _no_trace() -> Any:
    """JAX's state where nothing is traced, as a new thread has it."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(get_opaque_trace_state).result()


@cache
def _options() -> dict[str, Any] | None:
    """The options, where this version of XLA has them."""
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=QUICKLY).lower().compile()
    except jax.errors.JaxRuntimeError:
        return None
    return dict(QUICKLY)
