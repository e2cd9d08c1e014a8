"""Where the command line keeps what JAX has compiled, so that a process need not compile what an earlier one did."""

import hashlib
import os
import platform
import warnings
from pathlib import Path

import jax

from bayespbrl.studies.machine import processor_lines

VARIABLE = "JAX_COMPILATION_CACHE_DIR"  # JAX's own; it holds where it is set
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


def _processor() -> str:
    """The kind of processor, with its instruction set where the system reports one."""
    known = sorted({line for line in processor_lines() if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join([platform.machine(), *known]).encode()).hexdigest()[:16]
