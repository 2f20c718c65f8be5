"""Compile fewer programs, and compile rarely used programs with less optimisation.

The floats of a configuration are traced (`traced_floats`), so the configuration is an argument like an array: with
other sizes of an error or other limits of a press, the same compiled program runs.

On a CPU, XLA's fusion emitters hand much code to LLVM, which spends most of the compilation time on its optimisation.
Without these emitters and at LLVM's second level, a session of simulated touches is compiled in half the time and runs
a tenth longer (`python -m experiments.benchmark.programs` lists the times of programs). Other programs lose more:
contact pressures predicted from views and decisions where to touch take twice as long, registrations by touch three
times. The options are therefore chosen for each program, and for some by the amount of work.

A program that compiles slowly all the same is announced (`compiles_slowly`), unless it comes from the cache of compiled
programs. Commands show the announcement, which is logged.
"""

import logging
import threading
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache, wraps
from typing import Any, TypeVar, get_type_hints

import jax
import numpy as np

log = logging.getLogger(__name__)

Config = TypeVar("Config")
Function = TypeVar("Function", bound=Callable[..., Any])
_traced: set[type] = {float}  # types of traced fields, including configurations

# XLA's options for programs that must compile quickly on a CPU: no fusion emitters, and LLVM's second level of
# optimisation
QUICK_OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}

# Events of `jax.monitoring`. JAX records a scalar when it begins to compile a program and a duration at the end, and
# another event in between if the program comes from the cache.
COMPILE_EVENT, CACHE_HIT_EVENT = "/jax/core/compile/backend_compile_duration", "/jax/compilation_cache/cache_hits"
_slow_programs: dict[str, tuple[str, float]] = {}  # purpose and duration (s) of slow compilations, by function name
_announcements: dict[int, threading.Timer] = {}  # of the compilations under way, by thread


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


def compiles_slowly(purpose: str, *, seconds: float) -> Callable[[Function], Function]:
    """Announce that a function is being compiled and how long that takes, unless it comes from the cache; a decorator.

    Args:
        purpose: What the function is for, such as "the simulation of touches".
        seconds: Measured duration of the compilation in s, on two cores without other load.

    Returns:
        A decorator that returns the function unchanged.
    """

    def register(function: Function) -> Function:
        _slow_programs[function.__name__] = purpose, seconds
        return function

    return register


def _announce(name: str) -> None:
    """Announce a compilation; those of the same function for other shapes are not announced any more."""
    purpose, seconds = _slow_programs.pop(name, ("", 0.0))
    if not purpose:  # announced meanwhile, in another thread
        return
    duration = f", about {seconds:g} s on two quiet cores" if jax.default_backend() == "cpu" else ""
    once = ", only the first time" if jax.config.values["jax_compilation_cache_dir"] else ""
    log.info("compiling %s%s%s", purpose, duration, once)


def _on_begin(event: str, value: float, **about: Any) -> None:
    name = str(about.get("fun_name")).removeprefix("jit(").removesuffix(")")
    if event == COMPILE_EVENT and name in _slow_programs:
        timer = threading.Timer(1.0, _announce, (name,))  # s; reading a program from the cache takes less
        timer.daemon = True
        _announcements[threading.get_ident()] = timer
        timer.start()


def _on_end(event: str, *_: float, **__: Any) -> None:
    if event in (COMPILE_EVENT, CACHE_HIT_EVENT):
        timer = _announcements.pop(threading.get_ident(), None)
        if timer is not None:
            timer.cancel()


jax.monitoring.register_scalar_listener(_on_begin)
jax.monitoring.register_event_listener(_on_end)
jax.monitoring.register_event_duration_secs_listener(_on_end)


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
