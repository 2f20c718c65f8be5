"""Compile fewer programs, and compile rarely used programs with less optimisation.

The floats of a configuration are traced (`traced_floats`), so the configuration is an argument like an array: with
other sizes of an error or other limits of a press, the same compiled program runs.

On a CPU, XLA's fusion emitters hand much code to LLVM, which spends most of the compilation time on its optimisation.
Without these emitters and at LLVM's second level, a session of simulated touches is compiled in half the time and runs
a tenth longer (`python -m experiments.benchmark.programs` lists the times of programs). Other programs lose more:
contact pressures predicted from views and decisions where to touch take twice as long, registrations by touch three
times. The options are therefore chosen for each program, and for some by the amount of work.
"""

from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache, wraps
from typing import Any, TypeVar, get_type_hints

import jax
import numpy as np

Config = TypeVar("Config")
_traced: set[type] = {float}  # types of traced fields, including configurations

# XLA's options for programs that must compile quickly on a CPU: no fusion emitters, and LLVM's second level of
# optimisation
QUICK_OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}


def traced_floats(kind: type[Config]) -> type[Config]:
    """Make the floats of a configuration leaves of a tree, so that compiled functions trace them; a class decorator.

    Other fields are static: integers, strings, booleans, grids, and floats that determine the shape of an array
    (`field(metadata={"static": True})`). Fields that are such configurations themselves are part of the tree. Outside
    compiled functions the floats stay Python's, so that configurations are compared, hashed and written as before.
    `__post_init__` does not check a configuration again that JAX takes apart and rebuilds.

    Args:
        kind: A frozen dataclass.

    Returns:
        The same class, registered with JAX.
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
    """Compile a program quickly, with less optimisation, because a process runs it only a few times. On devices other
    than CPUs, and while JAX traces another program, a batch or a derivative, this is `jax.jit`.

    Args:
        function: A pure function.
        static_argnames: Names of static arguments, as for `jax.jit`.

    Returns:
        The compiled function.
    """
    usual = jax.jit(function, static_argnames=static_argnames)

    @cache
    def quick() -> Callable[..., Any]:
        return jax.jit(function, static_argnames=static_argnames, compiler_options=_options())

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        # Compiler options are refused while a program is traced, where all arrays are tracers, new ones too.
        arrays = jax.tree.leaves((jax.device_put(np.int32(0)), args, named))
        inside = any(isinstance(array, jax.core.Tracer) for array in arrays)
        return (usual if inside else quick())(*args, **named)

    call.compiler_options = _options  # type: ignore[attr-defined]  # for `i2t.runtime.batching`
    return call


def jit_by_amount(
    function: Callable[..., Any], few: int, *, static_argnames: str | tuple[str, ...] = ()
) -> Callable[[int], Callable[..., Any]]:
    """Compile a program quickly for little work, and with all optimisations for much work. The last digits of the two
    may differ.

    Args:
        function: A pure function.
        few: Largest amount of work for which quick compilation is worthwhile.
        static_argnames: Names of static arguments, as for `jax.jit`.

    Returns:
        A function that takes the amount of work and returns the compiled function for it.
    """
    quick = jit_quickly(function, static_argnames=static_argnames)
    usual = jax.jit(function, static_argnames=static_argnames)
    return lambda amount: quick if amount <= few else usual


@cache
def _options() -> dict[str, Any] | None:
    """Get the compiler options on a CPU, or None if this version of XLA does not have them."""
    if jax.default_backend() != "cpu":
        return None
    try:
        jax.jit(lambda: 0, compiler_options=QUICK_OPTIONS).lower().compile()
    except jax.errors.JaxRuntimeError:
        return None
    return dict(QUICK_OPTIONS)
