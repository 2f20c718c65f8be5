"""Programs that take longer to compile than they run, compiled with fewer optimisations.

On a CPU, XLA's fusion emitters hand LLVM much code, and LLVM spends most of the time on optimising it. Without the
emitters and at LLVM's first level a session of simulated touches is compiled in half the time, and runs 8 % longer
(`python -m experiments.benchmark.programs` says what programs take). Other programs lose more: predicted contact
pressures take 1.6 times as long, a decision where to touch 2.7 times. So it is chosen for each program.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, wraps
from typing import Any

import jax
from jax.extend.core import get_opaque_trace_state

QUICKLY = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}


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

    call.compiler_options = _options  # type: ignore[attr-defined]  # for `i2t.batching`
    return call


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
