"""Programs that commands compile are cached, in a folder of bounded size that never causes a failure."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from i2t.runtime import compile_cache
from i2t.runtime.compile_cache import CACHE_VARIABLE, JAX_CACHE_VARIABLE, use_compile_cache

SETTINGS = (
    "TF_CPP_MIN_LOG_LEVEL",
    JAX_CACHE_VARIABLE,
    "JAX_COMPILATION_CACHE_MAX_SIZE",
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS",
)


@pytest.fixture
def no_settings(monkeypatch):
    """An environment without settings, in which JAX is not imported yet; it is restored after the test."""
    for name in (CACHE_VARIABLE, *SETTINGS):
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "jax")
    return monkeypatch


def test_the_folder_is_in_the_users_cache_and_bounded(no_settings, tmp_path):
    no_settings.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = use_compile_cache()
    assert folder is not None
    assert folder.is_relative_to(tmp_path / "i2t")
    assert os.environ[JAX_CACHE_VARIABLE] == str(folder)
    assert int(os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"]) == compile_cache.MAX_CACHE_BYTES


def test_the_cache_can_be_disabled_and_respects_settings_of_jax(no_settings, tmp_path):
    no_settings.setenv("XDG_CACHE_HOME", str(tmp_path))
    no_settings.setenv(CACHE_VARIABLE, "OFF")
    assert use_compile_cache() is None
    assert JAX_CACHE_VARIABLE not in os.environ
    assert not list(tmp_path.iterdir())
    no_settings.delenv(CACHE_VARIABLE)
    no_settings.setenv(JAX_CACHE_VARIABLE, str(tmp_path / "mine"))
    assert use_compile_cache() is None
    assert os.environ[JAX_CACHE_VARIABLE] == str(tmp_path / "mine")


def test_another_machine_has_a_folder_of_its_own(no_settings, tmp_path):
    no_settings.setenv(CACHE_VARIABLE, str(tmp_path))
    here = use_compile_cache()
    no_settings.delenv(JAX_CACHE_VARIABLE)
    no_settings.setattr(compile_cache.platform, "processor", lambda: "another")
    assert use_compile_cache() not in (here, None)


@pytest.mark.parametrize("asked", [True, False])
def test_a_folder_that_cannot_be_created_gives_at_most_one_line(no_settings, tmp_path, caplog, asked):
    """A file where the folder should be is refused for every user, including root."""
    (tmp_path / "file").write_text("")
    no_settings.setenv(CACHE_VARIABLE if asked else "XDG_CACHE_HOME", str(tmp_path / "file"))
    assert use_compile_cache() is None
    assert JAX_CACHE_VARIABLE not in os.environ
    assert len(caplog.messages) == asked
    assert not asked or CACHE_VARIABLE in caplog.text


def test_the_log_of_xla_is_hidden_unless_the_user_or_jax_has_set_its_level(no_settings, tmp_path):
    no_settings.setenv(CACHE_VARIABLE, str(tmp_path))
    use_compile_cache()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"
    no_settings.setenv("TF_CPP_MIN_LOG_LEVEL", "0")
    use_compile_cache()
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "0"


# XLA logs an error, as its alarm about a long compilation is one, because it cannot dump a program to this folder.
LOGGED = """
import os, sys
os.environ["XLA_FLAGS"] = "--xla_dump_to=/proc/nowhere"
from i2t.cli.exit_codes import exit_code_of
def work():
    import jax, jax.numpy as jnp
    print(jax.jit(lambda x: x + 1)(1))
    try:
        jnp.zeros(2**60, jnp.int8).block_until_ready()
    except jax.errors.JaxRuntimeError as error:
        print(error)
sys.exit(exit_code_of(work))
"""


@pytest.mark.full
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs a folder that nobody can write to")
@pytest.mark.parametrize("level", [None, "2"])
def test_errors_in_the_log_of_xla_are_hidden_but_its_exceptions_are_not(tmp_path, level):
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("JAX_", "TF_", "XLA_"))}
    environment |= {CACHE_VARIABLE: str(tmp_path)} | ({} if level is None else {"TF_CPP_MIN_LOG_LEVEL": level})
    process = subprocess.run([sys.executable, "-c", LOGGED], env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert process.stdout.startswith("2\n")
    assert "RESOURCE_EXHAUSTED" in process.stdout
    assert ("dump.cc" in process.stderr) == (level == "2")
    assert level == "2" or process.stderr == ""


PROGRAM = """
import sys
from i2t.cli.exit_codes import exit_code_of
def work():
    import jax, jax.numpy as jnp
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    {spoil}
    print(jax.jit(lambda x: jnp.sin(x) @ x)(jnp.eye(3))[0, 0])
sys.exit(exit_code_of(work))
"""


def _run(folder: Path, spoil: str = "") -> subprocess.CompletedProcess:
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-W", "always", "-c", PROGRAM.format(spoil=spoil or "pass")]
    return subprocess.run(command, env=environment | {CACHE_VARIABLE: str(folder)}, capture_output=True, text=True)


def _kept(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*-cache"))


@pytest.mark.full
def test_a_second_process_finds_what_the_first_compiled(tmp_path):
    first = _run(tmp_path)
    assert first.returncode == 0, first.stderr
    kept = _kept(tmp_path)
    count = "jax.monitoring.register_event_listener(lambda name, **_: print(name) if 'cache_hits' in name else None)"
    second = _run(tmp_path, count)
    assert "/jax/compilation_cache/cache_hits" in second.stdout, second.stderr
    assert _kept(tmp_path) == kept != []


@pytest.mark.full
def test_a_disk_that_fills_up_later_causes_no_warning(tmp_path):
    """The folder is gone and cannot be created again when JAX writes to it."""
    spoil = (
        "import os, shutil, pathlib; f = pathlib.Path(os.environ['JAX_COMPILATION_CACHE_DIR']); "
        "jax.jit(lambda x: x + 1)(1.0); shutil.rmtree(f); f.write_text('')"
    )
    process = _run(tmp_path, spoil)
    assert process.returncode == 0, process.stderr
    assert "cache" not in process.stderr
