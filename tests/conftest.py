"""One place for what every test assumes: 64-bit off, ranks never promoted silently, keys never reused, shapes checked
at run time.
"""

import os
import subprocess
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as `experiments` has it

# What one worker, or a command that a test starts, has compiled need not be compiled by the next. The size is bounded
# because only then does JAX lock the folder, and workers share it.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "compiled"))
os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(4 * 2**30))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

import jax
import pytest
from filelock import FileLock
from helpers.debug_run import COMMAND
from xdist.scheduler import LoadFileScheduling

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)


MAPS = Path("/proc/self/maps")
# Tests compile much and compute little: most optimisations cost more than they earn. Without the fusion emitters a
# program of many operations compiles in half the time, and two workers leave no processor for compiling it in parts.
COMPILATION = (
    "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 --xla_backend_optimization_level=1"
)
# These fit pad models, whose registrations are eight times slower without optimisation.
COMPUTING = ("test_recognize.py", "test_constants.py", "test_magnetization.py", "test_calibrate.py")
# Longest first, so that no worker is left with one of them at the end. The second needs no trained run, which the first
# makes meanwhile.
SLOW = ("test_recognize.py", "test_batching.py", "test_examples.py", "test_train.py")


class OneFileOneWorker(LoadFileScheduling):
    """One worker for all tests of a file, which share what they make and compile."""

    def remove_node(self, node):
        """Of a worker that crashed, all tests go on but the one that crashed it. (xdist 3.8 gives that one to the next
        worker as well, and waits for ever.)
        """
        units = self.assigned_work[node]
        crashed = next((test for unit in units.values() for test, done in unit.items() if not done), None)
        if crashed:
            units[self._split_scope(crashed)][crashed] = True
        for scope in [scope for scope, unit in units.items() if all(unit.values())]:
            del units[scope]
        super().remove_node(node)
        return crashed


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Files in the order in which they are collected (`SLOW` first)."""
    config.option.loadscopereorder = False
    return OneFileOneWorker(config, log)


def pytest_addoption(parser):
    """The tier of tests."""
    parser.addoption("--full", action="store_true", help="run the full tier too: long sweeps, statistics and kills")


def pytest_configure(config):
    """The compiler's options, before anything is compiled here or in a command that a test starts."""
    os.environ.setdefault("XLA_FLAGS", COMPILATION)


def pytest_collection_modifyitems(config, items):
    """Select the fast tier unless the full one is requested, and put the slow files first."""
    if not (config.option.full or config.option.markexpr or config.option.keyword or _named(config)):
        full = [item for item in items if item.get_closest_marker("full")]
        if full:
            config.hook.pytest_deselected(items=full)
            items[:] = [item for item in items if not item.get_closest_marker("full")]
    items.sort(key=lambda item: SLOW.index(item.path.name) if item.path.name in SLOW else len(SLOW))


def _named(config) -> bool:
    """Whether single tests were requested by their names."""
    return any("::" in arg for arg in config.args)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Most of the compiler's optimisations or not, here and in commands that a test starts."""
    cheap = item.path.name not in COMPUTING
    jax.config.update("jax_disable_most_optimizations", cheap)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(cheap))


def pytest_runtest_teardown(item, nextitem):
    """Forgets what was compiled before it exhausts the memory maps that one process may have (65 530 on Linux), where
    the compiler crashes: between modules, and within one after tests that may compile whole commands. One module needs
    up to 15 000; until then the next module uses what this one compiled.
    """
    last = nextitem is None or nextitem.path != item.path
    most = 30_000 if last else 45_000
    if (last or item.get_closest_marker("full")) and (not MAPS.exists() or MAPS.read_bytes().count(b"\n") > most):
        jax.clear_caches()


@pytest.fixture(scope="session")
def trained_run(tmp_path_factory) -> Path:
    """A finished run of `experiments.train` (`helpers.debug_run`), one for all workers. A process of its own makes it:
    within this one the compiler sees other programs, and the last digits differ from those of a command.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    out = folder / "trained" / "debug"
    words = [*COMMAND, "--out", str(out)]
    environment = {**os.environ, "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "MPLBACKEND": "agg"}
    out.parent.mkdir(exist_ok=True)
    with FileLock(folder / "trained.lock"):
        if not (out / "metrics.json").exists():
            done = subprocess.run(
                words, cwd=Path(__file__).parents[1], env=environment, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real recordings, meshes and depth images, which are not part of the project."""
    folder = Path(os.environ.get("I2T_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real data not found at {folder}; set I2T_DATA to its folder")
    return folder
