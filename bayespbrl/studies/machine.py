"""What a study ran on: the machine, what rounds its sums, and the source."""

import platform
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path

from bayespbrl.models.threads import cores


def machine() -> str:
    """The machine in words: processor, cores, Python and JAX."""
    processor = platform.processor() or platform.machine()
    return f"{processor}, {cores()} cores, Python {platform.python_version()}, jax {version('jax')}"


def rounding() -> dict[str, str]:
    """What decides how sums are rounded: the processor, and the versions of the numerical libraries.

    Where all is the same a trial gives the same numbers; elsewhere its first iterations do, until rounding shows.
    """
    known = {name.strip(): text.strip() for name, _, text in (line.partition(":") for line in processor_lines())}
    names = ("vendor_id", "cpu family", "model", "CPU implementer", "CPU part")  # two vocabularies: x86 and ARM
    kind = [platform.machine(), *(f"{name} {known[name]}" for name in names if name in known)]
    kind += sorted({"avx2", "avx512f"} & set(known.get("flags", "").split()))
    return {"processor": ", ".join(kind)} | {name: version(name) for name in ("casadi", "jaxlib", "numpy", "scipy")}


def processor_lines() -> list[str]:
    """What the system reports of each core, a line for each fact; empty where it reports nothing."""
    try:
        return Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return []


def source_digest() -> str:
    """The first ten digits of the SHA-256 digest of the package's Python files: which source a study ran with."""
    digest = sha256()
    root = Path(__file__).parents[1]
    for path in sorted(root.rglob("*.py"), key=lambda path: path.relative_to(root).as_posix()):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:10]
