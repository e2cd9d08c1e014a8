"""Where the command line keeps what JAX has compiled, so that a process need not compile what an earlier one did."""

import hashlib
import os
import platform
import warnings
from pathlib import Path

import jax

from bayespbrl.studies.machine import processor_lines

VARIABLE = "JAX_COMPILATION_CACHE_DIR"  # JAX's own; it holds where it is set
# The least seconds of compilation for which JAX keeps a function. A run compiles some twenty in less than the default.
LEAST_SECONDS = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
HARMLESS = tuple(f"Error {doing} persistent compilation cache entry" for doing in ("reading", "writing"))


def keep_compiled() -> None:
    """Keep compiled functions in the user's cache folder, for this process and those that it starts.

    What is compiled for one processor may fail on another, and several may share a home: each kind has a folder.
    """
    # an entry that was cut short is compiled again, and one that the disk has no room for the next time
    warnings.filterwarnings("ignore", message=f"({'|'.join(HARMLESS)})")
    os.environ.setdefault("PYTHONWARNINGS", ",".join(f"ignore:{message}" for message in HARMLESS))
    if VARIABLE in os.environ:
        return
    try:
        home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        folder = Path(home) / "bayespbrl" / f"jax-{jax.__version__}-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):  # no home, or one that cannot be written to
        return
    os.environ[VARIABLE] = str(folder)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if LEAST_SECONDS not in os.environ:
        os.environ[LEAST_SECONDS] = "0"
        jax.config.update(LEAST_SECONDS.lower(), 0.0)


def _processor() -> str:
    """The kind of processor, with its instruction set where the system reports one."""
    known = sorted({line for line in processor_lines() if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join([platform.machine(), *known]).encode()).hexdigest()[:16]
