"""What is cached of a kernel holds those it calls, and is made anew when any of them changes."""

import os
import subprocess
import sys
from pathlib import Path

import adapter

RUN = """
import numba
import adapter.physics.kernels as kernels
from sneaked.outer import outer
print(outer(1.0), sum(outer.stats.cache_hits.values()))
"""
INNER = "from adapter.physics.kernels import jit\n\n\n@jit\ndef inner(x):\n    return x + {}\n"
OUTER = (
    "from adapter.physics.kernels import jit\nfrom sneaked.inner import inner\n\n\n"
    "@jit\ndef outer(x):\n    return inner(x)\n"
)


def answers(place: Path) -> list[str]:
    environment = {**os.environ, "PYTHONPATH": str(place)}
    environment.pop("NUMBA_CACHE_DIR", None)
    return subprocess.run(
        [sys.executable, "-c", RUN], env=environment, cwd=place, capture_output=True, text=True
    ).stdout.split()


def test_a_kernel_follows_those_it_calls(tmp_path: Path) -> None:
    """The package beside them is a small one of the same make: only `kernels` is the real one."""
    physics, sneaked = tmp_path / "adapter" / "physics", tmp_path / "sneaked"
    for folder in (physics, sneaked, tmp_path / "adapter" / "model"):
        folder.mkdir(parents=True)
    own = Path(adapter.__file__).parent
    for file in ("physics/kernels.py", "model/spatial.py", "model/__init__.py"):
        (tmp_path / "adapter" / file).write_bytes((own / file).read_bytes())
    for package in (tmp_path / "adapter", physics, sneaked):
        (package / "__init__.py").touch()
    inner = tmp_path / "adapter" / "inner.py"  # a file of the package, that another one calls
    outer = OUTER.replace("sneaked.inner", "adapter.inner")
    (sneaked / "outer.py").write_text(outer)
    inner.write_text(INNER.format("1.0"))
    assert answers(tmp_path) == ["2.0", "0"]
    assert answers(tmp_path) == ["2.0", "1"]
    inner.write_text(INNER.format("2.0"))
    assert answers(tmp_path) == ["3.0", "0"]
