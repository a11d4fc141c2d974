"""The model library of protocol 5, built once per arm with the machine's own C compiler."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from pathlib import Path

from sim.fci.model_source import model_source
from sim.truth import Truth

COMPILERS = ("cc", "gcc", "clang")
OPTIONS = ("-O2", "-shared", "-fPIC", "-x", "c", "-", "-lm")
TIMEOUT_S = 60.0


def model_library(truth: Truth) -> bytes | None:
    """The library's bytes; None without a C compiler, or where it does not build for x64 Linux."""
    compiler = next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None or (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        return None
    source = model_source(truth)
    key = hashlib.sha256("\n".join((compiler, *OPTIONS, source)).encode()).hexdigest()
    folder = _cache_folder()
    kept = folder / f"{key}.so"
    if not kept.is_file():
        with tempfile.TemporaryDirectory(dir=folder) as work:
            built = Path(work) / "model.so"
            try:
                subprocess.run(
                    [compiler, *OPTIONS, "-o", str(built)],
                    input=source.encode(),
                    capture_output=True,
                    timeout=TIMEOUT_S,
                    check=True,
                )
            except (OSError, subprocess.SubprocessError):
                return None
            built.replace(kept)
    return kept.read_bytes()


def _cache_folder() -> Path:
    """A folder of this user alone: what is in it will be run by clients."""
    folder = Path(tempfile.gettempdir()) / f"simulated-fci-models-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    facts = folder.lstat()
    if folder.is_symlink() or facts.st_uid != os.getuid() or facts.st_mode & 0o077:
        return Path(tempfile.mkdtemp(prefix="simulated-fci-models-"))
    return folder
