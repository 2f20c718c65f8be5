"""Cache of compiled programs in the user's folder, so that the next command does not have to compile them again.

Commands call `use_compile_cache` before they begin (`i2t.cli.exit_codes.exit_code_of`); other programs may do so too.
The environment variable `I2T_COMPILE_CACHE` changes the default: `off` disables the cache, and a path names another
folder. If JAX's own `JAX_COMPILATION_CACHE_DIR` is set, it is respected. The size of the folder is bounded, and the
least recently used programs are deleted first. Its name includes the processor, because home folders are shared between
machines and compiled code is not. A folder that cannot be written to, or a full disk, only costs compilation time.

XLA reports compilations of more than two minutes, which a busy computer needs, as errors in its log, with the advice to
file a bug. `use_compile_cache` therefore hides this log unless `TF_CPP_MIN_LOG_LEVEL` is set. XLA's failures are raised
as exceptions all the same. This module does not import JAX.
"""

import hashlib
import importlib.util
import logging
import os
import platform
import sys
import tempfile
import warnings
from pathlib import Path

log = logging.getLogger(__name__)

# environment variable with the folder of i2t's compile cache; off disables the cache
CACHE_VARIABLE = "I2T_COMPILE_CACHE"
JAX_CACHE_VARIABLE = "JAX_COMPILATION_CACHE_DIR"  # environment variable with JAX's own choice of the folder
# bytes, size of one processor's cache folder beyond which JAX deletes the least recently used programs; small, because
# JAX scans the folder whenever it stores a program
MAX_CACHE_BYTES = 2**28


def use_compile_cache() -> Path | None:
    """Let JAX cache compiled programs from now on, in this process and in those that it starts.

    If JAX is not imported yet, it also hides XLA's alarm about long compilations.

    Returns:
        The cache's folder. None if nothing is cached because the cache is off, its folder cannot be written to or the
        package filelock is missing, or if JAX's own cache is set.

    Example:
        i2t.use_compile_cache()
    """
    if "jax" not in sys.modules:  # jaxlib reads the lowest level that XLA's log shows once
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # only fatal errors
    requested = os.environ.get(CACHE_VARIABLE, "")
    if requested.lower() in ("off", "0", "no", "false") or os.environ.get(JAX_CACHE_VARIABLE):
        return None
    if importlib.util.find_spec("filelock") is None:  # JAX needs it to bound the folder
        return None
    folder = (Path(requested).expanduser() if requested else _user_cache() / "i2t" / "compiled") / _processor()
    if not _writable(folder):
        if requested:
            log.warning("warning: %s %s: cannot write to this folder; the cache is off", CACHE_VARIABLE, requested)
        return None
    _configure(folder)
    return folder


def _configure(folder: Path) -> None:
    """Configure JAX, imported already or not, except for settings that the user has made."""
    settings = {
        JAX_CACHE_VARIABLE: str(folder),
        "JAX_COMPILATION_CACHE_MAX_SIZE": MAX_CACHE_BYTES,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0.02,
    }
    # If the disk fills up later, JAX would warn for every program, which does not help a user.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    jax = sys.modules.get("jax")
    for name, value in settings.items():
        if name not in os.environ:
            os.environ[name] = str(value)
            if jax is not None:
                jax.config.update(name.lower(), value)


def _user_cache() -> Path:
    """Find the cache folder of the user's programs."""
    home = Path.home()
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"])
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    return home / ".cache"


def _processor() -> str:
    """Name the processor by its instruction set, for which code is compiled."""
    features = [platform.machine(), platform.processor()]
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(errors="replace").splitlines()
        features += sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    return hashlib.sha256("\n".join(features).encode()).hexdigest()[:12]


def _writable(folder: Path) -> bool:
    """Test whether files can be created in a folder, which is created if necessary."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"\0" * 4096)
    except (OSError, RuntimeError):  # RuntimeError: no home folder
        return False
    return True
