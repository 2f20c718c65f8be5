"""Cache of compiled programs in the user's folder, so that the next command need not compile them again.

Commands call `use_compile_cache` before they begin (`i2t.cli.exit_codes.exit_code_of`); a program that imports i2t may
do so too. `I2T_COMPILE_CACHE` says otherwise: `off` keeps nothing, and a path names another folder. Whoever sets JAX's
own `JAX_COMPILATION_CACHE_DIR` is left alone. The folder is bounded in size, the least recently used goes first, and it
is named after the processor, because home folders are shared between machines and compiled code is not. A folder that
cannot be written to, or a full disk, costs nothing but the time to compile. JAX itself is not imported here.
"""

import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
import warnings
from pathlib import Path

VARIABLE = "I2T_COMPILE_CACHE"
OFF_VALUES = ("off", "0", "no", "false")
MAX_CACHE_BYTES = 2**28  # of the folder, for each kind of processor; JAX goes through it whenever it keeps a program
MIN_COMPILE_S = 0.02  # what is compiled sooner is not worth a file
JAX_FOLDER = "JAX_COMPILATION_CACHE_DIR"


def use_compile_cache() -> Path | None:
    """Let JAX cache compiled programs from here on, in this process and in those that it starts.

    Returns:
        The folder; None where nothing is kept: it was switched off, cannot be written to, or is set for JAX already.

    Example:
        i2t.use_compile_cache()
    """
    asked = os.environ.get(VARIABLE, "")
    if asked.lower() in OFF_VALUES or os.environ.get(JAX_FOLDER):
        return None
    if importlib.util.find_spec("filelock") is None:  # without which JAX does not bound a folder
        return None
    folder = (Path(asked).expanduser() if asked else _user_cache() / "i2t" / "compiled") / _processor()
    if not _writable(folder):
        if asked:
            print(f"warning: {VARIABLE} {asked}: is no folder to write to; nothing compiled is kept", file=sys.stderr)
        return None
    _configure(folder)
    return folder


def _configure(folder: Path) -> None:
    """Configure JAX, imported already or not, except where its user has set something else."""
    settings = {
        JAX_FOLDER: str(folder),
        "JAX_COMPILATION_CACHE_MAX_SIZE": MAX_CACHE_BYTES,
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": MIN_COMPILE_S,
    }
    # A disk may fill up later: then JAX warns at every program, of which no user can make anything.
    warnings.filterwarnings("ignore", message="Error (reading|writing) persistent compilation cache entry")
    jax = sys.modules.get("jax")
    for name, value in settings.items():
        if name not in os.environ:
            os.environ[name] = str(value)
            if jax is not None:
                jax.config.update(name.lower(), value)


def _user_cache() -> Path:
    """Cache folder of a user's programs."""
    home = Path.home()
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"])
    if sys.platform == "darwin":
        return home / "Library" / "Caches"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    return home / ".cache"


def _processor() -> str:
    """Name of the processor by its instruction set, for which compiled code is made."""
    known = [platform.machine(), platform.processor()]
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text(errors="replace").splitlines()
        known += sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    return hashlib.sha256("\n".join(known).encode()).hexdigest()[:12]


def _writable(folder: Path) -> bool:
    """Test whether files can be made in a folder, which is made if need be."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"\0" * 4096)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return False
    return True
